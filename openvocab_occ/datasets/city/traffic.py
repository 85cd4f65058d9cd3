"""Who moves: cars follow lanes and each other, wait at junctions, crossings and stops; people walk and cross.

A simulation in steps of a tenth of a second; the ego takes part in it like any other vehicle. Following is the
intelligent driver model (Treiber, Hennecke, Helbing 2000).
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.city.lanes import LaneGraph

STEP = 0.1
"""Seconds between states."""
_HEADWAY, _GAP, _ACCELERATION, _BRAKE = 1.3, 2.2, 1.6, 2.5  # s, m, m/s^2, m/s^2
_LOOK = 45.0  # m that a driver looks ahead
_WAIT = 1.2  # m before the end of a lane where vehicles wait


@dataclass
class Driver:
    """A vehicle on its way. Mutable while simulated."""

    route: list[int]
    """Lanes, in order; long enough for the whole time."""
    s: float
    """Metres from the start of the first lane to its middle."""
    length: float
    speed: float
    desired: float
    stops: Sequence[tuple[float, float]] = ()
    """(metres along the route, seconds) at which it stops for a while."""
    pause: float = 0.0
    track: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Crosser:
    """Someone who walks straight on, and waits at the kerb while vehicles come."""

    start: tuple[float, float]
    heading: float
    speed: float
    kerb: float | None = None
    """Metres after which the road begins; None for who stays on the sidewalk."""
    width: float = 0.0
    """Of the road they cross, metres."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions over time, a state each `STEP`."""

    xy: Float[np.ndarray, "steps 2"]
    heading: Float[np.ndarray, " steps"]

    def at(self, time: float) -> tuple[float, float, float]:
        """Return x, y and heading at a time, seconds from the first state."""
        at = min(max(time / STEP, 0.0), len(self.xy) - 1.000001)
        i = int(at)
        t = at - i
        x, y = self.xy[i] * (1 - t) + self.xy[i + 1] * t
        return float(x), float(y), float(self.heading[i] * (1 - t) + self.heading[i + 1] * t)

    def velocity(self, time: float) -> tuple[float, float]:
        """Return metres a second along x and y, over half a second around a time."""
        a, b = self.at(time - 0.25), self.at(time + 0.25)
        return (b[0] - a[0]) / 0.5, (b[1] - a[1]) / 0.5


