"""The plan of the town: streets as curves, where they meet, and how far any point is from the road.

Lateral offsets are metres to the left of a street's direction; arc lengths start at its first point.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from openvocab_occ.arrays import ArrayLike

LANE_WIDTH = 3.5
BAY_WIDTH = 2.2
SIDEWALK_WIDTH = 3.2
CUT = 15.0
"""Lanes end this far before the middle of a junction, metres."""
_STEP = 1.0
_BLEND = 9.0  # metres over which two streets round their corners


@dataclass(frozen=True, eq=False)
class Street:
    """A curve with a road along it."""

    name: str
    points: Float[np.ndarray, "n 2"]
    """Centre line, about a metre apart; a closed street repeats its first point."""
    half_width: float
    bays: bool
    """Parking bays along both sides."""
    closed: bool = False

    @cached_property
    def _arc(self) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)

    @property
    def length(self) -> float:
        """Metres along the centre line."""
        return float(self._arc[-1])

    def at(self, s: ArrayLike, lateral: ArrayLike = 0.0) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n"]]:
        """Return points at arc lengths and lateral offsets, and the street's heading there."""
        along = np.asarray(s, dtype=np.float64)
        if self.closed:
            along = np.mod(along, self.length)
        i = np.clip(np.searchsorted(self._arc, along, side="right") - 1, 0, len(self.points) - 2)
        a, b = self.points[i], self.points[i + 1]
        t = (along - self._arc[i]) / (self._arc[i + 1] - self._arc[i])
        before, after = self._headings[i], self._headings[i + 1]
        heading = before + (after - before) * np.clip(t, 0, 1)
        left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        points = a + (b - a) * t[..., None] + left * np.asarray(lateral, dtype=np.float64)[..., None]
        return points, np.asarray(heading)

    @cached_property
    def _headings(self) -> np.ndarray:
        """Heading at each point, unwrapped."""
        d = np.diff(self.points, axis=0)
        steps = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
        first, last = steps[0], steps[-1]
        if self.closed:
            turn = 2 * np.pi * round((last - first) / (2 * np.pi))
            first, last = (steps[0] + steps[-1] - turn) / 2, (steps[0] + steps[-1] + turn) / 2
        return np.concatenate([[first], (steps[1:] + steps[:-1]) / 2, [last]])

    def project(self, xy: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return arc length and lateral offset of the nearest point of the centre line.

        Beyond the ends of an open street the offset is the distance to the end.
        """
        _, near = self._tree.query(xy)
        best_s, best = np.zeros(len(xy)), np.full(len(xy), np.inf)
        for shift in (-1, 0):
            i = near + shift
            i = np.mod(i, len(self.points) - 1) if self.closed else np.clip(i, 0, len(self.points) - 2)
            a, d = self.points[i], self.points[i + 1] - self.points[i]
            long = np.linalg.norm(d, axis=1)
            t = np.clip(np.einsum("ij,ij->i", xy - a, d) / long**2, 0, 1)
            off = xy - a - d * t[:, None]
            side = np.where(d[:, 0] * off[:, 1] - d[:, 1] * off[:, 0] >= 0, 1.0, -1.0)
            lateral = side * np.linalg.norm(off, axis=1)
            closer = np.abs(lateral) < np.abs(best)
            best = np.where(closer, lateral, best)
            best_s = np.where(closer, self._arc[i] + t * long, best_s)
        return best_s, best


@dataclass(frozen=True)
class Arm:
    """A street leaving a junction."""

    street: int
    s: float
    """Arc length at the middle of the junction."""
    direction: int
    """+1 when it leaves along the street's direction, else -1."""


@dataclass(frozen=True)
class Junction:
    """Where streets meet: three arms are a T, four an X."""

    center: tuple[float, float]
    arms: tuple[Arm, ...]


@dataclass(frozen=True)
class Patch:
    """A rectangle on the ground, turned by `yaw`."""

    center: tuple[float, float]
    size: tuple[float, float]
    yaw: float = 0.0

    def distance(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the signed distance to the rim, negative inside."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        local = np.abs((xy - np.asarray(self.center)) @ np.array([[c, -s], [s, c]])) - np.asarray(self.size) / 2
        return np.linalg.norm(np.maximum(local, 0), axis=1) + np.minimum(local.max(axis=1), 0)


@dataclass(frozen=True, eq=False)
class Plan:
    """Streets, junctions, parking lots and squares of a town."""

    streets: tuple[Street, ...]
    junctions: tuple[Junction, ...]
    lots: tuple[Patch, ...]
    """Parking lots; the last of each pair is the way in."""
    squares: tuple[Patch, ...]
    bounds: tuple[float, float, float, float] = field(default=(0.0, 0.0, 0.0, 0.0))
    """x0, x1, y0, y1 of all streets."""

    def distances(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "streets n"]:
        """Return the distance of points to the edge of each street's road, negative on it."""
        return np.stack([np.abs(street.project(xy)[1]) - street.half_width for street in self.streets])

    def road_distance(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the distance to the edge of what is paved for cars, negative on it; corners of junctions are round."""
        each = self.distances(xy)
        road = each[0]
        for other in each[1:]:
            road = _smooth_min(road, other, _BLEND)
        for lot in self.lots:
            road = _smooth_min(road, lot.distance(xy), 2.0)
        return road

    def square_distance(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the distance to the rim of the nearest square, negative inside."""
        return np.min([square.distance(xy) for square in self.squares], axis=0)

    def junction_distance(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the distance to the middle of the nearest junction."""
        centers = np.array([j.center for j in self.junctions])
        return np.linalg.norm(xy[:, None] - centers, axis=2).min(axis=1)


def _smooth_min(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Polynomial smooth minimum: equals the minimum where a and b differ by k or more."""
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - h * h * k / 4


def draw_plan(rng: np.random.Generator) -> Plan:
    """Draw a ring road with round corners, a straight main street across it, and two streets between them."""
    width, height = rng.uniform(290, 330), rng.uniform(210, 240)
    ring = _ring(width, height, rng)
    main_y = height * rng.uniform(0.46, 0.54)
    main = _between(ring, (-10.0, main_y), (width + 10.0, main_y + rng.uniform(-6, 6)), 0.0)
    x1, x2 = width * rng.uniform(0.3, 0.37), width * rng.uniform(0.64, 0.7)
    winding = _between(ring, (x1, -10.0), (x1 + rng.uniform(-8, 8), height + 10.0), rng.uniform(7, 10))
    short = [(x2, float(np.interp(x2, main[:, 0], main[:, 1]))), (x2 + rng.uniform(-5, 5), height + 10.0)]
    upper = _line(short[0], _crossing(_line(short[0], short[1], 0.0), ring), 0.0)
    wide, narrow = LANE_WIDTH + BAY_WIDTH, LANE_WIDTH
    streets = [Street("Ring Road", ring, wide, True, closed=True)]
    for name, line, half, host in (
        ("Main Street", main, wide, (0, 0)),
        ("Mill Lane", winding, wide, (0, 0)),
        ("Short Street", upper, narrow, (1, 0)),
    ):
        cut = [streets[h].half_width for h in host]
        streets.append(Street(name, _trim(line, cut[0], cut[1]), half, half == wide))
    junctions = _junctions(streets, [main, winding, upper])
    lots, squares = _patches(streets, width, height, rng)
    low, high = ring.min(axis=0), ring.max(axis=0)
    bounds = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    return Plan(tuple(streets), tuple(junctions), lots, squares, bounds)


def _ring(width: float, height: float, rng: np.random.Generator) -> np.ndarray:
    """Return a rectangle with round corners, anticlockwise, whose lower side bends."""
    r = 34.0
    turn = np.linspace(-np.pi / 2, 0, 50)
    corners = [((width - r, r), 0.0), ((width - r, height - r), 0.5), ((r, height - r), 1.0), ((r, r), 1.5)]
    outline = np.concatenate(
        [
            np.stack([cx + r * np.cos(turn + q * np.pi), cy + r * np.sin(turn + q * np.pi)], axis=1)
            for (cx, cy), q in corners
        ]
    )
    line = _resample(np.concatenate([outline, outline[:1]]))
    bend = np.clip((line[:, 0] - r) / (width - 2 * r), 0, 1)
    line[:, 1] += np.where(
        line[:, 1] < height / 2, rng.uniform(7, 11) * np.sin(2 * np.pi * bend) * np.sin(np.pi * bend), 0
    )
    return _resample(line)


def _resample(line: np.ndarray) -> np.ndarray:
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    s = np.linspace(0, arc[-1], max(2, round(arc[-1] / _STEP)) + 1)
    return np.stack([np.interp(s, arc, line[:, 0]), np.interp(s, arc, line[:, 1])], axis=1)


def _line(a: ArrayLike, b: ArrayLike, bow: float) -> np.ndarray:
    """Return a line from a to b that swings by `bow` to both sides."""
    start, end = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    t = np.linspace(0, 1, 400)
    d = end - start
    left = np.array([-d[1], d[0]]) / np.linalg.norm(d)
    swing = bow * np.sin(2 * np.pi * t) * np.sin(np.pi * t) ** 2
    return _resample(start + d * t[:, None] + left * swing[:, None])


def _crossing(line: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """Return the point of the second half of a line that is nearest to the ring."""
    half = line[len(line) // 2 :]
    distance, _ = KDTree(ring).query(half)
    return half[int(np.argmin(distance))]


def _between(ring: np.ndarray, a: Sequence[float], b: Sequence[float], bow: float) -> np.ndarray:
    """Return a street from the ring to the ring along the line from a to b."""
    whole = _line(a, b, 0.0)
    return _line(_crossing(whole[::-1], ring), _crossing(whole, ring), bow)


def _trim(line: np.ndarray, first: float, last: float) -> np.ndarray:
    """Cut metres off both ends, so that a street begins at the edge of the road it joins."""
    return line[round(first / _STEP) : len(line) - round(last / _STEP)]


def _junctions(streets: list[Street], lines: list[np.ndarray]) -> list[Junction]:
    """Return where each open street begins and ends, and where the two long ones cross."""
    found = []
    for number, (line, hosts) in enumerate(zip(lines, ((0, 0), (0, 0), (1, 0)), strict=True), start=1):
        for end, host in enumerate(hosts):
            point = line[0] if end == 0 else line[-1]
            s = float(streets[host].project(point[None])[0][0])
            own = -streets[host].half_width if end == 0 else streets[number].length + streets[host].half_width
            arms = (Arm(host, s, 1), Arm(host, s, -1), Arm(number, own, 1 if end == 0 else -1))
            found.append(Junction((float(point[0]), float(point[1])), arms))
    a, b = streets[1], streets[2]
    distance, _ = KDTree(b.points).query(a.points)
    at = a.points[int(np.argmin(distance))]
    sa, sb = (float(street.project(at[None])[0][0]) for street in (a, b))
    arms = (Arm(1, sa, 1), Arm(1, sa, -1), Arm(2, sb, 1), Arm(2, sb, -1))
    found.append(Junction((float(at[0]), float(at[1])), arms))
    return found


def _patches(
    streets: list[Street], width: float, height: float, rng: np.random.Generator
) -> tuple[tuple[Patch, ...], tuple[Patch, ...]]:
    """Place a parking lot with its way in below the main street, and a square above it."""
    main = streets[1]
    s = main.length * float(rng.uniform(0.6, 0.66))
    point, heading = main.at(s, -main.half_width - 24.0)
    yaw = float(heading)
    lot = Patch((float(point[0]), float(point[1])), (34.0, 26.0), yaw)
    point, _ = main.at(s - 10.0, -main.half_width - 6.0)
    way = Patch((float(point[0]), float(point[1])), (6.0, 16.0), yaw)
    point, heading = main.at(main.length * 0.16, main.half_width + SIDEWALK_WIDTH + 11.0)
    square = Patch((float(point[0]), float(point[1])), (30.0, 22.5), float(heading))
    return (lot, way), (square,)
