"""Fusion of scans: against a reference without any walking, and by its laws."""

import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose, transform
from openvocab_occ.occupancy._fusion_reference import fuse
from openvocab_occ.occupancy.fusion import LogOdds, OccupancyFuser, points_of_depth
from openvocab_occ.occupancy.lidar import grid_from_lidar

SPEC = GridSpec((-1.0, -2.0, 0.5), 0.5, (7, 6, 5))


def lattice(points):
    return (points - np.asarray(SPEC.origin)) / SPEC.size


@pytest.mark.parametrize("family", ["random", "faces", "axis", "outside"])
def test_as_the_reference(rng, family):
    """Random rays, returns and sensors on faces between voxels, rays along an axis, sensors outside."""
    scans = []
    for _ in range(4):
        points, origin = rng.uniform(-3, 5, (12, 3)), rng.uniform(-1, 2, 3)
        if family == "faces":
            points, origin = np.round(points * 2) / 2, np.round(origin * 2) / 2
        elif family == "axis":
            points[:, 1:] = origin[1:]
        elif family == "outside":
            origin += 20
        scans.append((points, origin))
    odds = LogOdds()
    fuser = OccupancyFuser(SPEC, odds=odds)
    for points, origin in scans:
        fuser.add_points(points, origin)
    wanted, seen = fuse([(lattice(p), lattice(o)) for p, o in scans], SPEC.shape, odds.hit, odds.miss,
                        (odds.lower, odds.upper))  # fmt: skip
    np.testing.assert_array_equal(fuser.seen, seen)
    np.testing.assert_allclose(fuser.log_odds, wanted, atol=1e-5)


def test_one_scan_is_the_grid_of_its_sweep(rng):
    points, origin = rng.uniform(-3, 5, (300, 3)), np.array([0.1, 0.2, 1.3])
    fuser = OccupancyFuser(SPEC)
    fuser.add_points(points, origin, min_range=0.7)
    sweep = grid_from_lidar(points, origin, SPEC, min_range=0.7)
    np.testing.assert_array_equal(fuser.grid().known, sweep.known)
    np.testing.assert_array_equal(fuser.grid().occupied, sweep.occupied)


def test_order_does_not_matter_short_of_the_bounds(rng):
    scans = [(rng.uniform(-3, 5, (40, 3)), rng.uniform(-1, 2, 3)) for _ in range(3)]
    grids = []
    for order in (scans, scans[::-1]):
        fuser = OccupancyFuser(SPEC, odds=LogOdds(lower=-50.0, upper=50.0))
        for points, origin in order:
            fuser.add_points(points, origin)
        grids.append(fuser)
    np.testing.assert_allclose(grids[0].log_odds, grids[1].log_odds, atol=1e-5)
    np.testing.assert_array_equal(grids[0].seen, grids[1].seen)


def test_a_rigid_motion_of_everything_changes_nothing(rng):
    T = pose((5, -3, 2), (0.8, 0.1, 0.3, -0.4))
    points, origin = rng.uniform(-3, 5, (60, 3)), np.array([0.1, 0.2, 1.3])
    a, b = OccupancyFuser(SPEC), OccupancyFuser(SPEC, T)
    a.add_points(points, origin)
    b.add_points(transform(T, points), transform(T, origin[None])[0])
    np.testing.assert_array_equal(a.seen, b.seen)
    np.testing.assert_array_equal(a.grid().labels, b.grid().labels)


def test_what_moved_away_is_carved_and_the_unseen_stays_unknown():
    """A box stands before a wall in one scan and is gone in three."""
    origin = np.array([-0.9, 0.1, 1.6])
    box, wall = np.array([[0.6, 0.1, 1.6]]), np.array([[2.1, 0.1, 1.6]])
    fuser = OccupancyFuser(SPEC)
    fuser.add_points(box, origin)
    assert fuser.grid().occupied[tuple(SPEC.index(box)[0])]
    assert not fuser.grid().known[tuple(SPEC.index(wall)[0])]
    for _ in range(3):
        fuser.add_points(wall, origin)
    grid = fuser.grid()
    assert grid.occupied[tuple(SPEC.index(wall)[0])]
    assert grid.known[tuple(SPEC.index(box)[0])]
    assert not grid.occupied[tuple(SPEC.index(box)[0])]
    assert not grid.known[0, 5].any()


def test_depth_images_are_scans():
    camera = Camera(np.array([[20.0, 0, 7.5], [0, 20, 5.5], [0, 0, 1]]), 16, 12, look_at((-0.9, 0, 1.6), (3, 0, 1.6)))
    depth = np.full((12, 16), 2.0, np.float32)
    depth[0, 0], depth[0, 1], depth[0, 2] = 0, np.nan, 99.0
    points = points_of_depth(depth, camera, max_depth=50.0)
    assert len(points) == 12 * 16 - 3
    np.testing.assert_allclose(points[:, 0], 1.1, atol=1e-9)
    pixels, back = camera.project(points)
    np.testing.assert_allclose(back, 2.0)
    np.testing.assert_allclose(pixels[0], [3, 0], atol=1e-9)
    a, b = OccupancyFuser(SPEC), OccupancyFuser(SPEC)
    a.add_depth(depth, camera, max_depth=50.0)
    b.add_points(points, camera.position)
    np.testing.assert_array_equal(a.log_odds, b.log_odds)


def test_bad_input_is_refused():
    with pytest.raises(ConfigError, match="miss < 0 < hit"):
        LogOdds(miss=0.1)
    fuser = OccupancyFuser(SPEC)
    with pytest.raises(DataError, match="points of a scan is not finite"):
        fuser.add_points(np.array([[0, 0, np.nan]]), np.zeros(3))
    assert not fuser.seen.any()
    fuser.add_points(np.empty((0, 3)), np.zeros(3))
    assert not fuser.seen.any()
