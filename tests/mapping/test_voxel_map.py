import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.errors import ConfigError, DataError, ShapeError
from openvocab_occ.mapping import NO_LABEL, Lifted, VoxelMap


def observation(rng, *, dim=3, reach=3, rows=12):
    """Keys with repeats, features, and pixels; some rows saw nothing."""
    keys = rng.integers(-reach, reach, size=(rows, 3)).astype(np.int32)
    pixels = rng.integers(0, 6, size=rows).astype(np.int32)
    sums = (rng.random((rows, dim)) * pixels[:, None]).astype(np.float32)
    colors = (rng.integers(0, 256, size=(rows, 3)) * pixels[:, None]).astype(np.float32)
    labels = rng.choice(np.array([2, 5, 9, NO_LABEL], np.uint8), size=rows)
    return keys, Lifted(sums, pixels.astype(np.float32), pixels, colors), labels


def built(frames, *, dim=3, contract="dense"):
    voxels = VoxelMap(0.5, dim, contract=contract)
    for time, (keys, lifted, labels) in frames:
        voxels.integrate(keys, lifted, time=time, labels=labels)
    return voxels


def assert_same(a, b):
    np.testing.assert_array_equal(a.keys, b.keys)
    for name in ("features", "weight", "agreement"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-4, atol=1e-6)
    for name in ("count", "first_seen", "last_seen", "labels"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (np.abs(a.colors.astype(int) - b.colors) <= 1).all()


def by_definition(frames):
    """The map as a dict of lists, from the definition."""
    seen: dict = {}
    for time, (keys, lifted, labels) in frames:
        for i in np.flatnonzero(lifted.pixels):
            seen.setdefault(tuple(keys[i].tolist()), []).append(
                (time, lifted.sums[i].astype(float), int(lifted.pixels[i]), lifted.color_sum[i], int(labels[i]))
            )
    return dict(sorted(seen.items()))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["dense", "logits"]))
def test_map_is_the_dict_of_means(seed, contract):
    rng = np.random.default_rng(seed)
    frames = [(float(t), observation(rng)) for t in (3, 1, 2, 2)]
    voxels, wanted = built(frames, contract=contract), by_definition(frames)
    assert [tuple(k) for k in voxels.keys.tolist()] == list(wanted)
    for i, rows in enumerate(wanted.values()):
        sums, weight = sum(r[1] for r in rows), sum(r[2] for r in rows)
        norm = sums.sum() if contract == "logits" else np.linalg.norm(sums)
        np.testing.assert_allclose(voxels.features[i], sums / norm, rtol=1e-4)
        np.testing.assert_allclose(voxels.agreement[i], norm / weight, rtol=1e-4)
        assert voxels.weight[i] == weight
        assert np.abs(voxels.colors[i] - sum(r[3] for r in rows) / weight).max() <= 0.51
        assert (voxels.first_seen[i], voxels.last_seen[i]) == (min(r[0] for r in rows), max(r[0] for r in rows))
        named = [(r[0], r[2], -r[4]) for r in rows if r[4] != NO_LABEL]
        assert voxels.labels[i] == (-max(named)[2] if named else NO_LABEL)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.randoms(use_true_random=False))
def test_order_does_not_matter_and_parts_merge_to_the_whole(seed, random):
    rng = np.random.default_rng(seed)
    frames = [(float(t % 3), observation(rng)) for t in range(6)]
    whole = built(frames)
    shuffled = frames.copy()
    random.shuffle(shuffled)
    assert_same(built(shuffled), whole)
    left, right = built(frames[:2]), built(frames[2:])
    left.merge(right)
    assert_same(left, whole)


def test_moving_by_whole_voxels_moves_only_keys(rng):
    keys, lifted, labels = observation(rng)
    here, there = built([(0.0, (keys, lifted, labels))]), built([(0.0, (keys + np.int32([7, -9, 4]), lifted, labels))])
    np.testing.assert_array_equal(there.keys, here.keys + np.array([7, -9, 4]))
    np.testing.assert_array_equal(there.features, here.features)
    np.testing.assert_allclose(there.centers, here.centers + np.array([7, -9, 4]) * 0.5)


def test_rows_of_one_frame_that_share_a_voxel_count_as_one_frame():
    voxels = VoxelMap(1.0, 1)
    lifted = Lifted(np.array([[1.0], [2.0]], np.float32), np.array([1.0, 2.0], np.float32), np.array([1, 2], np.int32))
    voxels.integrate(np.zeros((2, 3), np.int32), lifted, time=0.0)
    voxels.integrate(np.zeros((2, 3), np.int32), lifted, time=1.0)
    assert voxels.count.tolist() == [2]
    assert voxels.weight.tolist() == [6.0]
    assert voxels.labels.tolist() == [NO_LABEL]


def test_index_finds_every_key_and_no_other(rng):
    voxels = built([(0.0, observation(rng, rows=40))])
    np.testing.assert_array_equal(voxels.index(voxels.keys[::-1]), np.arange(len(voxels))[::-1])
    far = np.array([[99, 0, 0], [2**30, -(2**30), 2**20]], np.int32)
    assert voxels.index(far).tolist() == [-1, -1]
    # a key too large to pack must not wrap onto one that is there
    wrapped = voxels.keys[:1] + np.array([0, 0, 2**16], np.int32)
    assert voxels.index(wrapped).tolist() == [-1]
    assert VoxelMap(1.0, 1).index(far).tolist() == [-1, -1]


def test_columns_restore_the_map_and_it_grows_on_as_before(rng):
    frames = [(float(t), observation(rng)) for t in range(4)]
    voxels = built(frames[:3])
    twin = VoxelMap.from_columns(0.5, voxels.keys, voxels.features, voxels.columns(), contract="dense")
    assert_same(twin, voxels)
    for each in (voxels, twin):
        keys, lifted, labels = frames[3][1]
        each.integrate(keys, lifted, time=3.0, labels=labels)
    assert_same(twin, voxels)


def test_a_copy_does_not_grow_and_arrays_cannot_be_written(rng):
    voxels = built([(0.0, observation(rng))])
    twin, size = voxels.copy(), len(voxels)
    keys, lifted, labels = observation(rng)
    voxels.integrate(keys + np.int32(50), lifted, time=1.0, labels=labels)
    assert len(twin) == size < len(voxels)
    with pytest.raises(ValueError, match="read-only"):
        voxels.features[0] = 0


def test_refused_input_leaves_the_map_as_it_was(rng):
    voxels = built([(0.0, observation(rng))])
    before = voxels.copy()
    keys, lifted, _ = observation(rng)
    sums = lifted.sums.copy()
    sums[3] = np.nan
    bad = Lifted(sums, lifted.weight, lifted.pixels, lifted.color_sum)
    with pytest.raises(DataError, match="lifted features is not finite"):
        voxels.integrate(keys, bad, time=1.0)
    with pytest.raises(DataError, match="time of a frame is not finite"):
        voxels.integrate(keys, lifted, time=float("nan"))
    with pytest.raises(ShapeError, match="voxel keys has the wrong shape"):
        voxels.integrate(keys[:-1], lifted, time=1.0)
    with pytest.raises(DataError, match="voxel keys are too large"):
        voxels.integrate(keys + np.int32(2**24), lifted, time=1.0)
    with pytest.raises(ConfigError, match="different kinds cannot be merged"):
        voxels.merge(VoxelMap(0.4, 3))
    assert_same(voxels, before)


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan")])
def test_a_voxel_size_that_is_none_is_told(size):
    with pytest.raises(ConfigError, match="voxel size is not usable"):
        VoxelMap(size, 3)
