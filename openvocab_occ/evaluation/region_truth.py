"""Regions and junctions of a drive through the demo city against its plan."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from openvocab_occ.datasets.city.streets import Plan
from openvocab_occ.objects.regions import Regions, find_regions
from openvocab_occ.objects.scene_map import SceneMap

_MOUTH = 14.0  # metres from the middle of a junction to where its arms begin
_SEEN = 12.0  # metres from the drive within which a junction is asked for
_NEAR = 12.0  # metres that a found junction may lie off


@dataclass(frozen=True, kw_only=True)
class RegionScores:
    """How regions of the road agree with the plan."""

    purity: float
    """Share of the road's cells in regions whose commonest true piece they are of; NaN without road."""
    junctions: int
    """True ones that the drive passes."""
    found: int
    """Of them, found within 12 m."""
    right: int
    """Of them, with the right number of arms: three for a T, four for a cross."""
    extra: int
    """Found where the plan has none within 20 m."""


def score_regions(scene: SceneMap, plan: Plan) -> RegionScores:
    """Score the regions of a map of the city."""
    path = np.array([frame.T_world_ego[:2, 3] for frame in scene.frames], dtype=np.float64).reshape(-1, 2)
    regions = find_regions(scene.voxels, scene.class_names, path)
    centers = np.array([junction.center for junction in plan.junctions]).reshape(-1, 2)
    passed = [n for n, c in enumerate(centers) if np.linalg.norm(path - c, axis=1).min() <= _SEEN]
    found, right, used = 0, 0, set[int]()
    for n in passed:
        near = [(float(np.hypot(*(np.array(j.center) - centers[n]))), i) for i, j in enumerate(regions.lanes.junctions)]
        distance, best = min(near, default=(np.inf, -1))
        if distance <= _NEAR:
            found += 1
            used.add(best)
            right += len(regions.lanes.junctions[best].arms) == len(plan.junctions[n].arms)
    extra = sum(
        len(centers) == 0 or np.linalg.norm(centers - np.array(j.center), axis=1).min() > 20.0
        for j in regions.lanes.junctions
    )
    return RegionScores(purity=purity(regions, plan), junctions=len(passed), found=found, right=right, extra=int(extra))


def purity(regions: Regions, plan: Plan) -> float:
    """Return the share of road cells that are of their region's commonest true piece: junction, lot, or street."""
    cells = np.argwhere(regions.ground.road & (regions.number > 0))
    if not len(cells):
        return float("nan")
    true = pieces(plan, (cells + regions.ground.origin + 0.5) * regions.ground.voxel_size)
    number = regions.number[tuple(cells.T)]
    hits = sum(int(np.bincount(true[number == n]).max()) for n in np.unique(number))
    return hits / len(cells)


def pieces(plan: Plan, xy: Float[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
    """Return which piece of the plan each point is of: a junction, else a lot, else the nearest street."""
    streets, junctions = len(plan.streets), len(plan.junctions)
    code = plan.distances(xy).argmin(axis=0).astype(np.int64)
    for n, lot in enumerate(plan.lots):
        code[lot.distance(xy) <= 0] = streets + junctions + n // 2
    for n, junction in enumerate(plan.junctions):
        code[np.linalg.norm(xy - np.array(junction.center), axis=1) <= _MOUTH] = streets + n
    return code
