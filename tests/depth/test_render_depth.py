"""Depth images agree with brute force, exact and sampled."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ._jit import limit_threads
from openvocab_occ.depth import render_depth
from openvocab_occ.depth._sampling_reference import first_sample
from openvocab_occ.depth.render import num_samples
from openvocab_occ.errors import ConfigError, PoseError
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid, cast_rays, read_occ3d
from openvocab_occ.occupancy._rays_reference import first_hit
from openvocab_occ.occupancy.pixel_rays import PixelRays
from openvocab_occ.occupancy.rays import lattice_rays

K = np.array([[14.0, 0, 7.5], [0, 13.0, 5.0], [0, 0, 1]])
ROLL = pose(wxyz=[np.cos(0.3), 0, 0, np.sin(0.3)])
POSES = {
    "inside": look_at([0.3, 0.2, 1.1], [5, 1, 0.5]),
    "outside": look_at([-9, 4, 3], [0, 0, 1]),
    "rolled": look_at([-5, 4, 3], [0, 0, 1]) @ ROLL,
    "away": look_at([-9, 4, 3], [-20, 8, 3]),
    "down": look_at([0.1, 0.1, 9.0], [0.1, 0.1, 0.0]),
    "up": look_at([0.3, 0.2, -3.0], [0.3, 0.2, 4.0]),
    "on a face, along an axis": look_at([-4.0, 0.5, 1.2], [4.0, 0.5, 1.2]),
    "in a corner, along the diagonal": look_at([-3.0, -2.0, 0.0], [2.0, 3.0, 5.0]),
}
LENSES = {
    "pinhole": {},
    "brown": {"distortion": (-0.3, 0.05, 0.001, 0.0)},
    "fisheye": {"distortion": (0.0, 0.0, 0.0, 0.0), "lens": "fisheye"},
}


@pytest.fixture
def grid(rng) -> OccupancyGrid:
    labels = (rng.random((12, 10, 8)) > 0.06).astype(np.uint8)
    spec = GridSpec((-3.0, -2.0, 0.0), (0.5, 0.5, 0.4), labels.shape)
    known = rng.random(labels.shape) > 0.2
    return OccupancyGrid(labels, spec, free_label=1, known=known, class_names=GEOMETRY_CLASSES)


def reference_rays(grid, camera):
    rays = camera.rays().reshape(-1, 3) @ camera.T_world_cam[:3, :3].T
    origins, directions = lattice_rays(grid, camera.position[None], rays)
    return origins[0], directions


@pytest.mark.parametrize("step", [None, 0.1, 0.37, 2.5])
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("where", POSES)
def test_depth_agrees_with_brute_force(grid, where, lens, step):
    camera = Camera(K, 16, 11, POSES[where], **LENSES[lens])
    max_depth = 7.4
    image = render_depth(grid, camera, max_depth=max_depth, step=step)
    assert image.depth.shape == image.voxel.shape == (11, 16)
    origin, directions = reference_rays(grid, camera)
    depth, voxel = image.depth.ravel(), image.voxel.ravel()
    for pixel, direction in enumerate(directions):
        if np.isnan(direction).any():
            wanted = max_depth, -1
        elif step is None:
            wanted = first_hit(origin, direction, grid.occupied, max_depth)
        else:
            wanted = first_sample(origin, direction, grid.occupied, step, num_samples(max_depth, step))
            wanted = wanted if wanted[1] >= 0 else (max_depth, -1)
        assert (depth[pixel], voxel[pixel]) == (np.float32(wanted[0]), wanted[1])
    if where == "away":
        assert (voxel == -1).all()
    elif step is None or step < 1:
        assert (voxel >= 0).any()


@pytest.mark.parametrize("step", [0.1, 0.0625, 0.5, 0.003])
def test_samples_on_lattice_points_and_in_faces_agree_with_plain_sampling(rng, step):
    """Origins on the lattice, or a rounding error beside it, and directions that keep to faces or barely leave them."""
    from openvocab_occ.depth._sampling_kernels import first_samples

    occupied = rng.random((6, 5, 4)) < 0.15
    kinds = np.array([0.0, -0.0, 1e-17, -1e-17, 1e-13, 1e-300, 1.0, -1.0, 0.5, 0.3])
    for origin in rng.integers(-1, 7, (60, 3)) + rng.choice([0.0, 0.5, 4e-16, -4e-16, 0.1], (60, 3)):
        directions = rng.choice(kinds, (12, 3))
        t, voxel = np.empty(12, np.float32), np.empty(12, np.int32)
        first_samples(origin, directions, occupied, step, 2500, 0, 12, t, voxel)
        wanted = [first_sample(origin, d, occupied, step, 2500) for d in directions]
        np.testing.assert_array_equal(voxel, [w[1] for w in wanted])
        np.testing.assert_array_equal(t, np.array([w[0] for w in wanted], np.float32))


@pytest.mark.parametrize("k", [1, 3, 5])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_sample_that_rounds_onto_a_face_counts_like_in_plain_sampling(k, sign):
    """A hair before a face, o + t d rounds onto it long before the ray gets there."""
    from openvocab_occ.depth._sampling_kernels import first_samples

    occupied = np.zeros((6, 1, 1), dtype=bool)
    occupied[k if sign > 0 else k - 1] = True
    origin = np.array([np.nextafter(k, k - sign), 0.5, 0.5])
    for speed in np.geomspace(1e-19, 1e-16, 40):
        direction = np.array([[sign * speed, 0.0, 0.0]])
        t, voxel = np.empty(1, np.float32), np.empty(1, np.int32)
        first_samples(origin, direction, occupied, 0.5, 2500, 0, 1, t, voxel)
        wanted = first_sample(origin, direction[0], occupied, 0.5, 2500)
        np.testing.assert_array_equal((t[0], voxel[0]), (np.float32(wanted[0]), wanted[1]))


def test_depth_is_range_times_the_cosine(grid):
    camera = Camera(K, 16, 11, POSES["outside"])
    rays = camera.rays().reshape(-1, 3)
    hits = cast_rays(grid, camera.position, rays @ camera.T_world_cam[:3, :3].T)
    image = render_depth(grid, camera)
    seen = hits.voxel >= 0
    np.testing.assert_array_equal(image.voxel.ravel(), hits.voxel)
    np.testing.assert_allclose(
        image.depth.ravel()[seen], (hits.distance / np.linalg.norm(rays, axis=1))[seen], rtol=1e-5
    )


def test_a_sample_is_late_by_less_than_a_step(grid):
    """Unless the first voxel is cut so thinly that no sample falls into it."""
    camera = Camera(K, 16, 11, POSES["outside"]).resized(80, 55)
    exact, sampled = render_depth(grid, camera), render_depth(grid, camera, step=0.01)
    late = sampled.depth - exact.depth
    assert late.min() > -1e-5
    same = sampled.voxel == exact.voxel
    assert same.mean() > 0.95
    assert late[same].max() <= 0.01 + 1e-5


def test_a_camera_inside_a_voxel_sees_it_at_zero():
    spec = GridSpec((0.0, 0.0, 0.0), 1.0, (3, 3, 3))
    grid = OccupancyGrid(np.zeros(spec.shape, np.uint8), spec)
    camera = Camera(K, 16, 11, pose([1.5, 1.5, 1.5]))
    exact = render_depth(grid, camera)
    assert (exact.depth == 0).all()
    assert (exact.voxel == 13).all()
    sampled = render_depth(grid, camera, step=0.1)
    np.testing.assert_allclose(sampled.depth, 0.1, rtol=1e-6)  # sampling starts at i = 1
    assert (sampled.voxel == 13).all()


def wall(distance: float) -> tuple[OccupancyGrid, Camera]:
    """A wall whose face is at this z-depth, and a camera of one pixel."""
    spec = GridSpec((-1.0, -1.0, distance), 2.0, (1, 1, 1))
    return OccupancyGrid(np.zeros((1, 1, 1), np.uint8), spec), Camera(np.eye(3), 1, 1)


def test_where_max_depth_ends():
    grid, camera = wall(2.0)
    at = render_depth(grid, camera, max_depth=2.0)
    assert (at.depth[0, 0], at.voxel[0, 0]) == (2.0, -1)
    before = render_depth(grid, camera, max_depth=2.0001)
    assert (before.depth[0, 0], before.voxel[0, 0]) == (2.0, 0)
    sample = render_depth(grid, camera, max_depth=2.0, step=0.5)  # 4 * 0.5 lies in the wall and is not beyond
    assert (sample.depth[0, 0], sample.voxel[0, 0]) == (2.0, 0)
    short = render_depth(grid, camera, max_depth=1.99, step=0.5)
    assert (short.depth[0, 0], short.voxel[0, 0]) == (np.float32(1.99), -1)


def test_the_number_of_samples_is_that_of_the_paper():
    assert num_samples(100.0, 0.1) == 1000
    assert num_samples(0.3, 0.1) == 2  # 3 * 0.1 is above 0.3 in float64
    assert num_samples(0.05, 0.1) == 0
    for step in np.random.default_rng(0).uniform(0.01, 3, 200):
        count = num_samples(50.0, float(step))
        assert count * step <= 50.0 < (count + 1) * step


def test_walls_have_the_same_depth_in_all_pixels():
    spec = GridSpec((-20.0, -20.0, 5.0), 1.0, (40, 40, 1))
    image = render_depth(OccupancyGrid(np.zeros(spec.shape, np.uint8), spec), Camera(K, 16, 11))
    assert (image.depth == 5.0).all()  # z-depth, not range


def test_pixels_without_a_ray_see_nothing(grid):
    fisheye = Camera(np.array([[3.0, 0, 7.5], [0, 3, 5], [0, 0, 1]]), 16, 11, POSES["inside"], **LENSES["fisheye"])
    blind = np.isnan(fisheye.rays()).any(axis=-1)
    assert blind.any()
    for step in (None, 0.1):
        image = render_depth(grid, fisheye, max_depth=50.0, step=step)
        assert (image.voxel[blind] == -1).all()
        assert (image.depth[blind] == 50.0).all()
        assert (image.voxel[~blind] >= 0).any()


def test_many_cameras_give_a_list(grid):
    cameras = [Camera(K, 16, 11, T) for T in POSES.values()]
    images = render_depth(grid, cameras)
    assert len(images) == len(cameras)
    for camera, image in zip(cameras, images, strict=True):
        np.testing.assert_array_equal(image.depth, render_depth(grid, camera).depth)
    assert render_depth(grid, []) == []


@pytest.mark.parametrize("step", [None, 0.1])
def test_threads_change_nothing(grid, step):
    camera = Camera(K, 16, 11, POSES["outside"]).resized(200, 120)
    images = []
    for threads in (1, 3):
        with limit_threads(threads):
            images.append(render_depth(grid, camera, step=step))
    np.testing.assert_array_equal(images[0].depth, images[1].depth)
    np.testing.assert_array_equal(images[0].voxel, images[1].voxel)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_depth": 0.0}, r"max_depth is not a length: expected metres above 0, got 0\.0"),
        ({"max_depth": float("nan")}, "max_depth is not a length"),
        ({"max_depth": float("inf")}, "max_depth is not a length"),
        ({"step": 0.0}, r"step is not a length: expected metres above 0, got 0\.0"),
        ({"step": -0.1}, "step is not a length"),
        ({"step": float("nan")}, "step is not a length"),
    ],
)
def test_what_is_no_length_is_refused(grid, options, message):
    with pytest.raises(ConfigError, match=message):
        render_depth(grid, Camera(K, 16, 11), **options)


def test_a_nan_pose_never_becomes_a_camera():
    with pytest.raises(PoseError, match="T_world_cam holds NaN or infinity"):
        Camera(K, 16, 11).at(np.full((4, 4), np.nan))


@pytest.mark.data
def test_on_real_labels_samples_follow_the_exact_depth(data):
    grid = read_occ3d(data / "occ3d" / "labels.npz")
    camera = Camera(
        np.array([[126.6, 0, 81.2], [0, 126.6, 48.7], [0, 0, 1]]), 160, 90, look_at([1.7, 0.0, 1.5], [20, 0.0, 1.4])
    )
    exact, sampled = render_depth(grid, camera), render_depth(grid, camera, step=0.1)
    seen = exact.voxel >= 0
    assert 0.3 < seen.mean() < 1
    late = (sampled.depth - exact.depth)[seen]
    assert late.min() > -1e-4
    assert np.quantile(late, 0.95) <= 0.1 + 1e-4
    np.testing.assert_array_equal(grid.occupied.ravel()[exact.voxel[seen]], True)


@pytest.mark.parametrize("height", [1.5, 1.513, 1.4])
@pytest.mark.parametrize("step", [0.1, 0.25])
@pytest.mark.data
def test_on_real_labels_sampling_without_samples_is_sampling(data, height, step):
    """On planes of the lattice (1.4 m up) and off them, every pixel is that of plain sampling."""
    grid = read_occ3d(data / "occ3d" / "labels.npz")
    K = np.array([[63.3, 0, 40.0], [0, 63.3, 24.0], [0, 0, 1]])
    for target in ([20, 0.0, height], [-7, 12, height - 1]):
        camera = Camera(K, 80, 45, look_at([1.7, 0.0, height], target))
        view = PixelRays.of(camera, grid)
        image = render_depth(grid, camera, step=step)
        count = num_samples(100.0, step)
        pixels = np.arange(0, 80 * 45, 7)
        wanted = [first_sample(view.origin, d, grid.occupied, step, count) for d in view.directions(pixels)]
        np.testing.assert_array_equal(image.voxel.ravel()[pixels], [w[1] for w in wanted])
        depth = np.nan_to_num(np.array([w[0] for w in wanted]), nan=100.0).astype(np.float32)
        np.testing.assert_array_equal(image.depth.ravel()[pixels], depth)


@settings(max_examples=100)
@given(
    seed=st.integers(0, 1000),
    place=st.tuples(*[st.one_of(st.integers(-2, 7).map(float), st.floats(-3, 8, width=16))] * 3),
    wxyz=st.tuples(*[st.sampled_from([-1.0, 0.0, 0.5, 1.0, 0.3])] * 4).filter(any),
    step=st.sampled_from([0.1, 0.5, 0.3, 1.0, 7.0]),
    max_depth=st.sampled_from([0.5, 1.0, 3.0, 20.0]),
)
def test_so_it_is_for_whatever_hypothesis_thinks_of(seed, place, wxyz, step, max_depth):
    random = np.random.default_rng(seed)
    labels = (random.random(tuple(random.integers(1, 6, 3))) > 0.3).astype(np.uint8)
    spec = GridSpec((0.0, 0.0, 0.0), 1.0, labels.shape)
    grid = OccupancyGrid(labels, spec, free_label=1, class_names=GEOMETRY_CLASSES)
    camera = Camera(np.array([[4.0, 0, 3.0], [0, 4, 3], [0, 0, 1]]), 7, 7, pose(place, wxyz))
    view, image = PixelRays.of(camera, grid), render_depth(grid, camera, max_depth=max_depth, step=step)
    count = num_samples(max_depth, step)
    for pixel, direction in enumerate(view.directions(np.arange(49))):
        depth, voxel = first_sample(view.origin, direction, grid.occupied, step, count)
        assert image.voxel.flat[pixel] == voxel
        assert image.depth.flat[pixel] == np.float32(max_depth if voxel < 0 else depth)
