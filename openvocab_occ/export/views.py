"""View bundles: the map as a camera sees it, in pictures and one JSON file that a program or a language model reads."""

import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import openvocab_occ
from openvocab_occ.errors import ConfigError, MapError
from openvocab_occ.export.draw import SKY, draw_view, paint
from openvocab_occ.export.palette import NOTHING, UNLABELLED, label_colors, paint_labels
from openvocab_occ.export.render import MapView, overview_camera, render_map
from openvocab_occ.export.semantics import Semantics, name_voxels
from openvocab_occ.geometry import Camera, invert, transform
from openvocab_occ.io.files import PathLike, written_folder
from openvocab_occ.io.images import write_image
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.query.find import Answer, find

SCHEMA = "openvocab_occ.view_bundle"
VERSION = 1
DEPTH_SCALE = 256  # steps a metre of depth.png
_FARTHEST = 65535 / DEPTH_SCALE
_MARKER = "view.json"
_NAMED_AT_MOST = 65535  # instance.png has 16 bits


@dataclass(frozen=True)
class ViewBundle:
    """A folder with one view of a map."""

    folder: Path
    view: dict[str, Any]
    """What view.json holds."""

    @property
    def paths(self) -> dict[str, Path]:
        """Every file, by its name."""
        return {name: self.folder / name for name in (_MARKER, *self.view["files"])}


def export_views(
    scene: SceneMap,
    out: PathLike,
    *,
    query: Answer | str | None = None,
    viewpoint: Camera | None = None,
    width: int = 1024,
    height: int = 576,
    max_depth: float = 100.0,
) -> ViewBundle:
    """Render the map from one camera into a folder of pictures and `view.json`.

    The folder appears whole or not at all. One that is there already is replaced only if it holds a `view.json`.

    Args:
        scene: The map.
        out: The folder.
        query: An answer, or words for `find`; its hits are marked in view.png and listed in view.json.
        viewpoint: Camera to look from, used as it is. Without one, CAM_FRONT (else the first camera) of the middle
            frame, scaled to fit into width x height; of a map without cameras, an overview of that size.
        width: Pixels.
        height: Pixels.
        max_depth: Metres; what lies farther is not drawn. At most 255, the reach of depth.png.

    Raises:
        ConfigError: `max_depth` or the size cannot be.
        AlreadyExistsError: The folder is there and is no view bundle.
        MapError: The map is empty.
    """
    if not 0 < max_depth <= _FARTHEST:
        raise ConfigError("max_depth does not fit a depth image", expected=f"0 to {_FARTHEST:.0f} m", got=max_depth)
    if width < 16 or height < 16:
        raise ConfigError("picture is too small", expected="at least 16 x 16 pixels", got=f"{width} x {height}")
    if not len(scene.voxels):
        raise MapError("the map has no voxels to render", fix="map at least one frame with an occupancy grid or depth")
    camera, name, T_world_ego = _viewpoint(scene, viewpoint, width, height)
    answer = find(scene, query) if isinstance(query, str) else query
    view, semantics = render_map(scene, camera, max_depth), name_voxels(scene)
    seen = _seen_objects(scene, view)
    pictures = _pictures(scene, view, semantics, seen, answer)
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "version": VERSION,
        "frame": {"name": "world", "axes": "z up", "units": "m"},
        "ego": {"axes": "x forward, y left, z up", "T_world_ego": _numbers(T_world_ego)},
        "camera": _describe_camera(camera, name),
        "files": _FILES,
        "legend": _legend(view, semantics),
        "objects": [_describe(item, view, T_world_ego, mark) for mark, item in enumerate(seen, start=1)],
        "query": None if answer is None else _describe_answer(answer),
        "coverage": round(float((view.voxel >= 0).mean()), 4),
        "provenance": {
            **asdict(scene.provenance),
            "encoder": scene.encoder.name,
            "exported_by": f"openvocab_occ {openvocab_occ.__version__}",
        },
    }
    text = _as_json(content)
    target = Path(out).expanduser()
    with written_folder(target, marker=_MARKER) as folder:
        for file, image in pictures.items():
            write_image(folder / file, image)
        (folder / _MARKER).write_text(text, encoding="utf-8")
    return ViewBundle(target, json.loads(text))


_FILES: dict[str, dict[str, Any]] = {
    "view.png": {"kind": "picture", "note": "labels with shaded faces, outlines and names; hits in colour on grey"},
    "view_rgb.png": {"kind": "colour", "note": "mean colour of each voxel on a pale sky; not a photo"},
    "semantic.png": {"kind": "labels", "nothing": list(NOTHING), "unlabelled": list(UNLABELLED), "exact": True},
    "instance.png": {"kind": "objects", "dtype": "uint16", "nothing": 0, "value": "`instance` of the object"},
    "depth.png": {"kind": "z-depth", "dtype": "uint16", "units": "m", "scale": DEPTH_SCALE, "invalid": 0},
}  # fmt: skip


