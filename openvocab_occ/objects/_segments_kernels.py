"""Neighbours of sorted voxels, how much they differ, and graph-based segmentation by union-find."""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel


@kernel
@no_type_check
def pair_neighbours(packed, steps, out):
    """Write pairs of positions whose packed keys differ by one of `steps` (all above 0); return how many there are.

    `packed` ascends, so each step is one walk with two fingers. `out` has room for every voxel and step.
    """
    n, count = len(packed), 0
    for s in range(len(steps)):
        j = 0
        for i in range(n):
            wanted = packed[i] + steps[s]
            while j < n and packed[j] < wanted:
                j += 1
            if j == n:
                break
            if packed[j] == wanted:
                out[count, 0], out[count, 1] = i, j
                count += 1
    return count


@kernel
@no_type_check
def feature_distances(features, pairs, cosine, start, stop, out):
    """Write 1 - cosine of unit features, or half the sum of absolute differences of distributions."""
    for p in range(start, stop):
        a, b = pairs[p, 0], pairs[p, 1]
        total = 0.0
        if cosine:
            for c in range(features.shape[1]):
                total += features[a, c] * features[b, c]
            out[p] = 1.0 - total
        else:
            for c in range(features.shape[1]):
                total += abs(features[a, c] - features[b, c])
            out[p] = 0.5 * total


@kernel
@no_type_check
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
@no_type_check
def merge_edges(pairs, weights, order, scale, least, out):
    """Merge along edges from light to heavy (Felzenszwalb and Huttenlocher 2004); `out` gets the root of each node.

    Two components merge when the edge is no heavier than the heaviest edge inside either plus scale / its size. A
    second walk merges components of fewer than `least` nodes along their lightest edge.
    """
    n = len(out)
    size = np.ones(n, dtype=np.int64)
    inside = np.zeros(n, dtype=np.float64)
    for i in range(n):
        out[i] = i
    for walk in range(2):
        for e in order:
            a, b = _root(out, pairs[e, 0]), _root(out, pairs[e, 1])
            if a == b:
                continue
            w = weights[e]
            if walk == 0:
                if w > inside[a] + scale / size[a] or w > inside[b] + scale / size[b]:
                    continue
            elif size[a] >= least and size[b] >= least:
                continue
            out[max(a, b)] = min(a, b)
            root = min(a, b)
            size[root] = size[a] + size[b]
            inside[root] = max(w, inside[a], inside[b])
    for i in range(n):
        out[i] = _root(out, i)


@kernel
@no_type_check
def flood(pairs, same, hops, out):
    """Spread component numbers along pairs of one class to nodes that have none (-1), the nearest first.

    A node that two components reach in as many steps goes to the one with the smaller number.
    """
    fresh = out.copy()
    for _ in range(hops):
        changed = False
        for p in range(len(pairs)):
            if same[p]:
                a, b = pairs[p, 0], pairs[p, 1]
                if out[a] >= 0 and out[b] < 0 and (fresh[b] < 0 or out[a] < fresh[b]):
                    fresh[b], changed = out[a], True
                elif out[b] >= 0 and out[a] < 0 and (fresh[a] < 0 or out[b] < fresh[a]):
                    fresh[a], changed = out[b], True
        if not changed:
            break
        out[:] = fresh
