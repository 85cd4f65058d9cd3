"""The synthetic street is what it says it is."""

import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.datasets.street import CAR, MANMADE, PALETTE, ROAD, TRUCK, VEGETATION, WORLD, ego_pose, street
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import transform
from openvocab_occ.occupancy import OCC3D_FREE
from openvocab_occ.occupancy.rays import cast_rays


@pytest.mark.parametrize("seed", range(6))
def test_boxes_hold_their_voxels_exactly(seed):
    place = street(seed)
    count = {label: sum(o.label == label for o in place.objects) for label in (CAR, TRUCK)}
    assert count == {CAR: 7, TRUCK: 3}
    assert [o.name for o in place.objects if o.moving] == ["moving car"]
    for time in (0.0, 1.5):
        labels = place.world(time).labels
        owned = np.zeros(WORLD.shape, dtype=np.int64)
        for thing in place.objects:
            low, high = (np.rint((c - WORLD.origin) / WORLD.size).astype(int) for c in thing.bounds(time))
            assert (low >= 0).all()
            assert (high <= WORLD.shape).all()
            box = np.s_[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
            owned[box] += 1
            own = np.argwhere(labels[box] == thing.label)
            np.testing.assert_array_equal(own.min(axis=0), 0)  # tight on all six sides
            np.testing.assert_array_equal(own.max(axis=0) + 1, high - low)
        assert owned.max() == 1  # nothing overlaps
        assert (owned[np.isin(labels, [CAR, TRUCK, VEGETATION, MANMADE])] == 1).all()


def test_seeds_differ_and_repeat():
    assert street(3).objects == street(3).objects != street(4).objects
    a, b = (load_sequence("street", seed=3)[2] for _ in range(2))
    np.testing.assert_array_equal(a.views[1].image, b.views[1].image)


def test_window_agrees_with_the_world():
    place = street(0)
    sequence = load_sequence("street", frames=9)
    for index in (0, 8):
        frame = sequence[index]
        np.testing.assert_array_equal(frame.T_world_ego, ego_pose(frame.timestamp))
        world, grid = place.world(frame.timestamp), frame.occupancy
        flat = np.arange(grid.spec.num_voxels)
        centers = transform(grid.T_world_grid, grid.spec.centers(grid.spec.unflat(flat)))
        # a sample next to each centre: an empty neighbourhood is free, a full one has its label
        around = [
            world.spec.flat(world.spec.index(centers + d)) for d in np.mgrid[-1:2, -1:2, -1:2].reshape(3, -1).T * 0.2
        ]
        inside = (np.array(around) >= 0).all(axis=0)
        near = world.labels.reshape(-1)[np.array(around)[:, inside]]
        same = (near == near[0]).all(axis=0)
        assert same.mean() > 0.5
        np.testing.assert_array_equal(grid.labels.reshape(-1)[inside][same], near[0][same])
        assert grid.known is not None
        assert grid.known.reshape(-1)[inside].all()


def test_images_show_the_world():
    """Where the ray of a pixel hits a class, the nearest colour of the palette is mostly that class's."""
    place = street(0)
    frame = load_sequence("street")[4]
    assert len(frame.views) == 6
    world = place.world(frame.timestamp)
    colors = np.array(list(PALETTE.values()), dtype=float)
    right = []
    for view in frame.views:
        rays = view.camera.rays().reshape(-1, 3) @ view.camera.T_world_cam[:3, :3].T
        hits = cast_rays(world, view.camera.position, rays)
        seen = np.where(hits.voxel < 0, OCC3D_FREE, world.labels.reshape(-1)[hits.voxel])
        distance = np.linalg.norm(view.image.reshape(-1, 1, 3) - colors, axis=2)
        right.append(np.array(list(PALETTE))[distance.argmin(axis=1)] == seen)
    assert 0.9 < np.mean(right) < 1  # noise and haze leave something to get wrong


def test_the_car_moves_and_trucks_stay():
    frames = list(load_sequence("street", frames=6))
    assert [frame.timestamp for frame in frames] == [0, 0.5, 1, 1.5, 2, 2.5]
    place = street(0)
    assert place.world(0.0).labels.sum() != 0
    moved = place.world(0.0).labels != place.world(2.5).labels
    assert set(place.world(0.0).labels[moved]) == {CAR, OCC3D_FREE}
    yaw = [np.arctan2(f.T_world_ego[1, 0], f.T_world_ego[0, 0]) for f in frames]
    assert np.ptp(yaw) > 0.05
    below = transform(frames[3].T_world_ego, np.array([[0.0, 0.0, -0.1]]))
    assert place.world(1.5).labels.reshape(-1)[WORLD.flat(WORLD.index(below))] == ROAD


def test_bad_options(tmp_path):
    with pytest.raises(ConfigError, match="the street is too short: expected 1 to 20 frames, got 50"):
        load_sequence("street", frames=50)
    with pytest.raises(ConfigError, match="made up from a seed"):
        load_sequence("street", tmp_path)
