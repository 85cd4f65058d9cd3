"""Occ3D labels of a keyframe: semantics, instances, and what LiDAR and cameras observe.

`mask_lidar`: voxels that rays of the 32 beams cross before they hit, and those they hit, from where the ego stands at
this keyframe and at four around it (Occ3D accumulates the sweeps of a scene), and those that hold a return of this
sweep; moving things are taken as they stand now. `mask_camera`: `visibility_mask` by `pixel`, every third pixel of six
704 x 256 images, within `mask_lidar`. Both walk the voxels, not the meshes, so that a mask agrees with its labels.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int32

from openvocab_occ._jit import in_slices
from openvocab_occ.geometry import transform
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.occupancy._rays_kernels import mark_crossed
from openvocab_occ.occupancy.rays import lattice_rays, trace

_REACH = 110.0  # m, beyond any corner of the grid
_INTO = 1e-3  # lengths of the direction beyond the entry into the voxel that is hit


@dataclass(frozen=True, eq=False)
class Labels:
    """The truth of a keyframe."""

    grid: OccupancyGrid
    """Semantics; known is `mask_lidar`."""
    instances: Int32[np.ndarray, "x y z"]
    mask_lidar: Bool[np.ndarray, "x y z"]
    mask_camera: Bool[np.ndarray, "x y z"]


def observed(
    grid: OccupancyGrid, origins: Float[np.ndarray, "m 3"], directions: list[Float[np.ndarray, "_ 3"]]
) -> Bool[np.ndarray, "x y z"]:
    """Return the voxels that rays cross or hit; directions are those of each origin, in the world."""
    seen = np.zeros(grid.spec.shape, np.uint8)
    for origin, rays in zip(origins, directions, strict=True):
        t, _ = trace(grid, origin[None], rays, _REACH)
        ends = rays * (t + np.float32(_INTO))[:, None]
        start, steps = lattice_rays(grid, origin[None], ends)
        stops = start[0] + steps
        in_slices(lambda i, j, a=start[0], b=stops: mark_crossed(a, b, i, j, seen), len(stops), grain=2048)
    return seen != 0


def lidar_directions_world(directions: np.ndarray, T_world_lidar: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 3"]:
    """Turn directions of the LiDAR frame into the world."""
    return transform(T_world_lidar, directions) - T_world_lidar[:3, 3]
