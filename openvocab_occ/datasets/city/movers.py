"""Who is on the move during a traversal, and where they go."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from openvocab_occ.datasets.city.ground import CROSSING, KERB
from openvocab_occ.datasets.city.parking import COLORS, vehicle
from openvocab_occ.datasets.city.riders import bicycle, motorcycle, pedestrian
from openvocab_occ.datasets.city.streets import SIDEWALK_WIDTH
from openvocab_occ.datasets.city.surfaces import PAINTS
from openvocab_occ.datasets.city.things import LABELS, Thing
from openvocab_occ.datasets.city.town import Town
from openvocab_occ.datasets.city.traffic import Crosser, Driver, Motion, Simulation, random_route
from openvocab_occ.datasets.city.trucks import TRUCK_KINDS
from openvocab_occ.datasets.city.vehicles import CAR_KINDS

MOVER_IDS = 1_000_000
"""Instance numbers of movers start here; a thousand for each traversal."""
WARM_UP = 6.0
"""Seconds that traffic runs before the first keyframe."""
DURATION = 20.0
"""Seconds of a traversal, as a scene of nuScenes."""
EGO_LENGTH = 4.1
_DRIVERS, _WALKERS = 22, 46


@dataclass(frozen=True, eq=False)
class Mover:
    """A thing and its way."""

    thing: Thing
    motion: Motion


def ego_route(town: Town, route: int) -> list[int]:
    """Return the lanes of a route; route 0 begins at the western end of Main Street."""
    rng = np.random.default_rng([town.seed, 41, route])
    lanes = [n for n, lane in enumerate(town.lanes.lanes) if not lane.is_turn and lane.length > 30]
    if route == 0:
        start = min(lanes, key=lambda n: (town.lanes.lanes[n].street != 1, town.lanes.lanes[n].points[0, 0]))
    else:
        start = lanes[rng.integers(len(lanes))]
    return random_route(town.lanes, start, 420.0, rng)


@lru_cache(maxsize=8)
def set_going(town: Town, route: int, traversal: int, traffic: float) -> tuple[Motion, list[Mover]]:
    """Simulate a traversal; return the ego's motion and everyone else's, time 0 being the first keyframe."""
    rng = np.random.default_rng([town.seed, 42, route, traversal, round(10 * traffic)])
    way = ego_route(town, route)
    ego = Driver(way, float(rng.uniform(6, 14)), EGO_LENGTH, 6.0, float(rng.uniform(7.0, 8.5)))
    if rng.random() < 0.3:  # a stop on the way
        ego.stops = ((float(rng.uniform(70, 110)), float(rng.uniform(1.5, 3.0))),)
    drivers, cast = _drivers(town, way, round(_DRIVERS * traffic), rng)
    walkers, looks = _walkers(town, way, rng)
    simulation = Simulation(town.lanes, [ego, *drivers], walkers)
    driven, walked = simulation.run(WARM_UP + DURATION + 1.0)
    movers = []
    first = MOVER_IDS + 1000 * traversal
    for number, ((kind, color), motion) in enumerate(zip(cast, driven[1:], strict=True)):
        movers.append(_mover(first + number, kind, color, motion, 0.0))
    for number, ((look, color), walker, motion) in enumerate(zip(looks, walkers, walked, strict=True)):
        z = 0.0 if walker.kerb is not None else KERB
        mesh = pedestrian(color, look, 0.5 if look % 2 else -0.5)
        thing = Thing(id=first + 500 + number, kind="pedestrian", label=LABELS["pedestrian"], color=color, mesh=mesh,
                      position=(0.0, 0.0, z))  # fmt: skip
        movers.append(Mover(thing, motion))
    return driven[0], movers


def _mover(id_: int, kind: str, color: str, motion: Motion, z: float) -> Mover:
    if kind in ("bicycle", "motorcycle"):
        build = bicycle if kind == "bicycle" else motorcycle
        mesh, label = build(color, PAINTS["white" if color != "white" else "blue"]), LABELS[kind]
    else:
        mesh, label = vehicle(kind, color)
    return Mover(Thing(id=id_, kind=kind, label=label, color=color, mesh=mesh, position=(0.0, 0.0, z)), motion)


def _drivers(
    town: Town, way: list[int], count: int, rng: np.random.Generator
) -> tuple[list[Driver], list[tuple[str, str]]]:
    """Place drivers on lanes, most of them near the ego's way."""
    lanes = town.lanes.lanes
    along = np.concatenate([lanes[n].points for n in way[:5]])
    weights = []
    for lane in lanes:
        near = np.linalg.norm(lane.points[:, None] - along[None, ::4], axis=2).min()
        weights.append(0.0 if lane.is_turn or lane.length < 30 else np.exp(-((near / 60.0) ** 2)) + 0.05)
    chance = np.array(weights) * [lane.length for lane in lanes]
    taken: list[tuple[int, float, float]] = [(way[0], 10.0, 12.0)]
    drivers, cast = [], []
    for _ in range(count * 12):
        if len(drivers) == count:
            break
        lane = int(rng.choice(len(lanes), p=chance / chance.sum()))
        kind = _kind(rng)
        length = float(np.ptp(vehicle(kind, "red")[0].vertices[:, 0])) if kind not in ("bicycle", "motorcycle") else 2.0
        s = float(rng.uniform(length / 2 + 1, max(lanes[lane].length - length, length / 2 + 1.5)))
        if any(lane == other and abs(s - at) < (length + room) / 2 + 4.0 for other, at, room in taken):
            continue
        taken.append((lane, s, length))
        desired = float(rng.uniform(4, 5) if kind == "bicycle" else rng.uniform(7, 10.5))
        driver = Driver(random_route(town.lanes, lane, 420.0, rng), s, length, desired * 0.6, desired)
        if kind == "bus" or rng.random() < 0.25:  # it stops and goes on
            driver.stops = ((s + float(rng.uniform(25, 90)), float(rng.uniform(2, 6))),)
        drivers.append(driver)
        cast.append((kind, COLORS[rng.integers(len(COLORS))]))
    return drivers, cast


