"""Visibility masks: brute force over voxels and rays, and scenes whose answer is plain."""

from itertools import pairwise

import numpy as np
import pytest

from openvocab_occ._jit import limit_threads
from openvocab_occ.depth import render_depth
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose
from openvocab_occ.occupancy import (
    GEOMETRY_CLASSES,
    OccupancyGrid,
    cast_rays,
    observe,
    read_occ3d,
    read_occ3d_masks,
    visibility_mask,
)
from openvocab_occ.occupancy._rays_reference import intervals
from openvocab_occ.occupancy.rays import lattice_rays

K = np.array([[14.0, 0, 7.6], [0, 13.0, 5.2], [0, 0, 1]])
LENSES = {
    "pinhole": {},
    "brown": {"distortion": (-0.3, 0.05, 0.001, 0.0)},
    "fisheye": {"distortion": (0.0, 0.0, 0.0, 0.0), "lens": "fisheye"},
}
MODES = ("center", "pixel", "frustum")


def grid_of(occupied, *, known=None, T_world_grid=None) -> OccupancyGrid:
    spec = GridSpec((-3.0, -2.0, 0.0), (0.5, 0.5, 0.4), occupied.shape)
    T = np.eye(4) if T_world_grid is None else T_world_grid
    labels = np.where(occupied, 0, 1).astype(np.uint8)
    return OccupancyGrid(labels, spec, T, free_label=1, known=known, class_names=GEOMETRY_CLASSES)


def cameras(lens="pinhole") -> list[Camera]:
    poses = [
        look_at([0.31, 0.22, 1.13], [5, 1, 0.5]),
        look_at([-9.03, 4.07, 3.11], [0, 0, 1]),  # off the planes: ties are for the tests of rays
        look_at([-5.07, 4.03, 3.09], [0, 0, 1]) @ pose(wxyz=[0.9, 0, 0, 0.4]),
    ]
    return [Camera(K, 16, 11, T, **LENSES[lens]) for T in poses]


@pytest.fixture
def grid(rng) -> OccupancyGrid:
    shape = (12, 10, 8)
    T = pose([11.0, -7.0, 2.0], [0.9, 0.1, -0.2, 0.3])
    return grid_of(rng.random(shape) < 0.08, known=rng.random(shape) > 0.1, T_world_grid=T)


def moved(grid: OccupancyGrid, lens: str) -> list[Camera]:
    return [camera.at(grid.T_world_grid @ camera.T_world_cam) for camera in cameras(lens)]


