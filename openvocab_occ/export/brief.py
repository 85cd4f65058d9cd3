"""What comes along a route, in order and in words: the answer that a reader of the pictures should be able to give."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from openvocab_occ.export.route import Route, regions_of, route_ahead
from openvocab_occ.objects.ground import Junction
from openvocab_occ.objects.kinds import Kind, kind_of
from openvocab_occ.objects.regions import Regions
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.query.coverage import coverage_of

Side = Literal["left", "right", "ahead"]
_LANE = 1.5  # metres to each side of the way that the ego takes up, with some room
_BESIDE = 15.0  # metres from the way within which what can move is told
_NEAR = 12.0  # metres within which other things are told
_A_LANE = 3.5  # metres; a narrower road is one of which only a part was seen
_AT_LEAST = 0.4  # metres of a thing on the road that narrow it
_STEP = 1.0  # metres between places whose ground is looked up
_UNSEEN = 3.0  # metres of unknown way that are worth telling
_SMALL = ("cone", "barrier", "pole", "sign", "light", "bollard", "hydrant")


@dataclass(frozen=True, kw_only=True)
class RouteObject:
    """A thing beside or on the way."""

    id: int
    label: str
    state: str
    evidence: str
    side: Side
    """`ahead` when it reaches into the 3 m that the ego takes up."""
    station: float
    """Metres along the way to where it begins."""
    until: float
    """Metres along the way to where it ends."""
    left: float
    """Metres from the way to its nearest point, positive to the left; 0 where it stands across the way."""
    size: tuple[float, float, float]
    on_road: bool
    narrows: tuple[float, float] | None = None
    """Width of the road there and the widest gap it leaves, metres; None where it leaves the road free, where it may
    drive on, and where not all of the road was seen."""
    last_seen: float = 0.0

    def text(self) -> str:
        """Return it as a line."""
        where = {"left": "on the left", "right": "on the right", "ahead": "in the way"}[self.side]
        away = "" if self.side == "ahead" else f", {abs(self.left):.1f} m from the way"
        spot = "on the road" if self.on_road else "off the road"
        tight = ""
        if self.narrows is not None:
            tight = f"; narrows the road from {self.narrows[0]:.1f} m to {self.narrows[1]:.1f} m"
        known = self.label or "unnamed thing"
        state = "" if self.state in ("fixed", "unknown") else f"{self.state} "
        doubt = " (whether it moves was not observed)" if self.state == "unknown" else ""
        return f"{self.station:.0f} m: {state}{known} #{self.id} {where}, {spot}{away}{tight}{doubt}"


@dataclass(frozen=True, kw_only=True)
class RouteJunction:
    """A junction on the way."""

    station: float
    kind: str
    ways: tuple[str, ...]
    """Where one can go on: left, straight, right."""

    def text(self) -> str:
        """Return it as a line."""
        return f"{self.station:.0f} m: {self.kind} junction, ways on: {', '.join(self.ways) or 'none known'}"


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A stretch of the way."""

    start: float
    """Metres."""
    end: float

    def text(self) -> str:
        """Return it as a line."""
        return f"{self.start:.0f} to {self.end:.0f} m: the ground was never seen"


@dataclass(frozen=True, eq=False, kw_only=True)
class RouteBrief:
    """What comes within the length of a route."""

    route: Route
    objects: tuple[RouteObject, ...]
    """In the order in which they come."""
    junctions: tuple[RouteJunction, ...]
    unknown: tuple[Stretch, ...]
    counts: dict[str, int]
    """Other things within 12 m, by label; they are not listed one by one."""
    synthetic: bool

    @property
    def narrow(self) -> tuple[RouteObject, ...]:
        """Things that narrow the road, tightest first."""
        return tuple(sorted((o for o in self.objects if o.narrows), key=lambda o: (o.narrows or (0, 0))[1]))

    def text(self) -> str:
        """Return the brief as lines for a person."""
        way = self.route
        read = f", the last {way.length - way.driven:.0f} m of it read from the road" if way.driven < way.length else ""
        lines = [f"The next {way.length:.0f} m{read}{' (synthetic)' if self.synthetic else ''}"]
        events = [(o.station, o.text()) for o in (*self.objects, *self.junctions)]
        events += [(s.start, s.text()) for s in self.unknown]
        lines += [f"  {text}" for _, text in sorted(events, key=lambda event: event[0])]
        if not events:
            lines.append("  nothing to tell")
        if self.counts:
            rest = ", ".join(f"{count} {label or 'unnamed'}" for label, count in self.counts.items())
            lines.append(f"  beside the way, not listed: {rest}")
        if self.narrow and self.narrow[0].narrows is not None:
            tight = self.narrow[0]
            lines.append(f"  tightest: {tight.narrows[1]:.1f} m at {tight.station:.0f} m, beside #{tight.id}")  # pyright: ignore[reportOptionalSubscript]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "length": round(self.route.length, 2),
            "driven": round(self.route.driven, 2),
            "route": np.round(self.route.points, 2).tolist(),
            "units": "metres; stations along the route; left is positive",
            "synthetic": self.synthetic,
            "objects": [asdict(o) for o in self.objects],
            "junctions": [asdict(j) for j in self.junctions],
            "unknown": [asdict(s) for s in self.unknown],
            "counts": self.counts,
            "text": self.text(),
        }


