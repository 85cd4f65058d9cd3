import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import ConfigError, DataError, ShapeError
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose
from openvocab_occ.mapping import (
    PixelWeights,
    Segments,
    Sight,
    cover_grid,
    join,
    keys_of,
    lift,
    rows_from_depth,
    rows_from_grid,
)
from openvocab_occ.mapping._lift_reference import lift_reference
from openvocab_occ.mapping.keys import pack, unpack
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.segmentation.encoder import FeatureMap


def feature_map(rng, h, w, c, *, stride=4.0, shift=0.0):
    cells = rng.normal(size=(h, w, c)).astype(np.float32)
    return FeatureMap(cells, (1 / stride, 1 / stride), (0.5 / stride - 0.5 + shift, 0.5 / stride - 0.5))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 20), st.integers(1, 20)),
    cells=st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 3)),
    stride=st.sampled_from([0.5, 1.0, 3.7, 16.0]),
    shift=st.sampled_from([0.0, -9.0, 30.0]),
)
def test_lift_is_the_sum_of_upsampled_pixels(seed, size, cells, stride, shift):
    rng = np.random.default_rng(seed)
    rows = rng.integers(-1, 5, size=size).astype(np.int32)
    features = feature_map(rng, *cells, stride=stride, shift=shift)
    lifted = lift(rows, 5, features)
    np.testing.assert_allclose(lifted.sums, lift_reference(rows, 5, features), atol=1e-4)


def test_weights_and_constant_features_are_conserved(rng):
    rows = rng.integers(-1, 40, size=(90, 160)).astype(np.int32)
    constant = FeatureMap(np.ones((6, 10, 2), np.float32), (1 / 16, 1 / 16), (-0.46875, -0.46875))
    lifted = lift(rows, 40, constant)
    assert lifted.weight.sum() == lifted.pixels.sum() == (rows >= 0).sum()
    np.testing.assert_allclose(lifted.sums, lifted.weight[:, None] * [1, 1], rtol=1e-5)


def test_colours_add_up_and_a_row_without_pixels_is_zero(rng):
    rows = np.array([[0, 0], [2, -1]], np.int32)
    image = rng.integers(0, 256, size=(2, 2, 3), dtype=np.uint8)
    lifted = lift(rows, 3, feature_map(rng, 1, 1, 4), image=image)
    np.testing.assert_array_equal(lifted.color_sum, [image[0].sum(0), [0, 0, 0], image[1, 0]])
    assert not lifted.sums[1].any()
    assert lifted.weight[1] == 0


def test_agreement_is_one_for_equal_and_nought_for_opposite_features():
    cells = np.array([[[1, 0], [1, 0], [-1, 0]]], np.float32)
    lifted = lift(np.array([[0, 0, 1], [0, 0, 0]], np.int32)[:1], 2, FeatureMap(cells, (1.0, 1.0), (0.0, 0.0)))
    np.testing.assert_allclose(np.linalg.norm(lifted.sums, axis=1) / lifted.weight, [1, 1])
    lifted = lift(np.array([[0, -1, 0]], np.int32), 1, FeatureMap(cells, (1.0, 1.0), (0.0, 0.0)))
    assert np.linalg.norm(lifted.sums[0]) == 0


def test_joined_lifts_are_the_parts_below_one_another(rng):
    rows = rng.integers(-1, 3, size=(8, 9)).astype(np.int32)
    features, image = feature_map(rng, 3, 3, 2), np.zeros((8, 9, 3), np.uint8)
    both = join([lift(rows, 3, features, image=image), lift(rows, 3, features, image=image)])
    np.testing.assert_array_equal(both.sums[:3], both.sums[3:])
    assert both.color_sum is not None
    assert join([lift(rows, 3, features, image=image), lift(rows, 3, features)]).color_sum is None


def test_a_row_out_of_range_is_told(rng):
    with pytest.raises(ShapeError, match=r"rows are out of range: expected -1\.\.1, got 0\.\.2"):
        lift(np.array([[0, 2]], np.int32), 2, feature_map(rng, 1, 1, 1))


@settings(deadline=None)
@given(st.lists(st.tuples(*[st.integers(-(2**b), 2**b - 1) for b in (23, 23, 15)]), min_size=1))
def test_packing_is_undone_and_keeps_the_order(keys):
    array = np.array(keys, np.int32)
    packed = pack(array)
    np.testing.assert_array_equal(unpack(packed), array)
    np.testing.assert_array_equal(np.argsort(packed, kind="stable"), np.lexsort(array.T[::-1]))


