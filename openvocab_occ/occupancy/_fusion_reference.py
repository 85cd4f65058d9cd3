"""Fusion of scans, voxel by voxel and without any walking: every ray is cut with every voxel."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from openvocab_occ.occupancy._rays_reference import intervals

Scan = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " 3"]]
"""Returns and sensor, in units of voxels."""


def fuse(
    scans: Sequence[Scan], shape: tuple[int, int, int], hit: float, miss: float, bounds: tuple[float, float]
) -> tuple[Float[np.ndarray, "x y z"], Bool[np.ndarray, "x y z"]]:
    """Return log-odds and which voxels were seen. A voxel takes each scan's vote once; a return wins in its scan."""
    odds, seen = np.zeros(shape), np.zeros(shape, dtype=np.bool_)
    for points, origin in scans:
        votes = np.zeros(shape)
        for point in points:
            t_in, t_out = intervals(origin, point - origin, shape, 1.0)
            votes[(t_in < t_out) & (votes == 0)] = miss
        for point in points:
            cell = tuple(np.floor(point).astype(int))
            if all(0 <= i < n for i, n in zip(cell, shape, strict=True)):
                votes[cell] = hit
        odds, seen = np.clip(odds + votes, *bounds), seen | (votes != 0)
    return odds, seen
