"""Rasterise the exposed faces of a voxel grid into z-depth and voxel ids.

Lengths are in voxels of the grid, per axis. A pixel's ray is M [u, v, 1], which has z-depth 1 at parameter 1. On a face
plane x_axis = plane the parameter t of the hit solves o + t (M [u, v, 1])_axis = plane, so that

    1 / t = (M_axis . [u, v, 1]) / (plane - o)

is affine in the pixel: along a scan line a face is one vector loop, and the greatest 1 / t is the nearest face.
"""

import math
from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

# Pixels around an outline in which a pixel counts as covered, so that no cracks are left between neighbours, and as in
# doubt: far above the rounding of corners, whose part grows with how far off the image they are.
_BAND, _ROUNDING = 1e-6, 1e-11
# Float32 keeps what lies a little beyond the end; `resolve` cuts there.
_BEYOND = 1.0 + 1e-6
_CELL_EDGE = 1e-9  # voxels from the border of a cell of a face within which rounding says which one is hit


@kernel
@no_type_check
def raster(faces, M, P, o, near, max_depth, row0, doubt, inverse, winner):
    """Keep for each pixel of the rows from row0 on the nearest face: 1 / depth in `inverse`, its number in `winner`.

    P projects (x, y, z) relative to the camera, in voxels, to homogeneous pixels whose third number is z-depth. Faces
    must not come nearer than the z-depth `near`. Pixels on the outline of a face go to `doubt`, as flat indices of
    these rows, some of them often; returns how many they are, also beyond the end of `doubt`.
    """
    height, width = inverse.shape
    doubts = 0
    far = max_depth * _BEYOND
    inverse[:] = np.float32(1.0 / far)
    winner[:] = -1
    corner = np.empty((4, 3))
    clipped = np.empty((8, 3))
    px = np.empty(8)
    py = np.empty(8)
    upper = np.empty(8)
    lower = np.empty(8)
    lean = np.empty(8)
    around = np.empty(8)
    for f in range(faces.shape[0]):
        kind = faces[f, 0]
        axis = kind >> 1
        h = faces[f, 1] - o[axis]
        if (h >= 0.0) if kind & 1 else (h <= 0.0):
            continue  # seen from behind
        first = 1 if axis == 0 else 0
        second = 1 if axis == 2 else 2
        a0 = faces[f, 2] - o[first]
        a1 = faces[f, 3] - o[first]
        b0 = faces[f, 4] - o[second]
        b1 = faces[f, 5] - o[second]
        low = math.inf
        high = -math.inf
        for j in range(3):
            base = P[j, axis] * h
            pa0 = P[j, first] * a0
            pa1 = P[j, first] * a1
            pb0 = P[j, second] * b0
            pb1 = P[j, second] * b1
            corner[0, j] = base + pa0 + pb0
            corner[1, j] = base + pa1 + pb0
            corner[2, j] = base + pa1 + pb1
            corner[3, j] = base + pa0 + pb1
        for k in range(4):
            low = min(low, corner[k, 2])
            high = max(high, corner[k, 2])
        if high < near or low > far:
            continue
        m = 4
        if low < near:  # cut at the near plane (Sutherland-Hodgman, one plane)
            m = 0
            for k in range(4):
                k2 = (k + 1) & 3
                za = corner[k, 2]
                zb = corner[k2, 2]
                if za >= near:
                    clipped[m, 0] = corner[k, 0]
                    clipped[m, 1] = corner[k, 1]
                    clipped[m, 2] = za
                    m += 1
                if (za >= near) != (zb >= near):
                    s = (near - za) / (zb - za)
                    clipped[m, 0] = corner[k, 0] + s * (corner[k2, 0] - corner[k, 0])
                    clipped[m, 1] = corner[k, 1] + s * (corner[k2, 1] - corner[k, 1])
                    clipped[m, 2] = near
                    m += 1
        else:
            for k in range(4):
                clipped[k, 0] = corner[k, 0]
                clipped[k, 1] = corner[k, 1]
                clipped[k, 2] = corner[k, 2]
        left = math.inf
        right = -math.inf
        top = math.inf
        bottom = -math.inf
        for k in range(m):
            w = 1.0 / clipped[k, 2]
            px[k] = clipped[k, 0] * w
            py[k] = clipped[k, 1] * w
            left = min(left, px[k])
            right = max(right, px[k])
            top = min(top, py[k])
            bottom = max(bottom, py[k])
        band = _BAND + _ROUNDING * max(max(-left, right), max(-top, bottom))
        if right < -band or left > width - 1 + band or bottom < row0 - band or top > row0 + height - 1 + band:
            continue
        y0 = max(row0, math.ceil(max(top, -1.0) - band))
        y1 = min(row0 + height - 1, math.floor(min(bottom, row0 + height + 1.0) + band))
        if y0 > y1 or math.ceil(max(left, -1.0) - band) > right + band:
            continue
        A = M[axis, 0] / h
        B = M[axis, 1] / h
        C = M[axis, 2] / h
        slope = np.float32(A)
        number = np.int32(f)
        for k in range(m):
            k2 = k + 1 if k + 1 < m else 0
            upper[k] = min(py[k], py[k2])
            lower[k] = max(py[k], py[k2])
            # level with the scan line: all of it is outline
            level = lower[k] - upper[k] <= 4.0 * band
            lean[k] = 0.0 if level else (px[k2] - px[k]) / (py[k2] - py[k])
            around[k] = math.inf if level else band * (1.0 + abs(lean[k]))
        for y in range(y0, y1 + 1):
            low = math.inf
            high = -math.inf
            slack = 0.0
            for k in range(m):
                if upper[k] - band <= y <= lower[k] + band:
                    x = px[k] + (min(max(y, upper[k]), lower[k]) - py[k]) * lean[k]
                    low = min(low, x)
                    high = max(high, x)
                    slack = max(slack, around[k])
            if slack == math.inf:  # the ends of level edges
                for k in range(m):
                    if abs(py[k] - y) <= 5.0 * band:
                        low = min(low, px[k])
                        high = max(high, px[k])
            reach = slack if slack < math.inf else band
            x0 = math.ceil(max(low - reach, 0.0))
            x1 = math.floor(min(high + reach, width - 1.0))
            if x0 > x1:
                continue
            x = x0
            while x <= x1 and x <= low + slack:
                if doubts < doubt.shape[0]:
                    doubt[doubts] = (y - row0) * width + x
                doubts += 1
                x += 1
            end = x1
            while end >= x and end >= high - slack:
                if doubts < doubt.shape[0]:
                    doubt[doubts] = (y - row0) * width + end
                doubts += 1
                end -= 1
            start = np.float32(A * x0 + B * y + C)
            row = inverse[y - row0, x0 : x1 + 1]
            ids = winner[y - row0, x0 : x1 + 1]
            for x in range(x1 + 1 - x0):
                value = start + slope * np.float32(x)
                nearer = value > row[x]
                row[x] = value if nearer else row[x]
                ids[x] = number if nearer else ids[x]
    return doubts


