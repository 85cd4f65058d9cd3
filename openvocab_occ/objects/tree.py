"""Objects, and the tree they stand in: the scene at its root, objects below it."""

from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64

from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.objects.box import Box

SCENE, REGION, GROUP, OBJECT, PART = "scene", "region", "group", "object", "part"
LEVELS = (SCENE, REGION, GROUP, OBJECT, PART)
"""From the root down."""


class Sighting(NamedTuple):
    """Where an object is seen."""

    frame: int
    """Index of the frame."""
    view: str
    """Name of the view."""
    box: tuple[int, int, int, int]
    """Left, top, right, bottom pixel, all inclusive."""
    score: float = 0.0
    """How good a picture of it this is, to compare sightings of one object by; 0 where that was not recorded."""


@dataclass(frozen=True, eq=False)
class SceneObject:
    """One node of the tree: a group of voxels that belong together, or the scene."""

    id: int
    label: str
    """Best class of its voxels; empty where neither the model nor the occupancy names any."""
    score: float
    """How much speaks for `label`: mean probability of a `logits` model, else the share of voxels of that class."""
    box: Box
    voxels: Int64[np.ndarray, " n"] = field(repr=False)
    """Positions in the VoxelMap of the same SceneMap; none for the scene, which holds all."""
    points: Float32[np.ndarray, "p 3"] = field(repr=False)
    """Centres of the voxels in the world, metres, rounded by up to 0.03 mm at 1 km. Of what moves, those of its latest
    sighting: the map does not hold them, so there may be more than `voxels`."""
    embedding: Float32[np.ndarray, " c"] = field(repr=False)
    """Mean feature of the voxels; a unit vector for a `dense` map, a distribution for a `logits` map."""
    state: str = "unknown"
    """What motion was observed; never guessed from appearance."""
    level: str = OBJECT
    parent: int | None = None
    children: tuple[int, ...] = ()
    views: tuple[Sighting, ...] = ()
    """Best sightings, best first; empty where the map was built without recording them."""
    evidence: str = ""
    """What speaks for `state`, in words."""
    confidence: float = 0.0
    """How sure the state is, 0 to 1; not a probability."""
    heading: float | None = None
    """Direction it moved in, radians against the world's x axis; None where no motion told front from back."""
    speed: float = 0.0
    """Metres a second at the end of its observation."""
    times_seen: int = 0
    """Frames it was seen in."""
    first_seen: float = 0.0
    """Time of its first sighting, seconds."""
    last_seen: float = 0.0
    """Time of its last sighting, seconds."""
    best_embedding: Float32[np.ndarray, " c"] | None = field(default=None, repr=False)
    """As `embedding`, of its best views only; None where none were recorded."""
    agreement: float = 0.0
    """How far its sightings agree: length of their mean feature, 1 when all are the same."""
    names: tuple[tuple[str, float], ...] = ()
    """Best words of a vocabulary and their scores, best first."""
    colors: Float32[np.ndarray, "k 4"] | None = field(default=None, repr=False)
    """Colours that its own pixels show, the commonest first: share of the pixels, and mean sRGB from 0 to 255; None
    where no image told."""

    @property
    def time_observed(self) -> float:
        """Seconds from its first to its last sighting."""
        return self.last_seen - self.first_seen

    @property
    def center(self) -> Float64[np.ndarray, " 3"]:
        """Centre of the box, metres, world."""
        return self.box.center


class ObjectTree:
    """All nodes by id. Its length and its iteration are of the objects; the root is `tree[0]`."""

    def __init__(self, nodes: Iterable[SceneObject]) -> None:
        self._known: dict[int, SceneObject] | None = _by_id(tuple(nodes))
        self._load: Callable[[], Sequence[SceneObject]] | None = None

    @classmethod
    def stored(cls, load: Callable[[], Sequence[SceneObject]]) -> "ObjectTree":
        """Return a tree whose nodes are read when one is first asked for."""
        tree = cls.__new__(cls)
        tree._known, tree._load = None, load
        return tree

    @property
    def _nodes(self) -> dict[int, SceneObject]:
        if self._known is None:
            assert self._load is not None, "a tree is made of nodes, or of what reads them"
            self._known = _by_id(tuple(self._load()))
        return self._known

    @property
    def root(self) -> SceneObject:
        """The scene."""
        return self._nodes[0]

    @property
    def nodes(self) -> tuple[SceneObject, ...]:
        """All nodes, the scene included."""
        return tuple(self._nodes.values())

    def level(self, name: str) -> tuple[SceneObject, ...]:
        """Return the nodes of a level; none when the tree has no such level."""
        return tuple(node for node in self._nodes.values() if node.level == name)

    def walk(self, id: int = 0) -> Iterator[tuple[int, SceneObject]]:
        """Yield a node and all below it with their depth below it, each before its children."""
        todo = [(0, id)]
        while todo:
            depth, here = todo.pop()
            yield depth, self[here]
            todo += [(depth + 1, child) for child in reversed(self[here].children)]

    def region_of(self, id: int) -> SceneObject | None:
        """Return the region a node is in; None for one in none."""
        node: SceneObject | None = self[id]
        while node is not None and node.level != REGION:
            node = None if node.parent is None else self[node.parent]
        return node

    def __len__(self) -> int:
        return len(self.level(OBJECT))

    def __iter__(self) -> Iterator[SceneObject]:
        return iter(self.level(OBJECT))

    def __contains__(self, id: object) -> bool:
        return id in self._nodes

    def __getitem__(self, id: int) -> SceneObject:
        if id not in self._nodes:
            raise ConfigError("no object has this id", expected=f"one of {len(self._nodes)} ids from 0", got=id)
        return self._nodes[id]

    def __repr__(self) -> str:
        return f"ObjectTree({len(self)} objects)"


def _by_id(nodes: Sequence[SceneObject]) -> dict[int, SceneObject]:
    """Return nodes by id once they are known to be one tree."""
    found = {node.id: node for node in nodes}
    if len(found) != len(nodes):
        raise DataError("object ids repeat", got=sorted(node.id for node in nodes))
    if 0 not in found or found[0].level != SCENE:
        raise DataError("object tree has no root", expected="node 0 of level 'scene'", got=sorted(found)[:5])
    for node in nodes:
        if (node.parent is None) != (node.id == 0) or (node.parent is not None and node.parent not in found):
            raise DataError(f"object {node.id} hangs nowhere", expected="a parent in the tree", got=node.parent)
        if any(child not in found or found[child].parent != node.id for child in node.children):
            raise DataError(f"children of object {node.id} do not name it as parent", got=node.children)
    return found


def without(nodes: Sequence[SceneObject], gone: Set[int]) -> list[SceneObject]:
    """Return the nodes without those whose id is `gone`, unless something below them stays.

    Nodes that lose all that was below them go too, but for the root.
    """
    by_id = {node.id: node for node in nodes}
    kept: set[int] = {0}
    for node in nodes:
        if node.id in gone or (node.children and not len(node.voxels)):
            continue
        up: int | None = node.id
        while up is not None and up not in kept:
            kept.add(up)
            up = by_id[up].parent if up in by_id else None
    return [
        replace(node, children=tuple(child for child in node.children if child in kept))
        for node in nodes
        if node.id in kept
    ]
