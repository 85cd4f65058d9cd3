"""Rays agree exactly with cutting every voxel, and with Open3D's triangles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from openvocab_occ._jit import limit_threads
from openvocab_occ.errors import ConfigError, DataError, ShapeError
from openvocab_occ.geometry import GridSpec, pose, transform
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid, cast_rays, rays
from openvocab_occ.occupancy._rays_reference import first_hit
from openvocab_occ.occupancy.rays import lattice_rays, trace


def grid_of(occupied, *, origin=(0.0, 0.0, 0.0), voxel_size=1.0, T_world_grid=None, known=None) -> OccupancyGrid:
    return OccupancyGrid(
        np.where(occupied, 0, 1).astype(np.uint8),
        GridSpec(origin, voxel_size, occupied.shape),
        np.eye(4) if T_world_grid is None else T_world_grid,
        free_label=1,
        known=known,
        class_names=GEOMETRY_CLASSES,
    )


def assert_same_as_reference(grid: OccupancyGrid, origins, directions, t_max: float) -> int:
    """Compare bit for bit, and return how many rays hit."""
    t, voxel = trace(grid, origins, directions, t_max)
    starts, steps = lattice_rays(grid, origins, directions)
    wanted = [first_hit(o, d, grid.occupied, t_max) for o, d in zip(starts, steps, strict=True)]
    np.testing.assert_array_equal(voxel, [w[1] for w in wanted])
    np.testing.assert_array_equal(t, np.array([w[0] for w in wanted], dtype=np.float32))
    return int((voxel >= 0).sum())


def free_rays(rng, n, shape):
    return rng.uniform(-4, np.add(shape, 4), (n, 3)), rng.normal(size=(n, 3))


def lattice_points(rng, n, shape):
    """From lattice point to lattice point: on faces, along edges, through corners."""
    o, p = rng.integers(-2, np.add(shape, 3), (2, n, 3)).astype(np.float64)
    d = p - o
    return o, np.where(np.abs(d).max(axis=1, keepdims=True) > 0, d, 1.0)


def along_axes(rng, n, shape):
    o = np.round(rng.uniform(-2, np.add(shape, 2), (n, 3)) * 2) / 2
    return o, np.eye(3)[rng.integers(0, 3, n)] * rng.choice([-1.0, 1.0, 0.3], (n, 1))


def in_faces(rng, n, shape):
    """One direction component is zero, and that coordinate of the origin an integer."""
    o, d = free_rays(rng, n, shape)
    axis = rng.integers(0, 3, n)
    d[np.arange(n), axis] = rng.choice([0.0, -0.0], n)
    o[np.arange(n), axis] = rng.integers(-1, np.array(shape)[axis] + 2)
    return o, d


def diagonals(rng, n, shape):
    return np.round(rng.uniform(-3, np.add(shape, 3), (n, 3))), rng.choice([-1.0, 1.0, 0.5, -2.0], (n, 3))


def from_afar(rng, n, shape):
    o = rng.normal(size=(n, 3)) * 10.0 ** rng.integers(2, 14, (n, 1))
    return o, rng.uniform(0, shape, (n, 3)) - o


def nearly_along_axes(rng, n, shape):
    o, d = along_axes(rng, n, shape)
    return o, d + rng.choice([0.0, 1e-17, -1e-17, 1e-300, 1e-9], (n, 3))


FAMILIES = (free_rays, lattice_points, along_axes, in_faces, diagonals, from_afar, nearly_along_axes)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("density", [0.0, 0.02, 0.3, 1.0])
def test_the_walk_agrees_with_cutting_every_voxel(family, density, rng):
    hits = 0
    for shape in [(9, 7, 5), (1, 1, 1), (1, 12, 3)]:
        occupied = rng.random(shape) < density
        origins, directions = family(rng, 150, shape)
        for t_max in (3.0, np.inf):
            hits += assert_same_as_reference(grid_of(occupied), origins, directions, t_max)
    assert (hits > 0) == (density > 0)  # the families do reach the grid


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("density", [0.0, 0.002, 0.1, 1.0])
def test_leaps_over_empty_blocks_change_nothing(family, density, rng, monkeypatch):
    for shape in [(40, 30, 20), (17, 1, 9), (1, 1, 1)]:
        grid = grid_of(rng.random(shape) < density)
        origins, directions = family(rng, 2000, shape)
        for t_max in (3.0, np.inf):
            monkeypatch.setattr(rays, "LARGE", 1 << 40)
            walked = trace(grid, origins, directions, t_max)
            monkeypatch.setattr(rays, "LARGE", 0)
            leapt = trace(grid, origins, directions, t_max)
            for one, other in zip(walked, leapt, strict=True):
                np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("family", FAMILIES)
def test_so_it_does_on_a_turned_lattice_of_bricks(family, rng):
    occupied = rng.random((8, 6, 10)) < 0.1
    T = pose([311.5, -120.25, 7.125], [0.9, 0.1, -0.3, 0.2])
    grid = grid_of(occupied, origin=(-2.0, 1.0, 0.5), voxel_size=(0.5, 0.3, 0.2), T_world_grid=T)
    o, d = family(rng, 300, occupied.shape)
    origins = transform(T, o * grid.spec.size + grid.spec.origin)
    assert assert_same_as_reference(grid, origins, (d * grid.spec.size) @ T[:3, :3].T, 1e6) > 10


near_integers = st.one_of(
    st.integers(-3, 8).map(float), st.floats(-4, 9, width=16), st.sampled_from([-0.0, 1e-17, 5e-324])
)
rows = hnp.arrays(np.float64, (4, 3), elements=near_integers)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    occupied=hnp.arrays(np.bool_, st.tuples(*[st.integers(1, 5)] * 3)),
    origins=rows,
    directions=rows.filter(lambda d: bool((d != 0).any(axis=1).all())),
    t_max=st.sampled_from([0.5, 1.0, 4.0, np.inf]),
)
def test_whatever_hypothesis_thinks_of(occupied, origins, directions, t_max):
    assert_same_as_reference(grid_of(occupied), origins, directions, t_max)


def test_distances_are_metres_whatever_the_length_of_the_direction(rng):
    grid = grid_of(rng.random((8, 8, 8)) < 0.1, voxel_size=(0.5, 0.25, 0.4))
    origins, directions = rng.uniform(-1, 4, (1000, 3)), rng.normal(size=(1000, 3))
    hits = cast_rays(grid, origins, directions, 50.0)
    assert 100 < (hits.voxel >= 0).sum() < 1000
    for factor in (1e-200, 3.0, 1e200):
        scaled = cast_rays(grid, origins, directions * factor, 50.0)
        np.testing.assert_array_equal(scaled.voxel, hits.voxel)
        np.testing.assert_allclose(scaled.distance, hits.distance, rtol=1e-6)
    units = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    there = (origins + units * hits.distance[:, None])[hits.voxel >= 0]
    centers = grid.centers(hits.voxel[hits.voxel >= 0].astype(np.int64))
    assert (np.abs(there - centers) <= grid.spec.size / 2 + 1e-5).all()  # on or in the voxel


def test_moving_the_world_moves_nothing_else(rng):
    occupied = rng.random((9, 9, 9)) < 0.1
    origins, directions = rng.uniform(-2, 11, (300, 3)), rng.normal(size=(300, 3))
    hits = cast_rays(grid_of(occupied), origins, directions)
    T = pose([100, -50, 3], [0.5, -0.5, 0.1, 0.7])
    moved = cast_rays(grid_of(occupied, T_world_grid=T), transform(T, origins), directions @ T[:3, :3].T)
    np.testing.assert_array_equal(moved.voxel, hits.voxel)
    np.testing.assert_allclose(moved.distance, hits.distance, rtol=1e-5)


def test_threads_change_nothing(rng):
    grid = grid_of(rng.random((20, 20, 20)) < 0.02)
    origins, directions = rng.uniform(-2, 22, (20_000, 3)), rng.normal(size=(20_000, 3))
    with limit_threads(1):
        one = cast_rays(grid, origins, directions)
    with limit_threads(4):
        four = cast_rays(grid, origins, directions)
    np.testing.assert_array_equal(one.voxel, four.voxel)
    np.testing.assert_array_equal(one.distance, four.distance)


def one_ray(grid, origin, direction, max_range=100.0) -> tuple[float, int]:
    hits = cast_rays(grid, np.array(origin, float), np.array([direction], float), max_range)
    return float(hits.distance[0]), int(hits.voxel[0])


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ([1.5, 1.5, 1.5], [1, 0, 0], (0.0, 13)),  # starts inside
        ([1.0, 1.5, 1.5], [1, 0, 0], (0.0, 13)),  # starts on the face it goes in through
        ([2.0, 1.5, 1.5], [-1, 0, 0], (0.0, 13)),
        ([1.0, 1.5, 1.5], [-1, 0, 0], (100.0, -1)),  # starts on the face it goes away from
        ([2.0, 1.5, 1.5], [1, 0, 0], (100.0, -1)),
        ([0.5, 1.0, 1.5], [1, 0, 0], (0.5, 13)),  # within its lower face
        ([0.5, 2.0, 1.5], [1, 0, 0], (100.0, -1)),  # within its upper face, which the next voxel owns
        ([0.0, 3.0, 1.5], [1, -1, 0], (np.sqrt(2), 13)),  # in through an edge
        ([0.0, 2.0, 1.5], [1, -1, 0], (100.0, -1)),  # touches an edge
        ([0.0, 1.0, 1.5], [1, 1, 0], (100.0, -1)),
        ([0.0, 0.0, 0.0], [1, 1, 1], (np.sqrt(3), 13)),  # in through a corner
        ([0.0, 3.0, 0.0], [1, -1, 1], (np.sqrt(3), 13)),
        ([2.0, 0.0, 0.0], [-1, 1, 2], (100.0, -1)),  # touches a corner
        ([3.5, 1.5, 1.5], [1, 0, 0], (100.0, -1)),  # lies behind
        ([-7.0, 1.5, 1.5], [2, 0, 0], (8.0, 13)),  # from outside
    ],
)
def test_the_rules_on_one_voxel(origin, direction, expected):
    occupied = np.zeros((3, 3, 3), dtype=bool)
    occupied[1, 1, 1] = True
    distance, voxel = one_ray(grid_of(occupied), origin, direction)
    assert voxel == expected[1]
    assert distance == pytest.approx(expected[0], abs=1e-6)


def test_max_range_ends_before_the_face():
    occupied = np.zeros((3, 3, 3), dtype=bool)
    occupied[2] = True
    grid = grid_of(occupied)
    assert one_ray(grid, [0.5, 1.5, 1.5], [1, 0, 0], 1.5) == (1.5, -1)
    assert one_ray(grid, [0.5, 1.5, 1.5], [1, 0, 0], np.nextafter(1.5, 2)) == (1.5, 22)
    assert one_ray(grid, [0.5, 1.5, 1.5], [-1, 0, 0], np.inf) == (np.inf, -1)


def test_unknown_voxels_are_transparent():
    occupied = np.zeros((4, 1, 1), dtype=bool)
    occupied[1] = occupied[3] = True
    known = np.ones((4, 1, 1), dtype=bool)
    assert one_ray(grid_of(occupied, known=known), [0, 0.5, 0.5], [1, 0, 0]) == (1.0, 1)
    known[1] = False
    assert one_ray(grid_of(occupied, known=known), [0, 0.5, 0.5], [1, 0, 0]) == (3.0, 3)


def test_nan_directions_hit_nothing_and_disturb_nobody(rng):
    grid = grid_of(np.ones((3, 3, 3), dtype=bool))
    directions = np.array([[1, 0, 0], [np.nan, 0, 0], [0, 1, np.nan], [0, 1, 0.0]])
    hits = cast_rays(grid, np.array([1.5, 1.5, 1.5]), directions, 9.0)
    assert hits.voxel.tolist() == [13, -1, -1, 13]
    assert hits.distance.tolist() == [0, 9, 9, 0]


def test_no_rays_give_no_hits():
    hits = cast_rays(grid_of(np.ones((2, 2, 2), dtype=bool)), np.empty((0, 3)), np.empty((0, 3)))
    assert hits.distance.shape == hits.voxel.shape == (0,)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("origins", "directions", "max_range", "error", "message"),
    [
        (np.zeros(3), np.zeros((1, 3)), 9.0, DataError, r"ray directions are not directions: .*first is ray 0: \[0\.0"),
        (np.zeros(3), np.array([[1, 0, 0], [np.inf, 0, 0]]), 9.0, DataError, "got 1 of 2, the first is ray 1"),
        (np.array([0, np.nan, 0]), np.eye(3), 9.0, DataError, "ray origins is not finite"),
        (
            np.zeros((2, 3)),
            np.eye(3),
            9.0,
            ShapeError,
            r"ray origins has the wrong shape: expected \(3, 3\), got \(2, 3\)",
        ),
        (
            np.zeros(3),
            np.eye(2),
            9.0,
            ShapeError,
            r"ray directions has the wrong shape: expected \(any, 3\), got \(2, 2\)",
        ),
        (np.zeros(3), np.eye(3), 0.0, ConfigError, r"max_range is not a range: expected metres above 0, got 0\.0"),
        (np.zeros(3), np.eye(3), np.nan, ConfigError, "max_range is not a range"),
    ],
)
def test_what_is_no_ray_is_refused(origins, directions, max_range, error, message):
    with pytest.raises(error, match=message):
        cast_rays(grid_of(np.ones((2, 2, 2), dtype=bool)), origins, directions, max_range)


def test_open3d_sees_the_same_boxes(rng):
    o3d = pytest.importorskip("open3d", exc_type=ImportError)  # also where a system library of its is missing
    occupied = rng.random((12, 10, 6)) < 0.08
    T = pose([3, -2, 1], [0.8, 0.3, -0.2, 0.4])
    grid = grid_of(occupied, origin=(-3.0, -2.0, 0.0), voxel_size=(0.5, 0.4, 0.6), T_world_grid=T)
    lower = grid.spec.centers(np.argwhere(occupied)) - grid.spec.size / 2
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                      [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    vertices = transform(T, lower[:, None] + corners * grid.spec.size).reshape(-1, 3)
    triangles = (np.arange(len(lower))[:, None, None] * 8 + faces).reshape(-1, 3)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(np.ascontiguousarray(triangles, dtype=np.uint32))
    )
    low, high = grid.spec.bounds
    local = rng.uniform(low - 1, high + 1, (6000, 3))
    free = grid.spec.flat(grid.spec.index(local))
    local = local[(free < 0) | ~occupied.ravel()[free]]  # inside a box, triangles are first met on the way out
    origins, directions = transform(T, local), rng.normal(size=(len(local), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = cast_rays(grid, origins, directions)
    rays = o3d.core.Tensor(np.hstack([origins, directions]).astype(np.float32))
    theirs = scene.cast_rays(rays)
    distance = theirs["t_hit"].numpy()
    box = theirs["primitive_ids"].numpy().astype(np.int64) // 12
    same = np.isclose(hits.distance, distance, atol=1e-4) | (np.isinf(hits.distance) & np.isinf(distance))
    assert (hits.voxel >= 0).mean() > 0.1
    assert (~same).mean() < 1e-3  # float32 triangles: a ray may graze an edge
    both = same & (hits.voxel >= 0)
    flat = np.flatnonzero(occupied)[box[both]]
    assert (flat == hits.voxel[both]).mean() > 0.999