@kernel
@no_type_check
def resolve(faces, lens, R, o, shape, max_depth, row0, doubts, doubt, inverse, winner):
    """Turn 1 / depth into depth and the winning face into its voxel's flat index, in place.

    The depth is taken anew from the face's plane, in float64, by the formula of `PixelRays`. Pixels on the border
    between two voxels of a face are appended to `doubt`, which holds `doubts` already; returns how many it then should
    hold.
    """
    height, width = inverse.shape
    Y = shape[1]
    Z = shape[2]
    far = np.float32(max_depth)
    xs = np.empty(width)
    for row in range(height):
        y = (row0 + row - lens[4]) / lens[3]
        if row == 0 or lens[1] != 0.0:
            for u in range(width):
                xs[u] = ((u - lens[2]) - lens[1] * y) / lens[0]
        depths = inverse[row]
        ids = winner[row]
        begin = 0
        while begin < width:
            f = ids[begin]
            end = begin + 1
            while end < width and ids[end] == f:
                end += 1
            if f < 0:
                depths[begin:end] = far
                begin = end
                continue
            kind = faces[f, 0]
            axis = kind >> 1
            first = 1 if axis == 0 else 0
            second = 1 if axis == 2 else 2
            stride_a = np.int32(Z if axis == 0 else Y * Z)
            stride_b = np.int32(Z if axis == 2 else 1)
            stride_c = np.int32(Y * Z if axis == 0 else (Z if axis == 1 else 1))
            fixed = np.int32(faces[f, 1] - (kind & 1)) * stride_c
            fixed += np.int32(faces[f, 2]) * stride_a + np.int32(faces[f, 4]) * stride_b
            h = faces[f, 1] - o[axis]
            c0, c1y, c2 = R[axis, 0], R[axis, 1] * y, R[axis, 2]
            a0, a1y, a2 = R[first, 0], R[first, 1] * y, R[first, 2]
            b0, b1y, b2 = R[second, 0], R[second, 1] * y, R[second, 2]
            oa = o[first] - faces[f, 2]
            ob = o[second] - faces[f, 4]
            na = np.float64(faces[f, 3] - faces[f, 2] - 1)
            nb = np.float64(faces[f, 5] - faces[f, 4] - 1)
            xx = xs[begin:end]
            span = depths[begin:end]
            out = ids[begin:end]
            tied = False
            for k in range(end - begin):
                x = xx[k]
                d = h / ((c0 * x + c1y) + c2)
                va = (a0 * x + a1y) + a2
                vb = (b0 * x + b1y) + b2
                a = oa + d * va
                b = ob + d * vb
                fa = np.floor(a)
                fb = np.floor(b)
                tied |= (a - fa < _CELL_EDGE) | (b - fb < _CELL_EDGE)
                tied |= (a - fa > 1.0 - _CELL_EDGE) | (b - fb > 1.0 - _CELL_EDGE)
                fa = min(max(fa, 0.0), na)
                fb = min(max(fb, 0.0), nb)
                hit = d < max_depth
                span[k] = np.float32(d) if hit else far
                out[k] = fixed + np.int32(fa) * stride_a + np.int32(fb) * stride_b if hit else np.int32(-1)
            if tied:  # somewhere in this run: rare, so find out where in a loop of its own
                for k in range(end - begin):
                    d = h / ((c0 * xx[k] + c1y) + c2)
                    a = oa + d * ((a0 * xx[k] + a1y) + a2)
                    b = ob + d * ((b0 * xx[k] + b1y) + b2)
                    if min(abs(a - np.rint(a)), abs(b - np.rint(b))) < 2.0 * _CELL_EDGE:
                        if doubts < doubt.shape[0]:
                            doubt[doubts] = row * width + begin + k
                        doubts += 1
            begin = end
    return doubts
