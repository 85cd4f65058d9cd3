"""Things over frames, made of blocks: what stays one, what becomes two, and what state it has."""

import numpy as np
import pytest
from block_frames import NAMES, SIZE, block, frame_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.mapping import FreeSpace, Lifted, VoxelMap
from openvocab_occ.mapping.keys import pack, unpack
from openvocab_occ.objects.bridges import cut_bridge
from openvocab_occ.objects.describe import motion_of
from openvocab_occ.objects.refine import RefineConfig, refine
from openvocab_occ.objects.segments import segment_frame
from openvocab_occ.objects.state import judge
from openvocab_occ.objects.tracker import TrackConfig, Tracker
from openvocab_occ.objects.tracks import coarse


def follow(frames, config=None):
    """Track blocks; frames are lists of blocks, half a second apart."""
    tracker = Tracker(SIZE, NAMES, config)
    ids = []
    for n, blocks in enumerate(frames):
        segments = segment_frame(frame_of(blocks, index=n, time=n / 2), NAMES)
        ids.append(tracker.observe(segments, frame=n, time=n / 2))
    return tracker, ids


def states(tracker):
    tracks, _, _ = refine(tracker.tracks, together=tracker.together, apart=tracker.apart, names=NAMES)
    return [judge(t.motion(), movable=t.movable(NAMES))[0] for t in tracks]


def car(x, y=0, feature=None):
    return block("car", (x, y, 0), (11, 5, 4), feature)


def test_a_parked_car_is_one_thing_and_parked():
    tracker, ids = follow([[car(0)]] * 6)
    assert ids == [[1]] * 6
    assert states(tracker) == ["parked"]


@pytest.mark.parametrize("step", [2, 5, 10, 16])
def test_a_moving_car_keeps_its_identity_and_leaves_no_trail(step):
    tracker, ids = follow([[car(n * step)] for n in range(8)])
    assert {i for found in ids for i in found} == {1}
    assert states(tracker) == ["moving"]
    assert len(tracker.tracks[1].voxels) == 11 * 5 * 4
    assert tracker.tracks[1].heading() == pytest.approx(0.0)
    assert tracker.tracks[1].motion().speed == pytest.approx(step * SIZE * 2, rel=0.05)


def test_two_cars_that_meet_keep_their_identities():
    frames = [[car(n * 5, 0, "red"), car(60 - n * 5, 9, "blue")] for n in range(12)]
    tracker, ids = follow(frames)
    assert len(tracker.tracks) == 2
    assert states(tracker) == ["moving", "moving"]
    assert all(sorted(found) == [1, 2] for found in ids)


def test_a_moving_car_survives_an_occlusion():
    frames = [[car(n * 5)] if n not in (4, 5) else [] for n in range(10)]
    tracker, _ = follow(frames)
    assert len(tracker.tracks) == 1
    assert tracker.tracks[1].frames == [0, 1, 2, 3, 6, 7, 8, 9]


def test_a_thing_seen_once_is_unknown():
    tracker, _ = follow([[car(0)], []])
    assert states(tracker) == ["unknown"]


def test_what_starts_to_stand_is_stopped():
    xs = [0, 5, 10, 15, 20, 20, 20, 20, 20]
    tracker, _ = follow([[car(x)] for x in xs])
    assert states(tracker) == ["stopped"]


def test_an_empty_street_has_no_tracks():
    tracker, ids = follow([[], [], []])
    assert ids == [[], [], []]
    assert refine(tracker.tracks, together={}, apart={}, names=NAMES)[0] == []


def test_two_trucks_bumper_to_bumper_are_cut_at_the_neck():
    """Boxes of 7 m with a low bonnet at the front of each: where they touch, little is there."""
    one = [block("truck", (0, 0, 0), (15, 6, 8)), block("truck", (15, 0, 0), (3, 6, 2))]
    two = [block("truck", (18, 0, 0), (15, 6, 8)), block("truck", (33, 0, 0), (3, 6, 2))]
    tracker, _ = follow([one + two] * 5)
    assert len(tracker.tracks) == 1
    tracks, done, _ = refine(tracker.tracks, together=tracker.together, apart=tracker.apart, names=NAMES)
    assert len(tracks) == 2
    assert done.split == 1
    lengths = sorted(len(t.voxels) for t in tracks)
    assert lengths[0] / lengths[1] > 0.75
    assert sum(lengths) == len(tracker.tracks[1].voxels)
    whole, off, _ = refine(tracker.tracks, together={}, apart={}, names=NAMES, config=RefineConfig(split=False))
    assert (len(whole), off.split) == (1, 0)


def test_a_lone_truck_is_not_cut():
    keys = np.concatenate([block("truck", (0, 0, 0), (4, 6, 6))[0], block("truck", (4, 0, 0), (1, 6, 2))[0],
                           block("truck", (5, 0, 0), (13, 6, 8))[0]]).astype(np.int32)  # fmt: skip
    packed = np.sort(pack(keys))
    assert len(cut_bridge(packed, "truck", SIZE)) == 1
    assert len(cut_bridge(packed, "no such word", SIZE)) == 1


def test_pieces_of_one_thing_merge_and_two_things_do_not():
    """A wall is seen left and right of a tree, then whole; two parked cars always apart."""
    left, right = block("manmade", (0, 9, 0), (10, 1, 6)), block("manmade", (20, 9, 0), (10, 1, 6))
    whole = block("manmade", (0, 9, 0), (30, 1, 6))
    cars = [car(0), car(14)]
    tracker, _ = follow([[left, right, *cars]] * 2 + [[whole, *cars]] * 3)
    tracks, done, into = refine(tracker.tracks, together=tracker.together, apart=tracker.apart, names=NAMES)
    assert len(tracks) == 3
    assert done.merged == len(into) == 1
    assert sorted(len(t.voxels) for t in tracks) == [180, 220, 220]
    assert len(tracker.tracks) == 4  # the tracks themselves stay