class Simulation:
    """Moves drivers and walkers together. Mutable."""

    def __init__(self, graph: LaneGraph, drivers: list[Driver], walkers: list[Crosser]) -> None:
        self._graph, self._drivers, self._walkers = graph, drivers, walkers
        self._edges = [list(accumulate((graph.lanes[n].length for n in d.route), initial=0.0)) for d in drivers]
        self._lines = [
            (
                lane.arc.tolist(),
                lane.points[:, :2].tolist(),
                np.arctan2(*np.diff(lane.points, axis=0).T[1::-1]).tolist(),
            )
            for lane in graph.lanes
        ]  # scalars are faster than arrays of one
        self._holders: dict[int, set[int]] = {}  # turn -> drivers in it or let into it
        self._walked = np.zeros(len(walkers))

    def run(self, seconds: float) -> tuple[list[Motion], list[Motion]]:
        """Return the motions of the drivers and of the walkers."""
        steps = round(seconds / STEP) + 1
        walked = np.zeros((steps, len(self._walkers)))
        for step in range(steps):
            for driver in self._drivers:
                driver.track.append(driver.s)
            walked[step] = self._walked
            places = [self._place(n, d.s) for n, d in enumerate(self._drivers)]
            crossing = self._walk([p[:2] for p in places])
            self._drive(crossing)
        return [self._motion(n) for n in range(len(self._drivers))], [
            _walk_motion(w, walked[:, n]) for n, w in enumerate(self._walkers)
        ]

    def _lane(self, number: int, s: float) -> int:
        return min(bisect_right(self._edges[number], s) - 1, len(self._drivers[number].route) - 1)

    def _place(self, number: int, s: float) -> tuple[float, float, float]:
        k = self._lane(number, s)
        lane_number = self._drivers[number].route[k]
        at = s - self._edges[number][k]
        arc, points, headings = self._lines[lane_number]
        i = min(max(bisect_left(arc, at) - 1, 0), len(points) - 2)
        share = min(max((at - arc[i]) / (arc[i + 1] - arc[i]), 0.0), 1.0)
        (x0, y0), (x1, y1) = points[i], points[i + 1]
        return x0 + share * (x1 - x0), y0 + share * (y1 - y0), headings[i]

    def _walk(self, cars: list[tuple[float, float]]) -> list[tuple[float, float]]:
        """Move the walkers; return where those on the road are."""
        at, speeds = np.array(cars).reshape(-1, 2), np.array([d.speed for d in self._drivers])
        crossing = []
        for number, walker in enumerate(self._walkers):
            done = self._walked[number]
            position = np.array(walker.start) + done * np.array([np.cos(walker.heading), np.sin(walker.heading)])
            if walker.kerb is not None:
                if walker.kerb - 0.6 < done < walker.kerb + walker.width:
                    crossing.append((float(position[0]), float(position[1])))
                if walker.kerb - 0.7 - walker.speed * STEP < done <= walker.kerb - 0.6:
                    ahead = position + (walker.width / 2 + 0.6) * np.array(
                        [np.cos(walker.heading), np.sin(walker.heading)]
                    )
                    if (np.linalg.norm(at - ahead, axis=1) < 9.0 + 1.6 * speeds).any():
                        continue
            self._walked[number] += walker.speed * STEP
        return crossing

    def _drive(self, crossing: list[tuple[float, float]]) -> None:
        on_lane: dict[int, list[tuple[float, int]]] = {}
        for number, driver in enumerate(self._drivers):
            k = self._lane(number, driver.s)
            on_lane.setdefault(driver.route[k], []).append((driver.s - self._edges[number][k], number))
        self._release()
        changes = []
        for number, driver in enumerate(self._drivers):
            gap, speed = self._ahead(number, on_lane, crossing)
            wish = driver.desired
            k = self._lane(number, driver.s)
            if self._graph.lanes[driver.route[k]].is_turn:
                wish = min(wish, 5.5)
            close = driver.speed * _HEADWAY + driver.speed * (driver.speed - speed) / (
                2 * (_ACCELERATION * _BRAKE) ** 0.5
            )
            pull = 1 - (driver.speed / wish) ** 4 - ((_GAP + max(0.0, close)) / max(gap, 0.05)) ** 2
            changes.append(max(-7.0, _ACCELERATION * pull))
        for driver, change in zip(self._drivers, changes, strict=True):
            old = driver.speed
            driver.speed = max(0.0, old + change * STEP)
            driver.s += (old + driver.speed) / 2 * STEP
            if driver.stops and driver.speed < 0.15 and abs(driver.stops[0][0] - driver.s) < 4.0:
                driver.pause += STEP
                if driver.pause > driver.stops[0][1]:
                    driver.stops, driver.pause = driver.stops[1:], 0.0

    def _ahead(self, number: int, on_lane: dict[int, list[tuple[float, int]]], crossing: list[tuple[float, float]]
               ) -> tuple[float, float]:  # fmt: skip
        """Return the gap to what a driver must not reach, and its speed."""
        driver, edges = self._drivers[number], self._edges[number]
        front = driver.s + driver.length / 2
        best, speed = _LOOK, driver.desired
        if driver.stops:
            gap = driver.stops[0][0] + _GAP - driver.s
            if -1.0 < gap < best:
                best, speed = max(gap, 0.05), 0.0
        if driver.route and edges[-1] - front < best:
            best, speed = edges[-1] - front, 0.0
        first = self._lane(number, driver.s)
        for k in range(first, len(driver.route)):
            if edges[k] - front > _LOOK:
                break
            for s, other in on_lane.get(driver.route[k], ()):
                if other != number and edges[k] + s > driver.s:
                    gap = edges[k] + s - self._drivers[other].length / 2 - front
                    if gap < best:
                        best, speed = gap, self._drivers[other].speed
            turn = self._graph.lanes[driver.route[k]].is_turn
            if turn and k > first and not self._enter(number, driver.route[k], edges[k] - front):
                gap = edges[k] - _WAIT - front
                if gap < best:
                    best, speed = max(gap, 0.05), 0.0
        x, y, _ = self._place(number, driver.s)
        near = 18.0 + driver.length / 2 + 2.6
        for walker in crossing:
            if (walker[0] - x) ** 2 + (walker[1] - y) ** 2 > near**2:
                continue
            for reach in (2.0, 4.0, 7.0, 10.0, 14.0, 18.0):
                if reach < best:
                    there = self._place(number, front + reach)
                    if (walker[0] - there[0]) ** 2 + (walker[1] - there[1]) ** 2 < 2.6**2:
                        best, speed = max(reach - 1.5, 0.05), 0.0
        return best, speed

    def _enter(self, number: int, turn: int, distance: float) -> bool:
        """Let a driver into a turn when no conflicting one is taken; whoever asks within 14 m takes it."""
        holders = self._holders.setdefault(turn, set())
        if number in holders:
            return True
        if distance > 14.0:
            return distance > 25.0
        rivals = np.flatnonzero(self._graph.conflicts[turn])
        if any(self._holders.get(int(rival), set()) - {number} for rival in rivals):
            return False
        holders.add(number)
        return True

    def _release(self) -> None:
        """Give turns back that their holders have left behind."""
        for turn, holders in self._holders.items():
            for number in list(holders):
                driver = self._drivers[number]
                k = driver.route.index(turn)
                if driver.s - driver.length / 2 > self._edges[number][k + 1]:
                    holders.discard(number)

    def _motion(self, number: int) -> Motion:
        driver = self._drivers[number]
        places = np.array([self._place(number, s) for s in driver.track])
        half = min(driver.length * 0.3, 2.5)  # the heading is that of the line between the axles
        rear = np.array([self._place(number, max(s - half, 0.0))[:2] for s in driver.track])
        front = np.array([self._place(number, s + half)[:2] for s in driver.track])
        d = front - rear
        return (
            Motion((front + rear) / 2, np.unwrap(np.arctan2(d[:, 1], d[:, 0])))
            if len(places)
            else Motion(rear, d[:, 0])
        )


def _walk_motion(walker: Crosser, walked: np.ndarray) -> Motion:
    way = np.array([np.cos(walker.heading), np.sin(walker.heading)])
    return Motion(np.array(walker.start) + walked[:, None] * way, np.full(len(walked), walker.heading))


def random_route(graph: LaneGraph, start: int, length: float, rng: np.random.Generator) -> list[int]:
    """Return lanes from a start, turning at random, that are at least so long together."""
    route, total = [start], graph.lanes[start].length
    while total < length:
        options = [n for n in graph.lanes[route[-1]].successors if n not in route]
        if not options:
            options = list(graph.lanes[route[-1]].successors)
        if not options or (options[0] in route):
            break
        step = options[rng.integers(len(options))]
        route.append(step)
        total += graph.lanes[step].length
    return route
