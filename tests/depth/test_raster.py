"""The rasteriser gives what walking every ray gives, whatever the camera and the grid."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ._jit import limit_threads
from openvocab_occ.depth import render_depth
from openvocab_occ.depth.raster import MIN_CLEARANCE, can_raster, clearance, raster
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose, transform
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid, read_occ3d
from openvocab_occ.occupancy.pixel_rays import PixelRays
from openvocab_occ.occupancy.rays import trace_lattice

ROLL = pose(wxyz=[np.cos(0.3), 0, 0, np.sin(0.3)])
UPSIDE_DOWN = pose(wxyz=[0, 0, 0, 1])


def grid_of(occupied, *, origin=(0.0, 0.0, 0.0), voxel_size=1.0, T_world_grid=None) -> OccupancyGrid:
    return OccupancyGrid(
        np.where(occupied, 0, 1).astype(np.uint8),
        GridSpec(origin, voxel_size, occupied.shape),
        np.eye(4) if T_world_grid is None else T_world_grid,
        free_label=1,
        class_names=GEOMETRY_CLASSES,
    )


def walked(grid: OccupancyGrid, camera: Camera, max_depth: float):
    view = PixelRays.of(camera, grid)
    t, voxel = trace_lattice(
        grid, view.origin[None], view.directions(np.arange(camera.height * camera.width)), max_depth
    )
    return t.reshape(view.size), voxel.reshape(view.size)


def assert_walked(grid: OccupancyGrid, camera: Camera, max_depth: float = 100.0) -> bool:
    """Compare with the walk bit for bit; tell whether the rasteriser was used."""
    image = render_depth(grid, camera, max_depth=max_depth)
    depth, voxel = walked(grid, camera, max_depth)
    np.testing.assert_array_equal(image.voxel, voxel)
    np.testing.assert_array_equal(image.depth, depth)
    return can_raster(camera, PixelRays.of(camera, grid), grid.occupied)


def camera_at(T, *, focal=40.0, skew=0.0, size=(64, 48), center=None) -> Camera:
    cx, cy = center or ((size[0] - 1) / 2 + 0.137, (size[1] - 1) / 2 - 0.291)
    return Camera(np.array([[focal, skew, cx], [0, 1.1 * focal, cy], [0, 0, 1]]), *size, T)


DENSITIES = (0.0, 0.02, 0.3, 1.0)
SHAPES = ((9, 7, 5), (1, 1, 1), (1, 12, 3), (17, 3, 70), (20, 70, 2))


@pytest.mark.parametrize("density", DENSITIES)
@pytest.mark.parametrize("shape", SHAPES)
def test_from_anywhere_with_any_lens_matrix(rng, shape, density):
    """Bricks on a turned lattice; cameras inside, outside, rolled, upside down, with skew, near and far off axis."""
    T = pose([311.5, -120.25, 7.125], [0.9, 0.1, -0.3, 0.2])
    grid = grid_of(rng.random(shape) < density, origin=(-2.0, 1.0, 0.5), voxel_size=(0.5, 0.3, 0.2), T_world_grid=T)
    low, high = grid.spec.bounds
    rastered = 0
    for k in range(24):
        margin = (0.0, 0.5, 8.0)[k % 3]
        place = transform(T, rng.uniform(low - margin, high + margin))
        target = transform(T, rng.uniform(low, high))
        turn = (np.eye(4), ROLL, UPSIDE_DOWN, pose(wxyz=rng.normal(size=4)))[k % 4]
        skew, focal = rng.choice([0.0, 6.0]), 10.0 ** rng.uniform(0.5, 2.5)
        camera = camera_at(look_at(place, target) @ turn, focal=focal, skew=skew)
        rastered += assert_walked(grid, camera, float(rng.choice([1.5, 100.0])))
    assert rastered >= (12 if density < 1 else 6)


@pytest.mark.parametrize("density", DENSITIES)
def test_on_grid_planes_and_along_axes(rng, density):
    """Rays in faces, along edges, through corners: the walk's rule for ties holds in the image."""
    grid = grid_of(rng.random((12, 10, 8)) < density)
    looks = [
        np.array(d, float) for d in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1), (1, 1, 0), (1, -1, 1))
    ]
    rastered = 0
    for k in range(60):
        place = rng.integers(-8, 20, 3) / rng.choice([1.0, 2.0])
        T = look_at(place, place + looks[k % len(looks)]) @ (np.eye(4) if k % 2 else UPSIDE_DOWN)
        camera = camera_at(T, focal=float(rng.choice([8, 16, 32])), size=(33, 25), center=(16.0, 12.0))
        rastered += assert_walked(grid, camera)
    assert rastered >= 20


@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-6, 0.5 * MIN_CLEARANCE, 1.01 * MIN_CLEARANCE, 0.1])
def test_close_to_a_face_an_edge_and_a_corner(rng, gap):
    occupied = np.zeros((9, 9, 9), bool)
    occupied[4, 4, 4] = True
    occupied[:, :, 0] = rng.random((9, 9)) < 0.7
    grid = grid_of(occupied)
    for place in ([4 - gap, 4.4, 4.6], [5 + gap, 5 + gap, 4.5], [4.3, 4.7, 5 + gap], [4 - gap, 5 + gap, 4 - gap]):
        for target in ([4.5, 4.5, 4.5], [9, 2, 0], [0, 9, 9], [4.5, 4.5, 30]):
            rastered = assert_walked(grid, camera_at(look_at(place, target) @ ROLL, focal=20.0))
            assert rastered == (gap > MIN_CLEARANCE)


