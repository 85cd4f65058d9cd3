"""Merge the exposed faces of occupied voxels into rectangles, on bit columns ("binary greedy meshing").

A plane of exposed faces is a bit image: row a holds up to 64 cells b as the bits of one word. The lowest run of set
bits of a row is widened over the following rows while they hold it too, written out, and cleared. Axis and side of a
rectangle are one number, kind = 2 axis + side, side 0 facing down the axis and 1 up.
"""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel


@kernel
@no_type_check
def pack_columns(occupied, columns):
    """Set bit k of columns[i, j, c] where voxel [i, j, 64 c + k] is occupied."""
    X, Y, Z = occupied.shape
    for i in range(X):
        for j in range(Y):
            for c in range(columns.shape[2]):
                word = np.uint64(0)
                for k in range(min(64, Z - 64 * c)):
                    word |= np.uint64(occupied[i, j, 64 * c + k]) << np.uint64(k)
                columns[i, j, c] = word


@kernel
@no_type_check
def _write(out, n, kind, plane, a0, a1, b0, b1):
    if n < out.shape[0]:
        out[n, 0] = kind
        out[n, 1] = plane
        out[n, 2] = a0
        out[n, 3] = a1
        out[n, 4] = b0
        out[n, 5] = b1
    return n + 1


@kernel
@no_type_check
def _merge(rows, kind, plane, shift, out, n):
    """Write the rectangles of one bit image and clear it; cell b of the image is cell shift + b of the plane."""
    one = np.uint64(1)
    full = ~np.uint64(0)
    for a in range(rows.shape[0]):
        word = rows[a]
        while word != 0:
            low = word & (~word + one)
            b0 = 0
            while low != one << np.uint64(b0):
                b0 += 1
            b1 = b0
            while b1 < 64 and (word >> np.uint64(b1)) & one:
                b1 += 1
            run = (full >> np.uint64(64 - (b1 - b0))) << np.uint64(b0)
            a1 = a + 1
            while a1 < rows.shape[0] and rows[a1] & run == run:
                rows[a1] &= ~run
                a1 += 1
            word &= ~run
            n = _write(out, n, kind, plane, a, a1, shift + b0, shift + b1)
    return n


@kernel
@no_type_check
def faces_x(columns, side, out):
    """Rectangles of the faces across x, (a, b) = (y, z); returns how many there are, also beyond the end of `out`."""
    X, Y, C = columns.shape
    rows = np.empty(Y, np.uint64)
    n = 0
    for c in range(C):
        for i in range(X):
            other = i + 1 if side else i - 1
            inner = 0 <= other < X
            for j in range(Y):
                word = columns[i, j, c]
                rows[j] = word & ~columns[other, j, c] if inner else word
            n = _merge(rows, side, i + side, 64 * c, out, n)
    return n


@kernel
@no_type_check
def faces_y(columns, side, out):
    """Rectangles of the faces across y, (a, b) = (x, z)."""
    X, Y, C = columns.shape
    rows = np.empty(X, np.uint64)
    n = 0
    for c in range(C):
        for j in range(Y):
            other = j + 1 if side else j - 1
            inner = 0 <= other < Y
            for i in range(X):
                word = columns[i, j, c]
                rows[i] = word & ~columns[i, other, c] if inner else word
            n = _merge(rows, 2 + side, j + side, 64 * c, out, n)
    return n


@kernel
@no_type_check
def faces_z(columns, depth, side, out):
    """Rectangles of the faces across z, (a, b) = (x, y); `depth` is the number of voxels along z."""
    X, Y, C = columns.shape
    one = np.uint64(1)
    n = 0
    for c in range(C):
        planes = min(64, depth - 64 * c)
        images = np.zeros((planes, (Y + 63) // 64, X), np.uint64)
        for i in range(X):
            for j in range(Y):
                word = columns[i, j, c]
                if word == 0:
                    continue
                if side:
                    beyond = word >> one
                    if c + 1 < C:
                        beyond |= columns[i, j, c + 1] << np.uint64(63)
                else:
                    beyond = word << one
                    if c > 0:
                        beyond |= columns[i, j, c - 1] >> np.uint64(63)
                exposed = word & ~beyond
                bit = one << np.uint64(j % 64)
                k = 0
                while exposed != 0:
                    if exposed & np.uint64(0xFF) == 0:
                        exposed >>= np.uint64(8)
                        k += 8
                        continue
                    if exposed & one:
                        images[k, j // 64, i] |= bit
                    exposed >>= one
                    k += 1
        for k in range(planes):
            for w in range(images.shape[1]):
                n = _merge(images[k, w], 4 + side, 64 * c + k + side, 64 * w, out, n)
    return n
