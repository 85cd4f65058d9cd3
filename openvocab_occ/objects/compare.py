"""Two drives, object by object: what stayed, what appeared, what is gone, and what nobody looked at again."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from openvocab_occ.errors import EncoderMismatchError
from openvocab_occ.mapping import VoxelMap, keys_of
from openvocab_occ.mapping.keys import pack
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tracks import coarse
from openvocab_occ.objects.tree import ObjectTree, SceneObject

_MIN_SHARED = 0.3  # of the coarse cells of the smaller: less is another thing
_MIN_LIKE = 0.5  # cosine of embeddings
_MIN_LOOKED = 0.3  # share of a thing's voxels that must have been looked at to call it gone
_MOVED = 3.0  # metres between middles from which a thing that can move has changed its place


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectDiff:
    """What changed from map a to map b; each list by id."""

    same: tuple[tuple[SceneObject, SceneObject], ...]
    """Seen by both in one place."""
    moved: tuple[tuple[SceneObject, SceneObject], ...]
    """Pairs of `same` of which one moved while observed, or whose middles lie apart."""
    appeared: tuple[SceneObject, ...]
    """In b, where a looked and saw nothing of the kind."""
    gone: tuple[SceneObject, ...]
    """In a, where b looked and saw nothing of the kind."""
    not_observed: tuple[SceneObject, ...]
    """In one of the two, where the other did not look."""


def diff_objects(a: SceneMap, b: SceneMap) -> ObjectDiff:
    """Compare the objects of two maps in one frame and of one encoder.

    Raises EncoderMismatchError for maps of different encoders.
    """
    pairs = match_objects(a, b)
    mine, yours = {i for i, _ in pairs}, {j for _, j in pairs}
    same = tuple((a.objects[i], b.objects[j]) for i, j in sorted(pairs))
    left = [o for o in a.objects if o.id not in mine]
    fresh = [o for o in b.objects if o.id not in yours]
    return ObjectDiff(
        same=same,
        moved=tuple((p, q) for p, q in same if _moved(p, q)),
        appeared=tuple(o for o in fresh if looked_at(o, a.voxels) >= _MIN_LOOKED),
        gone=tuple(o for o in left if looked_at(o, b.voxels) >= _MIN_LOOKED),
        not_observed=tuple(
            o for side, other in ((left, b), (fresh, a)) for o in side if looked_at(o, other.voxels) < _MIN_LOOKED
        ),
    )


def match_objects(a: SceneMap, b: SceneMap) -> list[tuple[int, int]]:
    """Return the ids of objects that are one thing, each used once: by assignment over overlap and likeness."""
    from scipy.optimize import linear_sum_assignment

    if a.encoder.fingerprint != b.encoder.fingerprint:
        raise EncoderMismatchError(
            "objects of maps of different encoders cannot be compared", expected=a.encoder.name, got=b.encoder.name,
            fix="rebuild one of the maps with the other's encoder",
        )  # fmt: skip
    mine, yours = list(a.objects), list(b.objects)
    if not mine or not yours:
        return []
    score = _scores(mine, yours, a.voxels.voxel_size)
    rows, columns = linear_sum_assignment(score, maximize=True)
    return [(mine[r].id, yours[c].id) for r, c in zip(rows, columns, strict=True) if score[r, c] > 0]


def merge_objects(a: SceneMap, b: SceneMap) -> dict[int, int]:
    """Return the id that each node of b's tree gets when merged into a's: a's where they match, else a fresh one."""
    ids = {j: i for i, j in match_objects(a, b)} | {0: 0}
    fresh = max(node.id for node in a.objects.nodes) + 1
    for node in sorted(b.objects.nodes, key=lambda node: node.id):
        if node.id not in ids:
            ids[node.id], fresh = fresh, fresh + 1
    return ids


