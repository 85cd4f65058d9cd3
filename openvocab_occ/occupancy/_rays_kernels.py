"""Grid walk after Amanatides & Woo (1987), in lattice units: voxel i covers [i, i + 1) along each axis.

A ray crosses plane k of an axis at t = (k - o) / d, always computed from k and never summed up, so that every t is as
exact as one subtraction and one division allow, and does not depend on the way that led there.
"""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

_BLOCK = 3  # log2 of the voxels along an edge of a block; of 4, 8 and 16, 8 is fastest


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
def mark_blocks(occupied, out):
    """Set to 1 the blocks of 8 x 8 x 8 voxels that hold an occupied one."""
    for x in range(occupied.shape[0]):
        for y in range(occupied.shape[1]):
            for z in range(occupied.shape[2]):
                if occupied[x, y, z]:
                    out[x >> _BLOCK, y >> _BLOCK, z >> _BLOCK] = 1


@kernel
@no_type_check
def _leave_block(i, n, o, d):
    """Return when one axis leaves the block that index i is in."""
    if d == 0.0:
        return np.inf
    low = (i >> _BLOCK) << _BLOCK
    return (min(low + (1 << _BLOCK), n) - o) / d if d > 0.0 else (low - o) / d


@kernel
@no_type_check
def _walk_over_blocks(ox, oy, oz, dx, dy, dz, t_max, blocks, cells):
    """Do as `_walk` does, to the bit, in leaps over empty blocks.

    It pays on large grids: a leap costs as much as five steps or so.
    """
    nx, ny, nz = cells.shape
    t, t_end = _clip(ox, dx, nx, 0.0, t_max)
    t, t_end = _clip(oy, dy, ny, t, t_end)
    t, t_end = _clip(oz, dz, nz, t, t_end)
    while t < t_end:  # also ends when anything is NaN
        x, y, z = _locate(ox, dx, nx, t), _locate(oy, dy, ny, t), _locate(oz, dz, nz, t)
        out = min(_leave_block(x, nx, ox, dx), _leave_block(y, ny, oy, dy), _leave_block(z, nz, oz, dz))
        if blocks[x >> _BLOCK, y >> _BLOCK, z >> _BLOCK]:
            tx, ty, tz = _leave(x, ox, dx), _leave(y, oy, dy), _leave(z, oz, dz)
            while t < out and t < t_end:
                t_next = min(tx, ty, tz)
                if t < t_next and cells[x, y, z]:
                    return t, (x * ny + y) * nz + z
                t = t_next
                if tx == t_next:
                    x += 1 if dx > 0.0 else -1
                    tx = _leave(x, ox, dx)
                elif ty == t_next:
                    y += 1 if dy > 0.0 else -1
                    ty = _leave(y, oy, dy)
                else:
                    z += 1 if dz > 0.0 else -1
                    tz = _leave(z, oz, dz)
        t = out
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
def first_hits_over_blocks(origins, directions, blocks, occupied, t_max, start, stop, out_t, out_voxel):
    """Do as `first_hits`, in leaps over empty blocks."""
    for r in range(start, stop):
        o = 0 if len(origins) == 1 else r
        out_t[r], out_voxel[r] = _walk_over_blocks(
            origins[o, 0], origins[o, 1], origins[o, 2], directions[r, 0], directions[r, 1], directions[r, 2],
            t_max, blocks, occupied,
        )  # fmt: skip


