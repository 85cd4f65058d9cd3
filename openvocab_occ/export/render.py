"""The map as a camera sees it: for each pixel the voxel met, its depth and its object."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64
from numpy.typing import ArrayLike

from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import MapError
from openvocab_occ.geometry import Camera, GridSpec, invert, look_at, transform
from openvocab_occ.mapping.voxel_map import VoxelMap
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.occupancy.grid import GEOMETRY_CLASSES, OccupancyGrid

_OCCUPIED, _FREE = 0, 1  # of GEOMETRY_CLASSES
_RISE = 0.7  # metres up for each metre back, of an overview


@dataclass(frozen=True, eq=False)
class MapView:
    """What each pixel shows."""

    camera: Camera
    depth: Float32[np.ndarray, "h w"]
    """z-depth to the entry into the voxel, metres; `max_depth` where nothing is met."""
    voxel: Int32[np.ndarray, "h w"]
    """Position in the map of the voxel met, -1 where none."""
    item: Int32[np.ndarray, "h w"]
    """Id of its object, 0 where none."""


def render_map(scene: SceneMap, camera: Camera, max_depth: float = 100.0) -> MapView:
    """Cast a ray through each pixel and find the first voxel of the map within `max_depth`."""
    voxels = scene.voxels
    window = _window(voxels, np.flatnonzero(_in_view(voxels, camera, max_depth)))
    if window is None:
        size = (camera.height, camera.width)
        depth = np.full(size, max_depth, np.float32)
        return MapView(camera, depth, np.full(size, -1, np.int32), np.zeros(size, np.int32))
    grid, flat, voxel_at = window
    image = render_depth(grid, camera, max_depth=max_depth)
    hit = image.voxel >= 0
    voxel = np.full(image.voxel.shape, -1, np.int32)
    voxel[hit] = voxel_at[np.searchsorted(flat, image.voxel[hit])]
    owner = np.append(owners(scene), np.int32(0))  # position -1 reads the appended 0
    return MapView(camera, image.depth, voxel, owner[voxel])


def owners(scene: SceneMap) -> Int32[np.ndarray, " n"]:
    """Return for each voxel the id of its object, 0 where none; of several the one with the fewest voxels."""
    owner = np.zeros(len(scene.voxels), np.int32)
    for item in sorted(scene.objects, key=lambda item: -len(item.voxels)):
        owner[item.voxels] = item.id
    return owner


def overview(scene: SceneMap, aspect: float = 16 / 9, fov: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a position and a target, metres, from which all of the map but outliers is seen from behind and above."""
    centers = scene.voxels.centers
    if not len(centers):
        raise MapError("the map has no voxels to look at", fix="map at least one frame with an occupancy grid or depth")
    low, high = np.percentile(centers, (0.5, 99.5), axis=0)
    target = (low + high) / 2
    back = np.array([0.0, 0.0, _RISE]) - heading(scene)
    back /= np.linalg.norm(back)
    corners = np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i, j, k in np.ndindex(2, 2, 2)])
    local = transform(invert(look_at(target + back, target)), corners) - [0.0, 0.0, 1.0]  # z from the target on
    # a camera d behind the target has a corner in view when |x| <= tan (z + d), and likewise for y
    tan = np.tan(fov / 2) * np.array([aspect, 1.0])
    distance = float((np.abs(local[:, :2]) / tan - local[:, 2:]).max())
    return target + back * max(1.05 * distance, 4 * scene.voxels.voxel_size), target


def overview_camera(scene: SceneMap, width: int, height: int, fov: float = 1.0) -> Camera:
    """Return the camera of `overview`; `fov` is its vertical field of view, radians."""
    position, target = overview(scene, width / height, fov)
    return pinhole(width, height, fov, look_at(position, target))


def pinhole(width: int, height: int, fov: float, T_world_cam: ArrayLike) -> Camera:
    """Return a camera with square pixels and its principal point in the middle; `fov` is vertical, radians."""
    focal = height / 2 / np.tan(fov / 2)
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera(K, width, height, np.asarray(T_world_cam))


def heading(scene: SceneMap) -> Float[np.ndarray, " 3"]:
    """Return the level direction in which the ego looked on the whole; x where there is no frame."""
    total = np.zeros(3)
    for frame in scene.frames:
        total += frame.T_world_ego[:3, 0]
    total[2] = 0.0
    length = float(np.linalg.norm(total))
    return total / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])


def _in_view(voxels: VoxelMap, camera: Camera, max_depth: float) -> Bool[np.ndarray, " n"]:
    """Tell which voxels may be met by a ray: those whose bounding sphere touches the pyramid around all rays."""
    local = transform(invert(camera.T_world_cam), voxels.centers)
    radius = voxels.voxel_size * np.sqrt(3) / 2
    rays = camera.rays().reshape(-1, 3)
    rays = rays[np.isfinite(rays[:, 0])]
    if not len(rays):
        return np.zeros(len(local), dtype=bool)
    low, high = rays.min(axis=0), rays.max(axis=0)
    inside = (local[:, 2] > -radius) & (local[:, 2] < max_depth + radius)
    for axis in (0, 1):
        inside &= local[:, axis] - high[axis] * local[:, 2] < radius * np.hypot(1.0, high[axis])
        inside &= low[axis] * local[:, 2] - local[:, axis] < radius * np.hypot(1.0, low[axis])
    return inside


def _window(
    voxels: VoxelMap, chosen: Int64[np.ndarray, " k"]
) -> tuple[OccupancyGrid, Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]] | None:
    """Return a dense grid around voxels of the map, their flat indices in it, ascending, and the voxels in that order.

    None where there are no voxels.
    """
    if not len(chosen):
        return None
    keys = voxels.keys[chosen].astype(np.int64)
    lowest = keys.min(axis=0)
    shape = keys.max(axis=0) - lowest + 1
    # the lattice of the map is where its voxels say it is
    origin = voxels.centers[chosen[0]] + (lowest - keys[0] - 0.5) * voxels.voxel_size
    spec = GridSpec(tuple(origin.tolist()), voxels.voxel_size, tuple(shape.tolist()))
    flat = spec.flat(keys - lowest)
    order = np.argsort(flat)
    labels = np.full(spec.num_voxels, _FREE, np.uint8)
    labels[flat] = _OCCUPIED
    grid = OccupancyGrid(labels.reshape(spec.shape), spec, free_label=_FREE, class_names=GEOMETRY_CLASSES)
    return grid, flat[order], chosen[order]
