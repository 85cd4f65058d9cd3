"""Which voxels triangles pass through, by area, and which lie inside closed ones. Coordinates are in voxels."""

import math
from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

_LARGE = 30.0  # voxels; larger triangles are rasterised over the grid, smaller ones sampled over themselves


@kernel
@no_type_check
def to_lattice(vertices, rotation, shift, start, stop, out):
    """Put rotation @ vertex + shift into out for vertices start..stop."""
    for i in range(start, stop):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for c in range(3):
            out[i, c] = rotation[c, 0] * x + rotation[c, 1] * y + rotation[c, 2] * z + shift[c]


@kernel
@no_type_check
def touching(v, faces, shape, start, stop, out):
    """Tell of faces start..stop whether their boxes touch the grid."""
    for k in range(start, stop):
        a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
        inside = True
        for d in range(3):
            low, high = min(v[a, d], v[b, d], v[c, d]), max(v[a, d], v[b, d], v[c, d])
            inside = inside and high >= 0 and low < shape[d]
        out[k] = inside


@kernel
@no_type_check
def _give(x, y, z, x0, x1, label, owner, share, weight, area, best, instance):
    """Credit a voxel with some area of a class, and remember who gave most."""
    if x0 <= x < x1 and 0 <= y < area.shape[1] and 0 <= z < area.shape[2]:
        area[x, y, z, label] += share
        gift = share * weight[label]
        if gift > best[x, y, z]:
            best[x, y, z] = gift
            instance[x, y, z] = owner


@kernel
@no_type_check
def _sheet(a, u, w, n, axis, x0, x1, per_voxel, doubled, label, owner, weight, area, best, instance):
    """Sample the part of a large triangle that lies in the grid, on a lattice over the two axes other than `axis`."""
    p, q = (axis + 1) % 3, (axis + 2) % 3
    h = 1.0 / per_voxel
    share = h * h * doubled / abs(n[axis])
    lows, highs = np.empty(2, np.int64), np.empty(2, np.int64)
    for k in range(2):
        d = p if k == 0 else q
        low, high = a[d] + min(0.0, u[d], w[d]), a[d] + max(0.0, u[d], w[d])
        first, last = (x0, x1) if d == 0 else (0, area.shape[d])
        lows[k] = max(first, math.floor(low)) * per_voxel
        highs[k] = min(last, math.floor(high) + 1) * per_voxel
    cell = np.empty(3, np.int64)
    for i in range(lows[0], highs[0]):
        for j in range(lows[1], highs[1]):
            dp, dq = (i + 0.5) * h - a[p], (j + 0.5) * h - a[q]
            l1, l2 = (dp * w[q] - dq * w[p]) / n[axis], (u[p] * dq - u[q] * dp) / n[axis]
            if l1 >= 0 and l2 >= 0 and l1 + l2 <= 1:
                cell[p], cell[q] = i // per_voxel, j // per_voxel
                cell[axis] = math.floor(a[axis] + l1 * u[axis] + l2 * w[axis])
                _give(cell[0], cell[1], cell[2], x0, x1, label, owner, share, weight, area, best, instance)


@kernel
@no_type_check
def _patch(a, u, w, size, per_voxel, x0, x1, label, owner, weight, area, best, instance):
    """Cut a triangle into rows along its longest edge, and rows into samples that give their share of its area."""
    ends, longest, first = np.empty((3, 3)), -1.0, 0
    for d in range(3):
        ends[0, d], ends[1, d], ends[2, d] = a[d], a[d] + u[d], a[d] + w[d]
    for k in range(3):
        length = 0.0
        for d in range(3):
            edge = ends[(k + 1) % 3, d] - ends[k, d]
            length += edge * edge
        if length > longest:
            longest, first = length, k
    longest = math.sqrt(longest)
    p, q, r = ends[first], ends[(first + 1) % 3], ends[(first + 2) % 3]
    rows = max(1, math.ceil(2 * size / longest * per_voxel))
    for j in range(rows):
        h = (j + 0.5) / rows
        count = max(1, math.ceil(longest * (1 - h) * per_voxel))
        share = size * (2 * (rows - j) - 1) / (rows * rows) / count
        for i in range(count):
            s = (i + 0.5) / count * (1 - h)
            x = math.floor(p[0] + s * (q[0] - p[0]) + h * (r[0] - p[0]))
            y = math.floor(p[1] + s * (q[1] - p[1]) + h * (r[1] - p[1]))
            z = math.floor(p[2] + s * (q[2] - p[2]) + h * (r[2] - p[2]))
            _give(x, y, z, x0, x1, label, owner, share, weight, area, best, instance)


