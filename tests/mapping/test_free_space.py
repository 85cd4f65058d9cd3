import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera, GridSpec, look_at
from openvocab_occ.mapping import FreeSpace, keys_of
from openvocab_occ.mapping.cover import cover_grid
from openvocab_occ.occupancy import OccupancyGrid

K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])


def wall(known=None):
    """A wall across x = 6 to 6.4 m; all else free."""
    labels = np.full((30, 20, 12), 17, np.uint8)
    labels[15] = 15
    return OccupancyGrid(labels, GridSpec((0.0, -4.0, -2.4), 0.4, labels.shape), known=known)


def camera(distortion=()):
    return Camera(K, 64, 48, look_at((0.2, 0.1, 0.05), (6.0, 0.1, 0.05)), distortion)


def observed(grid, cam, **options):
    space = FreeSpace(0.4)
    space.integrate([(cam, render_depth(grid, cam, max_depth=30.0).depth)], grid=grid, max_depth=30.0, **options)
    return space


@pytest.mark.parametrize("distortion", [(), (0.05, 0.0, 0.0, 0.0)])
def test_what_lies_before_the_wall_is_free_and_nothing_else(distortion):
    grid, cam = wall(), camera(distortion)
    space = observed(grid, cam)
    centers = grid.centers(np.arange(grid.spec.num_voxels))
    count = space.count(keys_of(centers, 0.4))
    assert not count[centers[:, 0] > 5.6].any()  # the wall, what hides behind it, and half a diagonal before it
    pixels, depth = cam.project(centers)
    clear = cam.inside(pixels) & (depth < 5.2) & (depth > 0.5)
    assert count[clear].all()
    assert not count[~cam.inside(pixels)].any()


@pytest.mark.parametrize("height", range(1, 12))
@pytest.mark.parametrize("origin", [-1.0, -0.2, 0.2, 0.6, -1.1])
def test_roofs_of_a_grid_off_the_lattice_are_not_taken_for_air(origin, height):
    """Occ3D's grid begins at -1.0: its layers lie half a voxel off those of a map."""
    labels = np.full((30, 20, 14), 17, np.uint8)
    labels[15:20, 5:15, :height] = 4
    grid = OccupancyGrid(labels, GridSpec((0.0, -4.0, origin), 0.4, labels.shape))
    top = origin + 0.4 * height
    space = observed(grid, Camera(K, 64, 48, look_at((0.2, 0.1, top + 0.7), (7.0, 0.1, top))))
    things = np.flatnonzero(labels.reshape(-1) == 4)
    assert not space.count(cover_grid(things, grid, 0.4).keys).any()
    assert space.blocks[1].any()


def test_unknown_voxels_are_transparent_and_never_clear():
    known = np.ones((30, 20, 12), bool)
    known[5:10] = False
    space = observed(wall(known), camera())
    x = 0.2 + 0.4 * np.arange(15)
    count = space.count(keys_of(np.stack([x, np.full(15, 0.1), np.full(15, 0.1)], 1), 0.4))
    assert not count[5:10].any()
    assert count[10:13].all()


def test_measured_depth_clears_up_to_what_it_measures_and_not_where_it_measures_nothing():
    depth = np.full((48, 64), 5.0, np.float32)
    depth[:, :32] = 0
    space = FreeSpace(0.1)
    assert (space.factor, space.cell) == (2, 0.2)
    space.integrate([(camera(), depth)], max_depth=30.0)
    points = np.array([[3.0, -0.5, 0.1], [3.0, 0.7, 0.1], [5.15, -0.5, 0.1], [6.0, -0.5, 0.1]])
    assert space.count(keys_of(points, 0.1)).tolist() == [1, 0, 0, 0]


@given(st.integers(0, 2**32 - 1))
def test_counts_add_up_in_any_order_and_stop_at_255(seed):
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(3):
        keys = np.unique(rng.integers(-3, 3, (4, 3)), axis=0).astype(np.int32)
        parts.append(FreeSpace.from_blocks(0.4, keys, rng.integers(0, 200, (len(keys), 512)).astype(np.uint8)))
    one, other = FreeSpace(0.4), FreeSpace(0.4)
    for part in parts:
        one.merge(part)
    for part in parts[::-1]:
        other.merge(part)
    asked = rng.integers(-24, 24, (200, 3)).astype(np.int32)
    np.testing.assert_array_equal(one.count(asked), other.count(asked))
    total = sum(part.count(asked).astype(int) for part in parts)
    np.testing.assert_array_equal(one.count(asked), np.minimum(total, 255))
    twin = FreeSpace.from_blocks(0.4, *one.blocks)
    np.testing.assert_array_equal(twin.count(asked), one.count(asked))


def test_moving_by_whole_cells_moves_the_counts():
    space = observed(wall(), camera())
    T = np.eye(4)
    T[:3, 3] = [0.4 * 7, -0.4 * 3, 0.4]
    keys = np.random.default_rng(0).integers(-10, 20, (500, 3)).astype(np.int32)
    np.testing.assert_array_equal(space.moved(T).count(keys + np.int32([7, -3, 1])), space.count(keys))


def test_another_voxel_size_is_told():
    with pytest.raises(ConfigError, match="another voxel size"):
        FreeSpace(0.4).merge(FreeSpace(0.2))
