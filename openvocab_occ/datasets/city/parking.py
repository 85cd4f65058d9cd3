"""Who is parked where on which day: places are taken and left between traversals."""

from dataclasses import dataclass

import numpy as np

from openvocab_occ.datasets.city.ground import bay_positions, lot_places
from openvocab_occ.datasets.city.mesh import Mesh
from openvocab_occ.datasets.city.riders import motorcycle
from openvocab_occ.datasets.city.streets import LANE_WIDTH, Plan
from openvocab_occ.datasets.city.surfaces import PAINTS
from openvocab_occ.datasets.city.things import LABELS, Thing
from openvocab_occ.datasets.city.trucks import TRUCK_KINDS, trailer, truck
from openvocab_occ.datasets.city.vehicles import CAR_KINDS, bus, car, van

PARKED_IDS = 100_000
"""Instance numbers of parked vehicles start here; a hundred for each place."""
COLORS = tuple(PAINTS)
_TAKEN = 0.66  # of the bays
_CHANGE = 0.3  # of the places from one traversal to the next


@dataclass(frozen=True)
class Place:
    """A bay, or a place of a parking lot."""

    position: tuple[float, float]
    heading: float
    long: bool = False
    """Room for a truck."""
    neighbours: tuple[int, ...] = ()
    """Places that a truck here would cover."""


def places(plan: Plan) -> list[Place]:
    """Return all places where vehicles park."""
    found: list[Place] = []
    for street in plan.streets:
        for side in (-1, 1):
            s = bay_positions(plan, street, side)
            points, headings = street.at(s, np.full(len(s), side * (LANE_WIDTH + 1.13)))
            first = len(found)
            for i, (point, heading) in enumerate(zip(points, headings, strict=True)):
                inner = 0 < i < len(s) - 1 and s[i + 1] - s[i - 1] < 14.0
                beside = (first + i - 1, first + i + 1) if inner and i % 3 == 1 else ()
                yaw = float(heading) + (np.pi if side > 0 else 0.0)
                found.append(Place((float(point[0]), float(point[1])), yaw, bool(beside), beside))
    for position, heading in lot_places(plan.lots[0]):
        found.append(Place(position, heading))
    for number in (len(found) - 2, len(found) - 1):
        found[number] = Place(found[number].position, found[number].heading, long=True)
    return found


def vehicle(kind: str, color: str) -> tuple[Mesh, int]:
    """Return the mesh and the class of a kind of vehicle in a named colour."""
    if kind in CAR_KINDS:
        return car(kind, color), LABELS["car"]
    if kind == "van":
        return van(color), LABELS["car"]
    if kind in TRUCK_KINDS:
        return truck(kind, color), LABELS["truck"]
    if kind == "bus":
        return bus(color), LABELS["bus"]
    if kind == "trailer":
        return trailer(PAINTS[color]), LABELS["trailer"]
    return motorcycle(color), LABELS["motorcycle"]


def parked(town_seed: int, spots: list[Place], blocked: frozenset[int], traversal: int) -> list[Thing]:
    """Return the vehicles parked during a traversal; those that stayed since the last one keep their number."""
    taken: dict[int, tuple[int, np.random.Generator]] = {}
    for number in range(len(spots)):
        if number in blocked:
            continue
        days = np.random.default_rng([town_seed, 31, number])
        guest, there = 0, days.random() < _TAKEN
        for _ in range(traversal):
            if days.random() < _CHANGE:
                guest, there = guest + 1, bool(days.random() < _TAKEN)
        if there:
            taken[number] = (guest, np.random.default_rng([town_seed, 32, number, guest]))
    drawn = {n: _draw(spots[n], rng) for n, (_, rng) in taken.items()}
    for number, (kind, _) in list(drawn.items()):
        if number in drawn and kind in TRUCK_KINDS:
            for beside in spots[number].neighbours:
                drawn.pop(beside, None)
    things = []
    for number, (kind, color) in drawn.items():
        guest, rng = taken[number]
        mesh, label = vehicle(kind, color)
        (x, y), heading = spots[number].position, spots[number].heading
        ahead = float(rng.uniform(-0.3, 0.3))
        yaw = heading + float(rng.normal(0, 0.02)) + (0.5 if kind == "motorcycle" else 0.0)
        position = (x + ahead * float(np.cos(heading)), y + ahead * float(np.sin(heading)), 0.0)
        id_ = PARKED_IDS + 100 * number + guest
        things.append(Thing(id=id_, kind=kind, label=label, color=color, mesh=mesh, position=position, yaw=yaw))
    return things


def _draw(place: Place, rng: np.random.Generator) -> tuple[str, str]:
    """Draw kind and colour of who takes a place."""
    color = COLORS[rng.integers(len(COLORS))]
    if place.long and not place.neighbours:  # of the lot
        return ("trailer", "bus", "box truck", "tanker truck")[rng.integers(4)], color
    dice = rng.random()
    if place.neighbours and dice < 0.55:
        return TRUCK_KINDS[rng.integers(len(TRUCK_KINDS))], color
    if dice > 0.95:
        return "motorcycle", color
    if dice > 0.8:
        return "van", color
    return CAR_KINDS[rng.integers(len(CAR_KINDS))], color
