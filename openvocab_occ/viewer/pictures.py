"""Pictures beside the map: what a camera saw, and what the map says that it sees."""

from typing import Literal, get_args

import numpy as np
from jaxtyping import Float32, UInt8

from openvocab_occ.datasets.frame import Frame, View
from openvocab_occ.depth.render import render_depth
from openvocab_occ.export.draw import SKY, paint
from openvocab_occ.export.palette import paint_labels, paint_numbers
from openvocab_occ.export.render import MapView, render_map
from openvocab_occ.geometry import Camera, transform
from openvocab_occ.objects.scene_map import NamedCamera
from openvocab_occ.objects.tree import SceneObject, Sighting
from openvocab_occ.viewer.content import Content

PictureKind = Literal["image", "depth", "semantics", "depth error"]
PICTURE_KINDS: tuple[str, ...] = get_args(PictureKind)
MAX_DEPTH = 60.0
"""Metres that depth colours run to."""
MAX_ERROR = 2.0
"""Metres that colours of depth errors run to."""
_CROPS = 3
_CROP_HEIGHT = 120
_STRIP_WIDTH = 560  # at most
_PAD = 0.15  # of a crop's size, around it


def camera_picture(
    content: Content, frame_index: int, camera: NamedCamera, kind: str, width: int
) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return what a camera of a keyframe saw, or what the map says that it sees; None where the source is missing.

    `image` needs the frames. `depth` and `semantics` are drawn from the map. `depth error` is how far the map's depth
    is from that of `measured_depth`; grey where there is none.
    """
    small = camera.resized(width, max(round(camera.height * width / camera.width), 1))
    frame = content.frame(frame_index) if kind in ("image", "depth error") else None
    view = None if frame is None else next((view for view in frame.views if view.name == camera.name), None)
    if kind == "image":
        return None if view is None else _resized(view.image, small.width, small.height)
    if kind == "depth error" and (frame is None or view is None):
        return None
    seen = render_map(content.scene, small, MAX_DEPTH)
    if kind == "depth":
        image = paint_numbers(seen.depth.reshape(-1).astype(np.float64), 0.0, MAX_DEPTH, "viridis")
        image = image.reshape(*seen.depth.shape, 3)
        image[seen.voxel < 0] = SKY
        return image
    if kind == "semantics":
        semantics = content.semantics
        return paint(seen, paint_labels(semantics.labels, semantics.names), SKY)
    assert frame is not None and view is not None, "told above"  # noqa: PT018
    return _depth_error(seen, measured_depth(frame, view, small))


def measured_depth(frame: Frame, view: View, camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Return the z-depth that a frame gives each pixel of a smaller camera, 0 where it gives none.

    From the view's own depth, else from LiDAR returns, else from the occupancy grid of the frame.
    """
    depth = np.zeros((camera.height, camera.width), np.float32)
    if view.depth is not None:
        v = (np.arange(camera.height) + 0.5) * view.depth.shape[0] / camera.height
        u = (np.arange(camera.width) + 0.5) * view.depth.shape[1] / camera.width
        return view.depth[v.astype(int)[:, None], u.astype(int)[None]]
    if frame.points is None:
        if frame.occupancy is None:
            return depth
        own = render_depth(frame.occupancy, camera, max_depth=MAX_DEPTH)
        return np.where(own.voxel >= 0, own.depth, np.float32(0))
    pixels, z = camera.project(transform(frame.T_world_ego, frame.points.astype(np.float64)))
    good = np.flatnonzero((z > 0.5) & camera.inside(pixels))
    good = good[np.argsort(-z[good], kind="stable")]  # the nearest is written last
    u, v = np.floor(pixels[good] + 0.5).astype(int).T
    depth[np.clip(v, 0, camera.height - 1), np.clip(u, 0, camera.width - 1)] = z[good]
    return depth


def best_views(content: Content, item: SceneObject) -> tuple[UInt8[np.ndarray, "h w 3"] | None, str]:
    """Return the best sightings of an object side by side, and a note; drawn from the map where images are missing."""
    if not item.views:
        return None, ""
    crops, drawn = [], False
    for sighting in item.views[:_CROPS]:
        crop = _photo(content, sighting)
        if crop is None:
            crop, drawn = _drawn(content, sighting), True
        if crop is not None and min(crop.shape[:2]) >= 2:
            height, width = crop.shape[:2]
            crops.append(_resized(crop, max(int(width * _CROP_HEIGHT / height), 8), _CROP_HEIGHT))
    if not crops:
        return None, ""
    gap = np.full((_CROP_HEIGHT, 4, 3), 255, np.uint8)
    strip = np.concatenate([part for crop in crops for part in (crop, gap)][:-1], axis=1)
    if strip.shape[1] > _STRIP_WIDTH:
        strip = _resized(strip, _STRIP_WIDTH, max(int(_CROP_HEIGHT * _STRIP_WIDTH / strip.shape[1]), 1))
    where = ", ".join(f"{view.view} of frame {view.frame}" for view in item.views[: len(crops)])
    return np.ascontiguousarray(strip), f"{'drawn from the map, as ' if drawn else ''}{where}"


def _photo(content: Content, sighting: Sighting) -> UInt8[np.ndarray, "h w 3"] | None:
    frame = content.frame(sighting.frame)
    view = None if frame is None else next((view for view in frame.views if view.name == sighting.view), None)
    return None if view is None else _cut(view.image, sighting.box)


def _drawn(content: Content, sighting: Sighting) -> UInt8[np.ndarray, "h w 3"] | None:
    keyframe = next((frame for frame in content.scene.frames if frame.index == sighting.frame), None)
    cameras = () if keyframe is None else keyframe.cameras
    camera = next((camera for camera in cameras if camera.name == sighting.view), None)
    if camera is None:
        return None
    left, top, right, bottom = _padded(sighting.box, camera.width, camera.height)
    seen = render_map(content.scene, camera.cropped(left, top, right - left, bottom - top), MAX_DEPTH)
    return paint(seen, content.scene.voxels.colors, SKY)


def _cut(image: UInt8[np.ndarray, "h w 3"], box: tuple[int, int, int, int]) -> UInt8[np.ndarray, "a b 3"]:
    left, top, right, bottom = _padded(box, image.shape[1], image.shape[0])
    return image[top:bottom, left:right]


def _padded(box: tuple[int, int, int, int], width: int, height: int) -> tuple[int, int, int, int]:
    left, top, right, bottom = box
    pad = int(_PAD * max(right - left, bottom - top)) + 2
    return max(left - pad, 0), max(top - pad, 0), min(right + 1 + pad, width), min(bottom + 1 + pad, height)


def _depth_error(seen: MapView, measured: Float32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    image = np.full((*measured.shape, 3), 225, np.uint8)
    there = (measured > 0) & (seen.voxel >= 0)
    error = np.abs(seen.depth[there] - measured[there]).astype(np.float64)
    image[there] = paint_numbers(error, 0.0, MAX_ERROR, "plasma")
    return image


def _resized(image: UInt8[np.ndarray, "h w 3"], width: int, height: int) -> UInt8[np.ndarray, "a b 3"]:
    import cv2

    shrinks = width < image.shape[1]
    size = (max(width, 1), max(height, 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST), np.uint8)
