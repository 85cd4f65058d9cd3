"""Which cells of a window of the world a camera sees through."""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

_TOLERANCE = 1e-6
"""Voxels. A centre this little above a face of the grid counts as below it, as where voxels are covered: in a grid half
a voxel off the lattice roofs would else be taken for the air above them."""


@kernel
@no_type_check
def see_through(origin, cell, T_cam_world, K, depth, margin, start, stop, out):
    """Set to 1 the cells whose centre lies nearer than the depth of its pixel by at least `margin`, metres.

    Cell (i, j, k) of `out` covers origin + [i, i + 1) cell and so on; planes start..stop of i are done. Pixels at 0 or
    not finite say nothing.
    """
    h, w = depth.shape
    dx, dy, dz = T_cam_world[0, 2] * cell, T_cam_world[1, 2] * cell, T_cam_world[2, 2] * cell
    for i in range(start, stop):
        px = origin[0] + (i + 0.5) * cell
        for j in range(out.shape[1]):
            py, pz = origin[1] + (j + 0.5) * cell, origin[2] + 0.5 * cell
            x = T_cam_world[0, 0] * px + T_cam_world[0, 1] * py + T_cam_world[0, 2] * pz + T_cam_world[0, 3]
            y = T_cam_world[1, 0] * px + T_cam_world[1, 1] * py + T_cam_world[1, 2] * pz + T_cam_world[1, 3]
            z = T_cam_world[2, 0] * px + T_cam_world[2, 1] * py + T_cam_world[2, 2] * pz + T_cam_world[2, 3]
            for k in range(out.shape[2]):
                a, b, c = x + k * dx, y + k * dy, z + k * dz
                if c <= 0.0 or out[i, j, k]:
                    continue
                v = b / c * K[1, 1] + K[1, 2]
                u = (a * K[0, 0] + b * K[0, 1]) / c + K[0, 2]
                if u > -0.5 and v > -0.5 and u < w - 0.5 and v < h - 0.5:
                    seen = depth[int(v + 0.5), int(u + 0.5)]
                    if seen > c + margin and seen < np.inf:
                        out[i, j, k] = 1


@kernel
@no_type_check
def keep_free(origin, cell, T_grid_world, free, start, stop, out):
    """Set to 0 the cells of planes start..stop whose centre does not lie in a free voxel of a grid.

    T_grid_world takes metres to the lattice of `free`, where voxel i covers [i, i + 1).
    """
    for i in range(start, stop):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                if out[i, j, k]:
                    x, y, z = origin[0] + (i + 0.5) * cell, origin[1] + (j + 0.5) * cell, origin[2] + (k + 0.5) * cell
                    a = int(
                        np.floor(
                            T_grid_world[0, 0] * x
                            + T_grid_world[0, 1] * y
                            + T_grid_world[0, 2] * z
                            + T_grid_world[0, 3]
                            - _TOLERANCE
                        )
                    )
                    b = int(
                        np.floor(
                            T_grid_world[1, 0] * x
                            + T_grid_world[1, 1] * y
                            + T_grid_world[1, 2] * z
                            + T_grid_world[1, 3]
                            - _TOLERANCE
                        )
                    )
                    c = int(
                        np.floor(
                            T_grid_world[2, 0] * x
                            + T_grid_world[2, 1] * y
                            + T_grid_world[2, 2] * z
                            + T_grid_world[2, 3]
                            - _TOLERANCE
                        )
                    )
                    inside = 0 <= a < free.shape[0] and 0 <= b < free.shape[1] and 0 <= c < free.shape[2]
                    if not (inside and free[a, b, c]):
                        out[i, j, k] = 0
