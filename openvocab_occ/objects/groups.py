"""Groups: rows of parked vehicles, and what grows together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from openvocab_occ.objects.kinds import Kind, kind_of
from openvocab_occ.objects.tree import SceneObject

_VEHICLE_GAP = 3.5  # metres between boxes, along or across, of vehicles in one row
_PLANT_GAP = 0.9
_PLANT_HEIGHT = 2.5  # metres; what is higher is trees
_ALIGNED = np.deg2rad(25.0)  # parked in one row: side by side, or one behind the other
_PLANTS = ("vegetation", "bush", "hedge", "shrub", "plant")


@dataclass(frozen=True)
class Group:
    """Objects that stand together."""

    label: str
    members: tuple[int, ...]
    """Ids, ascending."""


def find_groups(objects: Sequence[SceneObject]) -> list[Group]:
    """Return rows of three or more parked vehicles, and hedges of two or more low plants; by their lowest id."""
    parked = [o for o in objects if o.state == "parked" and kind_of(o.label) == Kind.MOVABLE and o.box.size[0] > 1.4]
    plants = [o for o in objects if o.label in _PLANTS and o.box.size[2] <= _PLANT_HEIGHT]
    groups = []
    for members in _chains(parked, _VEHICLE_GAP, aligned=True):
        if len(members) >= 3:
            words = sorted({o.label for o in members})
            kind = f"{words[0]}s" if len(words) == 1 and not words[0].endswith("s") else "vehicles"
            groups.append(Group(f"row of parked {kind}", tuple(sorted(o.id for o in members))))
    groups += [
        Group("hedge", tuple(sorted(o.id for o in members)))
        for members in _chains(plants, _PLANT_GAP, aligned=False)
        if len(members) >= 2
    ]
    return sorted(groups, key=lambda group: group.members)


def _chains(objects: Sequence[SceneObject], gap: float, *, aligned: bool) -> list[list[SceneObject]]:
    """Return the objects linked by gaps (single linkage)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if len(objects) < 2:
        return []
    reach = max(float(o.box.size[:2].max()) for o in objects) + gap
    pairs = KDTree(np.array([o.center[:2] for o in objects])).query_pairs(reach, output_type="ndarray")
    links = [(i, j) for i, j in pairs if _linked(objects[i], objects[j], gap, aligned)]
    ends = np.array(links, dtype=int).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(len(objects),) * 2)
    count, part = connected_components(graph, directed=False)
    return [[o for o, p in zip(objects, part, strict=True) if p == n] for n in range(count)]


def _linked(a: SceneObject, b: SceneObject, gap: float, aligned: bool) -> bool:
    if aligned:
        turn = (a.box.yaw - b.box.yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
        if abs(turn) > _ALIGNED:
            return False
    return flat_gap(a, b) <= gap


def flat_gap(a: SceneObject, b: SceneObject) -> float:
    """Return about how far apart two boxes are on the ground, metres: from the rim of each to the other's corners."""
    best = np.inf
    for one, other in ((a.box, b.box), (b.box, a.box)):
        corners = other.corners[:4, :2]
        rim = np.concatenate([corners + (np.roll(corners, -1, axis=0) - corners) * t for t in np.linspace(0, 1, 9)])
        local = np.abs((rim - one.center[:2]) @ one.axes[:2, :2]) - one.size[:2] / 2
        best = min(best, float(np.linalg.norm(np.maximum(local, 0), axis=1).min()))
    return best
