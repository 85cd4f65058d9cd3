"""Which objects a view shows, how much of each, and what hides the rest."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int32, Int64

from openvocab_occ.depth.render import render_depth
from openvocab_occ.export.render import MapView
from openvocab_occ.geometry import Camera, GridSpec
from openvocab_occ.objects.tree import ObjectTree, SceneObject
from openvocab_occ.occupancy.grid import GEOMETRY_CLASSES, OccupancyGrid

_NAMED_AT_MOST = 65535  # instance.png has 16 bits
_HIDES = 0.1  # share of an object's pixels from which on what hides them is told


@dataclass(frozen=True, eq=False)
class SeenObject:
    """An object with at least one pixel."""

    object: SceneObject
    instance: int
    """Its number in instance.png, from 1: nearest first."""
    pixels: int
    box: tuple[int, int, int, int]
    """Left, top, right, bottom pixel that is seen, all inclusive."""


@dataclass(frozen=True)
class Visibility:
    """How much of an object is seen."""

    fraction: float
    """Share of the pixels that it would have in this picture if nothing stood before it."""
    hidden_by: tuple[int, ...]
    """Ids of objects that hide a tenth or more of it, most first; 0 for what belongs to no object."""
    truncated: bool
    """It goes on beyond the picture's border."""


def seen_objects(view: MapView, objects: ObjectTree, origin: Float[np.ndarray, " 3"]) -> list[SeenObject]:
    """Return the objects that a view shows, those whose centre is nearest to `origin` along the ground first."""
    from scipy.ndimage import find_objects

    ids, inverse, counts = np.unique(view.item, return_inverse=True, return_counts=True)
    boxes = find_objects(inverse.reshape(view.item.shape).astype(np.int32) + 1)
    found = []
    for id, count, box in zip(ids, counts, boxes, strict=True):
        if id <= 0 or box is None:
            continue
        v, u = box
        item = objects[int(id)]
        away = float(np.linalg.norm((item.center - origin)[:2]))
        found.append((away, int(id), item, int(count), (u.start, v.start, u.stop - 1, v.stop - 1)))
    found.sort(key=lambda one: one[:2])
    return [
        SeenObject(item, number, count, box)
        for number, (_, _, item, count, box) in enumerate(found[:_NAMED_AT_MOST], start=1)
    ]


def visibility(view: MapView, id: int, max_depth: float) -> Visibility:
    """Render an object alone and compare."""
    surface = view.surface
    rows = surface.rows_by_item[id]
    box, beyond = _frame(view.camera, surface.keys[rows], surface.voxel_size)
    if box is None:
        return Visibility(0.0, (), beyond)
    left, top, right, bottom = box
    camera = view.camera.cropped(left, top, right - left + 1, bottom - top + 1)
    alone = _alone(camera, surface.keys[rows], surface.voxel_size, max_depth)
    there = view.item[top : bottom + 1, left : right + 1]
    own = int(np.count_nonzero(there == id))
    total = int(np.count_nonzero(alone | (there == id)))
    hiding, counts = np.unique(there[alone & (there != id)], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    by = tuple(int(hiding[k]) for k in order if counts[k] >= _HIDES * total)
    return Visibility(own / total if total else 0.0, by, beyond)


def _alone(
    camera: Camera, keys: Int32[np.ndarray, "n 3"], voxel_size: float, max_depth: float
) -> Bool[np.ndarray, "h w"]:
    """Tell which pixels would show some voxels if there were no others."""
    low = keys.min(axis=0).astype(np.int64)
    shape = np.ptp(keys, axis=0).astype(np.int64) + 1
    labels = np.ones(tuple(shape), np.uint8)
    labels[tuple((keys - low).T)] = 0
    spec = GridSpec(tuple((low * voxel_size).tolist()), voxel_size, tuple(shape.tolist()))
    grid = OccupancyGrid(labels, spec, free_label=1, class_names=GEOMETRY_CLASSES)
    return render_depth(grid, camera, max_depth=max_depth).voxel >= 0


def _frame(
    camera: Camera, keys: Int32[np.ndarray, "n 3"], voxel_size: float
) -> tuple[tuple[int, int, int, int] | None, bool]:
    """Return the rectangle of pixels in which voxels can be seen, and whether they go on beyond the picture."""
    whole = (0, 0, camera.width - 1, camera.height - 1)
    low, high = keys.min(axis=0) * voxel_size, (keys.max(axis=0) + 1) * voxel_size
    pixels, depth = camera.project(np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T)
    if (depth < 0.1).any() or not np.isfinite(pixels).all():
        return whole, True
    first, last = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))
    edge = np.array([camera.width - 1, camera.height - 1])
    a, b = np.maximum(first, 0), np.minimum(last, edge)
    beyond = bool((first < -1).any() or (last > edge + 1).any())
    return (None if (a > b).any() else (int(a[0]), int(a[1]), int(b[0]), int(b[1]))), beyond


def amodal_box(camera: Camera, item: SceneObject) -> list[int] | None:
    """Return the pixels that an object's upright box takes up, cut at the picture's border.

    None where there are none, or where it reaches behind the camera.
    """
    pixels, depth = camera.project(item.box.corners)
    if (depth <= 0.05).any() or not np.isfinite(pixels).all():
        return None
    first, last = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))
    a, b = np.maximum(first, 0), np.minimum(last, [camera.width - 1, camera.height - 1])
    return None if (a > b).any() else [int(a[0]), int(a[1]), int(b[0]), int(b[1])]


def position_of(view: MapView, pixel: tuple[int, int]) -> Float[np.ndarray, " 3"]:
    """Return the point of the world that a pixel shows."""
    ray = view.camera.unproject(np.array([pixel], np.float64))[0]
    local = ray * float(view.depth[pixel[1], pixel[0]])
    return view.camera.T_world_cam[:3, :3] @ local + view.camera.position


def nearest_depth(view: MapView, seen: SeenObject) -> float:
    """Return the least z-depth of an object's pixels, metres."""
    left, top, right, bottom = seen.box
    window: Int64[np.ndarray, "h w"] = view.item[top : bottom + 1, left : right + 1].astype(np.int64)
    return float(view.depth[top : bottom + 1, left : right + 1][window == seen.object.id].min())
