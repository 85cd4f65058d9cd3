"""Grouping: neighbouring voxels whose features agree become an object."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Int32, Int64

from openvocab_occ.errors import ConfigError
from openvocab_occ.mapping import NO_LABEL, VoxelMap
from openvocab_occ.objects.box import Box
from openvocab_occ.objects.tree import SCENE, ObjectTree, SceneObject

_FORWARD = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])[14:]
"""Half of the 26 neighbours; the other half are their opposites."""
MIN_VOXELS = 4
MIN_COSINE = 0.85
_PAIRS_AT_ONCE = 1 << 15  # bounds the memory of comparing features


def group_objects(
    voxels: VoxelMap,
    *,
    min_voxels: int = MIN_VOXELS,
    min_cosine: float = MIN_COSINE,
    labels: Sequence[str] = (),
    class_names: Sequence[str] = (),
) -> ObjectTree:
    """Return the tree of objects: connected groups of voxels (26 neighbours) that agree with each other.

    Voxels of a `logits` map agree when the same label is best, those of a `dense` map when their cosine is at least
    `min_cosine`. Groups of fewer than `min_voxels` are left out of the tree; their voxels stay in the map.
    `labels` names the channels of a `logits` map; `class_names` the occupancy classes, by which the objects of a
    `dense` map are called. Ids run from 1 by falling number of voxels, then by the lowest key: the same map gives the
    same ids.
    """
    if min_voxels < 1:
        raise ConfigError("min_voxels is not usable", expected="at least 1", got=min_voxels)
    if not -1 <= min_cosine <= 1:
        raise ConfigError("min_cosine is not usable", expected="-1..1", got=min_cosine)
    if labels and voxels.contract == "logits" and len(labels) != voxels.dim:
        raise ConfigError("labels do not fit the map", expected=f"{voxels.dim} names", got=len(labels))
    names = tuple(labels) if voxels.contract == "logits" else tuple(class_names)
    groups = [g for g in components(voxels, min_cosine) if len(g) >= min_voxels]
    objects = [_object(voxels, members, id, names) for id, members in enumerate(groups, start=1)]
    return ObjectTree([_scene(voxels, len(objects)), *objects])


def components(voxels: VoxelMap, min_cosine: float) -> list[Int64[np.ndarray, " n"]]:
    """Return the positions of the voxels of each connected group, largest group first, then by lowest position."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(voxels)
    if not n:
        return []
    pairs = np.concatenate([pair[:, _agree(voxels, pair, min_cosine)] for pair in neighbours(voxels)], axis=1)
    graph = coo_matrix((np.ones(pairs.shape[1], dtype=bool), (pairs[0], pairs[1])), shape=(n, n))
    _, part = connected_components(graph, directed=False)
    order = np.argsort(part, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(part[order])) + 1)
    return sorted(groups, key=lambda g: (-len(g), g[0]))


def neighbours(voxels: VoxelMap) -> Iterator[Int64[np.ndarray, "2 p"]]:
    """Yield pairs of positions of voxels that touch, each pair once."""
    for offset in _FORWARD:
        there = voxels.index((voxels.keys + offset).astype(np.int32))
        here = np.flatnonzero(there >= 0)
        yield np.stack([here, there[here]])


def _agree(voxels: VoxelMap, pairs: Int64[np.ndarray, "2 p"], min_cosine: float) -> np.ndarray:
    features = voxels.features
    if voxels.contract == "logits":
        best = features.argmax(axis=1)
        return best[pairs[0]] == best[pairs[1]]
    cosine = np.empty(pairs.shape[1], dtype=np.float32)
    for start in range(0, len(cosine), _PAIRS_AT_ONCE):
        a, b = pairs[:, start : start + _PAIRS_AT_ONCE]
        cosine[start : start + _PAIRS_AT_ONCE] = np.einsum("pc,pc->p", features[a], features[b])
    return cosine >= min_cosine


def _object(voxels: VoxelMap, members: Int64[np.ndarray, " n"], id: int, names: Sequence[str]) -> SceneObject:
    embedding = voxels.features[members].mean(axis=0, dtype=np.float64)
    if voxels.contract == "logits":
        best = int(embedding.argmax())
        label, score = (names[best] if names else f"class {best}"), float(embedding[best])
    else:
        embedding /= max(float(np.linalg.norm(embedding)), 1e-12)
        label, score = _majority(voxels.labels[members], names)
    return SceneObject(
        id=id,
        label=label,
        score=score,
        box=Box.around(voxels.keys[members], voxels.voxel_size),
        voxels=members.astype(np.int64),
        points=voxels.centers[members].astype(np.float32),
        embedding=embedding.astype(np.float32),
        parent=0,
    )


def _majority(labels: np.ndarray, names: Sequence[str]) -> tuple[str, float]:
    """Return the commonest occupancy class and its share of the voxels."""
    counts = np.bincount(labels, minlength=NO_LABEL + 1)[: len(names)]
    if not counts.any():
        return "", 0.0
    best = int(counts.argmax())
    return names[best], float(counts[best] / len(labels))


def _scene(voxels: VoxelMap, num_objects: int) -> SceneObject:
    keys: Int32[np.ndarray, "n 3"] = voxels.keys
    lower, upper = (keys.min(axis=0), keys.max(axis=0) + 1) if len(keys) else (np.zeros(3), np.zeros(3))
    middle, size = (lower + upper) / 2 * voxels.voxel_size, (upper - lower) * voxels.voxel_size
    return SceneObject(
        id=0,
        label="scene",
        score=1.0,
        box=Box(middle.astype(np.float64), size.astype(np.float64), 0.0),
        voxels=np.empty(0, dtype=np.int64),
        points=np.empty((0, 3), dtype=np.float32),
        embedding=np.zeros(voxels.dim, dtype=np.float32),
        level=SCENE,
        children=tuple(range(1, num_objects + 1)),
    )
