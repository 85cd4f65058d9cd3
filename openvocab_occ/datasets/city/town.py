"""What stands in the town for good, or is built and torn down between traversals."""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.ndimage import map_coordinates

from openvocab_occ.datasets.city import furniture
from openvocab_occ.datasets.city.buildings import House, house, shed
from openvocab_occ.datasets.city.ground import BAY_LENGTH, KERB, LAWN, ground_meshes
from openvocab_occ.datasets.city.lanes import LaneGraph, build_lanes
from openvocab_occ.datasets.city.mesh import Mesh
from openvocab_occ.datasets.city.parking import Place, places
from openvocab_occ.datasets.city.riders import bicycle
from openvocab_occ.datasets.city.streets import CUT, SIDEWALK_WIDTH, Plan, Street, draw_plan
from openvocab_occ.datasets.city.things import FOREVER, LABELS, Thing
from openvocab_occ.datasets.city.trucks import excavator, wheel_loader
from openvocab_occ.datasets.city.vegetation import TREE_KINDS, bush, tree

_CELL = 0.5  # of the register of claimed ground, metres
_ZONES = {"road": "driveable surface", "sidewalk": "sidewalk", "square": "other flat", "terrain": "terrain"}


@dataclass(frozen=True, eq=False)
class Town:
    """The plan, its lanes, and all that does not move."""

    seed: int
    plan: Plan
    lanes: LaneGraph
    things: tuple[Thing, ...]
    """Ground, buildings, plants, furniture; each with the traversals it exists in."""
    spots: tuple[Place, ...]
    """Where vehicles park."""
    closed: frozenset[int]
    """Places taken by road works."""


