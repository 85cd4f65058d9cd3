"""Rays through an occupancy grid."""

import math
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from jaxtyping import Float, Float32, Int32

from openvocab_occ._jit import in_slices
from openvocab_occ.arrays import as_floats, check_shape
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.geometry import invert, transform
from openvocab_occ.occupancy._rays_kernels import first_hits, first_hits_over_blocks
from openvocab_occ.occupancy.grid import OccupancyGrid
from openvocab_occ.occupancy.tensor_rays import Tensor, TensorHits, cast_tensors

LARGE = 1 << 22
"""Voxels from which on rays leap over empty blocks: two to three times as fast in 1024 x 1024 x 64, not in Occ3D's."""
_GRAIN = 2048  # rays worth a thread: about half a millisecond


@dataclass(frozen=True, eq=False)
class RayHits:
    """Where rays first enter an occupied voxel."""

    distance: Float32[np.ndarray, " n"]
    """Metres along the normalised direction; max_range where there is no hit."""
    voxel: Int32[np.ndarray, " n"]
    """Flat C-order index of the voxel; -1 where there is no hit."""


@overload
def cast_rays(
    grid: OccupancyGrid,
    origins: Float[np.ndarray, "n 3"] | Float[np.ndarray, " 3"],
    directions: Float[np.ndarray, "n 3"],
    max_range: float = ...,
) -> RayHits: ...
@overload
def cast_rays(grid: OccupancyGrid, origins: Tensor, directions: Tensor, max_range: float = ...) -> TensorHits: ...
def cast_rays(
    grid: OccupancyGrid,
    origins: Float[np.ndarray, "n 3"] | Float[np.ndarray, " 3"] | Tensor,
    directions: Float[np.ndarray, "n 3"] | Tensor,
    max_range: float = math.inf,
) -> RayHits | TensorHits:
    """Find the first occupied voxel of each ray, in the world frame.

    A voxel is hit when the ray is in it for some length before `max_range`: touching an edge or a corner, or ending on
    a face, is no hit. A ray that starts in an occupied voxel hits it at distance 0. Voxels include their lower faces:
    a ray that runs within a face between two voxels is in the upper one, and one that starts on a face is in the voxel
    it goes into. Voxels that are not known are transparent.

    Args:
        grid: What to hit.
        origins: Metres; a single one serves all rays.
        directions: Of any length but zero. A direction with a NaN, as lenses give for pixels that see nothing, hits
            nothing. Rays that are torch tensors are cast where they are, on a GPU by Triton, and give tensors.
        max_range: Metres.

    Raises:
        DataError: An origin is not finite, or a direction is zero or infinite.
    """
    if not max_range > 0:
        raise ConfigError("max_range is not a range", expected="metres above 0", got=max_range)
    if isinstance(directions, Tensor) or isinstance(origins, Tensor):
        return _cast_tensors(grid, origins, directions, float(max_range))
    check_shape(directions, (None, 3), "ray directions")
    starts = as_floats(origins, (3,) if np.ndim(origins) == 1 else (len(directions), 3), "ray origins").reshape(-1, 3)
    largest = np.abs(directions.astype(np.float64)).max(axis=1, initial=0.0, keepdims=True)  # NaN stays NaN
    bad = np.flatnonzero((largest == 0.0) | np.isinf(largest))
    if bad.size:
        raise DataError(
            "ray directions are not directions",
            expected="finite and not zero (NaN for no ray)",
            got=f"{bad.size} of {len(directions)}, the first is ray {bad[0]}: {directions[bad[0]].tolist()}",
            fix="drop those rays",
        )
    # scaled before the norm, so that squares of huge or tiny numbers neither overflow nor vanish
    units = directions / largest
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    distance, voxel = trace(grid, starts, units, float(max_range))
    return RayHits(distance, voxel)


def _cast_tensors(grid: OccupancyGrid, origins: Any, directions: Any, max_range: float) -> TensorHits:
    if not (isinstance(origins, Tensor) and isinstance(directions, Tensor)):
        raise DataError("rays are half tensors", expected="origins and directions of one kind", got="one tensor")
    if directions.detach().device.type != "cpu":
        return cast_tensors(grid, origins, directions, max_range)
    hits = cast_rays(grid, origins.detach().double().numpy(), directions.detach().double().numpy(), max_range)
    like = directions.detach().new_tensor
    return TensorHits(like(hits.distance).float(), like(hits.voxel).int())


def trace(
    grid: OccupancyGrid,
    origins: Float[np.ndarray, "n_or_1 3"],
    directions: Float[np.ndarray, "n 3"],
    t_max: float,
) -> tuple[Float32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Return t and voxel of the first hit of origin + t direction, directions taken at the length they have.

    With directions (x, y, 1) of a camera, t is the z-depth. Inputs are not checked; see `cast_rays` for the rules.
    """
    return trace_lattice(grid, *lattice_rays(grid, origins, directions), t_max)


def trace_lattice(
    grid: OccupancyGrid, starts: Float[np.ndarray, "n_or_1 3"], steps: Float[np.ndarray, "n 3"], t_max: float
) -> tuple[Float32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Do as `trace` for rays that are in units of voxels."""
    t = np.empty(len(steps), dtype=np.float32)
    voxel = np.empty(len(steps), dtype=np.int32)
    occupied = grid.occupied
    if grid.spec.num_voxels >= LARGE:
        blocks = grid.blocks

        def work(start: int, stop: int) -> None:
            first_hits_over_blocks(starts, steps, blocks, occupied, t_max, start, stop, t, voxel)
    else:

        def work(start: int, stop: int) -> None:
            first_hits(starts, steps, occupied, t_max, start, stop, t, voxel)

    in_slices(work, len(steps), grain=_GRAIN)
    return t, voxel


def lattice_rays(
    grid: OccupancyGrid, origins: Float[np.ndarray, "m 3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "n 3"]]:
    """Return world rays in units of voxels, where voxel i covers [i, i + 1); t along them stays the same."""
    T_grid_world = invert(grid.T_world_grid)
    starts = (transform(T_grid_world, origins) - np.asarray(grid.spec.origin)) / grid.spec.size
    steps = directions.astype(np.float64) @ T_grid_world[:3, :3].T / grid.spec.size
    return np.ascontiguousarray(starts), np.ascontiguousarray(steps)