def seen_through_pixels(grid: OccupancyGrid, camera: Camera, max_hits: int, stride: int) -> np.ndarray:
    """Cut every ray with every voxel, and keep those entered no later than the last hit that counts."""
    rays = camera.rays()[stride // 2 :: stride, stride // 2 :: stride].reshape(-1, 3) @ camera.T_world_cam[:3, :3].T
    origins, directions = lattice_rays(grid, camera.position[None], rays)
    mask = np.zeros(grid.spec.shape, bool)
    for d in directions[~np.isnan(directions).any(axis=1)]:
        t_in, t_out = intervals(origins[0], d, grid.spec.shape, np.inf)
        crossed = t_in < t_out
        entries = np.sort(t_in[crossed & grid.occupied])
        mask |= crossed & (t_in <= (entries[max_hits - 1] if len(entries) >= max_hits else np.inf))
    return mask & grid.known


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize(("max_hits", "stride"), [(1, 1), (2, 1), (1, 3), (99, 2)])
def test_pixel_is_what_cutting_every_voxel_gives(grid, lens, max_hits, stride):
    views = moved(grid, lens)
    mask = visibility_mask(grid, views, mode="pixel", max_hits=max_hits, stride=stride)
    wanted = np.any([seen_through_pixels(grid, camera, max_hits, stride) for camera in views], axis=0)
    np.testing.assert_array_equal(mask, wanted)
    assert 0.05 < mask.mean() < 0.95


@pytest.mark.parametrize("lens", LENSES)
def test_center_and_frustum_are_what_projecting_and_casting_give(grid, lens):
    center, frustum = np.zeros((2, *grid.spec.shape), bool)
    flat = np.arange(grid.spec.num_voxels)
    points = grid.centers(flat)
    for camera in moved(grid, lens):
        pixels, depth = camera.project(points)
        inside = camera.inside(pixels) & (depth > 0)
        frustum.ravel()[inside] = True
        toward = points[inside] - camera.position
        hits = cast_rays(grid, camera.position, toward)
        reached = (hits.voxel == flat[inside]) | (hits.distance >= np.linalg.norm(toward, axis=1))
        center.ravel()[flat[inside][reached]] = True
    np.testing.assert_array_equal(visibility_mask(grid, moved(grid, lens), mode="frustum"), frustum & grid.known)
    np.testing.assert_array_equal(visibility_mask(grid, moved(grid, lens)), center & grid.known)
    assert center.sum() > 100
    assert (frustum & ~center).sum() > 100


def test_modes_contain_each_other(grid):
    views = moved(grid, "pinhole")
    center, frustum = (visibility_mask(grid, views, mode=mode) for mode in ("center", "frustum"))
    pixel = [visibility_mask(grid, views, mode="pixel", max_hits=hits, stride=1) for hits in (1, 2, 9)]
    assert not (center & ~frustum).any()
    for fewer, more in pairwise(pixel):
        assert not (fewer & ~more).any()
    assert pixel[0].sum() < pixel[1].sum() < pixel[2].sum()


def test_pixel_sees_the_voxels_of_the_depth_image(grid):
    views = moved(grid, "pinhole")
    mask = visibility_mask(grid, views, mode="pixel", stride=1)
    shown = np.concatenate([image.voxel.ravel() for image in render_depth(grid, views)])
    np.testing.assert_array_equal(np.flatnonzero(mask & grid.occupied), np.unique(shown[shown >= 0]))


@pytest.mark.parametrize("mode", ["center", "pixel"])
def test_a_wall_hides_what_is_behind_it(mode):
    occupied = np.zeros((12, 10, 8), bool)
    occupied[6] = True
    mask = visibility_mask(
        grid_of(occupied), Camera(K, 16, 11, look_at([-2.9, 0.51, 1.61], [5, 0.51, 1.61])), mode=mode
    )
    assert mask[6].any()
    assert mask[1:6].any(axis=(1, 2)).all()
    assert not mask[7:].any()


@pytest.mark.parametrize("mode", MODES)
def test_nothing_is_seen_behind_the_camera_or_where_nothing_is_known(mode):
    free = np.zeros((12, 10, 8), bool)
    away = Camera(K, 16, 11, look_at([-9, 4, 3], [-20, 8, 3]))
    assert not visibility_mask(grid_of(free), away, mode=mode).any()
    ahead = cameras()[1]
    assert visibility_mask(grid_of(free), ahead, mode=mode).any()
    assert not visibility_mask(grid_of(free, known=free), ahead, mode=mode).any()
    assert not visibility_mask(grid_of(free), [], mode=mode).any()


def test_a_camera_in_an_occupied_voxel_sees_no_other():
    occupied = np.zeros((12, 10, 8), bool)
    occupied[6, 4, 2] = True
    grid = grid_of(occupied)
    camera = Camera(K, 16, 11, look_at([0.1, 0.2, 1.0], [5, 1, 0.5]))
    assert np.argwhere(visibility_mask(grid, camera, mode="pixel", stride=1)).tolist() == [[6, 4, 2]]
    assert visibility_mask(grid, camera).sum() <= 1


@pytest.mark.parametrize("mode", MODES)
def test_threads_and_the_order_of_cameras_change_nothing(grid, mode):
    views = moved(grid, "pinhole")
    masks = []
    for threads, order in ((1, views), (4, views[::-1])):
        with limit_threads(threads):
            masks.append(visibility_mask(grid, order, mode=mode))
    np.testing.assert_array_equal(*masks)
    each = [visibility_mask(grid, view, mode=mode) for view in views]
    np.testing.assert_array_equal(masks[0], np.any(each, axis=0))


def test_the_rule_is_recorded(grid):
    seen = observe(grid, moved(grid, "pinhole"), mode="pixel", max_hits=3, stride=2)
    assert (seen.mode, seen.max_hits, seen.stride) == ("pixel", 3, 2)
    np.testing.assert_array_equal(
        seen.mask, visibility_mask(grid, moved(grid, "pinhole"), mode="pixel", max_hits=3, stride=2)
    )


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "lidar"}, "visibility mode is not known: expected center or pixel or frustum, got lidar"),
        ({"max_hits": 0}, "max_hits counts nothing: expected 1 or more, got 0"),
        ({"stride": 0}, "stride counts nothing"),
    ],
)
def test_what_is_no_rule_is_refused(grid, options, message):
    with pytest.raises(ConfigError, match=message):
        visibility_mask(grid, cameras(), **options)


@pytest.mark.data
def test_on_real_labels_no_rule_is_the_published_mask(data):
    """With cameras as those of nuScenes; the file does not say its own."""
    path = data / "occ3d" / "labels.npz"
    grid, masks = read_occ3d(path), read_occ3d_masks(path)
    lens = np.array([[126.6, 0, 81.2], [0, 126.6, 48.7], [0, 0, 1]])
    views = []
    for yaw in np.deg2rad([0, 55, 110, 180, 250, 305]):
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        place = ahead * [1.5, 0.5, 0] + [0, 0, 1.513]
        views.append(Camera(lens, 160, 90, look_at(place, place + ahead)))

    def overlap(**rule) -> float:
        mask = visibility_mask(grid, views, **rule)
        return (mask & masks.camera).sum() / (mask | masks.camera).sum()

    center, pixel, deep = overlap(), overlap(mode="pixel"), overlap(mode="pixel", max_hits=8)
    assert 0.3 < center < pixel < deep < 0.9