def merged_tree(a: SceneMap, b: SceneMap, voxels: VoxelMap) -> ObjectTree:
    """Return the tree of both maps over their merged voxels; ids of a stay, objects that both saw become one.

    Of a thing that both saw, voxels and sightings are put together; state, box and evidence are of the later drive.
    """
    ids = merge_objects(a, b)
    nodes = {node.id: _rehung(node, a.voxels, voxels, {}) for node in a.objects.nodes}
    for node in b.objects.nodes:
        if node.id == 0:
            continue
        new = _rehung(node, b.voxels, voxels, ids)
        nodes[new.id] = _both(nodes[new.id], new, voxels) if new.id in nodes else new
    children: dict[int, list[int]] = {id: [] for id in nodes}
    for node in nodes.values():
        if node.parent is not None:
            children[node.parent].append(node.id)
    return ObjectTree(replace(nodes[id], children=tuple(sorted(children[id]))) for id in sorted(nodes))


def looked_at(item: SceneObject, voxels: VoxelMap) -> float:
    """Return which share of an object's voxels another map saw, or saw through."""
    if not len(item.points):
        return 0.0
    keys = keys_of(item.points, voxels.voxel_size)
    return float(((voxels.index(keys) >= 0) | (voxels.free.count(keys) > 0)).mean())


def _scores(mine: Sequence[SceneObject], yours: Sequence[SceneObject], size: float) -> Float64[np.ndarray, "a b"]:
    score = np.zeros((len(mine), len(yours)))
    cells = [[coarse(pack(keys_of(o.points, size))) for o in side] for side in (mine, yours)]
    holders: dict[int, list[int]] = {}
    for column, there in enumerate(cells[1]):
        for cell in there.tolist():
            holders.setdefault(cell, []).append(column)
    for row, here in enumerate(cells[0]):
        counts = np.bincount([c for cell in here.tolist() for c in holders.get(cell, ())], minlength=len(yours))
        for column in np.flatnonzero(counts).tolist():
            shared = counts[column] / min(len(here), len(cells[1][column]))
            p, q = mine[row].embedding, yours[column].embedding
            like = float(p @ q) / max(float(np.linalg.norm(p) * np.linalg.norm(q)), 1e-12)
            if shared >= _MIN_SHARED and like >= _MIN_LIKE:
                score[row, column] = shared + like
    return score


def _moved(p: SceneObject, q: SceneObject) -> bool:
    going = {p.state, q.state} & {"moving", "stopped"}
    far = float(np.linalg.norm(p.center[:2] - q.center[:2])) > _MOVED
    return bool(going) or (far and "parked" in (p.state, q.state))


def _rehung(node: SceneObject, old: VoxelMap, new: VoxelMap, ids: dict[int, int]) -> SceneObject:
    """Return a node with its voxels' places in another map, under its new id."""
    at = new.index(old.keys[node.voxels]) if len(node.voxels) else node.voxels
    parent = None if node.parent is None else ids.get(node.parent, node.parent)
    return replace(node, id=ids.get(node.id, node.id), parent=parent, voxels=np.sort(at[at >= 0]), children=())


def _both(a: SceneObject, b: SceneObject, voxels: VoxelMap) -> SceneObject:
    late, early = (b, a) if b.last_seen >= a.last_seen else (a, b)
    members = np.union1d(a.voxels, b.voxels)
    points = voxels.centers[members].astype(np.float32) if len(members) else late.points
    share = np.array([max(len(a.points), 1), max(len(b.points), 1)], dtype=np.float64)
    embedding = np.average([a.embedding, b.embedding], axis=0, weights=share)
    norm = float(embedding.sum() if voxels.contract == "logits" else np.linalg.norm(embedding))
    return replace(
        late, id=a.id, parent=a.parent, voxels=members, points=points,
        embedding=(embedding / (norm or 1.0)).astype(np.float32), times_seen=a.times_seen + b.times_seen,
        first_seen=early.first_seen, views=late.views or early.views,
    )  # fmt: skip