def brief_route(
    scene: SceneMap, route: Route | None = None, *, frame: int | None = None, length: float = 100.0
) -> RouteBrief:
    """Tell what comes along a route, or along the way ahead of the ego at a keyframe.

    Listed are things that can move within 15 m of the way, and small ones of the road's furniture within 12 m; of all
    else within 12 m only how many.

    Raises ConfigError as `route_ahead` does, where no route is given.
    """
    regions = regions_of(scene)
    way = route or route_ahead(scene, frame=frame, length=length, regions=regions)
    listed, counts = [], {}
    for item in scene.objects:
        station, until, low, high = _span(way, item)
        off = 0.0 if low <= 0 <= high else min(abs(low), abs(high))
        if until < 0 or station > way.length or off > _BESIDE:
            continue
        small = any(word in item.label.lower() for word in _SMALL)
        movable = kind_of(item.label) == Kind.MOVABLE
        if movable or (small and off <= _NEAR):
            listed.append(_listed(scene, item, way, regions, (station, until, low, high)))
        elif off <= _NEAR and kind_of(item.label) != Kind.GROUND:
            counts[item.label] = counts.get(item.label, 0) + 1
    listed.sort(key=lambda o: (o.station, o.id))
    return RouteBrief(
        route=way,
        objects=tuple(listed),
        junctions=tuple(_junctions(way, regions.lanes.junctions)),
        unknown=tuple(_unknown(scene, way)),
        counts=dict(sorted(counts.items(), key=lambda one: (-one[1], one[0]))),
        synthetic=scene.provenance.synthetic,
    )


def _span(way: Route, item: SceneObject) -> tuple[float, float, float, float]:
    """Return where an object begins and ends along the way, and the least and the most it is to the left of it."""
    corners = item.box.corners[:4, :2]
    rim = np.concatenate([corners + t * (np.roll(corners, -1, axis=0) - corners) for t in (0.0, 0.25, 0.5, 0.75)])
    station, left = way.locate(rim)
    return float(station.min()), float(station.max()), float(left.min()), float(left.max())


def _listed(
    scene: SceneMap, item: SceneObject, way: Route, regions: Regions, span: tuple[float, float, float, float]
) -> RouteObject:
    station, until, low, high = span
    middle = float(np.clip((station + until) / 2, 0, way.length))
    side: Side = "ahead" if low < _LANE and high > -_LANE else ("left" if low > 0 else "right")
    nearest = 0.0 if low <= 0 <= high else (low if low > 0 else high)
    right, left = _road(way, regions, middle)
    on_road = left - right > 0 and min(high, left) - max(low, right) > _AT_LEAST
    narrows = None
    rims_seen = coverage_of(scene).seen(np.stack([_beside(way, middle, right - 0.6), _beside(way, middle, left + 0.6)]))
    if on_road and rims_seen.all() and left - right >= _A_LANE and item.state not in ("moving", "stopped"):
        narrows = (round(left - right, 2), round(max(left - high, low - right, 0.0), 2))
    length, width, height = (round(float(s), 2) for s in item.box.size)
    return RouteObject(
        id=item.id, label=item.label, state=item.state, evidence=item.evidence, side=side,
        station=round(max(station, 0.0), 2), until=round(until, 2), left=round(nearest, 2),
        size=(length, width, height), on_road=on_road, narrows=narrows, last_seen=round(item.last_seen, 3),
    )  # fmt: skip


def _road(way: Route, regions: Regions, station: float) -> tuple[float, float]:
    """Return how far the road reaches to the right (negative) and to the left of the way at a station, metres."""
    place, heading = way.at(station), way.heading(station)
    across = np.array([-np.sin(heading), np.cos(heading)])
    step = regions.ground.voxel_size / 2
    offsets = np.arange(0.0, 15.0, step)
    reach = []
    for sign in (-1.0, 1.0):
        on = regions.ground.at(regions.ground.road, place + sign * offsets[:, None] * across) > 0
        reach.append(sign * float(_first_off(on)) * step)
    return reach[0], reach[1]


def _beside(way: Route, station: float, left: float) -> Float[np.ndarray, " 2"]:
    """Return the place so far to the left of the way at a station."""
    heading = way.heading(station)
    return way.at(station) + left * np.array([-np.sin(heading), np.cos(heading)])


def _first_off(on: Bool[np.ndarray, " n"]) -> int:
    return len(on) if on.all() else int(np.argmin(on))


def _junctions(way: Route, junctions: tuple[Junction, ...]) -> Iterator[RouteJunction]:
    found = []
    for junction in junctions:
        station, left = way.locate(np.array([junction.center]))
        if 0 <= station[0] <= way.length and abs(left[0]) <= junction.radius:
            found.append((float(station[0]), junction))
    for station, junction in sorted(found, key=lambda one: one[0]):
        yield RouteJunction(
            station=round(station, 2),
            kind=junction.kind,
            ways=_ways_on(way.heading(station - junction.radius), junction),
        )


def _ways_on(heading: float, junction: Junction) -> tuple[str, ...]:
    """Return where the arms of a junction lead for one who arrives with a heading."""
    turns = [float((arm - heading + np.pi) % (2 * np.pi) - np.pi) for arm in junction.arms]
    names = {
        "left": any(np.deg2rad(30) < turn < np.deg2rad(150) for turn in turns),
        "straight": any(abs(turn) <= np.deg2rad(30) for turn in turns),
        "right": any(-np.deg2rad(150) < turn < -np.deg2rad(30) for turn in turns),
    }
    return tuple(name for name, there in names.items() if there)


def _unknown(scene: SceneMap, way: Route) -> Iterator[Stretch]:
    """Return the stretches of the way whose ground nobody saw."""
    stations = np.arange(0.0, way.length, _STEP)
    places: Float[np.ndarray, "n 2"] = np.array([way.at(s) for s in stations])
    unseen = np.diff(np.r_[0, (~coverage_of(scene).seen(places)).astype(int), 0])
    for start, end in zip(np.flatnonzero(unseen == 1), np.flatnonzero(unseen == -1), strict=True):
        if (end - start) * _STEP >= _UNSEEN:
            yield Stretch(start=float(start * _STEP), end=float(min(end * _STEP, way.length)))
