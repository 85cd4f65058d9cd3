"""The lane graph: a lane each way along every stretch of street, and turns between them through the junctions."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from openvocab_occ.datasets.city.streets import CUT, LANE_WIDTH, Plan

_CLEARANCE = 2.6  # metres between the middles of turns that can be driven at once


@dataclass(frozen=True, eq=False)
class Lane:
    """A way that a vehicle follows."""

    points: Float[np.ndarray, "n 2"]
    """Middle of the lane in driving direction, about a metre apart, in the world."""
    street: int
    """Number of the street, -1 for a turn."""
    junction: int
    """Number of the junction a turn crosses, -1 for a lane of a street."""
    successors: tuple[int, ...] = ()

    @cached_property
    def arc(self) -> Float[np.ndarray, " n"]:
        """Metres from the start to each point."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.arc[-1])

    @property
    def is_turn(self) -> bool:
        """True inside a junction."""
        return self.junction >= 0


@dataclass(frozen=True, eq=False)
class LaneGraph:
    """All lanes; a lane's number is its place in the list."""

    lanes: tuple[Lane, ...]
    conflicts: Bool[np.ndarray, "lanes lanes"] = field(repr=False)
    """Turns that cannot be driven at the same time."""

    def to_dict(self) -> dict[str, object]:
        """Return the graph as plain data."""
        return {
            "lanes": [
                {
                    "id": number,
                    "kind": "turn" if lane.is_turn else "lane",
                    "street": lane.street,
                    "junction": lane.junction,
                    "points": np.round(lane.points, 3).tolist(),
                    "successors": list(lane.successors),
                }
                for number, lane in enumerate(self.lanes)
            ]
        }


def build_lanes(plan: Plan) -> LaneGraph:
    """Return the lane graph of a plan; traffic keeps to the right."""
    lanes: list[Lane] = []
    into: dict[int, list[int]] = {}
    out_of: dict[int, list[int]] = {}
    for number, street in enumerate(plan.streets):
        stops = sorted(
            {(arm.s, j) for j, junction in enumerate(plan.junctions) for arm in junction.arms if arm.street == number}
        )
        pairs = list(zip(stops, [*stops[1:], *([(stops[0][0] + street.length, stops[0][1])] if street.closed else [])],
                         strict=False))  # fmt: skip
        for (s0, j0), (s1, j1) in pairs:
            s = np.linspace(s0 + CUT, s1 - CUT, max(2, round(s1 - s0 - 2 * CUT)) + 1)
            for lateral, start, end, order in ((-LANE_WIDTH / 2, j0, j1, 1), (LANE_WIDTH / 2, j1, j0, -1)):
                points, _ = street.at(s, np.full(len(s), lateral))
                out_of.setdefault(start, []).append(len(lanes))
                into.setdefault(end, []).append(len(lanes))
                lanes.append(Lane(points[::order], number, -1))
    successors: dict[int, list[int]] = {}
    for junction in range(len(plan.junctions)):
        for a in into[junction]:
            for b in out_of[junction]:
                turn = _turn(lanes[a].points, lanes[b].points)
                if turn is None:
                    continue
                successors.setdefault(a, []).append(len(lanes))
                lanes.append(Lane(turn, -1, junction, (b,)))
    linked = tuple(
        Lane(lane.points, lane.street, lane.junction, lane.successors or tuple(successors.get(number, ())))
        for number, lane in enumerate(lanes)
    )
    return LaneGraph(linked, _conflicts(linked))


def _turn(before: np.ndarray, after: np.ndarray) -> np.ndarray | None:
    """Return a Bezier curve from the end of one lane to the start of another; None for turning back."""
    p, q = before[-1], after[0]
    d, e = before[-1] - before[-2], after[1] - after[0]
    d, e = d / np.linalg.norm(d), e / np.linalg.norm(e)
    if d @ e < -0.7:
        return None
    reach = np.linalg.norm(q - p) * 0.48  # wider than a circle, away from the corner
    t = np.linspace(0, 1, 60)[:, None]
    a, b = p + d * reach, q - e * reach
    curve = (1 - t) ** 3 * p + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * q
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    s = np.linspace(0, arc[-1], max(2, round(arc[-1])) + 1)
    return np.stack([np.interp(s, arc, curve[:, 0]), np.interp(s, arc, curve[:, 1])], axis=1)


def _conflicts(lanes: tuple[Lane, ...]) -> np.ndarray:
    """Tell which turns of a junction come too close, except those that begin together."""
    conflicts = np.zeros((len(lanes), len(lanes)), dtype=np.bool_)
    for i, a in enumerate(lanes):
        for j, b in enumerate(lanes[:i]):
            if a.is_turn and a.junction == b.junction and np.linalg.norm(a.points[0] - b.points[0]) > 0.5:
                gap = np.linalg.norm(a.points[:, None] - b.points[None], axis=2).min()
                conflicts[i, j] = conflicts[j, i] = gap < _CLEARANCE
    return conflicts