def test_a_piece_of_a_parked_car_does_not_jump_to_the_next_one():
    """Cars in a row, shown bit by bit through what drives by: now the rear of one, now the rear of another."""
    rear = [block("car", (x, 0, 1), (2, 5, 2), "car") for x in (0, 16, 32)]
    whole = [car(x, 0, "car") for x in (0, 16, 32)]
    frames = [[whole[0], rear[1]], [whole[0], whole[1], rear[2]], [rear[0], whole[1], whole[2]], whole, whole]
    tracker, ids = follow(frames)
    assert len(tracker.tracks) == 3
    assert [sorted(found) for found in ids[1:]] == [[1, 2, 3]] * 4
    assert states(tracker) == ["parked"] * 3


def test_two_segments_now_and_then_do_not_keep_a_thing_in_two():
    """An excavator is once seen as cab and boom, and later as one."""
    cab, boom = block("truck", (0, 0, 0), (8, 6, 7)), block("truck", (11, 2, 5), (6, 2, 2))
    link = block("truck", (8, 2, 5), (3, 2, 2), "truck")
    tracker, _ = follow([[cab, boom]] + [[cab, link, boom]] * 5)
    tracks, _, _ = refine(tracker.tracks, together=tracker.together, apart=tracker.apart, names=NAMES)
    assert len(tracks) == 1


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_merging_is_the_same_whatever_was_seen_apart(seed):
    """Pieces of a wall that stands merge along `together`, be they apart in other frames or not."""
    rng = np.random.default_rng(seed)
    walls = [block("manmade", (9 * n, 0, 0), (3, 1, 3)) for n in range(6)]
    tracker, _ = follow([walls] * 2)
    pairs = [tuple(sorted(p)) for p in (rng.integers(1, 7, size=(8, 2))).tolist() if p[0] != p[1]]
    apart = dict.fromkeys([tuple(sorted(p)) for p in rng.integers(1, 7, size=(9, 2)).tolist() if p[0] != p[1]], 9)
    together = dict.fromkeys(pairs, 2)
    graph = np.zeros((7, 7), bool)
    for a, b in together:
        graph[a, b] = True
    count = connected_components(graph, directed=False)[0] - 1  # id 0 is none
    assert len(refine(tracker.tracks, together=together, apart=apart, names=NAMES)[0]) == count


def test_what_may_be_one_thing_is_cut_at_a_clear_gap_only():
    def cut(*blocks):
        return len(cut_bridge(np.sort(pack(np.concatenate(blocks).astype(np.int32))), "truck", SIZE))

    cab, box = block("truck", (0, 0, 0), (12, 6, 6))[0], block("truck", (14, 0, 0), (14, 6, 8))[0]
    assert cut(cab, block("truck", (12, 0, 0), (2, 6, 2))[0], box) == 1  # 11 m: a lorry with a neck
    assert cut(cab, block("truck", (12, 3, 0), (2, 1, 1))[0], box) == 2  # a stray voxel between two
    far = block("truck", (32, 0, 0), (14, 6, 8))[0]
    assert cut(box, block("truck", (28, 0, 0), (4, 6, 2))[0], far) == 2  # 13 m: too long for one


def test_a_rim_that_was_once_seen_through_is_not_left():
    tracker, _ = follow([[car(0)], [car(3)]])
    voxels = VoxelMap(SIZE, 16)
    packed = np.union1d(tracker.tracks[1].first.seen, tracker.tracks[1].last.seen)
    keys = unpack(packed)
    one = np.ones(len(keys), np.float32)
    lifted = Lifted(np.ones((len(keys), 16), np.float32), one, one.astype(np.int32))
    blocks = np.unique(keys // 8, axis=0).astype(np.int32)
    voxels.free = FreeSpace.from_blocks(SIZE, blocks, np.ones((len(blocks), 512), np.uint8))
    assert motion_of(tracker.tracks[1], voxels).left == 1.0
    for n in range(5):
        voxels.integrate(keys, lifted, time=float(n))
    assert motion_of(tracker.tracks[1], voxels).left == 0.0


def test_noise_is_dropped_when_asked():
    tracker, _ = follow([[block("car", (0, 0, 0), (2, 1, 1)), car(20)], [car(20)]])
    kept, done, _ = refine(tracker.tracks, together={}, apart={}, names=NAMES)
    assert (len(kept), done.dropped) == (1, 1)
    kept, done, _ = refine(tracker.tracks, together={}, apart={}, names=NAMES, config=RefineConfig(drop=False))
    assert (len(kept), done.dropped) == (2, 0)


def test_a_frame_costs_what_it_sees_and_not_what_the_map_holds():
    """5,000 things: a frame that sees one of them asks only about those near it."""
    cells = [block("manmade", (4 * (n % 100), 4 * (n // 100), 0), (1, 1, 4)) for n in range(5000)]
    tracker, ids = follow([cells, cells])
    assert ids[0] == ids[1]
    assert len(tracker.tracks) == 5000
    segments = segment_frame(frame_of(cells[:1], index=2, time=1.0), NAMES)
    assert len(tracker._shared(coarse(segments[0].body).tolist())) == 1
    assert tracker.observe(segments, frame=2, time=1.0) == [ids[0][0]]


def test_bad_input_is_told():
    with pytest.raises(ConfigError, match=r"track option overlap is not usable: expected >= 0, got -1.0"):
        TrackConfig(overlap=-1.0)
    with pytest.raises(DataError, match="time of frame 3 is not finite: expected seconds, got nan"):
        Tracker(SIZE, NAMES).observe([], frame=3, time=float("nan"))