def test_inside_an_occupied_voxel():
    occupied = np.zeros((5, 5, 5), bool)
    occupied[2, 3, 1] = True
    camera = camera_at(look_at([2.5, 3.2, 1.9], [0, 0, 0]))
    image = render_depth(grid_of(occupied), camera)
    assert (image.depth == 0).all()
    assert (image.voxel == (2 * 5 + 3) * 5 + 1).all()


def test_a_large_flat_grid(rng):
    """1024 x 1024 x 64, as a tile of a city: floor, walls, dust."""
    occupied = np.zeros((1024, 1024, 64), bool)
    occupied[:, :, :2] = True
    occupied[300:310, :, :20] = True
    occupied.reshape(-1)[rng.integers(0, occupied.size, 3000)] = True
    grid = grid_of(occupied, origin=(-200.0, -200.0, -1.0), voxel_size=0.4)
    for place, target in (([0, 0, 1.5], [60, 20, 1]), ([-300, -300, 80], [0, 0, 0]), ([3, 4, 30], [3, 4, 0])):
        assert assert_walked(grid, camera_at(look_at(place, target), focal=300.0, size=(320, 180)), 600.0)


@settings(max_examples=150)
@given(
    seed=st.integers(0, 1000),
    place=st.tuples(*[st.one_of(st.integers(-2, 7).map(float), st.floats(-3, 8, width=16))] * 3),
    wxyz=st.tuples(*[st.sampled_from([-1.0, 0.0, 0.5, 1.0, 0.3])] * 4).filter(lambda q: any(q)),
    center=st.tuples(*[st.sampled_from([0.0, 4.0, 3.5, 7.0, -20.0])] * 2),
    focal=st.sampled_from([0.01, 1.0, 4.0, 7.3, 1e4]),
    max_depth=st.sampled_from([0.5, 1.0, 3.0, 50.0]),
)
def test_whatever_hypothesis_thinks_of(seed, place, wxyz, center, focal, max_depth):
    random = np.random.default_rng(seed)
    grid = grid_of(random.random(tuple(random.integers(1, 6, 3))) < 0.4)
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    assert_walked(grid, Camera(K, 8, 8, pose(place, wxyz)), max_depth)


def test_one_camera_of_many_rows_and_columns(rng):
    """One pixel, one row, one column: bands of rows may be empty."""
    grid = grid_of(rng.random((6, 6, 6)) < 0.2)
    for size in ((1, 1), (200, 1), (1, 200)):
        assert assert_walked(grid, camera_at(look_at([-4, 3, 3], [3, 3, 3]), size=size))


def test_threads_and_company_change_nothing(rng):
    """The same bits from one thread and from many, alone and with others, called from several threads at once."""
    grid = grid_of(rng.random((20, 20, 20)) < 0.05)
    places = rng.uniform(-5, 25, (8, 3))
    cameras = [camera_at(look_at(p, [10, 10, 10]), size=(160, 120)) for p in places]
    with limit_threads(1):
        alone = [render_depth(grid, c) for c in cameras]

    def again(_: int):
        fresh = grid_of(grid.occupied)  # its mesh is made by whoever comes first
        return render_depth(fresh, cameras)

    with ThreadPoolExecutor(4) as pool:
        for images in pool.map(again, range(8)):
            for one, other in zip(alone, images, strict=True):
                np.testing.assert_array_equal(one.depth, other.depth)
                np.testing.assert_array_equal(one.voxel, other.voxel)


def test_the_mesh_is_made_once(rng):
    grid = grid_of(rng.random((6, 6, 6)) < 0.2)
    render_depth(grid, camera_at(look_at([-4, 3, 3], [3, 3, 3])))
    assert grid.faces is grid.faces
    assert "faces" in grid.__dict__


def test_clearance_is_the_distance_to_the_nearest_voxel(rng):
    occupied = rng.random((6, 5, 4)) < 0.1
    lower = np.argwhere(occupied)
    for point in rng.uniform(-2, 8, (200, 3)):
        nearest = np.linalg.norm(np.clip(point, lower, lower + 1) - point, axis=1).min()
        assert clearance(occupied, point) == pytest.approx(min(1.0, nearest), abs=1e-12)


@pytest.mark.data
def test_on_real_labels_it_is_the_walk_and_few_pixels_are_in_doubt(data):
    grid = read_occ3d(data / "occ3d" / "labels.npz")
    for yaw in (0.0, 55.0, 180.0):
        away = np.array([np.cos(np.deg2rad(yaw)), np.sin(np.deg2rad(yaw)), 0.0])
        place = np.array([0.0, 0.0, 1.513]) + 1.5 * away
        for T in (look_at(place, place + away), look_at(place, place + away) @ ROLL):
            camera = camera_at(T, focal=316.6, size=(400, 225))
            assert assert_walked(grid, camera)
            ((_, doubt),) = raster(grid, [PixelRays.of(camera, grid)], 100.0)
            assert len(doubt) < 0.01 * 400 * 225
