"""What `view.json` says."""

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from openvocab_occ._version import __version__
from openvocab_occ.export.overhead import CEILING, Overhead
from openvocab_occ.export.palette import NOTHING, UNLABELLED, label_colors
from openvocab_occ.export.render import MapView
from openvocab_occ.export.views.lookout import Lookout
from openvocab_occ.export.views.seen import SeenObject, amodal_box, nearest_depth, position_of, visibility
from openvocab_occ.export.views.unknown import to_ego, unknown_of
from openvocab_occ.geometry import Camera, invert
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import SCENE, SceneObject
from openvocab_occ.query.answer import Answer
from openvocab_occ.query.boxes import Boxes
from openvocab_occ.query.relations import Anchor, Viewpoint, related

SCHEMA = "openvocab_occ.view_bundle"
VERSION = 2
MARGIN = (44, 26)
"""Pixels at the left and at the bottom of the picture from above, for the numbers of its grid."""
DEPTH_SCALE = 256  # steps a metre of depth.png
_RELATIONS = ("next to", "in front of", "behind", "left of", "right of")
_RELATED_WITHIN = 15.0  # metres between centres
_MOST_RELATIONS = 40


@dataclass(frozen=True, eq=False)
class Contents:
    """Everything that a bundle tells of one view."""

    scene: SceneMap
    lookout: Lookout
    view: MapView
    overhead: Overhead
    seen: Sequence[SeenObject]
    """Nearest first."""
    marks: dict[int, int]
    """Mark of each marked object, by its id."""
    points: dict[int, tuple[int, int]]
    """The pixel that each marked object is pointed at by, by its id."""
    answer: Answer | None
    max_depth: float
    least_pixels: int

    def to_dict(self, files: dict[str, Any], pictures: dict[str, Any]) -> dict[str, Any]:
        """Return plain values: the content of view.json."""
        scene, lookout = self.scene, self.lookout
        objects = [self._object(one) for one in self.seen]
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "frame": {"name": "world", "axes": "z up", "units": "m", "time": "s", "angles": "radians unless _deg"},
            "ego": {"axes": "x forward, y left, z up", "T_world_ego": numbers(lookout.T_world_ego)},
            "viewpoint": {"name": lookout.name, "method": lookout.method, "reason": lookout.reason,
                          "time": lookout.time},
            "camera": _camera(self.view.camera, lookout.name),
            "bev": self._bev(),
            "files": files,
            "pictures": pictures,
            "legend": self._legend(),
            "objects": objects,
            "relations": self._relations(),
            "query": None if self.answer is None else self._query(self.answer),
            "unknown": {
                **unknown_of(scene, self.view, self.overhead),
                "states": sorted(o["mark"] for o in objects if o["mark"] and o["state"] == "unknown"),
                "unmarked_objects": sum(o["mark"] is None for o in objects),
            },
            "coverage": round(float((self.view.voxel >= 0).mean()), 4),
            "provenance": {
                **asdict(scene.provenance),
                "encoder": scene.encoder.name,
                "encoder_fingerprint": scene.encoder.fingerprint,
                "frames": len(scene.frames),
                "voxels": len(scene.voxels),
                "exported_by": f"openvocab_occ {__version__}",
            },
        }  # fmt: skip

    @cached_property
    def T_ego_world(self) -> Float[np.ndarray, "4 4"]:
        """World to ego."""
        return invert(self.lookout.T_world_ego)

    @cached_property
    def now(self) -> float | None:
        """Time that ages are told against, seconds: that of the lookout, else of the last frame."""
        if self.lookout.time is not None:
            return self.lookout.time
        return max((frame.timestamp for frame in self.scene.frames), default=None)

    def _object(self, seen: SeenObject) -> dict[str, Any]:
        item = seen.object
        center = to_ego(self.T_ego_world, item.center)
        mark = self.marks.get(item.id)
        large = seen.pixels >= self.least_pixels
        hidden = visibility(self.view, item.id, self.max_depth) if large else None
        pixel = self.points.get(item.id)
        point = None if pixel is None else position_of(self.view, pixel)
        timed = item.last_seen > 0 and self.now is not None
        return {
            "mark": mark,
            "instance": seen.instance,
            "id": item.id,
            "label": item.label,
            "score": round(float(item.score), 4),
            "alternatives": [[name, round(float(score), 4)] for name, score in item.names[1:4]],
            "state": item.state,
            "evidence": item.evidence,
            "speed": round(float(item.speed), 2),
            "center_world": numbers(item.center),
            "center_ego": numbers(center),
            "size": numbers(item.box.size),
            "yaw": round(float(item.box.yaw), 4),
            "range_m": round(float(np.hypot(center[0], center[1])), 2),
            "bearing_deg": round(bearing_deg(center), 1),
            "depth_m": round(nearest_depth(self.view, seen), 2) if large else None,
            "bbox_2d": list(seen.box),
            "bbox_amodal": amodal_box(self.view.camera, item),
            "mark_uv": None if pixel is None else list(pixel),
            "point_world": None if point is None else numbers(point),
            "visible_px": seen.pixels,
            "visible_fraction": None if hidden is None else round(hidden.fraction, 3),
            "occluded_by": [] if hidden is None else [self._named(id) for id in hidden.hidden_by],
            "truncated": None if hidden is None else hidden.truncated,
            "last_seen": round(item.last_seen, 3) if timed else None,
            "age_s": round(float(self.now) - item.last_seen, 2) if timed and self.now is not None else None,
            "parent": self._parent(item),
        }

    def _named(self, id: int) -> dict[str, Any]:
        label = self.scene.objects[id].label if id else "what belongs to no object"
        return {"mark": self.marks.get(id), "id": id or None, "label": label}

    def _parent(self, item: SceneObject) -> dict[str, Any] | None:
        if item.parent is None:
            return None
        node = self.scene.objects[item.parent]
        return None if node.level == SCENE else {"id": node.id, "level": node.level, "label": node.label}

    def _relations(self) -> list[dict[str, Any]]:
        """Return how marked things stand to each other, as seen from the ego; of two that say the same only one."""
        items = [self.scene.objects[id] for id in self.marks]
        marks = list(self.marks.values())
        boxes = Boxes.of(items)
        viewer = Viewpoint(self.lookout.T_world_ego[:3, 3].copy(), self.lookout.heading, "ego")
        found: list[tuple[float, int, int, str]] = []
        for at, anchor in enumerate(marks):
            one = Anchor(boxes.take(slice(at, at + 1)))
            near = np.linalg.norm(boxes.center[:, :2] - boxes.center[at, :2], axis=1) <= _RELATED_WITHIN
            for name in _RELATIONS:
                degree = related(name, boxes, one, viewer)
                found += [
                    (float(degree[k]), subject, anchor, name)
                    for k, subject in enumerate(marks)
                    if subject < anchor and near[k] and degree[k] >= 0.5
                ]
        found.sort(key=lambda r: (-r[0], r[1], r[2], _RELATIONS.index(r[3])))
        return [
            {"subject": subject, "relation": name, "object": anchor, "degree": round(degree, 2)}
            for degree, subject, anchor, name in found[:_MOST_RELATIONS]
        ]

    def _legend(self) -> list[dict[str, Any]]:
        """Return the labels that are seen, most pixels first."""
        surface, voxel = self.view.surface, self.view.voxel
        labels = surface.label[voxel[voxel >= 0]]
        counts = np.bincount(labels[labels >= 0], minlength=len(surface.names))
        colors = label_colors(surface.names)
        return [
            {"label": surface.names[label], "rgb": colors[label].tolist(), "visible_px": int(counts[label])}
            for label in np.argsort(-counts, kind="stable")
            if counts[label]
        ]

    def _query(self, answer: Answer) -> dict[str, Any]:
        return {
            "text": answer.text,
            "reading": answer.reading,
            "verdict": answer.verdict,
            "threshold": None if answer.threshold is None else float(answer.threshold),
            "score_kind": answer.score_kind,
            "count": answer.count,
            "unknown_words": list(answer.unknown),
            "notes": list(answer.notes),
            "region_seen": answer.region_seen,
            "hits": [
                {"id": hit.object.id, "mark": self.marks.get(hit.object.id), "label": hit.object.label,
                 "score": round(float(hit.score), 4), "undecided": hit.undecided}
                for hit in answer.hits
            ],
        }  # fmt: skip

    def _bev(self) -> dict[str, Any]:
        extent = self.overhead.extent
        return {
            "axes": "+x (ahead) is up, +y (left) is left",
            "x_range": [-extent.behind, extent.ahead],
            "y_range": [-extent.side, extent.side],
            "metres_per_pixel": round(extent.pixel, 6),
            "margin_left_px": MARGIN[0],
            "grid_m": 10,
            "T_world_bev": numbers(self.overhead.T_world_ego),
            "ceiling_m": CEILING,
        }


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) that every view.json fits."""
    return json.loads((Path(__file__).parent / "view.schema.json").read_text(encoding="utf-8"))


def bearing_deg(in_ego: Float[np.ndarray, " 3"]) -> float:
    """Return the direction of a point of the ego frame, degrees: 0 ahead, positive to the left."""
    return float(np.degrees(np.arctan2(in_ego[1], in_ego[0])))


def file_notes(*, marks: bool, bev: bool, query: bool, crops: Sequence[int]) -> dict[str, Any]:
    """Return what each picture of a bundle is, by its name."""
    files: dict[str, Any] = {
        "view_marked.png": {"kind": "picture", "note": "labels with shaded faces; numbers are the marks of objects"},
        "view_clean.png": {"kind": "picture", "note": "the same without numbers and outlines"},
        "view_rgb.png": {"kind": "colour", "note": "mean colour of each voxel on a pale sky; not a photo"},
        "semantic.png": {"kind": "labels", "nothing": list(NOTHING), "unlabelled": list(UNLABELLED), "exact": True},
        "instance.png": {"kind": "objects", "dtype": "uint16", "nothing": 0, "value": "`instance` of the object"},
        "depth.png": {"kind": "z-depth", "dtype": "uint16", "units": "m", "scale": DEPTH_SCALE, "invalid": 0},
    }
    if not marks:
        del files["view_marked.png"]
    if bev:
        note = "from above, ahead is up and left is left; grid of 10 m; hatched where nobody looked"
        files["bev_marked.png"] = {"kind": "picture from above", "note": note + ("; the same marks" if marks else "")}
    if query:
        note = "objects that answer the query, dark (score 0) to bright (1), on grey"
        files["relevance.png"] = {"kind": "relevance", "note": note}
    for mark in crops:
        files[f"crops/{mark}.png"] = {"kind": "crop", "note": f"mark {mark}, enlarged from view_clean.png"}
    return files


def as_json(content: Any) -> str:
    """Return indented JSON with short lists, such as rows of matrices, on one line."""
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False, default=str)
    return re.sub(r"\[\s+([^][{}\"]+?)\s+\]", lambda row: "[" + re.sub(r"\s+", " ", row[1]) + "]", text) + "\n"


def numbers(values: np.ndarray) -> list[Any]:
    """Return an array as lists, with a micrometre kept."""
    return np.round(np.asarray(values, np.float64), 6).tolist()


def _camera(camera: Camera, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "K": numbers(camera.K),
        "lens": camera.lens,
        "distortion": list(camera.distortion),
        "T_world_cam": numbers(camera.T_world_cam),
        "axes": "x right, y down, z forward",
        "pixel_center": "integer",
    }
