import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.objects import Box
from openvocab_occ.query.boxes import Boxes, cover, gap, ground_gap, repeated
from openvocab_occ.query.relations import (
    Anchor,
    Columns,
    Viewpoint,
    between,
    distance,
    falling,
    related,
    rising,
    within,
)  # fmt: skip

NAMES = ("next to", "near", "far from", "touching", "on", "under", "above", "below", "inside", "outside", "of", "along",
         "in front of", "behind", "left of", "right of", "facing")  # fmt: skip
EYE = Viewpoint(np.array([0.0, 0.0, 1.5]))


def drawn(seed, n, *, spread=30.0):
    rng = np.random.default_rng(seed)
    center = rng.uniform(-spread, spread, (n, 3)) * [1, 1, 0.1]
    return Boxes(center, rng.uniform(0.2, 8.0, (n, 3)), rng.uniform(-np.pi / 2, np.pi / 2, n))


def one(center, size=(1, 1, 1), yaw=0.0):
    return Boxes(np.array([center], float), np.array([size], float), np.array([yaw], float))


def moved(boxes, turn, shift):
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return Boxes(boxes.center @ R.T + shift, boxes.size, boxes.yaw + turn)


@pytest.mark.parametrize("seed", range(4))
def test_gaps_are_those_of_many_points(seed):
    """Distances between footprints against the least distance of points all over them."""
    a, b = drawn(seed, 60, spread=8.0), drawn(seed + 100, 60, spread=8.0)
    t = np.linspace(-0.5, 0.5, 41)
    shares = np.stack(np.meshgrid(t, t, indexing="ij"), axis=-1).reshape(-1, 2)
    found = ground_gap(a, b)
    np.testing.assert_allclose(found, ground_gap(b, a), atol=1e-9)
    for i in range(60):
        one_a, one_b = a.take(np.array([i])), b.take(np.array([i]))
        points = one_a.footprint(shares)
        brute = np.linalg.norm(points - one_b.nearest(points), axis=-1).min()
        assert found[i] <= brute + 1e-9
        assert brute - found[i] <= 8.0 / 40  # the spacing of the points


def test_boxes_agree_with_those_of_objects():
    box = Box(np.array([3.0, -2.0, 1.0]), np.array([4.0, 2.0, 2.0]), 0.6)
    row = one(box.center, box.size, box.yaw)
    corners = row.corners[0]
    np.testing.assert_allclose(corners, box.corners[:4, :2])
    assert ground_gap(row, row)[0] == 0
    assert cover(row, row)[0] == 1
    assert cover(one((0, 0, 0)), one((5, 0, 0)))[0] == 0


@given(st.integers(0, 1000), st.floats(-3, 3), st.floats(-100, 100))
@settings(max_examples=8)
def test_degrees_do_not_depend_on_the_axes_of_the_world(seed, turn, shift):
    things, other = drawn(seed, 30), drawn(seed + 1, 1)
    away = np.array([shift, -2 * shift, 0.3 * shift])
    eye = moved(EYE.boxes(), turn, away)
    there = Viewpoint(eye.center[0], EYE.heading + turn)
    for name in NAMES:
        before = related(name, things, Anchor(other), EYE)
        after = related(name, moved(things, turn, away), Anchor(moved(other, turn, away)), there)
        # samples of footprints that lie on an edge may fall to either side
        close = np.isclose(before, after, atol=1e-6)
        assert close.mean() >= (0.9 if name in ("on", "inside", "of", "outside", "under", "above", "below") else 1.0), (
            name
        )
        assert ((before >= 0) & (before <= 1)).all(), name
    to_me = [related(name, things, Anchor(EYE.boxes(), is_viewer=True), EYE) for name in NAMES]
    moved_me = [
        related(name, moved(things, turn, away), Anchor(there.boxes(), is_viewer=True), there) for name in NAMES
    ]
    np.testing.assert_allclose(to_me, moved_me, atol=1e-6)


@given(st.integers(0, 10_000))
@settings(max_examples=15)
def test_symmetry(seed):
    a, b = drawn(seed, 1, spread=10), drawn(seed + 1, 1, spread=10)
    for name in ("next to", "near", "far from", "touching"):
        assert related(name, a, Anchor(b), EYE) == pytest.approx(related(name, b, Anchor(a), EYE), abs=1e-9), name
    for name, opposite in (("left of", "right of"), ("in front of", "behind"), ("above", "under"), ("below", "above")):
        assert related(name, a, Anchor(b), EYE) == pytest.approx(related(opposite, b, Anchor(a), EYE), abs=1e-9), name
    c = drawn(seed + 2, 5, spread=10)
    np.testing.assert_allclose(between(c, Anchor(a), Anchor(b)), between(c, Anchor(b), Anchor(a)), atol=1e-9)


