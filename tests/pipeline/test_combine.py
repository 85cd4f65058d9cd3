import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, DataError, EncoderMismatchError
from openvocab_occ.geometry import pose
from openvocab_occ.mapping import FreeSpace, Lifted, VoxelMap
from openvocab_occ.objects import EncoderInfo, KeyFrame, SceneMap, group_objects
from openvocab_occ.pipeline.combine import concat, crop, merge
from openvocab_occ.pipeline.compare import diff

INFO = EncoderInfo(name="toy", contract="logits", dim=2, labels=("road", "truck"), fingerprint="ab" * 32)


def block(low, size):
    return (np.argwhere(np.ones(size)) + np.array(low)).astype(np.int32)


def scene(*parts, time=0.0, free=(), info=INFO, frame=0):
    """Blocks of (low, size, channel); `free` holds boxes that were looked through."""
    voxels = VoxelMap(0.4, 2, contract="logits")
    for low, size, channel in parts:
        keys = block(low, size)
        ones = np.ones(len(keys), np.float32)
        sums = np.tile(np.eye(2, dtype=np.float32)[channel], (len(keys), 1))
        voxels.integrate(keys, Lifted(sums, ones, ones.astype(np.int32)), time=time)
    for low, size in free:
        cells = block(low, size)
        keys, where = np.unique(cells // 8, axis=0, return_inverse=True)
        counts = np.zeros((len(keys), 512), np.uint8)
        inner = cells % 8
        counts[where.ravel(), (inner[:, 0] * 8 + inner[:, 1]) * 8 + inner[:, 2]] = 1
        voxels.free.merge(FreeSpace.from_blocks(0.4, keys.astype(np.int32), counts))
    frames = (KeyFrame(frame, time, np.eye(4)),)
    return SceneMap(voxels, group_objects(voxels, labels=info.labels), info, frames)


ROAD = ((0, 0, 0), (40, 12, 1), 0)
TRUCK = ((10, 4, 4), (8, 4, 5), 1)
SPACE = ((0, 0, 2), (40, 12, 10))


def test_diff_tells_gone_from_not_observed():
    before = scene(ROAD, TRUCK, time=0.0)
    after = scene(ROAD, time=100.0, free=[((0, 0, 2), (14, 12, 10))])
    found = diff(before, after)
    keys = before.voxels.keys
    assert found.same == 480
    assert (keys[found.vanished][:, 0] < 14).all()
    assert (keys[found.not_observed_in_b][:, 0] >= 14).all()
    assert len(found.vanished) == len(found.not_observed_in_b) == 80
    everywhere = diff(before, scene(ROAD, time=100.0, free=[SPACE]))
    assert len(everywhere.vanished) == 160
    truck = next(node for node in before.objects if node.label == "truck")
    assert everywhere.objects_vanished == (truck.id,)
    back = diff(scene(ROAD, time=0.0, free=[SPACE]), before)
    assert len(back.appeared) == 160
    assert len(back.objects_appeared) == 1
    assert diff(before, before).to_dict()["same"] == 640


def test_diff_sees_changes_and_forgives_a_shift_by_a_voxel():
    before = scene(ROAD, TRUCK)
    shifted = scene(ROAD, ((11, 4, 4), (8, 4, 5), 1), free=[SPACE])
    found = diff(before, shifted)
    assert (len(found.vanished), len(found.appeared), found.shifted) == (0, 0, 40)
    repainted = scene(ROAD, (TRUCK[0], TRUCK[1], 0))
    assert len(diff(before, repainted).changed) == 160
    assert len(diff(before, shifted, tolerance=0).vanished) == 20


def test_merging_removes_what_left_between_the_drives_and_keeps_what_was_not_looked_at():
    before, after = scene(ROAD, TRUCK, time=0.0), scene(ROAD, time=100.0, free=[SPACE], frame=5)
    for merged in (merge(before, after), merge(after, before)):
        assert len(merged.scene.voxels) == 480
        assert merged.gone == 160
        assert len({frame.index for frame in merged.scene.frames}) == 2
    unseen = merge(before, scene(ROAD, time=100.0)).scene
    assert len(unseen.voxels) == 640
    assert unseen.voxels.count.max() == 2


def test_a_crop_and_its_rest_put_together_are_the_whole():
    whole = scene(ROAD, TRUCK, free=[SPACE])
    low, high, cut = np.array([-99.0, -99, -99]), np.array([99.0, 99, 99]), 5.6
    left = crop(whole, np.stack([low, [cut, 99, 99]]))
    right = crop(whole, np.stack([[cut, -99, -99], high]))
    assert 0 < len(left.voxels) < len(whole.voxels)
    for node in left.objects:
        np.testing.assert_allclose(left.voxels.centers[node.voxels], node.points, atol=1e-5)
    back = concat([left, right])
    np.testing.assert_array_equal(back.voxels.keys, whole.voxels.keys)
    np.testing.assert_allclose(back.voxels.features, whole.voxels.features, atol=1e-6)
    assert sum(len(node.voxels) for node in back.objects) == sum(len(node.voxels) for node in whole.objects)
    for node in back.objects:
        np.testing.assert_allclose(back.voxels.centers[node.voxels], node.points, atol=1e-5)
    with pytest.raises(DataError, match="maps share voxels"):
        concat([left, whole])
    with pytest.raises(ConfigError, match="region is not a box"):
        crop(whole, np.stack([high, low]))


def landmark_scene(T=None, seed=0):
    """A made-up place of walls that ICP can hold on to."""
    rng = np.random.default_rng(seed)
    parts = [ROAD, ((0, 0, 0), (1, 60, 20), 1), ((0, 40, 0), (60, 1, 16), 1)]
    parts += [(tuple(rng.integers(4, 34, 3) * [1, 1, 0]), (3, 2, int(rng.integers(4, 14))), 1) for _ in range(9)]
    made = scene(*[(low, size, c) for low, size, c in parts])
    if T is None:
        return made
    return SceneMap(made.voxels.moved(T), group_objects(made.voxels.moved(T)), INFO, made.frames)


def test_icp_finds_the_motion_between_two_drives_and_refuses_strangers():
    turn = 0.03
    T = pose((0.5, -0.3, 0.2), (np.cos(turn / 2), 0, 0, np.sin(turn / 2)))
    a, b = landmark_scene(), landmark_scene(T)
    merged = merge(a, b, align=True)
    assert merged.alignment.overlap > 0.9
    off = merged.alignment.T_a_b @ T
    assert np.linalg.norm(off[:3, 3]) < 0.4
    assert len(merged.scene.voxels) < 1.7 * len(a.voxels)
    far = landmark_scene(pose((300.0, 0.0, 0.0)))
    with pytest.raises(DataError, match=r"maps could not be aligned: expected a partner within 0\.4 m"):
        merge(a, far, align=True)


def test_a_rigid_motion_of_the_world_keeps_weight_and_features(rng):
    made = landmark_scene().voxels
    turn = 0.7
    moved = made.moved(pose((3.1, 2.2, 0.0), (np.cos(turn / 2), 0, 0, np.sin(turn / 2))))
    np.testing.assert_allclose(moved.weight.sum(), made.weight.sum(), rtol=1e-4)
    total = (made.features * made.weight[:, None]).sum(0)
    np.testing.assert_allclose((moved.features * moved.weight[:, None]).sum(0), total, rtol=1e-3)


def test_maps_that_cannot_be_compared_are_told():
    other = EncoderInfo(name="else", contract="logits", dim=2, labels=("a", "b"), fingerprint="cd" * 32)
    with pytest.raises(EncoderMismatchError, match="made by different encoders: expected toy"):
        merge(scene(ROAD), scene(ROAD, info=other))
    with pytest.raises(EncoderMismatchError, match="cannot be compared"):
        diff(scene(ROAD), scene(ROAD, info=other))
    with pytest.raises(ConfigError, match="diff options"):
        diff(scene(ROAD), scene(ROAD), tolerance=9)
