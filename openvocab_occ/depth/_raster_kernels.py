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

# Pixels by which a face reaches over its outline, so that rounding leaves no cracks between neighbours.
_OVERLAP = 1e-6


@kernel
@no_type_check
def raster(faces, M, P, o, near, max_depth, row0, inverse, winner):
    """Keep for each pixel of the rows from row0 on the nearest face: 1 / depth in `inverse`, its number in `winner`.

    P projects (x, y, z) relative to the camera, in voxels, to homogeneous pixels whose third number is z-depth. Faces must
    not come nearer than the z-depth `near`.
    """
    height, width = inverse.shape
    inverse[:] = np.float32(1.0 / max_depth)
    winner[:] = -1
    corner = np.empty((4, 3))
    clipped = np.empty((8, 3))
    px = np.empty(8)
    py = np.empty(8)
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
        if high < near or low >= max_depth:
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
        y0 = max(row0, math.ceil(max(top, -1.0) - _OVERLAP))
        y1 = min(row0 + height - 1, math.floor(min(bottom, 1e8) + _OVERLAP))
        if y0 > y1 or right < -_OVERLAP or left > width - 1 + _OVERLAP or math.ceil(left - _OVERLAP) > right + _OVERLAP:
            continue
        A = M[axis, 0] / h
        B = M[axis, 1] / h
        C = M[axis, 2] / h
        slope = np.float32(A)
        number = np.int32(f)
        for y in range(y0, y1 + 1):
            low = math.inf
            high = -math.inf
            for k in range(m):
                k2 = k + 1 if k + 1 < m else 0
                ya = py[k]
                yb = py[k2]
                if ya > yb:
                    ya, yb = yb, ya
                if ya - _OVERLAP <= y <= yb + _OVERLAP:
                    if yb - ya <= 2 * _OVERLAP:  # level with the scan line
                        low = min(low, px[k], px[k2])
                        high = max(high, px[k], px[k2])
                    else:
                        s = (y - py[k]) / (py[k2] - py[k])
                        s = min(1.0, max(0.0, s))
                        x = px[k] + s * (px[k2] - px[k])
                        low = min(low, x)
                        high = max(high, x)
            x0 = math.ceil(max(low, 0.0) - _OVERLAP)
            x1 = math.floor(min(high, width - 1.0) + _OVERLAP)
            if x0 > x1:
                continue
            start = np.float32(A * x0 + B * y + C)
            row = inverse[y - row0, x0 : x1 + 1]
            ids = winner[y - row0, x0 : x1 + 1]
            for x in range(x1 + 1 - x0):
                value = start + slope * np.float32(x)
                nearer = value > row[x]
                row[x] = value if nearer else row[x]
                ids[x] = number if nearer else ids[x]


@kernel
@no_type_check
def resolve(faces, M, o, shape, max_depth, row0, inverse, winner):
    """Turn 1 / depth into depth and the winning face into its voxel's flat index, in place."""
    height, width = inverse.shape
    Y = shape[1]
    Z = shape[2]
    far = np.float32(max_depth)
    one = np.float32(1.0)
    for y in range(height):
        row = inverse[y]
        ids = winner[y]
        x = 0
        while x < width:
            f = ids[x]
            end = x + 1
            while end < width and ids[end] == f:
                end += 1
            if f < 0:
                for k in range(x, end):
                    row[k] = far
                x = end
                continue
            kind = faces[f, 0]
            axis = kind >> 1
            first = 1 if axis == 0 else 0
            second = 1 if axis == 2 else 2
            stride_a = np.int32(Z if axis == 0 else Y * Z)
            stride_b = np.int32(Z if axis == 2 else 1)
            stride_c = np.int32(Y * Z if axis == 0 else (Z if axis == 1 else 1))
            fixed = np.int32(faces[f, 1] - (kind & 1)) * stride_c
            # cells are counted from the face's corner: its float32 is exact enough over one face
            da = np.float32(M[first, 0])
            db = np.float32(M[second, 0])
            ra = np.float32(M[first, 0] * x + M[first, 1] * (row0 + y) + M[first, 2])
            rb = np.float32(M[second, 0] * x + M[second, 1] * (row0 + y) + M[second, 2])
            oa = np.float32(o[first] - faces[f, 2])
            ob = np.float32(o[second] - faces[f, 4])
            na = np.int32(faces[f, 3] - faces[f, 2] - 1)
            nb = np.int32(faces[f, 5] - faces[f, 4] - 1)
            fixed += np.int32(faces[f, 2]) * stride_a + np.int32(faces[f, 4]) * stride_b
            zero = np.int32(0)
            span = row[x:end]
            out = ids[x:end]
            for k in range(end - x):
                d = one / span[k]
                a = np.int32(oa + d * (ra + da * np.float32(k)))
                b = np.int32(ob + d * (rb + db * np.float32(k)))
                a = min(max(a, zero), na)
                b = min(max(b, zero), nb)
                span[k] = d
                out[k] = fixed + a * stride_a + b * stride_b
            x = end
