"""Kernels of the window: map voxels to a local grid and back, and the merge of records.

Lattice units: voxel i covers [i, i + 1). An affine map is [3, 4], its last column the shift. A centre within a
millionth of a voxel of a face counts as above it, so that rounding cannot speckle windows that are half a cell off.
"""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

_SNAP = 1e-6
_SIDE = 64  # cells along a tile, as in schema.TILE: divisions by a constant are shifts


@kernel
@no_type_check
def locate(affine, rows, out):
    """For each voxel (cell, height) of a tile write rows[x, y, z] of the grid voxel its centre lies in, else -1.

    Returns how many were found.
    """
    nx, ny, nz = rows.shape
    found = 0
    for cell in range(out.shape[0]):
        x, y = cell // _SIDE + 0.5, cell % _SIDE + 0.5
        u = affine[0, 0] * x + affine[0, 1] * y + affine[0, 3] + _SNAP
        v = affine[1, 0] * x + affine[1, 1] * y + affine[1, 3] + _SNAP
        w = affine[2, 0] * x + affine[2, 1] * y + affine[2, 3] + _SNAP
        for h in range(out.shape[1]):
            z = h + 0.5
            i = int(np.floor(u + affine[0, 2] * z))
            j = int(np.floor(v + affine[1, 2] * z))
            k = int(np.floor(w + affine[2, 2] * z))
            row = -1
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                row = rows[i, j, k]
            out[cell, h] = row
            found += row >= 0
    return found


@kernel
@no_type_check
def _beats(stamp, writer, payload, old_stamp, old_writer, old_payload):
    """Tell whether (stamp, writer, payload) is greater, in this order; equal records do not beat each other."""
    if stamp != old_stamp:
        return stamp > old_stamp
    if writer != old_writer:
        return writer > old_writer
    for b in range(payload.shape[0]):
        if payload[b] != old_payload[b]:
            return payload[b] > old_payload[b]
    return False


@kernel
@no_type_check
def merge_rows(rows, codes, stamp, writer, force, stamps, writers, payload):
    """Put codes[rows] into a tile where they win, or everywhere if `force`; return how many records changed."""
    changed = 0
    for cell in range(rows.shape[0]):
        for h in range(rows.shape[1]):
            row = rows[cell, h]
            if row < 0:
                continue
            new, old = codes[row], payload[cell, h]
            if force or _beats(stamp, writer, new, stamps[cell, h], writers[cell, h], old):
                stamps[cell, h] = stamp
                writers[cell, h] = writer
                for b in range(new.shape[0]):
                    old[b] = new[b]
                changed += 1
    return changed


@kernel
@no_type_check
def merge_tiles(stamps, writers, payload, out_stamps, out_writers, out_payload):
    """Put the records of one tile into another where they win; return how many changed."""
    changed = 0
    for cell in range(stamps.shape[0]):
        for h in range(stamps.shape[1]):
            new, old = payload[cell, h], out_payload[cell, h]
            if stamps[cell, h] != 0 and _beats(
                stamps[cell, h], writers[cell, h], new, out_stamps[cell, h], out_writers[cell, h], old
            ):
                out_stamps[cell, h] = stamps[cell, h]
                out_writers[cell, h] = writers[cell, h]
                for b in range(new.shape[0]):
                    old[b] = new[b]
                changed += 1
    return changed


@kernel
@no_type_check
def _slot(table, x, y, z, heights):
    """Return slot, cell and height of map voxel (x, y, z) counted from the window's first tile; slot -1 if none."""
    if x < 0 or y < 0 or z < 0:
        return -1, 0, 0
    floor, height = 0, z
    if z >= heights:
        floor = z // heights
        height = z - floor * heights
    i, j = x // _SIDE, y // _SIDE
    if floor >= table.shape[0] or i >= table.shape[1] or j >= table.shape[2]:
        return -1, 0, 0
    return table[floor, i, j], (x % _SIDE) * _SIDE + y % _SIDE, height


