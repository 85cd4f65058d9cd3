"""How well one thing stands in a relation to another: 0 not at all, 1/2 just, 1 fully.

Every rule is a ramp over metres or degrees between boxes, so degrees are the same wherever the world's axes lie, and a
rule says in one line where its border is. Things whose footprint fills less than half of its box, such as a road that
turns, are compared by the columns of their voxels.

Left, right, in front and behind are the viewer's: the line of sight runs from the viewer to the middle between both
things; nearer is in front, farther is behind. The four share each direction: at the diagonal two of them have 1/2.
To the viewer itself they are by its heading. Peers' borders are kept where they exist: near 10 m, beside the viewer
50 m, facing within 22.5 degrees (RefAV).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from openvocab_occ.query.boxes import Boxes, cover, gap, ground_gap, height_gap, repeated

REACH = {
    "next to": 4.5, "near": 15.0, "touching": 0.9, "on": 1.0, "under": 1.0, "above": 1.0, "below": 1.0, "inside": 1.0,
    "of": 1.0, "along": 8.0, "in front of": 50.0, "behind": 50.0, "left of": 50.0, "right of": 50.0, "facing": 60.0,
}  # fmt: skip
"""Metres beyond which a relation surely does not hold; no entry where it can hold at any distance."""
_SAME_HEIGHT = 0.5
_SIDES = {"in front of": 180.0, "behind": 0.0, "left of": 90.0, "right of": -90.0}
"""Degrees from the line of sight, counter-clockwise seen from above."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Where the viewer stands, and where it looks."""

    position: Float64[np.ndarray, " 3"]
    heading: float = 0.0
    """Radians from the world's x axis."""
    name: str = "a given viewpoint"

    def boxes(self) -> Boxes:
        """Return the viewer as a box without size."""
        return Boxes(self.position[None], np.zeros((1, 3)), np.array([self.heading]))


@dataclass(frozen=True, eq=False)
class Anchor:
    """What things are compared with."""

    box: Boxes
    """One row."""
    columns: "Columns | None" = None
    """Where it really is, if its box says too little."""
    is_viewer: bool = False


class Columns:
    """The ground that voxels stand on, with the heights at each place."""

    def __init__(self, points: Float[np.ndarray, "n 3"], voxel_size: float) -> None:
        from scipy.spatial import KDTree

        cells, owner = np.unique(np.floor(points[:, :2] / voxel_size), axis=0, return_inverse=True)
        owner = owner.reshape(-1)
        self.top, self.bottom = np.full(len(cells), -np.inf), np.full(len(cells), np.inf)
        np.maximum.at(self.top, owner, points[:, 2] + voxel_size / 2)
        np.minimum.at(self.bottom, owner, points[:, 2] - voxel_size / 2)
        self.places = (cells + 0.5) * voxel_size
        self.half = voxel_size / 2
        self._tree = KDTree(self.places)

    @property
    def area(self) -> float:
        """Square metres."""
        return len(self.places) * 4 * self.half**2

    def near(self, points: Float[np.ndarray, "n k 2"]) -> tuple[Float64[np.ndarray, "n k"], np.ndarray]:
        """Return the distance from points of the ground to the nearest column's middle, less half a voxel; and it."""
        distance, at = self._tree.query(points)
        return np.maximum(distance - self.half, 0.0), np.asarray(at)


def falling(value: Float[np.ndarray, "*n"], full: float, zero: float) -> Float64[np.ndarray, "*n"]:
    """Return 1 up to `full`, 0 from `zero`, a straight line between."""
    return np.clip((zero - np.asarray(value, dtype=np.float64)) / (zero - full), 0.0, 1.0)


def rising(value: Float[np.ndarray, "*n"], zero: float, full: float) -> Float64[np.ndarray, "*n"]:
    """Return 0 up to `zero`, 1 from `full`, a straight line between."""
    return np.clip((np.asarray(value, dtype=np.float64) - zero) / (full - zero), 0.0, 1.0)


def distance(things: Boxes, anchor: Anchor) -> Float64[np.ndarray, " n"]:
    """Return the gap between each thing and an anchor, metres; along the ground where the anchor is the viewer."""
    if anchor.columns is not None:
        return _flat(things, anchor)
    other = repeated(anchor.box, len(things))
    return ground_gap(things, other) if anchor.is_viewer else gap(things, other)


