"""The tree from scene to parts: regions of ground, groups in them, objects in those, and what objects are made of."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from openvocab_occ.mapping import VoxelMap
from openvocab_occ.objects.box import Box
from openvocab_occ.objects.group import components
from openvocab_occ.objects.groups import find_groups
from openvocab_occ.objects.kinds import Kind, kinds_of
from openvocab_occ.objects.parts import find_parts
from openvocab_occ.objects.regions import Regions, find_regions
from openvocab_occ.objects.tree import GROUP, LEVELS, OBJECT, PART, REGION, SCENE, ObjectTree, SceneObject

_MIN_VOXELS = 4
_MIN_COSINE = 0.85
_BUILDING = (2.5, 3.0)  # metres: what is built, as high and as long as this, is a building
_FRONT_GAP = 8.0  # metres between buildings of one front
_BUILT = ("manmade", "building", "house", "wall")


def build_tree(
    objects: Sequence[SceneObject], voxels: VoxelMap, *, names: Sequence[str] = (), labels: Sequence[str] = (),
    ego: Sequence[np.ndarray] = (),
) -> ObjectTree:  # fmt: skip
    """Hang objects into a tree, with the ground they stand on.

    Args:
        objects: Of level `object`; their ids stay.
        voxels: The map they stand in.
        names: Classes of its occupancy, or labels of its model where it names none.
        labels: Channels of a `logits` map.
        ego: Poses of the frames; regions of the road are told near them.
    """
    path = np.array([T[:2, 3] for T in ego], dtype=np.float64).reshape(-1, 2)
    regions = find_regions(voxels, names, path)
    nodes = _Nodes(voxels, names, labels, max((o.id for o in objects), default=0) + 1)
    home: dict[int, int] = {}  # object -> node it hangs in
    region_ids = _hang_regions(nodes, regions, home)
    claimed = np.zeros(len(voxels), dtype=bool)
    claimed[regions.ground.voxels] = True
    for item in objects:
        claimed[item.voxels] = True
    if not len(regions.ground.voxels):
        objects = [*objects, *_leftovers(nodes, claimed)]
    fronts = _fronts(nodes, objects, home)
    for item in objects:
        if item.id not in home:
            number = regions.nearest(_footprint(item))
            home[item.id] = region_ids.get(number, 0)
    for group in find_groups([o for o in objects if o.id not in fronts]):
        members = [o for o in objects if o.id in group.members]
        where = max(sorted({home[o.id] for o in members}), key=lambda r: sum(home[o.id] == r for o in members))
        id = nodes.add_above(GROUP, group.label, members, where)
        home.update({o.id: id for o in members})
    for item in objects:
        nodes.put(replace(item, parent=home[item.id]))
        for members in find_parts(item, voxels) if item.state != "moving" else []:
            nodes.put(nodes.of_voxels(PART, "", members, item.id))
    return nodes.tree()


class _Nodes:
    """Collects nodes and gives out ids. Mutable."""

    def __init__(self, voxels: VoxelMap, names: Sequence[str], labels: Sequence[str], fresh: int) -> None:
        self.voxels, self.names, self.labels = voxels, tuple(names), tuple(labels)
        self._fresh = fresh
        self._nodes: dict[int, SceneObject] = {}

    def next_id(self) -> int:
        """Return an id not given out yet."""
        self._fresh += 1
        return self._fresh - 1

    def put(self, node: SceneObject) -> int:
        """Add a node and return its id."""
        self._nodes[node.id] = node
        return node.id

    def of_voxels(self, level: str, label: str, members: Int64[np.ndarray, " n"], parent: int) -> SceneObject:
        """Return a node of voxels of the map; without a label their best channel or class names it."""
        voxels = self.voxels
        embedding = voxels.features[members].mean(axis=0, dtype=np.float64)
        score = 1.0
        if voxels.contract == "logits":
            best = int(embedding.argmax())
            if self.labels and not label:
                label, score = self.labels[best], float(embedding[best])
        else:
            embedding /= max(float(np.linalg.norm(embedding)), 1e-12)
            if not label and self.names and level != PART:
                counts = np.bincount(voxels.labels[members], minlength=256)[: len(self.names)]
                label = self.names[int(counts.argmax())] if counts.any() else ""
                score = float(counts.max() / len(members))
        return SceneObject(
            id=self.next_id(), label=label or level, score=score,
            box=Box.around(voxels.keys[members], voxels.voxel_size), voxels=np.sort(members),
            points=voxels.centers[np.sort(members)].astype(np.float32), embedding=embedding.astype(np.float32),
            level=level, parent=parent, times_seen=int(voxels.count[members].max()),
            first_seen=float(voxels.first_seen[members].min()), last_seen=float(voxels.last_seen[members].max()),
        )  # fmt: skip

    def add_above(self, level: str, label: str, members: Sequence[SceneObject], parent: int) -> int:
        """Add a node for objects and return its id."""
        corners = np.concatenate([o.box.corners for o in members])
        low, high = corners.min(axis=0), corners.max(axis=0)
        weights = np.array([max(len(o.points), 1) for o in members], dtype=np.float64)
        embedding = np.average([o.embedding for o in members], axis=0, weights=weights)
        norm = float(embedding.sum() if self.voxels.contract == "logits" else np.linalg.norm(embedding))
        return self.put(SceneObject(
            id=self.next_id(), label=label, score=1.0, box=Box((low + high) / 2, high - low, 0.0),
            voxels=np.empty(0, np.int64), points=np.empty((0, 3), np.float32),
            embedding=(embedding / (norm or 1.0)).astype(np.float32), level=level, parent=parent,
            first_seen=min(o.first_seen for o in members), last_seen=max(o.last_seen for o in members),
        ))  # fmt: skip

    def tree(self) -> ObjectTree:
        """Return the tree of all nodes below a root; children ascend."""
        children: defaultdict[int, list[int]] = defaultdict(list)
        for node in self._nodes.values():
            assert node.parent is not None, "every node but the root hangs somewhere"
            children[node.parent].append(node.id)
        keys, size = self.voxels.keys, self.voxels.voxel_size
        low, high = (keys.min(axis=0), keys.max(axis=0) + 1) if len(keys) else (np.zeros(3), np.zeros(3))
        root = SceneObject(
            id=0, label=SCENE, score=1.0,
            box=Box(((low + high) / 2 * size).astype(np.float64), ((high - low) * size).astype(np.float64), 0.0),
            voxels=np.empty(0, np.int64), points=np.empty((0, 3), np.float32),
            embedding=np.zeros(self.voxels.dim, np.float32), level=SCENE,
        )  # fmt: skip
        everything = [root, *(self._nodes[id] for id in sorted(self._nodes))]
        return ObjectTree(replace(node, children=tuple(sorted(children[node.id]))) for node in everything)


def _hang_regions(nodes: _Nodes, regions: Regions, home: dict[int, int]) -> dict[int, int]:
    """Add each region, and its ground as an object in it; return the ids of regions by number."""
    ground, ids = regions.ground, {}
    if not len(ground.voxels):
        return ids
    number = regions.number[tuple(ground.columns.T)]
    for n, region in enumerate(regions.regions, start=1):
        members = ground.voxels[number == n]
        if not len(members):
            continue
        label = f"{region.junction.kind} junction" if region.junction else region.kind
        surface = nodes.of_voxels(OBJECT, "", members, 0)
        ids[n] = nodes.add_above(REGION, label, [surface], 0)
        home[surface.id] = ids[n]
        nodes.put(replace(surface, parent=ids[n], state="fixed", evidence="ground"))
    loose = ground.voxels[number == 0]
    if len(loose) >= _MIN_VOXELS:
        nodes.put(replace(nodes.of_voxels(OBJECT, "", loose, 0), state="fixed", evidence="ground"))
    return ids


def _leftovers(nodes: _Nodes, claimed: np.ndarray) -> list[SceneObject]:
    """Return objects of what no track holds, where nothing tells ground from things: pieces that look alike."""
    kinds = kinds_of(nodes.labels)
    found = []
    for members in components(nodes.voxels, _MIN_COSINE):
        members = members[~claimed[members]]
        if len(members) < _MIN_VOXELS:
            continue
        item = nodes.of_voxels(OBJECT, "", members, 0)
        if item.label in nodes.labels and kinds[nodes.labels.index(item.label)] == Kind.NOTHING:
            continue
        found.append(item)
    return found


def _fronts(nodes: _Nodes, objects: Sequence[SceneObject], home: dict[int, int]) -> set[int]:
    """Hang buildings into fronts: those that stand in line with little between; return their ids."""
    from scipy.cluster.hierarchy import fcluster, linkage

    from openvocab_occ.objects.groups import flat_gap

    high, long = _BUILDING
    built = [o for o in objects if o.label in _BUILT and o.box.size[2] >= high and o.box.size[0] >= long]
    if not built:
        return set()
    part = np.ones(1, int)
    if len(built) > 1:
        gaps = [flat_gap(a, b) for i, a in enumerate(built) for b in built[i + 1 :]]
        part = fcluster(linkage(np.array(gaps), "single"), _FRONT_GAP, "distance")
    for n in np.unique(part):
        members = [o for o, p in zip(built, part, strict=True) if p == n]
        id = nodes.add_above(REGION, "building front", members, 0)
        home.update({o.id: id for o in members})
    return {o.id for o in built}


def _footprint(item: SceneObject) -> Float64[np.ndarray, "n 2"]:
    """Return points on the ground below and beside an object."""
    steps = np.linspace(-0.6, 0.6, 7)
    local = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2) * item.box.size[:2]
    return item.box.center[:2] + local @ item.box.axes[:2, :2].T


@dataclass(frozen=True, eq=False)
class Dendrogram:
    """The tree as one linkage of its leaves; levels are heights to cut it at."""

    leaves: tuple[int, ...]
    """Ids of the nodes without children."""
    linkage: Float64[np.ndarray, "m 4"]
    """As SciPy's: two clusters, the height at which they merge, the leaves of both. Merges inside an object lie in
    (0, 1], inside a group in (1, 2], inside a region in (2, 3], inside the scene in (3, 4]; lower ones
    are more alike."""

    def cut(self, level: str) -> dict[int, int]:
        """Return the cluster of each leaf when cut at the height of a level: two of a node of that level share one."""
        from scipy.cluster.hierarchy import fcluster

        height = float(LEVELS[::-1].index(level))
        if len(self.leaves) < 2:
            return dict.fromkeys(self.leaves, 1)
        return dict(zip(self.leaves, fcluster(self.linkage, height, "distance").tolist(), strict=True))


def dendrogram(tree: ObjectTree) -> Dendrogram:
    """Return the one dendrogram whose cuts are the levels of a tree."""
    leaves = [node.id for node in tree.nodes if not node.children]
    cluster = {id: n for n, id in enumerate(leaves)}
    size, rows = [1] * len(leaves), []
    by_depth = sorted(tree.nodes, key=lambda node: (-LEVELS.index(node.level), node.id))
    for node in by_depth:
        inside = [child for child in node.children if child in cluster]
        if not inside:
            continue
        base = float(LEVELS[::-1].index(node.level)) - 1
        first = tree[inside[0]].embedding
        off = sorted((1 - _cosine(first, tree[id].embedding), id) for id in inside[1:])
        current = cluster[inside[0]]
        for rank, (distance, id) in enumerate(off, start=1):
            alike = 0.5 * min(max(distance / 2, 0.0), 1.0) + 0.5 * rank / len(off)
            size.append(size[current] + size[cluster[id]])
            rows.append((current, cluster[id], base + max(alike, 1e-6), size[-1]))
            current = len(size) - 1
        cluster[node.id] = current
    return Dendrogram(tuple(leaves), _ascending(np.array(rows, dtype=np.float64).reshape(-1, 4), len(leaves)))


def _ascending(rows: Float64[np.ndarray, "m 4"], leaves: int) -> Float64[np.ndarray, "m 4"]:
    """Return merges in order of height, clusters renumbered."""
    order = np.argsort(rows[:, 2], kind="stable")
    new = np.arange(leaves + len(rows))
    new[leaves + order] = leaves + np.arange(len(rows))
    ordered = rows[order]
    ordered[:, :2] = np.sort(new[ordered[:, :2].astype(int)], axis=1)
    return ordered


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0
