"""Depth images of an occupancy grid (LMPOcc, section III-E)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from jaxtyping import Float, Float32, Int32

from openvocab_occ._jit import in_slices
from openvocab_occ.depth._sampling_kernels import first_samples
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.occupancy.rays import lattice_rays, trace

_GRAIN = 2048  # rays worth a thread


@dataclass(frozen=True, eq=False)
class DepthImage:
    """What a camera sees of a grid."""

    depth: Float32[np.ndarray, "h w"]
    """z-depth in metres; max_depth where nothing is seen."""
    voxel: Int32[np.ndarray, "h w"]
    """Flat C-order index of the voxel that is seen; -1 where there is none."""


@overload
def render_depth(
    grid: OccupancyGrid, camera: Camera, *, max_depth: float = ..., step: float | None = ...
) -> DepthImage: ...
@overload
def render_depth(
    grid: OccupancyGrid, camera: Sequence[Camera], *, max_depth: float = ..., step: float | None = ...
) -> list[DepthImage]: ...
def render_depth(
    grid: OccupancyGrid, camera: Camera | Sequence[Camera], *, max_depth: float = 100.0, step: float | None = None
) -> DepthImage | list[DepthImage]:
    """Render the z-depth of the first occupied voxel in each pixel; several cameras give a list.

    The ray of a pixel runs from the camera's position through the pixel's centre, forward only. Voxels that are not
    known are transparent, and pixels without a ray (beyond a distorted lens) see nothing.

    Args:
        grid: What is seen.
        camera: From where; inside, outside or beside the grid.
        max_depth: Metres. An exact entry counts when it lies before it, a sample when i step <= max_depth in float64.
        step: None for the exact depth at which the ray enters the voxel (0 when the camera is inside it), by the rules
            of `cast_rays`. Else the paper's sampling (Eq. 5-9): the smallest i step, i = 1, 2, ..., whose point lies in
            an occupied voxel. It is late by up to one step, and misses corners thinner than that.
    """
    _check_length(max_depth, "max_depth")
    if step is not None:
        _check_length(step, "step")
    if isinstance(camera, Camera):
        return _render(grid, camera, float(max_depth), step)
    return [_render(grid, one, float(max_depth), step) for one in camera]


def _check_length(value: float, name: str) -> None:
    if not 0.0 < value < math.inf:
        raise ConfigError(f"{name} is not a length", expected="metres above 0", got=value)


def _render(grid: OccupancyGrid, camera: Camera, max_depth: float, step: float | None) -> DepthImage:
    size = (camera.height, camera.width)
    rays = camera.rays().reshape(-1, 3) @ camera.T_world_cam[:3, :3].T  # (h*w, 3), of z-depth 1
    if step is None:
        depth, voxel = trace(grid, camera.position[None], rays, max_depth)
    else:
        depth, voxel = _sample(grid, camera.position, rays, max_depth, float(step))
    return DepthImage(depth.reshape(size), voxel.reshape(size))


def _sample(
    grid: OccupancyGrid,
    position: Float[np.ndarray, " 3"],
    rays: Float[np.ndarray, "n 3"],
    max_depth: float,
    step: float,
) -> tuple[Float32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    origins, directions = lattice_rays(grid, position[None], rays)
    occupied, count = grid.occupied, num_samples(max_depth, step)
    depth = np.empty(len(rays), dtype=np.float32)
    voxel = np.empty(len(rays), dtype=np.int32)
    in_slices(
        lambda start, stop: first_samples(origins[0], directions, occupied, step, count, start, stop, depth, voxel),
        len(rays),
        grain=_GRAIN,
    )
    depth[voxel < 0] = max_depth
    return depth, voxel


def num_samples(max_depth: float, step: float) -> int:
    """Return the largest i with i step <= max_depth, as float64 sees it (1000 samples of 0.1 m in 100 m)."""
    count = int(max_depth / step)
    while (count + 1) * step <= max_depth:
        count += 1
    while count * step > max_depth:
        count -= 1
    return count