@dataclass
class _Planter:
    """Puts things where there is room for them. Mutable."""

    plan: Plan
    rng: np.random.Generator
    things: list[Thing] = field(default_factory=list)

    def __post_init__(self) -> None:
        x0, x1, y0, y1 = self.plan.bounds
        self._low = np.array([x0, y0]) - 60.0
        extent = np.ceil(np.array([x1, y1]) + 60.0 - self._low).astype(int)
        self._claimed = np.zeros(np.ceil(extent / _CELL).astype(int), dtype=np.bool_)
        xy = np.stack(np.meshgrid(*(np.arange(n + 1.0) for n in extent), indexing="ij"), axis=-1) + self._low
        self._road = self.plan.road_distance(xy.reshape(-1, 2)).reshape(xy.shape[:2])

    def road_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance to the road, interpolated between the metres of a lattice."""
        return map_coordinates(self._road, (points - self._low).T, order=1, mode="nearest")

    def footprint(self, xy: tuple[float, float], yaw: float, size: tuple[float, float]) -> np.ndarray:
        """Return points half a cell apart that cover a rectangle."""
        steps = [np.arange(-a / 2, a / 2 + _CELL / 2, _CELL / 2) for a in size]
        x, y = (a.ravel() for a in np.meshgrid(*steps))
        c, s = np.cos(yaw), np.sin(yaw)
        return np.stack([xy[0] + c * x - s * y, xy[1] + s * x + c * y], axis=1)

    def claim(self, points: np.ndarray) -> bool:
        """Take the ground under the points, or return False where some of it is taken."""
        i, j = np.floor((points - self._low) / _CELL).astype(int).T
        if self._claimed[i, j].any():
            return False
        self._claimed[i, j] = True
        return True

    def put(self, kind: str, label: str, mesh: Mesh, xy: tuple[float, float], yaw: float = 0.0, *, z: float = KERB,
            **more: object) -> None:  # fmt: skip
        """Add a thing."""
        position = (float(xy[0]), float(xy[1]), z)
        self.things.append(
            Thing(id=len(self.things) + 1, kind=kind, label=LABELS[label], mesh=mesh, position=position, yaw=float(yaw),
                  **more)  # pyright: ignore[reportArgumentType]
        )  # fmt: skip


@lru_cache(maxsize=2)
def build_town(seed: int) -> Town:
    """Draw a town; the same seed gives the same town. The last two are kept."""
    plan = draw_plan(np.random.default_rng([seed, 11]))
    planter = _Planter(plan, np.random.default_rng([seed, 12]))
    for zone, mesh in ground_meshes(plan).items():
        planter.put(zone, _ZONES[zone], mesh, (0.0, 0.0), z=0.0)
    spots = places(plan)
    closed = _road_works(planter, spots)
    for lot in plan.lots:
        planter.claim(planter.footprint(lot.center, lot.yaw, lot.size))
    _square(planter)
    for street in plan.streets:
        _signs(planter, street)
        _lamps(planter, street)
        _houses(planter, street)
        _trees(planter, street)
        _sidewalk(planter, street)
    _yard(planter)
    return Town(seed, plan, build_lanes(plan), tuple(planter.things), tuple(spots), closed)


def _houses(p: _Planter, street: Street) -> None:
    """Build houses along both sides, most with a garden in front; one is built and one torn down later."""
    stock = [
        House(width=w, depth=float(p.rng.uniform(8, 10)), floors=int(p.rng.integers(2 if shop else 1, 4)),
              flat=shop or p.rng.random() < 0.2, shop=shop, look=int(p.rng.integers(1 << 20)))
        for shop in (False, False, False, True) for w in (9.0, 10.5, 12.0)
    ]  # fmt: skip
    built = 0
    for side in (-1, 1):
        s = 2.0
        while s < street.length - 2.0:
            spec = stock[p.rng.integers(len(stock))]
            setback = SIDEWALK_WIDTH + (0.45 if spec.shop else float(p.rng.uniform(3.2, 5.5)))
            point, heading = street.at(s + spec.width / 2, side * (street.half_width + setback + spec.depth / 2))
            yaw = float(heading) + (0.0 if side > 0 else np.pi)
            ground = p.footprint((point[0], point[1]), yaw, (spec.width + 0.8, spec.depth + 0.6))
            if p.road_distance(ground).min() < SIDEWALK_WIDTH or not p.claim(ground):
                s += 2.0
                continue
            built += 1
            exists = {4: (2, FOREVER), 7: (0, 2)}.get(built, (0, FOREVER))
            kind = "shop" if spec.shop else "house"
            p.put(kind, "manmade", house(spec), (point[0], point[1]), yaw, z=LAWN, exists=exists)
            if not spec.shop:
                _garden(p, street, s, side, spec, new=built in (3, 9))
            s += spec.width + float(p.rng.uniform(1.2, 4.0))


def _garden(p: _Planter, street: Street, s: float, side: int, spec: House, *, new: bool) -> None:
    """Add a fence, a wall or a hedge in front, bushes, and at times a shed behind."""
    point, heading = street.at(s + spec.width / 2, side * (street.half_width + SIDEWALK_WIDTH + 0.7))
    xy, length = (float(point[0]), float(point[1])), round(spec.width - 1.0, 1)
    kind = p.rng.random()
    yaw = float(heading) + (0.0 if side > 0 else np.pi)
    if p.claim(p.footprint(xy, yaw, (length, 0.8))):
        if kind < 0.4 or new:
            exists = (1, FOREVER) if new else (0, FOREVER)
            p.put("fence", "manmade", furniture.fence(length, int(p.rng.integers(3))), xy, yaw, z=LAWN, exists=exists)
        elif kind < 0.65:
            p.put("wall", "manmade", furniture.wall(length, int(p.rng.integers(2))), xy, yaw, z=LAWN)
        elif kind < 0.9:
            p.put("hedge", "vegetation", bush(length, int(p.rng.integers(4))), xy, yaw, z=LAWN)
    for lateral, chance in ((2.3, 0.6), (SIDEWALK_WIDTH + 18.0, 0.5)):
        if p.rng.random() > chance:
            continue
        offset = side * (street.half_width + SIDEWALK_WIDTH + lateral)
        point, _ = street.at(s + spec.width * float(p.rng.random()), offset)
        behind = lateral > 5
        ground = p.footprint((point[0], point[1]), yaw, (3.4, 2.8) if behind else (2.4, 1.0))
        if p.road_distance(ground).min() > SIDEWALK_WIDTH + 0.3 and p.claim(ground):
            if behind:
                p.put("shed", "manmade", shed(int(p.rng.integers(3))), (point[0], point[1]), yaw, z=LAWN)
            else:
                p.put("bush", "vegetation", bush(2.2, int(p.rng.integers(6))), (point[0], point[1]), yaw, z=LAWN)


def _along(
    p: _Planter, street: Street, side: int, step: float, offset: float
) -> list[tuple[tuple[float, float], float]]:
    """Return places along a sidewalk, so many metres from the kerb, and the heading towards the road."""
    s = np.arange(float(p.rng.uniform(2, step)), street.length, step)
    s = s + p.rng.uniform(-0.12 * step, 0.12 * step, len(s))
    points, headings = street.at(s, np.full(len(s), side * (street.half_width + offset)))
    good = np.abs(p.road_distance(points) - offset) < 0.15
    return [
        ((float(point[0]), float(point[1])), float(heading) - side * np.pi / 2)
        for point, heading in zip(points[good], headings[good], strict=True)
    ]


def _trees(p: _Planter, street: Street) -> None:
    for side in (-1, 1):
        for xy, yaw in _along(p, street, side, 13.0, 2.5):
            if p.claim(p.footprint(xy, yaw, (0.8, 0.8))):
                _tree(p, xy, KERB)
        for xy, yaw in _along(p, street, side, 17.0, 20.0):  # of gardens
            if p.claim(p.footprint(xy, yaw, (2.0, 2.0))):
                _tree(p, xy, LAWN)


def _tree(p: _Planter, xy: tuple[float, float], z: float) -> None:
    kind = TREE_KINDS[p.rng.choice(3, p=[0.72, 0.13, 0.15])]
    mesh = tree(kind, float(p.rng.choice([5.5, 6.5, 7.5, 8.5])), int(p.rng.integers(2)))
    p.put("tree", "vegetation", mesh, xy, float(p.rng.uniform(0, 2 * np.pi)), z=z)


def _lamps(p: _Planter, street: Street) -> None:
    light = (furniture.LAMP_REACH, 0.0, furniture.LAMP_HEIGHT)
    for side in (-1, 1):
        for xy, yaw in _along(p, street, side, 24.0, 0.6):
            if p.claim(p.footprint(xy, yaw, (0.4, 0.4))):
                p.put("street lamp", "manmade", furniture.lamp(), xy, yaw, light=light)


def _signs(p: _Planter, street: Street) -> None:
    """Put a sign or a signal at every arm of the junctions, and parking and speed signs along the way."""
    number = p.plan.streets.index(street)
    for junction in p.plan.junctions:
        for arm in junction.arms:
            if arm.street != number:
                continue
            s, side = arm.s + arm.direction * (CUT - 0.8), arm.direction
            point, heading = street.at(s, side * (street.half_width + 0.45))
            yaw = float(heading) + (np.pi if arm.direction > 0 else 0.0)
            xy = (float(point[0]), float(point[1]))
            p.claim(p.footprint(xy, 0.0, (0.4, 0.4)))
            if len(junction.arms) == 4:
                p.put("traffic signal", "manmade", furniture.signal(2 if number == 1 else 0), xy, yaw)
            else:
                kind = "stop" if arm is junction.arms[-1] else "yield"
                if kind == "stop" or p.rng.random() < 0.4:
                    p.put(f"{kind} sign", "manmade", furniture.sign(kind), xy, yaw)
    for side in (-1, 1):
        for xy, yaw in _along(p, street, side, 55.0, 0.45):
            kind = ("parking", "speed limit")[p.rng.integers(2)]
            if p.claim(p.footprint(xy, yaw, (0.4, 0.4))):
                p.put(
                    f"{kind} sign",
                    "manmade",
                    furniture.sign(kind),
                    xy,
                    yaw + side * np.pi / 2 + (np.pi if side > 0 else 0),
                )


def _sidewalk(p: _Planter, street: Street) -> None:
    """Add bins, benches and bicycles."""
    for side in (-1, 1):
        for xy, yaw in _along(p, street, side, 33.0, 0.8):
            if p.claim(p.footprint(xy, yaw, (0.7, 0.7))):
                p.put("litter bin", "others", furniture.bin_(), xy, yaw)
        for xy, yaw in _along(p, street, side, 41.0, 2.6):
            if p.claim(p.footprint(xy, yaw, (0.8, 1.8))):
                p.put("bench", "others", furniture.bench(), xy, yaw + np.pi)
        for xy, yaw in _along(p, street, side, 37.0, 2.85):
            color = ("red", "blue", "green", "black", "orange")[p.rng.integers(5)]
            if p.claim(p.footprint(xy, yaw + np.pi / 2, (1.9, 0.6))):
                p.put("bicycle", "bicycle", bicycle(color), xy, yaw + np.pi / 2, color=color)


def _square(p: _Planter) -> None:
    """Plant trees on the square and put benches under them."""
    for patch in p.plan.squares:
        c, s = np.cos(patch.yaw), np.sin(patch.yaw)
        for x in (-11.0, -4.0, 4.0, 11.0):
            for y in (-6.5, 6.5):
                xy = (patch.center[0] + c * x - s * y, patch.center[1] + s * x + c * y)
                _tree(p, xy, 0.16)
                side = (xy[0] + c * 1.6, xy[1] + s * 1.6)
                p.put("bench", "others", furniture.bench(), side, patch.yaw + np.pi / 2 * (-1 if y > 0 else 1), z=0.16)
        p.claim(p.footprint(patch.center, patch.yaw, (patch.size[0] + 1, patch.size[1] + 1)))


def _road_works(p: _Planter, spots: list[Place]) -> frozenset[int]:
    """Close three bays of the main street for an excavator, with barriers and cones around it."""
    street = p.plan.streets[1]
    s, lateral = street.project(np.array([spot.position for spot in spots]))
    there = np.flatnonzero((np.abs(lateral - 4.6) < 0.3) & (s > 5) & (s < street.length - 5))
    first = int(there[np.argmin(np.abs(s[there] - street.length * 0.22))])
    middle = float(s[first])
    point, heading = street.at(middle, 4.75)
    yaw = float(heading)
    p.put(
        "excavator",
        "construction vehicle",
        excavator("yellow"),
        (point[0], point[1]),
        yaw + np.pi,
        z=0.0,
        color="yellow",
    )
    for end in (-1, 1):
        point, _ = street.at(middle + end * 1.42 * BAY_LENGTH, 4.6)
        p.put("barrier", "barrier", furniture.barrier(), (point[0], point[1]), yaw, z=0.0)
    for ahead in np.linspace(-1.35, 1.35, 8) * BAY_LENGTH:
        point, _ = street.at(middle + ahead, 3.45)
        p.put("traffic cone", "traffic cone", furniture.cone(), (point[0], point[1]), yaw, z=0.0, color="orange")
    near = np.abs(s - middle) < 1.6 * BAY_LENGTH
    return frozenset(np.flatnonzero(near & (np.abs(lateral - 4.6) < 0.3)).tolist())


def _yard(p: _Planter) -> None:
    """Put a wheel loader behind concrete barriers near the way into the parking lot."""
    way = p.plan.lots[1]
    c, s = np.cos(way.yaw), np.sin(way.yaw)
    for x in (-14.0, 14.0):
        xy = (way.center[0] + c * x + s * 1.5, way.center[1] + s * x - c * 1.5)
        if not p.claim(p.footprint(xy, way.yaw, (8.0, 4.0))):
            continue
        loader = wheel_loader("yellow")
        p.put("wheel loader", "construction vehicle", loader, xy, way.yaw + 0.3, z=LAWN, color="yellow")
        for k in (-1, 0, 1):
            at = (xy[0] + c * 2.2 * k - s * 2.6, xy[1] + s * 2.2 * k + c * 2.6)
            p.put("barrier", "barrier", furniture.barrier("concrete"), at, way.yaw + np.pi / 2, z=LAWN)
        return
