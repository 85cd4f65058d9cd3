from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvocab_occ.errors import ConfigError
from openvocab_occ.objects.state import StateConfig, judge, observe_motion, shift

metres = st.floats(-50, 50)


@given(metres, metres, st.floats(0, 10), st.floats(0, 10))
def test_a_rigid_shift_is_found_and_growing_is_none(low, way, length, more):
    a, b = np.array([low, 0.0]), np.array([low + length, 0.0])
    ahead, grown = np.array([way, 0.0]), np.array([more, 0.0])
    np.testing.assert_allclose(shift(a, b, a + ahead, b + ahead), ahead, atol=1e-9)
    np.testing.assert_array_equal(shift(a, b, a - grown, b + grown), [0, 0])
    np.testing.assert_array_equal(shift(a, b, a, b + grown), [0, 0])


def seen(path, length=4.4, times=None, **more):
    path = np.asarray(path, dtype=float).reshape(-1, 2)
    times = np.arange(len(path)) * 0.5 if times is None else np.asarray(times, dtype=float)
    return observe_motion(times, path - length / 2, path + length / 2, sightings=len(path),
                          time_observed=float(times[-1] - times[0]), voxel_size=0.4, **more)  # fmt: skip


def line(speeds):
    return np.c_[np.concatenate([[0.0], np.cumsum(speeds)]) * 0.5, np.zeros(len(speeds) + 1)]


@pytest.mark.parametrize(
    ("path", "movable", "state"),
    [
        (line([4] * 8), 1.0, "moving"),
        (line([4] * 4 + [0] * 6), 1.0, "stopped"),
        (line([0] * 8), 1.0, "parked"),
        (line([0] * 8), 0.0, "fixed"),
        (line([0] * 8), float("nan"), "unknown"),
        (line([0]), 1.0, "unknown"),
        ([[0, 0]], 1.0, "unknown"),
        (line([1.4] * 4), 1.0, "moving"),
        (line([0] * 4 + [4] * 4), 1.0, "moving"),
        (line([4] * 8), 0.0, "fixed"),
    ],
)  # fmt: skip
def test_states_come_from_motion(path, movable, state):
    assert judge(seen(path), movable=movable)[0] == state


def test_a_bus_seen_piece_by_piece_did_not_move():
    """Its rear is seen first, then more of its side, then its front: both bounds wander, but never the same way."""
    low = np.array([[0, 0], [0, 0], [0, 0], [3, 0], [8, 0]], float)
    high = np.array([[3, 2.5], [8, 2.5], [12, 2.5], [12, 2.5], [12, 2.5]], float)
    motion = observe_motion(np.arange(5) * 0.5, low, high, sightings=5, time_observed=2.0, voxel_size=0.4)
    assert motion.extent == 8.0  # rear at first, front at last: bounds alone cannot tell
    state, _, why = judge(replace(motion, left=0.0), movable=1.0)
    assert state == "parked"
    assert "5 sightings in 2.0 s" in why


def test_nothing_seen_in_pieces_seems_to_move_further_than_it_is_long():
    """A walker whose first place nobody could look through: 8 m are more than a person, and less than a bus."""
    motion = replace(seen(line([2] * 8)), left=0.0)
    assert motion.extent == pytest.approx(8.0)
    assert judge(motion, movable=1.0, longest=1.2)[0] == "moving"
    assert judge(motion, movable=1.0, longest=19.0)[0] == "parked"
    assert judge(motion, movable=1.0)[0] == "parked"


def test_uncertainty_grows_with_voxels_and_sureness_with_time():
    short, long = (judge(seen(line([0] * n)), movable=1.0)[1] for n in (4, 20))
    assert 0 < short < long < 1
    assert seen(line([0.2] * 3)).speed == 0.0  # within the uncertainty


def test_options_are_checked():
    with pytest.raises(ConfigError, match="state option extent is not usable: expected >= 0, got nan"):
        StateConfig(extent=float("nan"))
