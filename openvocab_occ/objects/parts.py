"""Parts: pieces of a thing that features tell apart, such as cab and box of a truck."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from openvocab_occ.mapping import VoxelMap
from openvocab_occ.mapping.keys import pack
from openvocab_occ.objects import _segments_kernels as kernels
from openvocab_occ.objects.segments import neighbour_pairs
from openvocab_occ.objects.tree import SceneObject

_SCALE = 1.5  # the k of the segmentation: parts of fewer voxels need a sharper edge
_MIN_VOXELS = 6
_MIN_SHARE = 0.06
_APART = 0.2  # distance of mean features below which pieces are one part
MIN_OBJECT = 30
"""Voxels below which a thing is too coarse to show parts."""


def find_parts(item: SceneObject, voxels: VoxelMap) -> list[Int64[np.ndarray, " _"]]:
    """Return positions of the voxels of each part, largest first; none where features show fewer than two.

    The parts of a thing hold all its voxels.
    """
    if len(item.voxels) < MIN_OBJECT:
        return []
    features = np.ascontiguousarray(voxels.features[item.voxels])
    pairs = neighbour_pairs(pack(voxels.keys[item.voxels]))
    weights = np.empty(len(pairs), dtype=np.float32)
    kernels.feature_distances(features, pairs, voxels.contract == "dense", 0, len(pairs), weights)
    least = max(_MIN_VOXELS, round(_MIN_SHARE * len(item.voxels)))
    part = np.empty(len(item.voxels), dtype=np.int64)
    kernels.merge_edges(pairs, weights, np.argsort(weights, kind="stable"), _SCALE, least, part)
    groups = [np.flatnonzero(part == n) for n in np.unique(part)]
    groups = _alike_merged(groups, features, voxels.contract == "dense", least)
    return [item.voxels[g] for g in sorted(groups, key=lambda g: (-len(g), g[0]))] if len(groups) > 1 else []


def _alike_merged(groups: Sequence[np.ndarray], features: np.ndarray, cosine: bool, least: int) -> list[np.ndarray]:
    """Merge the two groups nearest in features until all are apart; crumbs go to the nearest of any distance."""
    groups = list(groups)
    while len(groups) > 1:
        means = np.stack([features[g].mean(axis=0) for g in groups])
        norm = np.linalg.norm(means, axis=1) if cosine else means.sum(axis=1)
        means /= np.maximum(norm, 1e-12)[:, None]
        apart = 1 - means @ means.T if cosine else np.abs(means[:, None] - means[None]).sum(axis=2) / 2
        np.fill_diagonal(apart, np.inf)
        small = [n for n, g in enumerate(groups) if len(g) < least]
        a = min(small, key=lambda n: len(groups[n])) if small else int(apart.min(axis=1).argmin())
        b = int(apart[a].argmin())
        if not small and apart[a, b] >= _APART:
            break
        merged = np.sort(np.concatenate([groups[a], groups[b]]))
        groups = [g for n, g in enumerate(groups) if n not in (a, b)] + [merged]
    return groups