def within(things: Boxes, anchor: Anchor, low: float, high: float | None) -> Float64[np.ndarray, " n"]:
    """Return 1 where the gap lies in a range, falling to 0 at a tenth beyond its ends: 1/2 at 5 % beyond."""
    degree = np.zeros(len(things))
    rows = _in_reach(things, anchor, None if high is None else high * 1.1 + 1e-9)
    if len(rows):
        d = distance(things.take(rows), anchor)
        below = np.ones(len(rows)) if high is None else falling(d, high, high * 1.1 + 1e-9)
        degree[rows] = below if low <= 0 else np.minimum(below, rising(d, low * 0.9, low))
    return degree


def related(name: str, things: Boxes, anchor: Anchor, viewer: Viewpoint) -> Float64[np.ndarray, " n"]:
    """Return how far each thing stands in a relation (other than `between`) to an anchor."""
    degree = np.zeros(len(things))
    rows = _in_reach(things, anchor, REACH.get(name))
    if len(rows):
        degree[rows] = _related(name, things.take(rows), anchor, viewer)
    return degree


def _in_reach(things: Boxes, anchor: Anchor, reach: float | None) -> Int64[np.ndarray, " m"]:
    """Return the rows whose gap to the anchor may be at most `reach`, by the circles around both."""
    if reach is None:
        return np.arange(len(things))
    apart = np.linalg.norm(things.center[:, :2] - anchor.box.center[0, :2], axis=1)
    return np.flatnonzero(apart <= reach + things.radius + anchor.box.radius[0])


def between(things: Boxes, a: Anchor, b: Anchor) -> Float64[np.ndarray, " n"]:
    """Return how far each thing lies between two anchors.

    By the angle under which the nearest points of both are seen from it: 1 from 150 degrees, 1/2 at 120, 0 to 90; and
    by their gap: 1 up to 20 m, 0 from 60 m.
    """
    middle = things.center[:, None, :2]
    to_a = (_nearest(a, things, middle) - middle)[:, 0]
    to_b = (_nearest(b, things, middle) - middle)[:, 0]
    cosine = (to_a * to_b).sum(axis=1) / np.maximum(np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1), 1e-12)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return np.minimum(rising(angle, 90.0, 150.0), falling(np.full(len(things), distance(a.box, b)[0]), 20.0, 60.0))


def _related(name: str, things: Boxes, anchor: Anchor, viewer: Viewpoint) -> Float64[np.ndarray, " n"]:
    if name in _SIDES:
        return _side(name, things, anchor, viewer)
    other = repeated(anchor.box, len(things))
    match name:
        case "next to":  # side by side: within 3 m, at the same height
            beside = rising(-height_gap(things, other), -_SAME_HEIGHT, _SAME_HEIGHT)
            close = falling(_flat(things, anchor), 1.5, 4.5)
            return close if anchor.columns is not None or anchor.is_viewer else np.minimum(close, beside)
        case "near":
            return falling(distance(things, anchor), 5.0, 15.0)
        case "far from":
            return rising(distance(things, anchor), 20.0, 40.0)
        case "touching":
            return falling(distance(things, anchor), 0.3, 0.9)
        case "on":
            return _on(things, anchor)
        case "above":
            return _above(things, anchor)
        case "under" | "below":
            return _under(things, anchor)
        case "inside" | "of":
            return _inside(things, anchor)
        case "outside":
            return 1.0 - _inside(things, anchor)
        case "along":  # beside something longer than itself
            longer = rising(other.size[:, 0] / np.maximum(things.size[:, 0], 1e-6), 1.0, 2.0)
            return np.minimum(falling(_flat(things, anchor), 3.0, 8.0), longer)
        case "facing":
            return _facing(things, anchor)
        case _:
            raise ValueError(name)


def _nearest(anchor: Anchor, things: Boxes, points: Float[np.ndarray, "n k 2"]) -> Float64[np.ndarray, "n k 2"]:
    """Return the places of the anchor's footprint that are nearest to points."""
    if anchor.columns is not None:
        return anchor.columns.places[anchor.columns.near(points)[1]]
    return repeated(anchor.box, len(things)).nearest(points)


def _flat(things: Boxes, anchor: Anchor) -> Float64[np.ndarray, " n"]:
    """Return the gap along the ground."""
    if anchor.columns is None:
        return ground_gap(things, repeated(anchor.box, len(things)))
    outline = np.concatenate([things.samples, things.corners], axis=1)
    return anchor.columns.near(outline)[0].min(axis=1)


def _on(things: Boxes, anchor: Anchor) -> Float64[np.ndarray, " n"]:
    """Carried by the anchor: half of the footprint over it, bottom and top within 0.75 m."""
    if anchor.columns is None:
        other = repeated(anchor.box, len(things))
        return np.minimum(cover(things, other), falling(np.abs(things.bottom - other.top), 0.5, 1.0))
    away, at = anchor.columns.near(things.samples)
    over = away <= anchor.columns.half
    steps = np.abs(things.bottom[:, None] - anchor.columns.top[at])
    return (over * falling(steps, 0.5, 1.0)).mean(axis=1)


