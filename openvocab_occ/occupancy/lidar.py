"""An occupancy grid from LiDAR returns: hit, seen through, or not known."""

import math

import numpy as np
from jaxtyping import Float

from openvocab_occ._jit import in_slices
from openvocab_occ.arrays import ArrayLike, as_floats
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.occupancy._rays_kernels import mark_crossed
from openvocab_occ.occupancy.grid import GEOMETRY_CLASSES, OccupancyGrid

_OCCUPIED, _FREE = range(len(GEOMETRY_CLASSES))
_GRAIN = 512  # rays worth a thread


def grid_from_lidar(
    points: Float[np.ndarray, "n 3"],
    origin: Float[np.ndarray, " 3"],
    spec: GridSpec,
    *,
    T_world_grid: ArrayLike | None = None,
    min_range: float = 0.0,
) -> OccupancyGrid:
    """Make a grid of the classes `occupied` and `free` from one sweep.

    A voxel that holds a return is occupied, whatever passes through it; one that only lines from the sensor to its
    returns pass through (for more than an instant) is free; the rest is not known. The occupied-wins rule is that of
    Occ3D (Tian et al. 2023, algorithm 2).

    Args:
        points: Returns in the frame of the grid, metres. Those outside the grid still clear the way to them.
        origin: The sensor in the same frame; it may lie outside the grid.
        spec: The lattice.
        T_world_grid: Grid frame to world; the two are the same by default.
        min_range: Returns closer to the sensor than this, in metres, are dropped: they lie on the own car.

    Raises:
        DataError: A point or the origin is not finite.
    """
    if not 0.0 <= min_range < math.inf:
        raise ConfigError("min_range is not a range", expected="metres, 0 or more", got=min_range)
    returns = as_floats(points, (None, 3), "LiDAR points")
    sensor = as_floats(origin, (3,), "LiDAR origin")
    if min_range > 0.0:
        returns = returns[np.linalg.norm(returns - sensor, axis=1) >= min_range]
    ends = (returns - np.asarray(spec.origin)) / spec.size
    start = (sensor - np.asarray(spec.origin)) / spec.size
    crossed = np.zeros(spec.shape, dtype=np.uint8)
    in_slices(lambda a, b: mark_crossed(start, ends, a, b, crossed), len(ends), grain=_GRAIN)
    hit = spec.flat(spec.index(returns))
    occupied = np.zeros(spec.num_voxels, dtype=np.bool_)
    occupied[hit[hit >= 0]] = True
    occupied = occupied.reshape(spec.shape)
    return OccupancyGrid(
        labels=np.where(occupied, _OCCUPIED, _FREE).astype(np.uint8),
        spec=spec,
        T_world_grid=np.eye(4) if T_world_grid is None else np.asarray(T_world_grid),
        free_label=_FREE,
        known=occupied | (crossed != 0),
        class_names=GEOMETRY_CLASSES,
    )
