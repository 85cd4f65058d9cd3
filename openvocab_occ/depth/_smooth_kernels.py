"""First crossing of p = 0.5 of a trilinear field along rays.

The field has its values at the points of a lattice; between eight of them, in a cell, it is a cubic polynomial along a
ray. Cells none of whose corners reaches 0.5 cannot hold a crossing and are passed by.
"""

import math
from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

_LEVEL = 0.5
_HALVINGS = 48  # of a cell: far below float32


@kernel
@no_type_check
def mark_active(field, out):
    """Set to 1 the cells of which a corner reaches 0.5; cell (i, j, k) lies between points i and i + 1, and so on."""
    for i in range(field.shape[0]):
        for j in range(field.shape[1]):
            for k in range(field.shape[2]):
                if field[i, j, k] >= _LEVEL:
                    out[max(i - 1, 0) : i + 1, max(j - 1, 0) : j + 1, max(k - 1, 0) : k + 1] = 1


@kernel
@no_type_check
def _value(field, x, y, z, a, b, c):
    """Return the field minus 0.5 at (a, b, c), 0..1, in a cell."""
    low = (field[x, y, z] * (1.0 - c) + field[x, y, z + 1] * c) * (1.0 - b) + (
        field[x, y + 1, z] * (1.0 - c) + field[x, y + 1, z + 1] * c
    ) * b
    high = (field[x + 1, y, z] * (1.0 - c) + field[x + 1, y, z + 1] * c) * (1.0 - b) + (
        field[x + 1, y + 1, z] * (1.0 - c) + field[x + 1, y + 1, z + 1] * c
    ) * b
    return low * (1.0 - a) + high * a - _LEVEL


@kernel
@no_type_check
def _along(field, x, y, z, ox, oy, oz, dx, dy, dz, t):
    a = min(max(ox + t * dx - x, 0.0), 1.0)
    b = min(max(oy + t * dy - y, 0.0), 1.0)
    c = min(max(oz + t * dz - z, 0.0), 1.0)
    return _value(field, x, y, z, a, b, c)


@kernel
@no_type_check
def _first_root(field, x, y, z, ox, oy, oz, dx, dy, dz, t0, t1):
    """Return the first t in [t0, t1] at which the field reaches 0.5 in a cell, or NaN.

    The extrema of the cubic cut the interval into pieces on which it rises or falls; the first that ends above
    is halved.
    """
    v0 = _along(field, x, y, z, ox, oy, oz, dx, dy, dz, t0)
    if v0 >= 0.0:
        return t0
    third = (t1 - t0) / 3.0
    v1 = _along(field, x, y, z, ox, oy, oz, dx, dy, dz, t0 + third)
    v2 = _along(field, x, y, z, ox, oy, oz, dx, dy, dz, t1 - third)
    v3 = _along(field, x, y, z, ox, oy, oz, dx, dy, dz, t1)
    # coefficients over s in [0, 1] of v0 + p s + q s^2 + r s^3
    p = (-11.0 * v0 + 18.0 * v1 - 9.0 * v2 + 2.0 * v3) / 2.0
    q = (18.0 * v0 - 45.0 * v1 + 36.0 * v2 - 9.0 * v3) / 2.0
    r = (-9.0 * v0 + 27.0 * v1 - 27.0 * v2 + 9.0 * v3) / 2.0
    first, second = 1.0, 1.0
    root = q * q - 3.0 * p * r
    if root > 0.0:
        w = -(q + math.copysign(math.sqrt(root), q))
        s1 = w / (3.0 * r) if r != 0.0 else 1.0
        s2 = p / w if w != 0.0 else 1.0
        first = s1 if 0.0 < s1 < 1.0 else 1.0
        second = s2 if 0.0 < s2 < 1.0 else 1.0
        if second < first:
            first, second = second, first
    begin = t0
    for s in (first, second, 1.0):
        end = t0 + s * (t1 - t0)
        if _along(field, x, y, z, ox, oy, oz, dx, dy, dz, end) >= 0.0:
            for _ in range(_HALVINGS):
                middle = 0.5 * (begin + end)
                if _along(field, x, y, z, ox, oy, oz, dx, dy, dz, middle) >= 0.0:
                    end = middle
                else:
                    begin = middle
            return end
        begin = end
    return np.nan


@kernel
@no_type_check
def _heaviest(field, x, y, z, a, b, c):
    """Return the flat index, in the lattice without its border, of the corner that makes most of the surface here."""
    best, found = -1.0, -1
    for corner in range(8):
        i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
        value = field[x + i, y + j, z + k]
        weight = value * (a if i else 1.0 - a) * (b if j else 1.0 - b) * (c if k else 1.0 - c)
        if value >= _LEVEL and weight > best:
            best = weight
            found = ((x + i - 1) * (field.shape[1] - 2) + y + j - 1) * (field.shape[2] - 2) + z + k - 1
    return found


@kernel
@no_type_check
def _enter(o, d, n, t):
    """Return index, step and the next crossing of one axis, from t on."""
    i = int(min(max(np.floor(o + t * d), 0.0), n - 1.0))
    if d == 0.0:
        return i, 0, np.inf
    return i, (1 if d > 0.0 else -1), ((i + 1 if d > 0.0 else i) - o) / d


@kernel
@no_type_check
def first_crossings(origin, directions, field, active, t_max, start, stop, out_t, out_voxel):
    """Find for rays start..stop the first t < t_max at which the field is 0.5 or more, else t_max and -1.

    In units of the lattice of the field, whose outermost points are a border of 0; NaN directions hit nothing.
    """
    nx, ny, nz = active.shape
    ox, oy, oz = origin[0], origin[1], origin[2]
    for ray in range(start, stop):
        out_t[ray], out_voxel[ray] = t_max, -1
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        t, t_end = 0.0, t_max
        for o, d, n in ((ox, dx, nx), (oy, dy, ny), (oz, dz, nz)):
            if d == 0.0:
                t_end = t_end if 0.0 <= o < n else -1.0
            else:
                t = max(t, min(-o / d, (n - o) / d))
                t_end = min(t_end, max(-o / d, (n - o) / d))
        if not t < t_end or np.isnan(dx + dy + dz):
            continue
        x, step_x, tx = _enter(ox, dx, nx, t)
        y, step_y, ty = _enter(oy, dy, ny, t)
        z, step_z, tz = _enter(oz, dz, nz, t)
        while t < t_end:
            t_next = min(tx, ty, tz)
            if active[x, y, z]:
                hit = _first_root(field, x, y, z, ox, oy, oz, dx, dy, dz, t, max(t, min(t_next, t_end)))
                if hit < t_max:
                    a, b, c = ox + hit * dx - x, oy + hit * dy - y, oz + hit * dz - z
                    out_t[ray], out_voxel[ray] = hit, _heaviest(field, x, y, z, a, b, c)
                    break
            t = max(t, t_next)
            if tx == t_next:
                x += step_x
                if x < 0 or x >= nx:
                    break
                tx = ((x + 1 if dx > 0.0 else x) - ox) / dx
            elif ty == t_next:
                y += step_y
                if y < 0 or y >= ny:
                    break
                ty = ((y + 1 if dy > 0.0 else y) - oy) / dy
            else:
                z += step_z
                if z < 0 or z >= nz:
                    break
                tz = ((z + 1 if dz > 0.0 else z) - oz) / dz