@kernel
@no_type_check
def _set(codes, levels, weight, out):
    """Write weight times the logits of a voxel to out; with `levels` they are codes, and centred here."""
    count = out.shape[0]
    if levels.shape[0] == 0:
        for c in range(count):
            out[c] = weight * np.float32(codes[c])
        return
    one = two = three = np.float32(0.0)  # three sums, six classes at a time: each addition waits for the one before
    sixes = count // 6 * 6
    for c in range(0, sixes, 6):
        a, b, d = levels[np.uint8(codes[c])], levels[np.uint8(codes[c + 1])], levels[np.uint8(codes[c + 2])]
        e, f, g = levels[np.uint8(codes[c + 3])], levels[np.uint8(codes[c + 4])], levels[np.uint8(codes[c + 5])]
        out[c], out[c + 1], out[c + 2], out[c + 3], out[c + 4], out[c + 5] = a, b, d, e, f, g
        one += a + e
        two += b + f
        three += d + g
    for c in range(sixes, count):
        out[c] = levels[np.uint8(codes[c])]
        one += out[c]
    mean = (one + two + three) / np.float32(count)
    for c in range(count):
        out[c] -= mean
    if weight != np.float32(1.0):
        for c in range(count):
            out[c] *= weight


@kernel
@no_type_check
def _add(values, slot, cell, h, levels, weight, out):
    """Add weight times the logits of a voxel to out; with `levels` they are codes, and centred here."""
    count = out.shape[0]
    if levels.shape[0] > 0:
        mean = np.float32(0.0)
        for c in range(count):
            mean += levels[np.uint8(values[slot, cell, h, c])]
        mean /= np.float32(count)
        for c in range(count):
            out[c] += weight * (levels[np.uint8(values[slot, cell, h, c])] - mean)
    else:
        for c in range(count):
            out[c] += weight * np.float32(values[slot, cell, h, c])


@kernel
@no_type_check
def _mix(table, values, stamps, levels, fading, u, v, iw, row):
    """Add to row the known ones of the four columns around (u, v), where whole numbers are centres of columns."""
    now, rate = fading
    iu, iv = int(np.floor(u)), int(np.floor(v))
    fu, fv = u - iu, v - iv
    total = 0.0
    for a in range(2):
        for b in range(2):
            share = (fu if a else 1.0 - fu) * (fv if b else 1.0 - fv)
            slot, cell, h = _slot(table, iu + a, iv + b, iw, values.shape[2])
            if share > 0.0 and slot >= 0 and stamps[slot, cell, h] != 0:
                total += share
                if rate > 0.0:
                    share *= np.exp(-rate * max(0.0, now - np.float64(stamps[slot, cell, h])))
                _add(values, slot, cell, h, levels, np.float32(share), row)
    for c in range(row.shape[0]):
        row[c] /= np.float32(total)


@kernel
@no_type_check
def gather(affine, table, values, stamps, levels, fading, bilinear, start, stop, out, out_known):
    """Read slices start..stop of a window: values where the nearest voxel is known, else 0.

    `fading` is (now, rate): a voxel weighs exp(-rate (now - stamp)). With `bilinear` the four columns around are
    mixed in x and y, by those of them that are known.
    """
    heights = values.shape[2]
    now, rate = fading
    _, ny, nz, count = out.shape
    for i in range(start, stop):
        for j in range(ny):
            x, y = i + 0.5, j + 0.5
            u0 = affine[0, 0] * x + affine[0, 1] * y + affine[0, 3] + _SNAP
            v0 = affine[1, 0] * x + affine[1, 1] * y + affine[1, 3] + _SNAP
            w0 = affine[2, 0] * x + affine[2, 1] * y + affine[2, 3] + _SNAP
            column, slot, cell = (-1, -1, -1), -1, 0
            for k in range(nz):
                row = out[i, j, k]
                u, v, w = u0 + affine[0, 2] * (k + 0.5), v0 + affine[1, 2] * (k + 0.5), w0 + affine[2, 2] * (k + 0.5)
                iu, iv, iw = int(np.floor(u)), int(np.floor(v)), int(np.floor(w))
                floor = iw // heights if iw >= heights else 0
                if iu != column[1] or iv != column[2] or floor != column[0]:  # seldom, as poses are nearly upright
                    column = floor, iu, iv
                    slot, cell, _ = _slot(table, iu, iv, floor * heights, heights)
                h = iw - floor * heights
                known = slot >= 0 and h >= 0 and stamps[slot, cell, h] != 0
                out_known[i, j, k] = known
                if known and not bilinear:
                    weight = np.float32(1.0)
                    if rate > 0.0:
                        weight = np.float32(np.exp(-rate * max(0.0, now - np.float64(stamps[slot, cell, h]))))
                    _set(values[slot, cell, h], levels, weight, row)
                    continue
                for c in range(count):
                    row[c] = 0.0
                if known:
                    _mix(table, values, stamps, levels, fading, u - _SNAP - 0.5, v - _SNAP - 0.5, iw, row)
