"""Samples: pooled labels are what they say, drives come back as they were written, faults are told."""

import json
from dataclasses import replace

import numpy as np
import pytest

from openvocab_occ.datasets.frame import View
from openvocab_occ.errors import DataError, GridError, ShapeError
from openvocab_occ.geometry import Camera, GridSpec
from openvocab_occ.networks.flashocc import M0, MICRO, TINY
from openvocab_occ.occupancy import OCC3D_FREE, OCC3D_SPEC, OccupancyGrid, visibility_mask
from openvocab_occ.training.drives import Drive, DriveInfo, write_drive
from openvocab_occ.training.samples import crop, network_spec, pool_any, pool_grid, pool_labels, sample_of, spread

from .conftest import K, drive_frames

INFO = DriveInfo(name="a", place="p", log="l", scene="s")


def test_pooling_is_its_definition(rng):
    labels = rng.choice([2, 5, OCC3D_FREE], (8, 6, 4), p=[0.1, 0.2, 0.7]).astype(np.uint8)
    pooled = pool_labels(labels, 2, OCC3D_FREE)
    for x, y, z in np.ndindex(4, 3, 2):
        block = labels[2 * x : 2 * x + 2, 2 * y : 2 * y + 2, 2 * z : 2 * z + 2].ravel().tolist()
        occupied = [b for b in block if b != OCC3D_FREE]
        best = min(set(occupied), key=lambda c: (-occupied.count(c), c)) if occupied else OCC3D_FREE
        assert pooled[x, y, z] == best


def test_spreading_and_pooling_cancel(rng):
    labels = rng.integers(0, 18, (5, 4, 3)).astype(np.uint8)
    np.testing.assert_array_equal(pool_labels(spread(labels, 2), 2, OCC3D_FREE), labels)
    mask = rng.random((5, 4, 3)) < 0.5
    np.testing.assert_array_equal(pool_any(spread(mask.astype(np.uint8), 3) != 0, 3), mask)


def test_unknown_voxels_do_not_become_occupied():
    labels = np.full(OCC3D_SPEC.shape, 4, np.uint8)
    known = np.zeros(OCC3D_SPEC.shape, bool)
    known[:2] = True
    pooled = pool_grid(OccupancyGrid(labels, OCC3D_SPEC, known=known), network_spec(TINY))
    assert (pooled.labels[0] == 4).all()
    assert (pooled.labels[1:] == OCC3D_FREE).all()
    assert pooled.known is not None
    assert pooled.known[0].all()
    assert not pooled.known[1:].any()


def test_grids_that_cannot_be_pooled_are_refused():
    odd = OccupancyGrid(np.zeros((200, 200, 16), np.uint8), GridSpec((-40.0, -40.0, -1.0), 0.5, (200, 200, 16)))
    with pytest.raises(GridError, match="cannot be pooled"):
        pool_grid(odd, network_spec(TINY))
    other = OccupancyGrid(np.ones((4, 4, 4), np.uint8), GridSpec((0.0, 0.0, 0.0), 0.4, (4, 4, 4)), np.eye(4), 1,
                          class_names=("occupied", "free"))  # fmt: skip
    with pytest.raises(GridError, match="other classes"):
        pool_grid(other, network_spec(TINY))
    with pytest.raises(ShapeError, match="split into blocks"):
        pool_labels(np.zeros((3, 4, 4), np.uint8), 2, OCC3D_FREE)


def test_sample_keeps_what_cameras_see():
    frame = drive_frames(1)[0]
    sample = sample_of(frame, TINY)
    grid = pool_grid(frame.occupancy, network_spec(TINY))
    np.testing.assert_array_equal(sample.labels, grid.labels)
    np.testing.assert_array_equal(
        sample.mask, visibility_mask(grid, [v.camera for v in frame.views], mode="pixel", stride=1)
    )
    given = np.zeros(OCC3D_SPEC.shape, bool)
    given[10, 11, 12] = True
    published = sample_of(frame, TINY, masks=lambda _: given)
    assert published.mask.sum() == 1
    assert published.mask[5, 5, 6]
    fine = replace(TINY, cell=0.4, shape=(200, 200, 16))
    assert sample_of(frame, fine, masks=lambda _: given).mask[10, 11, 12]


def test_drive_comes_back_and_is_cut_to_the_network(tmp_path):
    frames = drive_frames(2)
    drive = write_drive(tmp_path / "d.npz", frames, INFO, MICRO)
    whole = Drive(tmp_path / "d.npz")
    assert whole.info == INFO
    assert whole.labels.shape == (2, 100, 100, 8)
    assert drive.labels.shape == (2, *MICRO.shape)
    samples = [sample_of(frame, MICRO) for frame in frames]
    np.testing.assert_array_equal(whole.labels, [s.labels for s in samples])
    np.testing.assert_array_equal(whole.mask, [s.mask for s in samples])
    np.testing.assert_array_equal(drive.labels, whole.labels[:, 25:75, 25:75])
    np.testing.assert_array_equal(drive.poses, [f.T_world_ego for f in frames])
    with pytest.raises(GridError, match="do not cover"):
        _ = Drive(tmp_path / "d.npz", network_spec(M0)).labels


def test_crop_is_between_voxels():
    outer, inner = GridSpec((0.0, 0.0, 0.0), 0.4, (8, 8, 8)), GridSpec((0.8, 0.4, 0.0), 0.4, (2, 3, 4))
    assert crop(outer, inner) == (slice(2, 4), slice(1, 4), slice(0, 4))
    for wrong in (GridSpec((0.9, 0.0, 0.0), 0.4, (2, 2, 2)), GridSpec((0.0, 0.0, 0.0), 0.4, (9, 2, 2))):
        with pytest.raises(GridError, match="do not cover"):
            crop(outer, wrong)


def test_damaged_drives_are_refused(tmp_path):
    write_drive(tmp_path / "d.npz", drive_frames(2), INFO, MICRO)
    content = (tmp_path / "d.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=r"remove it"):
        Drive(tmp_path / "cut.npz")
    np.savez(tmp_path / "other.npz", meta=np.array(json.dumps({"format": 1})))
    with pytest.raises(DataError, match="not a drive of this version"):
        Drive(tmp_path / "other.npz")
    with pytest.raises(DataError, match="differ in their cameras"):
        sequence = drive_frames(2)
        both = sequence.map(lambda f: drive_frames(2, cameras=1)[0] if f.index else f)
        write_drive(tmp_path / "mixed.npz", both, INFO, MICRO)
    assert not (tmp_path / "mixed.npz").exists()


def test_images_that_would_be_noise_are_refused():
    frame = drive_frames(1)[0]
    with pytest.raises(DataError, match="lacks cameras"):
        sample_of(replace(frame, views=()), TINY)
    with pytest.raises(GridError, match="has no occupancy"):
        sample_of(replace(frame, occupancy=None), TINY)
    small = View(np.zeros((4, 8, 3), np.uint8), Camera(K, 8, 4, np.eye(4)))
    with pytest.raises(DataError, match="too small"):
        sample_of(replace(frame, views=(small,)), TINY)
    with pytest.raises((ShapeError, TypeError)):  # NaN needs floats, which no view holds
        View(np.full((48, 128, 3), np.nan), Camera(K, 128, 48, np.eye(4)))  # pyright: ignore[reportArgumentType]
