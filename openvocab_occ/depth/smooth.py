"""Depth of the surface at which occupancy is as likely as not."""

import numpy as np
from jaxtyping import Float, Float32, Int32

from openvocab_occ._jit import in_slices
from openvocab_occ.depth._smooth_kernels import first_crossings, mark_active
from openvocab_occ.occupancy import OccupancyGrid

_GRAIN = 1024  # rays worth a thread


def trace_surface(
    grid: OccupancyGrid, origin: Float[np.ndarray, " 3"], directions: Float[np.ndarray, "n 3"], max_depth: float
) -> tuple[Float32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Return t and voxel of the first crossing of rays in units of voxels; max_depth and -1 where there is none.

    The field is trilinear between the centres of voxels, and falls to 0 one voxel outside the grid. The voxel is the
    one of the eight around the crossing, of those at 0.5 and above, that adds most to the field there.
    """
    field = np.pad(grid.probability, 1)  # its point (1, 1, 1) is the centre (0.5, 0.5, 0.5) of voxel (0, 0, 0)
    active = np.zeros(tuple(n - 1 for n in field.shape), np.uint8)
    mark_active(field, active)
    t = np.empty(len(directions), np.float32)
    voxel = np.empty(len(directions), np.int32)
    start = origin + 0.5
    in_slices(
        lambda a, b: first_crossings(start, directions, field, active, max_depth, a, b, t, voxel),
        len(directions),
        grain=_GRAIN,
    )
    return t, voxel