def test_grid_layers_centred_on_faces_of_the_lattice_stay_apart():
    spec = GridSpec((-40.0, -40.0, -1.0), 0.4, (200, 200, 16))
    z = spec.centers(np.stack([np.zeros(16, int), np.zeros(16, int), np.arange(16)], axis=1))
    np.testing.assert_array_equal(keys_of(z, 0.4)[:, 2], np.arange(16) - 2)


@pytest.mark.parametrize("point", [[1e9, 0, 0], [0, 0, -1e6], [np.nan, 0, 0]])
def test_points_out_of_reach_are_told(point):
    with pytest.raises(DataError, match=r"outside the reach of the voxel map.*subtract a local origin"):
        keys_of(np.array([point], np.float64), 0.1)


def wall_scene(turn=0.0):
    """A wall one voxel thick at x = 8 m of the grid, seen by a camera at its origin that looks along x."""
    labels = np.full((20, 20, 16), 17, np.uint8)
    labels[16] = 15
    wxyz = (np.cos(turn / 2), 0, 0, np.sin(turn / 2))
    grid = OccupancyGrid(
        labels,
        GridSpec((0.0, -5.0, -4.0), 0.5, labels.shape),
        pose(np.array([100.0, 50.0, 1.0]), np.array(wxyz, float)),
    )
    T = grid.T_world_grid @ look_at(np.array([0.2, 0.1, 0.1]), np.array([5.0, 0.1, 0.1]))
    return grid, Camera(np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]), 64, 48, T)


def test_grid_and_measured_depth_find_the_same_wall():
    grid, camera = wall_scene()
    image = render_depth(grid, camera, max_depth=30.0)
    rows, flat = rows_from_grid(image, grid)
    assert (grid.labels.reshape(-1)[flat] == 15).all()
    assert (rows >= 0).all()
    cover = cover_grid(flat, grid, 0.5)
    assert (cover.share == 1).all()
    keys = cover.keys[np.argsort(cover.row)]
    # depth just inside the voxels, as a sensor with a small bias would give
    rows2, keys2 = rows_from_depth(image.depth + np.float32(0.001), camera, 0.5)
    np.testing.assert_array_equal(keys[rows], keys2[rows2])


def test_rows_name_the_voxel_that_each_pixel_sees():
    grid, camera = wall_scene(turn=0.6)
    image = render_depth(grid, camera, max_depth=6.0)
    rows, flat = rows_from_grid(image, grid)
    hit = image.voxel >= 0
    np.testing.assert_array_equal(rows >= 0, hit)
    np.testing.assert_array_equal(flat[rows[hit]], image.voxel[hit])


def test_measured_depth_that_is_none_adds_nothing():
    _, camera = wall_scene()
    depth = np.zeros((48, 64), np.float32)
    depth[0, :4] = [np.nan, np.inf, 50.0, 3.0]
    rows, keys = rows_from_depth(depth, camera, 0.5, max_depth=40.0)
    assert len(keys) == 1
    assert np.argwhere(rows >= 0).tolist() == [[0, 3]]
    with pytest.raises(DataError, match="measured depth is negative"):
        rows_from_depth(-depth, camera, 0.5)


def slanted(rng, tilt=0.0):
    """A plane 10 m ahead that leans by `tilt` about the image's x axis; its exact depth."""
    camera = Camera(np.array([[80.0, 0, 63.5], [0, 80.0, 47.5], [0, 0, 1]]), 128, 96)
    normal = np.array([0.0, np.sin(tilt), -np.cos(tilt)])
    depth = -10.0 * np.cos(tilt) / (camera.rays() @ normal)
    return camera, depth.astype(np.float32), normal


def weights_of(camera, depth, weights, rng):
    """The weight of every pixel: each is a row of its own."""
    rows = np.arange(depth.size, dtype=np.int32).reshape(depth.shape)
    cells = feature_map(rng, 6, 8, 2, stride=16.0)
    return lift(rows, depth.size, cells, sight=Sight(camera, depth, weights))


