"""A sweep makes hit, free and unknown; carving agrees with cutting every voxel and with dense sampling."""

import numpy as np
import pytest

from openvocab_occ._jit import limit_threads
from openvocab_occ.errors import ConfigError, DataError, ShapeError
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OCC3D_SPEC, cast_rays, grid_from_lidar
from openvocab_occ.occupancy._rays_reference import intervals

SPEC = GridSpec((-2.0, 1.0, -0.5), (0.5, 0.25, 0.4), (9, 8, 7))


def reference(points, origin, spec):
    """Voxels with a return, and voxels that some line from sensor to return is in for a while."""
    hit, crossed = np.zeros((2, *spec.shape), dtype=bool)
    start = (origin - np.array(spec.origin)) / spec.size
    for point in points.astype(np.float64):
        end = (point - np.array(spec.origin)) / spec.size
        t_in, t_out = intervals(start, end - start, spec.shape, 1.0)
        crossed |= t_in < t_out
        index = np.floor(end).astype(int)
        if ((index >= 0) & (index < spec.shape)).all():
            hit[tuple(index)] = True
    return hit, crossed & ~hit


@pytest.mark.parametrize("where", ["inside", "outside", "on a corner", "on a face"])
@pytest.mark.parametrize("kind", ["anywhere", "on the lattice"])
def test_carving_agrees_with_cutting_every_voxel(where, kind, rng):
    low, high = SPEC.bounds
    origin = {
        "inside": np.array([0.1, 2.1, 0.7]),
        "outside": high + SPEC.size,
        "on a corner": low + SPEC.size * [3, 4, 2],
        "on a face": low + SPEC.size * [3, 4.5, 2.5],
    }[where]
    points = rng.uniform(low - 1, high + 1, (120, 3))
    if kind == "on the lattice":
        points = low + SPEC.size * rng.integers(-1, np.add(SPEC.shape, 2), (120, 3))
    grid = grid_from_lidar(points, origin, SPEC)
    hit, free = reference(points, origin, SPEC)
    np.testing.assert_array_equal(grid.occupied, hit)
    np.testing.assert_array_equal(grid.known & ~grid.occupied, free)
    assert hit.any()
    assert free.any()


def test_what_dense_samples_pass_through_is_known(rng):
    origin = np.array([0.1, 2.1, 0.7])
    low, high = SPEC.bounds
    points = rng.uniform(low - 1, high + 1, (40, 3)).astype(np.float32)
    grid = grid_from_lidar(points, origin, SPEC)
    samples = origin + np.linspace(0, 1, 5001)[:, None, None] * (points - origin)
    flat = np.unique(SPEC.flat(SPEC.index(samples)))
    seen = np.zeros(SPEC.num_voxels, dtype=bool)
    seen[flat[flat >= 0]] = True
    assert not (seen & ~grid.known.ravel()).any()
    assert (grid.known.ravel() & ~seen).sum() <= 0.02 * seen.sum()  # clipped corners thinner than the sampling


def test_a_hand_made_row():
    spec = GridSpec((0.0, 0.0, 0.0), 1.0, (6, 1, 1))
    grid = grid_from_lidar(np.array([[3.5, 0.5, 0.5], [9.0, 0.5, 0.5]])[:1], np.array([0.5, 0.5, 0.5]), spec)
    assert grid.class_names == GEOMETRY_CLASSES
    assert grid.free_label == 1
    assert grid.occupied.ravel().tolist() == [False, False, False, True, False, False]
    assert grid.known.ravel().tolist() == [True, True, True, True, False, False]
    # a second return from outside the grid clears the way behind, and does not clear what was hit
    both = grid_from_lidar(np.array([[3.5, 0.5, 0.5], [9.0, 0.5, 0.5]]), np.array([0.5, 0.5, 0.5]), spec)
    np.testing.assert_array_equal(both.occupied, grid.occupied)
    assert both.known.all()


def test_order_and_threads_change_nothing(rng):
    points = rng.normal(scale=30, size=(5000, 3))
    origin = np.array([0.9, 0.0, 1.8])
    with limit_threads(1):
        one = grid_from_lidar(points, origin, OCC3D_SPEC)
    with limit_threads(4):
        four = grid_from_lidar(points[::-1], origin, OCC3D_SPEC)
    np.testing.assert_array_equal(one.labels, four.labels)
    np.testing.assert_array_equal(one.known, four.known)


def test_close_returns_are_dropped_with_their_rays():
    spec = GridSpec((0.0, 0.0, 0.0), 1.0, (6, 1, 1))
    points, origin = np.array([[2.5, 0.5, 0.5]]), np.array([0.5, 0.5, 0.5])
    assert grid_from_lidar(points, origin, spec, min_range=2.0).occupied.any()
    assert not grid_from_lidar(points, origin, spec, min_range=2.01).known.any()


def test_no_returns_know_nothing():
    T = pose([1, 2, 3])
    grid = grid_from_lidar(np.empty((0, 3)), np.zeros(3), SPEC, T_world_grid=T)
    assert not grid.known.any()
    assert not grid.occupied.any()
    np.testing.assert_array_equal(grid.T_world_grid, T)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("points", "origin", "options", "error", "message"),
    [
        (
            np.array([[0, 0, np.nan]]),
            np.zeros(3),
            {},
            DataError,
            "LiDAR points is not finite: expected numbers, got 1 of 3",
        ),
        (np.array([[0, np.inf, 0]]), np.zeros(3), {}, DataError, "LiDAR points is not finite"),
        (np.zeros((1, 3)), np.full(3, np.nan), {}, DataError, "LiDAR origin is not finite"),
        (
            np.zeros((1, 5)),
            np.zeros(3),
            {},
            ShapeError,
            r"LiDAR points has the wrong shape: expected \(any, 3\), got \(1, 5\)",
        ),
        (np.zeros((1, 3)), np.zeros(3), {"min_range": -1.0}, ConfigError, "min_range is not a range"),
        (np.zeros((1, 3)), np.zeros(3), {"min_range": np.nan}, ConfigError, "min_range is not a range"),
    ],
)
def test_what_is_no_sweep_is_refused(points, origin, options, error, message):
    with pytest.raises(error, match=message):
        grid_from_lidar(points, origin, SPEC, **options)


@pytest.mark.data
def test_the_real_sweep_hits_its_own_returns(keyframe):
    import json

    info = json.loads((keyframe / "info.json").read_text())["data_list"][0]
    T = np.array(info["lidar_points"]["lidar2ego"])
    sweep = np.fromfile(next(keyframe.glob("*LIDAR_TOP*.bin")), np.float32).reshape(-1, 5)[:, :3]
    points = sweep.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    origin = T[:3, 3]
    grid = grid_from_lidar(points, origin, OCC3D_SPEC, min_range=2.5)
    assert 3000 < grid.occupied.sum() < 20_000
    assert 0.05 < grid.known.mean() < 0.5
    far = points[np.linalg.norm(points - origin, axis=1) >= 2.5]
    hits = cast_rays(grid, origin, far - origin)
    inside = OCC3D_SPEC.contains(OCC3D_SPEC.index(far))
    ranges = np.linalg.norm(far - origin, axis=1)
    assert (hits.distance[inside] <= ranges[inside] + 1e-4).all()  # the voxel of the return stops its own ray
    assert np.median(ranges[inside] - hits.distance[inside]) < 0.8