@given(st.integers(0, 10_000))
@settings(max_examples=15)
def test_a_thing_is_not_on_both_sides(seed):
    things, other = drawn(seed, 50), Anchor(drawn(seed + 1, 1))
    for name, opposite in (("left of", "right of"), ("in front of", "behind"), ("on", "under"), ("inside", "outside")):
        both = np.minimum(related(name, things, other, EYE), related(opposite, things, other, EYE))
        assert (both <= 0.5).all(), name
    # the four sides share each direction: near things have degrees that add up to 1
    sides = sum(related(name, things, other, EYE) for name in ("left of", "right of", "in front of", "behind"))
    beside = (distance(things, other) <= 10) & (sides > 0)
    np.testing.assert_allclose(sides[beside], 1.0, atol=1e-6)


@pytest.mark.parametrize("name", ["next to", "near", "touching", "along", "left of", "facing"])
def test_moving_away_never_helps(name):
    steps = np.linspace(0, 80, 400)
    yaw = np.pi / 2 if name == "facing" else 0.0
    things = Boxes(
        np.stack([0 * steps + 20, 3 + steps, 0 * steps], 1), np.tile([4.0, 2, 2], (400, 1)), np.full(400, yaw)
    )
    degree = related(name, things, Anchor(one((20, 0, 0), (12, 2, 2))), Viewpoint(np.array([-1000.0, 0, 0])))
    assert (np.diff(degree) <= 1e-9).all()
    assert degree[0] >= (0.0 if name == "touching" else 0.5)
    assert degree[-1] == 0


def holds(name, thing, other, viewer=EYE, **more):
    return related(name, thing, Anchor(other, **more), viewer)[0] >= 0.5


def test_plain_scenes():
    truck = one((20, 0, 1.5), (7, 2.5, 3))
    assert holds("left of", one((20, 5, 1)), truck)
    assert holds("right of", one((20, -5, 1)), truck)
    assert holds("behind", one((30, 0, 1)), truck)
    assert holds("in front of", one((12, 0, 1)), truck)
    other_side = Viewpoint(np.array([40.0, 0, 0]), np.pi)
    assert holds("right of", one((20, 5, 1)), truck, other_side)
    assert holds("in front of", one((30, 0, 1)), truck, other_side)
    assert holds("on", one((20, 0, 3.5)), truck)
    assert not holds("on", one((20, 0, 6)), truck)
    assert holds("above", one((20, 0, 6)), truck)
    assert holds("under", truck, one((20, 0, 6), (9, 9, 1)))
    assert holds("next to", one((20, 3.5, 1)), truck)
    assert not holds("next to", one((20, 0, 6)), truck)
    assert holds("near", one((20, 10, 1)), truck)
    assert holds("far from", one((20, 60, 1)), truck)
    assert holds("inside", one((20, 0, 1)), truck)
    assert holds("facing", one((20, -10, 1), (4, 2, 2), np.pi / 2), truck)
    assert not holds("facing", one((20, -10, 1), (4, 2, 2), 0.0), truck)
    assert not holds("facing", one((20, -10, 1), (1, 1, 2), np.pi / 2), truck)
    assert between(one((25, 0, 1)), Anchor(truck), Anchor(one((32, 0, 1))))[0] == 1
    assert between(one((25, 9, 1)), Anchor(truck), Anchor(one((32, 0, 1))))[0] == 0
    me = Viewpoint(np.array([0.0, 0, 0]), np.pi / 2)  # looking along y
    assert holds("in front of", one((0, 10, 0)), me.boxes(), me, is_viewer=True)
    assert holds("behind", one((0, -10, 0)), me.boxes(), me, is_viewer=True)
    assert holds("left of", one((-10, 0, 0)), me.boxes(), me, is_viewer=True)


def test_ground_that_turns_is_compared_by_its_voxels():
    """An L of road: the corner that its box also covers is not on it."""
    x, y = np.meshgrid(np.arange(0.2, 40, 0.4), np.arange(0.2, 40, 0.4), indexing="ij")
    road = (x < 5) | (y < 5)
    points = np.stack([x[road], y[road], 0.05 * x[road]], axis=1)  # it climbs
    anchor = Anchor(one((20, 20, 1), (40, 40, 2)), Columns(points, 0.4))
    on_road = one((30, 2, 0.05 * 30 + 0.2 + 1), (1, 1, 2))
    beside = one((30, 30, 0.05 * 30 + 1.2), (1, 1, 2))
    for name in ("on", "inside"):
        assert related(name, on_road, anchor, EYE)[0] == 1
        assert related(name, beside, anchor, EYE)[0] == 0
    assert distance(beside, anchor)[0] == pytest.approx(24.5, abs=0.5)
    assert anchor.columns is not None
    assert anchor.columns.area == pytest.approx(road.sum() * 0.16)


def test_distances_and_ramps():
    things, other = drawn(3, 200), drawn(4, 1)
    d = gap(things, repeated(other, 200))
    degree = within(things, Anchor(other), 5.0, 20.0)
    assert (degree[(d >= 5) & (d <= 20)] == 1).all()
    assert (degree[(d > 22) | (d < 4.5)] == 0).all()
    x = np.linspace(-5, 5, 50)
    np.testing.assert_allclose(falling(x, -1.0, 2.0), 1 - rising(x, -1.0, 2.0))
