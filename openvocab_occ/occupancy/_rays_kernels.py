"""Grid walk after Amanatides & Woo (1987), in lattice units: voxel i covers [i, i + 1) along each axis.

A ray crosses plane k of an axis at t = (k - o) / d, always computed from k and never summed up, so that every t is as
exact as one subtraction and one division allow, and does not depend on the way that led there.
"""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel


@kernel
@no_type_check
def _clip(o, d, n, t_in, t_out):
    """Cut [t_in, t_out] down to where one axis is inside [0, n]; it comes back empty where it never is."""
    if d == 0.0:
        return (t_in, t_out) if 0.0 <= o < n else (t_in, -1.0)
    a, b = (0.0 - o) / d, (n - o) / d
    return max(t_in, min(a, b)), min(t_out, max(a, b))


@kernel
@no_type_check
def _locate(o, d, n, t):
    """Return the index along one axis that the ray is in from `t` on: t_enter <= t < t_leave."""
    if d == 0.0:
        return int(np.floor(o))
    i = int(min(max(np.floor(o + t * d), 0.0), n - 1.0))  # off by rounding, far from the grid by more
    if d > 0.0:
        while i > 0 and (i - o) / d > t:
            i -= 1
        while i < n - 1 and (i + 1 - o) / d <= t:
            i += 1
    else:
        while i < n - 1 and (i + 1 - o) / d > t:
            i += 1
        while i > 0 and (i - o) / d <= t:
            i -= 1
    return i


@kernel
@no_type_check
def _leave(i, o, d):
    """Return when one axis leaves index i."""
    if d == 0.0:
        return np.inf
    return (i + 1 - o) / d if d > 0.0 else (i - o) / d


@kernel
@no_type_check
def _walk(ox, oy, oz, dx, dy, dz, t_max, marking, cells):
    """Walk from t = 0 to t_max through the voxels that the ray is in for more than an instant.

    When `marking`, set each of them to 1; else stop at the first that is not 0. Returns t and flat index there, or
    t_max and -1.
    """
    nx, ny, nz = cells.shape
    t, t_end = _clip(ox, dx, nx, 0.0, t_max)
    t, t_end = _clip(oy, dy, ny, t, t_end)
    t, t_end = _clip(oz, dz, nz, t, t_end)
    if not t < t_end:  # also when anything is NaN
        return t_max, -1
    x, y, z = _locate(ox, dx, nx, t), _locate(oy, dy, ny, t), _locate(oz, dz, nz, t)
    tx, ty, tz = _leave(x, ox, dx), _leave(y, oy, dy), _leave(z, oz, dz)
    while t < t_end:
        t_next = min(tx, ty, tz)
        if t < t_next:  # false where the ray only touches an edge or a corner
            if marking:
                cells[x, y, z] = 1
            elif cells[x, y, z]:
                return t, (x * ny + y) * nz + z
        t = t_next
        if tx == t_next:
            x += 1 if dx > 0.0 else -1
            if x < 0 or x >= nx:
                break
            tx = _leave(x, ox, dx)
        elif ty == t_next:
            y += 1 if dy > 0.0 else -1
            if y < 0 or y >= ny:
                break
            ty = _leave(y, oy, dy)
        else:
            z += 1 if dz > 0.0 else -1
            if z < 0 or z >= nz:
                break
            tz = _leave(z, oz, dz)
    return t_max, -1


@kernel
@no_type_check
def first_hits(origins, directions, occupied, t_max, start, stop, out_t, out_voxel):
    """Find the first occupied voxel of rays start..stop. One origin may serve all rays; NaN directions hit nothing."""
    for r in range(start, stop):
        o = 0 if len(origins) == 1 else r
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        if np.isnan(dx + dy + dz):
            out_t[r], out_voxel[r] = t_max, -1
            continue
        out_t[r], out_voxel[r] = _walk(origins[o, 0], origins[o, 1], origins[o, 2], dx, dy, dz, t_max, False, occupied)


@kernel
@no_type_check
def mark_crossed(origin, ends, start, stop, out):
    """Set to 1 the voxels that the lines from `origin` to ends start..stop are in.

    Threads may share `out`: whoever writes a voxel writes 1.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    for r in range(start, stop):
        _walk(ox, oy, oz, ends[r, 0] - ox, ends[r, 1] - oy, ends[r, 2] - oz, 1.0, True, out)
