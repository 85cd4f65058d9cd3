"""The samples of LMPOcc Eq. 5-9 along a ray, without taking those that cannot be in another voxel than the last."""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

_ROUNDING = 1e-14  # relative to |o| + n: far above what o + t d, or the time of a crossing, is ever off by


@kernel
@no_type_check
def _clip(o, d, n, slack, t_in, t_out):
    """Cut [t_in, t_out] down to where samples may round to a point inside [0, n) of one axis."""
    if d == 0.0:
        return (t_in, t_out) if -slack <= o <= n + slack else (t_in, -1.0)
    a, b = (-slack - o) / d, (n + slack - o) / d
    return max(t_in, min(a, b)), min(t_out, max(a, b))


@kernel
@no_type_check
def _leaving(o, d, slack):
    """Return a and b such that no sample up to t = a + b i leaves index i of one axis, by motion or by rounding."""
    if abs(d) < 1e-300:
        return np.inf, 0.0
    return ((1.0 - slack - o) / d if d > 0.0 else (slack - o) / d), 1.0 / d


@kernel
@no_type_check
def _first_sample(ox, oy, oz, dx, dy, dz, occupied, step, count, begin):
    """Return t and flat index of the first sample in an occupied voxel, or NaN and -1; none is before t = `begin`."""
    nx, ny, nz = occupied.shape
    if np.isnan(dx + dy + dz):
        return np.nan, -1
    slack_x, slack_y, slack_z = _ROUNDING * (abs(ox) + nx), _ROUNDING * (abs(oy) + ny), _ROUNDING * (abs(oz) + nz)
    per_step = (1.0 - 1e-12) / step  # rounds down, so that a leap never skips the first sample outside
    t_in, t_out = _clip(ox, dx, nx, slack_x, begin, count * step)
    t_in, t_out = _clip(oy, dy, ny, slack_y, t_in, t_out)
    t_in, t_out = _clip(oz, dz, nz, slack_z, t_in, t_out)
    if not t_in <= t_out:
        return np.nan, -1
    ax, bx = _leaving(ox, dx, slack_x)
    ay, by = _leaving(oy, dy, slack_y)
    az, bz = _leaving(oz, dz, slack_z)
    i = max(int(t_in / step), 1)
    last = min(int(t_out / step) + 1, count)
    while i <= last:
        t = i * step
        px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
        if not (0.0 <= px < nx and 0.0 <= py < ny and 0.0 <= pz < nz):
            i += 1
            continue
        x, y, z = int(px), int(py), int(pz)
        if occupied[x, y, z]:
            return t, (x * ny + y) * nz + z
        leaps = min(ax + bx * x, ay + by * y, az + bz * z, t_out) * per_step
        i = max(i, int(leaps)) + 1
    return np.nan, -1


@kernel
@no_type_check
def first_samples(origin, directions, occupied, step, count, start, stop, out_t, out_voxel):
    """Find the smallest i of 1..count whose sample origin + i step direction is in an occupied voxel; else t = NaN.

    Takes a sample, then leaps over those that are surely in the same voxel. NaN directions hit nothing.
    """
    for r in range(start, stop):
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        out_t[r], out_voxel[r] = _first_sample(origin[0], origin[1], origin[2], dx, dy, dz, occupied, step, count, 0.0)


@kernel
@no_type_check
def _at(x, y, z, occupied):
    """Return the flat index of the occupied voxel at a point, or -1."""
    nx, ny, nz = occupied.shape
    if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz) or not occupied[int(x), int(y), int(z)]:
        return -1
    return (int(x) * ny + int(y)) * nz + int(z)


@kernel
@no_type_check
def samples_from_entry(lens, R, origin, occupied, step, count, start, stop, depth, voxel):
    """Turn exact depth, in place, into that of samples, for rows start..stop of a pinhole image (see `PixelRays`).

    `depth` holds where each ray enters its first voxel, within float32, and `voxel` is -1 where it enters none.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    for row in range(start, stop):
        y = (row - lens[4]) / lens[3]
        for u in range(depth.shape[1]):
            if voxel[row, u] < 0:
                continue
            x = ((u - lens[2]) - lens[1] * y) / lens[0]
            dx = (R[0, 0] * x + R[0, 1] * y) + R[0, 2]
            dy = (R[1, 0] * x + R[1, 1] * y) + R[1, 2]
            dz = (R[2, 0] * x + R[2, 1] * y) + R[2, 2]
            begin = depth[row, u] * (1.0 - 1e-6)
            i = max(int(begin / step), 1)
            t = i * step
            hit = _at(ox + t * dx, oy + t * dy, oz + t * dz, occupied)
            if hit < 0:  # almost always the next one: the first after the entry
                i += 1
                t = i * step
                hit = _at(ox + t * dx, oy + t * dy, oz + t * dz, occupied)
            if hit >= 0 and i <= count:
                depth[row, u], voxel[row, u] = t, hit
            else:
                depth[row, u], voxel[row, u] = _first_sample(ox, oy, oz, dx, dy, dz, occupied, step, count, begin)