@kernel
@no_type_check
def _cross(a, u, w, nz, x0, x1, label, crossings):
    """Count where the upright lines through the middles of voxel columns pass through a triangle, with sign.

    One more layer than there are voxels tells which columns have crossings.
    """
    X0, X1 = a[0] + min(0.0, u[0], w[0]), a[0] + max(0.0, u[0], w[0])
    Y0, Y1 = a[1] + min(0.0, u[1], w[1]), a[1] + max(0.0, u[1], w[1])
    for i in range(max(x0, math.ceil(X0 - 0.51)), min(x1 - 1, math.floor(X1 - 0.49)) + 1):
        for j in range(max(0, math.ceil(Y0 - 0.51)), min(crossings.shape[1] - 1, math.floor(Y1 - 0.49)) + 1):
            dx, dy = i + 0.5003137 - a[0], j + 0.5001713 - a[1]  # off every edge along the axes
            l1, l2 = (dx * w[1] - dy * w[0]) / nz, (u[0] * dy - u[1] * dx) / nz
            if l1 >= 0 and l2 >= 0 and l1 + l2 <= 1:
                z = math.floor(a[2] + l1 * u[2] + l2 * w[2] + 0.5)  # the first cell whose middle is above
                if z < crossings.shape[2] - 1:
                    crossings[i, j, max(z, 0), label] += 1 if nz < 0 else -1
                    crossings[i, j, crossings.shape[2] - 1, 0] = 1


@kernel
@no_type_check
def splat(v, faces, chosen, labels, owners, closed, fill, weight, per_voxel, x0, x1, area, best, instance, crossings):
    """Spread the area of the chosen faces over voxels x0 <= x < x1, and count crossings of closed ones to be filled.

    v: vertices in voxels; labels, owners, closed: class, instance, and whether part of a closed surface, of each face;
    fill: classes whose inside counts; weight: of each class; per_voxel: samples along an edge of a voxel.
    """
    a, u, w, n = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    Y, Z = area.shape[1], area.shape[2]
    for r in range(chosen.shape[0]):
        k = chosen[r]
        low, high = np.inf, -np.inf
        for d in range(3):
            a[d] = v[faces[k, 0], d]
            u[d], w[d] = v[faces[k, 1], d] - a[d], v[faces[k, 2], d] - a[d]
        low, high = a[0] + min(0.0, u[0], w[0]), a[0] + max(0.0, u[0], w[0])
        if high < x0 or low >= x1:
            continue
        n[0], n[1], n[2] = u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]
        doubled = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        if doubled < 2e-9:
            continue
        label, owner = labels[k], owners[k]
        wide = max(high - low, max(0.0, u[1], w[1]) - min(0.0, u[1], w[1]))
        x, y, z = math.floor(low), math.floor(a[1]), math.floor(a[2])
        if wide > _LARGE:
            axis = 0
            for d in range(1, 3):
                if abs(n[d]) > abs(n[axis]):
                    axis = d
            _sheet(a, u, w, n, axis, x0, x1, math.ceil(per_voxel), doubled, label, owner, weight, area, best, instance)
        elif (
            x == math.floor(high) and 0 <= y < Y and 0 <= z < Z
            and y == math.floor(a[1] + min(0.0, u[1], w[1])) and y == math.floor(a[1] + max(0.0, u[1], w[1]))
            and z == math.floor(a[2] + min(0.0, u[2], w[2])) and z == math.floor(a[2] + max(0.0, u[2], w[2]))
        ):  # fmt: skip
            _give(x, y, z, x0, x1, label, owner, doubled / 2, weight, area, best, instance)
        else:
            _patch(a, u, w, doubled / 2, per_voxel, x0, x1, label, owner, weight, area, best, instance)
        if closed[k] and fill[label] and abs(n[2]) > 1e-9:
            _cross(a, u, w, n[2], x0, x1, label, crossings)


@kernel
@no_type_check
def decide(area, best, crossings, fill, weight, least, free, x0, x1, instance, out):
    """Label voxels x0 <= x < x1: the class of the largest weighted area; inside closed things theirs; else free.

    A column whose crossings of a class do not cancel is not filled. `instance` is cleared where it is free, and set
    inside things to that of the voxel below. `area`, `best` and `crossings` are zero again afterwards, which is cheaper
    than to clear all of them before.
    """
    Y, Z, C = area.shape[1], area.shape[2], area.shape[3]
    inside, leaks = np.zeros(C, np.int64), np.zeros(C, np.bool_)
    last = np.zeros(C, np.int32)
    for x in range(x0, x1):
        for y in range(Y):
            crossed = crossings[x, y, Z, 0] != 0
            if crossed:
                inside[:] = 0
                last[:] = 0
                for z in range(Z):
                    for c in range(C):
                        inside[c] += crossings[x, y, z, c]
                for c in range(C):
                    leaks[c] = inside[c] != 0
                inside[:] = 0
            for z in range(Z):
                top, surface = free, False
                if best[x, y, z] > 0:
                    most, total = 0.0, 0.0
                    for c in range(C):
                        total += area[x, y, z, c]
                        if area[x, y, z, c] * weight[c] > most:
                            most, top = area[x, y, z, c] * weight[c], c
                        area[x, y, z, c] = 0
                    best[x, y, z] = 0
                    if total < least:
                        top = free
                    surface = top != free
                if crossed:
                    for c in range(C):
                        inside[c] += crossings[x, y, z, c]
                        if fill[c] and inside[c] > 0 and not leaks[c] and (top == free or weight[top] < 0.2):
                            top, surface = c, False
                out[x, y, z] = top
                if top == free:
                    instance[x, y, z] = 0
                elif surface:
                    last[top] = instance[x, y, z]
                else:
                    instance[x, y, z] = last[top]
            if crossed:
                crossings[x, y] = 0