def _kind(rng: np.random.Generator) -> str:
    dice = rng.random()
    for limit, kinds in ((0.55, CAR_KINDS), (0.66, ("van",)), (0.82, TRUCK_KINDS), (0.88, ("bus",)),
                         (0.94, ("motorcycle",)), (1.01, ("bicycle",))):  # fmt: skip
        if dice < limit:
            return kinds[rng.integers(len(kinds))]
    raise AssertionError("chances end above 1")


def _walkers(town: Town, way: list[int], rng: np.random.Generator) -> tuple[list[Crosser], list[tuple[int, str]]]:
    """Let people walk along the streets of the ego's way, stand about on the square, and cross at junctions."""
    plan = town.plan
    streets = sorted({town.lanes.lanes[n].street for n in way} - {-1})
    walkers = []
    for _ in range(_WALKERS):
        street = plan.streets[streets[rng.integers(len(streets))]]
        side, along = rng.choice([-1, 1]), rng.choice([-1, 1])
        s = float(rng.uniform(10, street.length - 10))
        lateral = side * (street.half_width + float(rng.uniform(1.1, 2.1)))
        point, heading = street.at(s, lateral)
        end, _ = street.at(s + along * 34.0, lateral)
        offset = plan.road_distance(np.stack([point + (end - point) * t for t in np.linspace(0, 1, 12)]))
        if offset.min() < 0.4 or offset.max() > SIDEWALK_WIDTH - 0.4:
            continue
        heading = float(np.arctan2(end[1] - point[1], end[0] - point[0]))
        speed = float(rng.uniform(1.0, 1.5)) if rng.random() < 0.85 else 0.0
        walkers.append(Crosser((float(point[0]), float(point[1])), heading, speed))
    for square in plan.squares:
        for _ in range(6):
            at = np.array(square.center) + rng.uniform(-0.35, 0.35, 2) * square.size
            speed = 0.0 if rng.random() < 0.5 else 0.4
            walkers.append(Crosser((float(at[0]), float(at[1])), float(rng.uniform(0, 2 * np.pi)), speed))
    for junction in plan.junctions:
        for arm in junction.arms:
            if rng.random() > 0.45:
                continue
            street, side = plan.streets[arm.street], int(rng.choice([-1, 1]))
            s = arm.s + arm.direction * (sum(CROSSING) / 2 + float(rng.uniform(-0.8, 0.8)))
            lead = float(rng.uniform(1.0, 2.6))
            point, heading = street.at(s, side * (street.half_width + lead))
            walkers.append(
                Crosser((float(point[0]), float(point[1])), float(heading) - side * np.pi / 2,
                        float(rng.uniform(1.1, 1.5)), lead, 2 * street.half_width)
            )  # fmt: skip
    return walkers, [(int(rng.integers(1 << 16)), COLORS[rng.integers(len(COLORS))]) for _ in walkers]