@kernel
@no_type_check
def mark_crossed(origin, ends, start, stop, out):
    """Set to 1 the voxels that the lines from `origin` to ends start..stop are in.

    Threads may share `out`: whoever writes a voxel writes 1.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    for r in range(start, stop):
        _walk(ox, oy, oz, ends[r, 0] - ox, ends[r, 1] - oy, ends[r, 2] - oz, 1.0, True, out)


@kernel
@no_type_check
def _start(o, d, n, t):
    """Return index, step, time of the next crossing and time between crossings of one axis, from t on."""
    i = _locate(o, d, n, t)
    if d == 0.0:
        return i, 0, np.inf, np.inf
    return i, (1 if d > 0.0 else -1), _leave(i, o, d), abs(1.0 / d)


@kernel
@no_type_check
def mark_seen(origin, directions, hits, start, stop, out):
    """Mark what rays start..stop see, up to and with the `hits`-th occupied voxel; NaN directions see nothing.

    `out` is the grid within a border one voxel wide: 4 in the border, 1 where occupied, to which 2 is added where seen.
    Times are summed up here, unlike in the walk: a border makes that safe, and a rounding error is no matter.
    Threads may share `out`: whoever writes a voxel writes the same.
    """
    nx, ny, nz = out.shape[0] - 2, out.shape[1] - 2, out.shape[2] - 2
    cells = out.reshape(-1)
    ox, oy, oz = origin[0], origin[1], origin[2]
    for r in range(start, stop):
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        t, t_end = _clip(ox, dx, nx, 0.0, np.inf)
        t, t_end = _clip(oy, dy, ny, t, t_end)
        t, t_end = _clip(oz, dz, nz, t, t_end)
        if not t < t_end:  # also when anything is NaN
            continue
        x, step_x, tx, wait_x = _start(ox, dx, nx, t)
        y, step_y, ty, wait_y = _start(oy, dy, ny, t)
        z, step_z, tz, wait_z = _start(oz, dz, nz, t)
        at = ((x + 1) * (ny + 2) + y + 1) * (nz + 2) + z + 1
        step_x *= (ny + 2) * (nz + 2)
        step_y *= nz + 2
        left = hits
        while True:
            t_next = min(tx, ty, tz)
            if t < t_next:
                state = cells[at]
                if state > 3:
                    break
                cells[at] = state | 2
                if state & 1:
                    left -= 1
                    if left == 0:
                        break
            elif cells[at] > 3:
                break
            t = t_next
            go_x = tx == t_next
            go_y = (ty == t_next) & ~go_x
            go_z = ~(go_x | go_y)
            at += (step_x if go_x else 0) + (step_y if go_y else 0) + (step_z if go_z else 0)
            tx += wait_x if go_x else 0.0
            ty += wait_y if go_y else 0.0
            tz += wait_z if go_z else 0.0


@kernel
@no_type_check
def mark_reached(origin, candidates, occupied, start, stop, out):
    """Set to 1 the candidate voxels of slices start..stop along x whose centre no other occupied voxel hides."""
    ox, oy, oz = origin[0], origin[1], origin[2]
    ny, nz = occupied.shape[1], occupied.shape[2]
    for x in range(start, stop):
        for y in range(ny):
            for z in range(nz):
                if not candidates[x, y, z] or out[x, y, z]:
                    continue
                _, hit = _walk(ox, oy, oz, x + 0.5 - ox, y + 0.5 - oy, z + 0.5 - oz, 1.0, False, occupied)
                if hit < 0 or hit == (x * ny + y) * nz + z:
                    out[x, y, z] = 1


@kernel
@no_type_check
def centers_in_view(P, origin, width, height, start, stop, out):
    """Tell for voxels of slices start..stop along x whether their centre is on the image of a pinhole camera.

    P takes offsets from the camera, in voxels, to homogeneous pixels whose third number is z-depth.
    """
    for x in range(start, stop):
        for y in range(out.shape[1]):
            for z in range(out.shape[2]):
                a, b, c = x + 0.5 - origin[0], y + 0.5 - origin[1], z + 0.5 - origin[2]
                depth = P[2, 0] * a + P[2, 1] * b + P[2, 2] * c
                u = P[0, 0] * a + P[0, 1] * b + P[0, 2] * c
                v = P[1, 0] * a + P[1, 1] * b + P[1, 2] * c
                out[x, y, z] = (
                    depth > 0.0
                    and -0.5 * depth <= u < (width - 0.5) * depth
                    and -0.5 * depth <= v < (height - 0.5) * depth
                )