@pytest.mark.parametrize("tilt", [0.0, 0.5, -1.0])
def test_normals_and_incidence_of_a_plane_are_exact(tilt, rng):
    camera, depth, normal = slanted(rng, tilt)
    depth = np.where((depth > 0) & (depth < 200), depth, 0).astype(np.float32)
    lifted = weights_of(camera, depth, PixelWeights(range=0.0, grazing=0.05, border=0.0, bend=0.0), rng)
    seen = (depth > 0).ravel()
    seen &= (np.roll(depth, 8, 0) > 0).ravel() & (np.roll(depth, -8, 0) > 0).ravel()
    rays = camera.rays().reshape(-1, 3)
    cosine = np.abs(rays @ normal) / np.linalg.norm(rays, axis=1)
    np.testing.assert_allclose(lifted.weight[seen], np.maximum(cosine, 0.05)[seen], rtol=2e-3)
    found = lifted.normal_sum[seen] / lifted.weight[seen, None]
    np.testing.assert_allclose(found, np.broadcast_to(normal, found.shape), atol=2e-3)


def test_each_weight_does_what_it_says(rng):
    camera, depth, _ = slanted(rng)
    none = PixelWeights.none()
    assert (weights_of(camera, depth, none, rng).weight == 1).all()
    by_range = weights_of(camera, depth, PixelWeights(range=10.0, grazing=0.0, border=0.0, bend=0.0), rng)
    np.testing.assert_allclose(by_range.weight, 0.5, rtol=1e-5)
    border = weights_of(camera, depth, PixelWeights(range=0.0, grazing=0.0, border=0.5, bend=0.0), rng)
    border = border.weight.reshape(depth.shape)
    np.testing.assert_allclose(border[48, [0, 3, 7, 8, 64]], [0.5 / 8, 3.5 / 8, 7.5 / 8, 1, 1], rtol=1e-6)
    bend = PixelWeights(range=0.0, grazing=0.0, border=0.0, bend=0.1)
    np.testing.assert_allclose(weights_of(camera, depth, bend, rng).weight, 1, rtol=1e-4)  # a plane has no edges
    near = depth.copy()
    near[:, 64:] = 4.0
    edge = weights_of(camera, near, bend, rng).weight.reshape(depth.shape)[48]
    assert (edge[56:72] < 0.1).all()
    np.testing.assert_allclose(edge[[20, 50, 80, 110]], 1, rtol=1e-3)
    with pytest.raises(ConfigError, match="pixel weight bend is not usable"):
        PixelWeights(bend=float("nan"))


def test_the_box_of_a_row_holds_its_pixels_and_no_more(rng):
    rows = rng.integers(-1, 6, size=(40, 50)).astype(np.int32)
    rows[10:, 10:] = -1
    lifted = lift(rows, 7, feature_map(rng, 3, 4, 2, stride=13.0), view=3)
    for r in range(6):
        v, u = np.nonzero(rows == r)
        assert lifted.box[r].tolist() == [u.min(), v.min(), u.max(), v.max()]
    assert lifted.view.tolist() == [3] * 7
    np.testing.assert_array_equal(lifted.score, lifted.weight)


def test_threads_do_not_change_a_bit(rng):
    from openvocab_occ._jit import limit_threads

    rows = rng.integers(-1, 900, size=(300, 400)).astype(np.int32)
    features = feature_map(rng, 19, 25, 16, stride=16.0)
    with limit_threads(1):
        one = lift(rows, 900, features)
    with limit_threads(4):
        four = lift(rows, 900, features)
    np.testing.assert_array_equal(one.sums, four.sums)
    np.testing.assert_array_equal(one.box, four.box)


def test_segments_are_a_feature_for_every_pixel(rng):
    rows = rng.integers(-1, 30, size=(40, 50)).astype(np.int32)
    segments = Segments(rng.integers(-1, 4, size=(40, 50)).astype(np.int32), rng.normal(size=(4, 3)).astype(np.float32))
    image = rng.integers(0, 256, size=(40, 50, 3), dtype=np.uint8)
    lifted = lift(rows, 30, segments, image=image)
    wanted, colors, count = np.zeros((30, 3)), np.zeros((30, 3)), np.zeros(30, int)
    both = (rows >= 0) & (segments.ids >= 0)
    np.add.at(wanted, rows[both], segments.vectors[segments.ids[both]])
    np.add.at(colors, rows[both], image[both])
    np.add.at(count, rows[both], 1)
    np.testing.assert_allclose(lifted.sums, wanted, atol=1e-4)
    np.testing.assert_array_equal(lifted.pixels, count)
    np.testing.assert_array_equal(lifted.color_sum, colors)
    with pytest.raises(ShapeError, match="ids of segments have no vector"):
        lift(rows, 30, Segments(segments.ids + 1, segments.vectors))
