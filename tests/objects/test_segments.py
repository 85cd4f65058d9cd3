from dataclasses import replace

import numpy as np
import pytest
from block_frames import NAMES, block, frame_of, vector
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.mapping.keys import pack
from openvocab_occ.objects import _segments_kernels as kernels
from openvocab_occ.objects import _segments_reference as reference
from openvocab_occ.objects.segments import SegmentConfig, neighbour_pairs, segment_frame
from openvocab_occ.occupancy import OccupancyGrid


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 24), st.sampled_from([0.0, 0.3, 5.0]), st.integers(1, 4))
def test_union_find_agrees_with_sets(seed, n, scale, least):
    rng = np.random.default_rng(seed)
    pairs = rng.integers(0, n, size=(rng.integers(0, 3 * n + 1), 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    weights = rng.choice([0.0, 0.25, 0.5, 1.0], len(pairs)).astype(np.float32)  # with ties
    out = np.empty(n, np.int64)
    kernels.merge_edges(pairs, weights, np.argsort(weights, kind="stable"), scale, least, out)
    np.testing.assert_array_equal(out, reference.merge_edges(pairs, weights, n, scale, least))


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_neighbours_are_those_of_brute_force(seed, count):
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(-3, 4, size=(count, 3)), axis=0).astype(np.int32)
    keys = keys[np.argsort(pack(keys))]
    found = {tuple(sorted(p)) for p in neighbour_pairs(pack(keys)).tolist()}
    off = np.abs(keys[:, None] - keys[None]).max(axis=2)
    assert found == {(i, j) for i, j in np.argwhere(off == 1).tolist() if i < j}
    assert len(found) == len(neighbour_pairs(pack(keys)))


def kinds(segments):
    return sorted((NAMES[int(s.class_votes.argmax())], len(s.seen)) for s in segments)


def test_things_apart_are_segments_and_ground_is_none():
    frame = frame_of([
        block("driveable surface", (-20, -20, -1), (40, 40, 1)), block("car", (0, 0, 0), (10, 5, 4)),
        block("truck", (0, 10, 0), (16, 6, 8)),
    ])  # fmt: skip
    segments = segment_frame(frame, NAMES)
    assert kinds(segments) == [("car", 200), ("truck", 768)]
    truck = segments[0]
    np.testing.assert_allclose(truck.low, [0, 4, 0], atol=1e-9)
    np.testing.assert_allclose(truck.high, [6.4, 6.4, 3.2])
    np.testing.assert_allclose(truck.feature, vector("truck"), atol=1e-5)
    assert truck.weight == 9 * 768


@pytest.mark.parametrize(("gap", "blind", "count"), [(1, True, 1), (2, True, 1), (3, True, 2), (1, False, 2)])
def test_layers_that_a_lidar_tells_of_are_one_thing(gap, blind, count):
    """A wall known in two bands: what is unknown between them may be wall, what is known to be free is not."""
    bands = [block("manmade", (0, 0, 0), (6, 1, 3)), block("manmade", (0, 0, 3 + gap), (6, 1, 3))]
    known = np.ones((12, 12, 16), bool)
    known[:, :, 7 : 7 + gap] = not blind
    labels = np.full(known.shape, NAMES.index("free"), np.uint8)
    spec = GridSpec((-1.6, -1.6, -1.8), 0.4, known.shape)  # half a voxel off the lattice, as Occ3D's
    grid = OccupancyGrid(labels, spec, np.eye(4), NAMES.index("free"), known=known, class_names=NAMES)
    frame = replace(frame_of(bands), window=grid)
    assert len(segment_frame(frame, NAMES)) == count


def test_an_empty_street_has_no_segments():
    assert segment_frame(frame_of([]), NAMES) == []
    assert segment_frame(frame_of([block("driveable surface", (0, 0, 0), (9, 9, 1))]), NAMES) == []


def test_a_person_before_a_wall_of_the_same_colour_is_a_person():
    wall, person = block("manmade", (0, 0, 0), (40, 1, 8), "grey"), block("pedestrian", (20, 1, 0), (1, 1, 4), "grey")
    segments = segment_frame(frame_of([wall, person]), NAMES)
    assert kinds(segments) == [("manmade", 320), ("pedestrian", 4)]
    # classes are evidence: without the penalty nothing tells the two apart
    free = segment_frame(frame_of([wall, person]), NAMES, SegmentConfig(class_penalty=0.0))
    assert len(free) == 1


def test_features_cut_where_no_class_is_named():
    """Two boxes that touch, of different features, and nothing that names either."""
    blocks = [block(None, (0, 0, 0), (6, 4, 4), "red"), block(None, (6, 0, 0), (6, 4, 4), "blue")]
    assert sorted(len(s.seen) for s in segment_frame(frame_of(blocks), ())) == [96, 96]


def test_a_car_behind_a_pole_is_one_thing():
    """The pole hides a slice of the car; the grid still knows the slice."""
    car = block("car", (0, 5, 0), (11, 5, 4))
    hidden = block("car", (5, 5, 0), (1, 5, 4))
    front = [
        block("car", (0, 5, 0), (5, 5, 4)),
        block("car", (6, 5, 0), (5, 5, 4)),
        block("manmade", (5, 0, 0), (1, 1, 9)),
    ]
    segments = segment_frame(frame_of(front, hidden=[hidden]), NAMES)
    assert kinds(segments) == [("car", 200), ("manmade", 9)]
    assert {len(s.body) for s in segments} == {len(car[0]), 9}
    apart = segment_frame(frame_of(front), NAMES)
    assert kinds(apart) == [("car", 100), ("car", 100), ("manmade", 9)]


def test_a_bus_that_fills_the_view_is_one_thing_with_a_cut_off_crop():
    bus = block("bus", (2, -20, 0), (1, 40, 8))
    rows = np.full((30, 40), 0, np.int32)
    rows[:] = np.arange(320).reshape(8, 40)[np.arange(30)[:, None] * 8 // 30, np.arange(40)[None]]
    segments = segment_frame(frame_of([bus], views=[("FRONT", rows)]), NAMES)
    assert kinds(segments) == [("bus", 320)]
    (crop,) = segments[0].crops
    assert crop.box == (0, 0, 39, 29)
    assert crop.pixels == 1200
    assert crop.score == pytest.approx(0.5 * 1200**0.5)


def test_a_thing_across_two_cameras_is_one_segment_with_a_crop_in_each():
    car = block("car", (0, 0, 0), (10, 1, 4))
    rows = np.arange(40, dtype=np.int32).reshape(10, 4).T  # z down the image, x along it
    left, right = rows.copy(), rows.copy()
    left[:, 6:], right[:, :4] = -1, -1
    segments = segment_frame(frame_of([car], views=[("LEFT", left), ("RIGHT", right)]), NAMES)
    assert len(segments) == 1
    assert [(c.view, c.pixels) for c in segments[0].crops] == [("LEFT", 24), ("RIGHT", 24)]


def test_options_are_checked():
    with pytest.raises(ConfigError, match=r"segment option scale is not usable: expected >= 0, got -1.0"):
        SegmentConfig(scale=-1.0)
    with pytest.raises(ConfigError, match="min_voxels is not usable: expected at least 1, got 0"):
        SegmentConfig(min_voxels=0)