def _pictures(
    scene: SceneMap, view: MapView, semantics: Semantics, seen: list[SceneObject], answer: Answer | None
) -> dict[str, np.ndarray]:
    colors = paint_labels(semantics.labels, semantics.names)
    marks = np.zeros(max([0, *(item.id for item in seen)]) + 1, np.uint16)
    marks[[item.id for item in seen]] = np.arange(1, len(seen) + 1)
    instance = marks[np.where(view.item < len(marks), view.item, 0)]
    depth = np.where(view.voxel >= 0, np.clip(np.rint(view.depth * DEPTH_SCALE), 1, 65535), 0).astype(np.uint16)
    if answer is None:
        names, hits = {item.id: f"{mark} {item.label}" for mark, item in enumerate(seen, start=1)}, None
    else:
        hits = [hit.object.id for hit in answer.hits]
        names = {item.id: f"{mark} {item.label}" for mark, item in enumerate(seen, start=1) if item.id in set(hits)}
    return {
        "view.png": draw_view(view, scene.voxels, colors, names, hits),
        "view_rgb.png": paint(view, scene.voxels.colors, SKY),
        "semantic.png": paint(view, colors),
        "instance.png": instance,
        "depth.png": depth,
    }


def _viewpoint(
    scene: SceneMap, camera: Camera | None, width: int, height: int
) -> tuple[Camera, str, Float[np.ndarray, "4 4"]]:
    """Return the camera, its name, and the ego pose that positions are given against."""
    if camera is not None:
        return camera, "given", _levelled(camera)
    with_cameras = [frame for frame in scene.frames if frame.cameras]
    if not with_cameras:
        camera = overview_camera(scene, width, height)
        return camera, "overview", _levelled(camera)
    frame = with_cameras[len(with_cameras) // 2]
    found = next((camera for camera in frame.cameras if camera.name == "CAM_FRONT"), frame.cameras[0])
    scale = min(width / found.width, height / found.height)
    camera = found.resized(max(round(found.width * scale), 1), max(round(found.height * scale), 1))
    return camera, found.name, frame.T_world_ego


def _levelled(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """Return the pose at a camera with x forward and level, y left, z up."""
    forward = camera.T_world_cam[:3, 2] * [1.0, 1.0, 0.0]
    if np.linalg.norm(forward) < 1e-6:  # it looks straight up or down: what is up in the picture is forward
        forward = -camera.T_world_cam[:3, 1] * [1.0, 1.0, 0.0]
    forward /= np.linalg.norm(forward)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 3] = forward, [-forward[1], forward[0], 0.0], camera.position
    return T


def _seen_objects(scene: SceneMap, view: MapView) -> list[SceneObject]:
    """Return the objects with at least one pixel, nearest to the camera first."""
    seen = [scene.objects[int(id_)] for id_ in np.unique(view.item) if id_ > 0]
    return sorted(seen, key=lambda item: _range(item, view.camera))[:_NAMED_AT_MOST]


def _range(item: SceneObject, camera: Camera) -> float:
    return float(np.linalg.norm(item.center - camera.position))


def _describe(item: SceneObject, view: MapView, T_world_ego: np.ndarray, mark: int) -> dict[str, Any]:
    in_ego = transform(invert(T_world_ego), np.asarray(item.center, np.float64)[None])[0]
    v, u = np.nonzero(view.item == item.id)
    return {
        "instance": mark,
        "id": item.id,
        "label": item.label,
        "score": round(float(item.score), 4),
        "state": item.state,
        "center_world": _numbers(item.center),
        "center_ego": _numbers(in_ego),
        "size": _numbers(item.box.size),
        "yaw": round(float(item.box.yaw), 4),
        "range_m": round(_range(item, view.camera), 2),
        "bearing_deg": round(float(np.degrees(np.arctan2(in_ego[1], in_ego[0]))), 1),
        "bbox_2d": [int(u.min()), int(v.min()), int(u.max()), int(v.max())],
        "visible_px": len(u),
    }


def _describe_camera(camera: Camera, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "K": _numbers(camera.K),
        "lens": camera.lens,
        "distortion": list(camera.distortion),
        "T_world_cam": _numbers(camera.T_world_cam),
        "axes": "x right, y down, z forward",
        "pixel_center": "integer",
    }


def _describe_answer(answer: Answer) -> dict[str, Any]:
    return {
        "text": answer.text,
        "verdict": answer.verdict,
        "threshold": None if answer.threshold is None else float(answer.threshold),
        "hits": [{"id": hit.object.id, "score": round(float(hit.score), 4)} for hit in answer.hits],
    }


def _legend(view: MapView, semantics: Semantics) -> list[dict[str, Any]]:
    """Return the labels that are seen, most pixels first."""
    labels = semantics.labels[view.voxel[view.voxel >= 0]]
    counts = np.bincount(labels[labels >= 0], minlength=len(semantics.names))
    colors = label_colors(semantics.names)
    return [
        {"label": semantics.names[label], "rgb": colors[label].tolist(), "visible_px": int(counts[label])}
        for label in np.argsort(-counts, kind="stable")
        if counts[label]
    ]


def _as_json(content: dict[str, Any]) -> str:
    """Return indented JSON with short lists, such as rows of matrices, on one line."""
    text = json.dumps(content, indent=1, ensure_ascii=False, default=str)
    return re.sub(r"\[\s+([^][{}\"]+?)\s+\]", lambda row: "[" + re.sub(r"\s+", " ", row[1]) + "]", text) + "\n"


def _numbers(values: np.ndarray) -> list[Any]:
    """Return an array as lists, with a micrometre kept."""
    return np.round(np.asarray(values, np.float64), 6).tolist()