def _above(things: Boxes, anchor: Anchor) -> Float64[np.ndarray, " n"]:
    """Higher and over each other."""
    other = repeated(anchor.box, len(things))
    if anchor.columns is None:
        return _stacked(things, other)
    away, at = anchor.columns.near(things.samples)
    clear = rising(things.bottom[:, None] - anchor.columns.top[at], -1.0, 0.0)
    return ((away <= anchor.columns.half) * clear).mean(axis=1)


def _under(things: Boxes, anchor: Anchor) -> Float64[np.ndarray, " n"]:
    """Lower and over each other; by columns where there are any, so that a car stands under a tree's crown."""
    if anchor.columns is None:
        return _stacked(repeated(anchor.box, len(things)), things)
    away, at = anchor.columns.near(things.samples)
    clear = rising(anchor.columns.bottom[at] - things.top[:, None], -1.0, 0.0)
    return ((away <= anchor.columns.half) * clear).mean(axis=1)


def _stacked(upper: Boxes, lower: Boxes) -> Float64[np.ndarray, " n"]:
    shared = np.maximum(cover(upper, lower), cover(lower, upper))
    return np.minimum(shared, rising(upper.bottom - lower.top, -1.0, 0.0))


def _inside(things: Boxes, anchor: Anchor) -> Float64[np.ndarray, " n"]:
    """Within the anchor's box, or on it where it is flat ground."""
    other = repeated(anchor.box, len(things))
    shared = np.minimum(things.top, other.top) - np.maximum(things.bottom, other.bottom)
    tall = np.clip(shared / np.maximum(things.size[:, 2], 1e-6), 0.0, 1.0)
    if anchor.columns is None:
        over = cover(things, other)
    else:
        over = (anchor.columns.near(things.samples)[0] <= anchor.columns.half).mean(axis=1)
    return np.maximum(np.minimum(over, tall), _on(things, anchor))


def _side(name: str, things: Boxes, anchor: Anchor, viewer: Viewpoint) -> Float64[np.ndarray, " n"]:
    if anchor.is_viewer:
        offset = things.center[:, :2] - viewer.position[:2]
        sight = np.broadcast_to([np.cos(viewer.heading), np.sin(viewer.heading)], offset.shape)
        turn = 180.0 if name in ("in front of", "behind") else 0.0  # ahead of me is where I look
        close = falling(_flat(things, anchor), 40.0, 60.0)
    else:
        offset, middle = _offset(things, anchor)
        sight = middle - viewer.position[:2]
        turn = 0.0
        close = falling(_flat(things, anchor), 10.0, 50.0)
    ahead = (offset * sight).sum(axis=1)
    across = sight[:, 0] * offset[:, 1] - sight[:, 1] * offset[:, 0]
    angle = np.degrees(np.arctan2(across, ahead))
    off = np.abs((angle - _SIDES[name] - turn + 180.0) % 360.0 - 180.0)
    known = (np.abs(ahead) + np.abs(across)) > 1e-12
    return np.where(known, np.minimum(falling(off, 30.0, 60.0), close), 0.0)


def _offset(things: Boxes, anchor: Anchor) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]:
    """Return the way from the anchor to each thing, and the middle between them.

    Long things count by their parts that face each other, so the way is the mean of both ways to the nearest part,
    with a little of the way between the centres, which decides where both overlap. Turned round when both change roles.
    """
    here = things.center[:, None, :2]
    near = _nearest(anchor, things, here)
    there = near if anchor.columns is not None else repeated(anchor.box, len(things)).center[:, None, :2]
    back = things.nearest(there)
    offset = (here - near) + (back - there) + 0.1 * (here - there)
    return offset[:, 0], ((near + back) / 2)[:, 0]


def _facing(things: Boxes, anchor: Anchor) -> Float64[np.ndarray, " n"]:
    """Pointing one end at the anchor: a box has no front, so either end counts; round things face nothing."""
    way = _nearest(anchor, things, things.center[:, None, :2])[:, 0] - things.center[:, :2]
    along = np.abs((way * things.axes[:, :, 0]).sum(axis=1)) / np.maximum(np.linalg.norm(way, axis=1), 1e-12)
    angle = np.degrees(np.arccos(np.clip(along, 0.0, 1.0)))
    slender = rising(things.size[:, 0] / np.maximum(things.size[:, 1], 1e-6), 1.0, 1.3)
    close = falling(_flat(things, anchor), 40.0, 60.0)
    return np.minimum(np.minimum(falling(angle, 15.0, 30.0), slender), close)
