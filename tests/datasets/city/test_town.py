"""The town is a town: lanes connect, nothing stands on the road, parked vehicles stay, moving ones do not collide."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from openvocab_occ.datasets.city import City
from openvocab_occ.datasets.city.keyframes import boxes
from openvocab_occ.datasets.city.lanes import build_lanes
from openvocab_occ.datasets.city.mesh import Builder
from openvocab_occ.datasets.city.movers import WARM_UP
from openvocab_occ.datasets.city.parking import parked
from openvocab_occ.datasets.city.sensors import PERIOD
from openvocab_occ.datasets.city.streets import draw_plan
from openvocab_occ.datasets.city.surfaces import DARK, Part
from openvocab_occ.datasets.city.things import LABELS, VEHICLES
from openvocab_occ.errors import ConfigError


@pytest.mark.parametrize("seed", range(5))
def test_every_lane_leads_to_every_other(seed):
    plan = draw_plan(np.random.default_rng([seed, 11]))
    lanes = build_lanes(plan).lanes
    rows = [(n, m) for n, lane in enumerate(lanes) for m in lane.successors]
    graph = csr_matrix((np.ones(len(rows)), np.array(rows).T), shape=(len(lanes), len(lanes)))
    assert connected_components(graph, directed=True, connection="strong")[0] == 1
    for n, m in rows:
        np.testing.assert_allclose(lanes[n].points[-1], lanes[m].points[0], atol=1e-6)
    assert {len(j.arms) for j in plan.junctions} == {3, 4}
    for lane in lanes:  # a car's width of road on both sides
        assert plan.road_distance(lane.points).max() < -1.0


def test_each_traversal_has_the_ground_everywhere(city):
    zones = {t.kind: t.mesh for t in city.town.things[:4]}
    area = {}
    for kind, mesh in zones.items():
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces[mesh.part == Part.GROUND]][:, :, :2], 1, 0)
        d, e = b - a, c - a
        area[kind] = np.abs(d[:, 0] * e[:, 1] - d[:, 1] * e[:, 0]).sum() / 2
    x0, x1, y0, y1 = city.town.plan.bounds
    rng = np.random.default_rng(0)
    points = rng.uniform((x0 - 60, y0 - 60), (x1 + 60, y1 + 60), (20_000, 2))
    total = (x1 - x0 + 120) * (y1 - y0 + 120)
    share = (city.town.plan.road_distance(points) < 0).mean() * total  # from the definition, by chance
    assert area["road"] == pytest.approx(share, rel=0.05)


def test_nothing_built_stands_on_the_road(city):
    kinds = Counter(t.kind for t in city.town.things)
    assert min(kinds[k] for k in ("house", "shop", "tree", "street lamp", "fence", "wall", "bush", "stop sign")) >= 2
    for thing in city.town.things[4:]:
        if thing.label in (LABELS["manmade"], LABELS["vegetation"]) and thing.kind != "tree":
            low, high = thing.mesh.bounds
            foot = np.array([(x, y, 0.0) for x in (low[0], high[0]) for y in (low[1], high[1])])
            foot = np.zeros((1, 2)) if thing.kind == "street lamp" else foot[:, :2]
            T = thing.pose()
            assert city.town.plan.road_distance(foot @ T[:2, :2].T + T[:2, 3]).min() > -0.1, thing.kind


def test_ways_of_parking(city):
    """Vehicles that stay keep number and place; some come, some go; none overlap."""
    days = [parked(7, list(city.town.spots), city.town.closed, n) for n in range(4)]
    for before, after in pairwise(days):
        a, b = {t.id: t for t in before}, {t.id: t for t in after}
        stayed = a.keys() & b.keys()
        assert len(stayed) > 0.4 * len(a)
        assert a.keys() - b.keys()
        assert b.keys() - a.keys()
        assert all(a[n].position == b[n].position and a[n].color == b[n].color for n in stayed)
    for day in days:
        centers = np.array([t.position[:2] for t in day])
        gap = np.linalg.norm(centers[:, None] - centers, axis=2) + 99 * np.eye(len(centers))
        assert gap.min() > 2.5


def test_buildings_come_and_go(city):
    there = [{t.id for t in city.traversal(0, n).still if t.label == LABELS["manmade"]} for n in range(3)]
    assert there[1] - there[0]  # a fence
    assert there[2] - there[1]  # a house
    assert there[1] - there[2]  # torn down


def test_vehicles_keep_apart(drive):
    """No two vehicles of the lanes, and not the ego, overlap at any second: discs that lie inside their boxes."""
    wheels = [m for m in drive.movers if m.thing.label in VEHICLES]
    for time in np.arange(0.0, 20.0, 1.0):
        discs, owner = [], []
        for number, T in enumerate([drive.T_world_ego(time), *(drive.mover_pose(m, time) for m in wheels)]):
            low, high = ((-2.0, 0, 0), (2.0, 0, 0)) if number == 0 else wheels[number - 1].thing.mesh.bounds
            for along in np.linspace(low[0] + 0.9, high[0] - 0.9, 5):
                discs.append(T[:2, :2] @ (along, 0.0) + T[:2, 3])
                owner.append(number)
        discs, owner = np.array(discs), np.array(owner)
        near = np.linalg.norm(discs[:, None] - discs, axis=2) < 1.2
        assert not (near & (owner[:, None] != owner)).any(), time


def test_truth_of_moving(drive):
    """Parked ones never move; what is said to move does, by more than half a metre while it is near."""
    tracks: dict[int, list] = {}
    for index in range(0, drive.num_frames):
        for box in boxes(drive, index):
            tracks.setdefault(box.id, []).append(box)
    assert any(b.attribute == "vehicle.stopped" for track in tracks.values() for b in track)
    for track in tracks.values():
        centers = np.array([box.center for box in track])
        far = np.linalg.norm(centers - centers[0], axis=1).max()
        assert len({box.moves for box in track}) == 1
        assert (far > 0.5) == track[0].moves
        if track[0].attribute == "vehicle.parked":
            assert far <= 0.5
        for box in track:
            assert (np.hypot(*box.velocity) > 0.2) <= (box.moves or far <= 0.5)
    assert {b.attribute for track in tracks.values() for b in track} >= {"vehicle.moving", "vehicle.parked"}


def test_velocity_is_that_of_the_centre(drive):
    for mover in drive.movers:
        a, b = (np.array(mover.motion.at(WARM_UP + t)[:2]) for t in (3.0, 3.5))
        np.testing.assert_allclose(drive.mover_velocity(mover, 3.25), (b - a) / PERIOD, atol=1e-6)


def test_solids_are_closed():
    """The signed volume of a builder's solids is that of the formula: faces look outwards, none is missing."""
    for add, volume in (
        (lambda b: b.box((0, 2), (0, 3), (0, 4), DARK, Part.BODY), 24.0),
        (lambda b: b.slab([(0, 0), (2, 0), (2, 1), (0, 1)], (0, 3), DARK, Part.BODY), 6.0),
        (lambda b: b.tube((0, 0, 0), (1, 2, 2), 1.0, DARK, Part.BODY, sides=400), 3 * np.pi),
        (lambda b: b.ball((1, 2, 3), (1, 2, 3), DARK, Part.BODY, level=4), 8 * np.pi),
    ):
        b = Builder()
        add(b)
        mesh = b.mesh()
        p, q, r = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
        assert np.einsum("ij,ij->i", p, np.cross(q, r)).sum() / 6 == pytest.approx(volume, rel=2e-2)


def test_bad_input():
    with pytest.raises(ConfigError, match="seed is not usable: expected 0 or more, got -1"):
        City(-1)
    with pytest.raises(ConfigError, match="condition is not known: expected clear or rain or night or fog"):
        City(0).traversal(condition="snow")
    with pytest.raises(ConfigError, match="route or traversal is not usable"):
        City(0).traversal(route=-2)
