"""Which voxels of the map a voxel of a turned grid, or a pixel with depth, is about."""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

_TOLERANCE = 1e-6
"""Voxels. A point this little below a face of the map counts as above it, as in `keys_of`; so a centre of the map this
little above a face of the grid counts as below it, and layers half a voxel off the lattice move up, not both ways."""


@kernel
@no_type_check
def held(index, T_grid_map, T_map_grid, start, stop, out_source, out_keys):
    """Write source and key of every map voxel whose centre one of index[start:stop] holds; return how many.

    Both poses are in voxels: T_grid_map takes map keys to grid indices, where voxel i covers [i, i + 1). A run that
    is out of room in `out` returns -1.
    """
    n = 0
    reach = np.empty(3)  # of the box around a turned voxel, in map voxels
    for a in range(3):
        reach[a] = 0.5 * (abs(T_map_grid[a, 0]) + abs(T_map_grid[a, 1]) + abs(T_map_grid[a, 2])) + 2 * _TOLERANCE
    low, high, key = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3)
    for g in range(start, stop):
        for a in range(3):
            middle = T_map_grid[a, 3]
            for b in range(3):
                middle += T_map_grid[a, b] * (index[g, b] + 0.5)
            low[a], high[a] = int(np.floor(middle - reach[a] - 0.5)), int(np.ceil(middle + reach[a] - 0.5))
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    key[0], key[1], key[2] = i + 0.5, j + 0.5, k + 0.5
                    inside = True
                    for a in range(3):
                        at = T_grid_map[a, 3]
                        for b in range(3):
                            at += T_grid_map[a, b] * key[b]
                        if int(np.floor(at - _TOLERANCE)) != index[g, a]:
                            inside = False
                            break
                    if inside:
                        if n == len(out_source):
                            return -1
                        out_source[n] = g
                        out_keys[n, 0], out_keys[n, 1], out_keys[n, 2] = i, j, k
                        n += 1
    return n


@kernel
@no_type_check
def packed_points(depth, max_depth, K, rays, T, voxel_size, start, stop, out, out_good):
    """Pack the keys of the points of lines start..stop; tell which pixels have one, or return False if out of reach.

    Arithmetic and rounding as in `keys_of` and `pack`. `rays` is empty for a pinhole.
    """
    for v in range(start, stop):
        for u in range(depth.shape[1]):
            z = float(depth[v, u])
            if not (z > 0.0 and z <= max_depth) or np.isinf(z):
                continue
            if rays.shape[0] > 0:
                x, y = float(rays[v, u, 0]), float(rays[v, u, 1])
                if np.isnan(x + y):
                    continue
            else:
                y = (v - K[1, 2]) / K[1, 1]
                x = (u - K[0, 2] - K[0, 1] * y) / K[0, 0]
            i = np.floor((z * (T[0, 0] * x + T[0, 1] * y + T[0, 2]) + T[0, 3]) / voxel_size + _TOLERANCE)
            j = np.floor((z * (T[1, 0] * x + T[1, 1] * y + T[1, 2]) + T[1, 3]) / voxel_size + _TOLERANCE)
            k = np.floor((z * (T[2, 0] * x + T[2, 1] * y + T[2, 2]) + T[2, 3]) / voxel_size + _TOLERANCE)
            if not (abs(i + 0.5) < 8388608.0 and abs(j + 0.5) < 8388608.0 and abs(k + 0.5) < 32768.0):
                return False
            out[v, u] = (np.int64(i) << 40) | ((np.int64(j) + 8388608) << 16) | (np.int64(k) + 32768)
            out_good[v, u] = 1
    return True
