import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from openvocab_occ.errors import ConfigError, DataError, NotFoundError
from openvocab_occ.geometry import Trajectory, interpolate, invert, turn_up


def some_poses(rng, count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=0).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    return poses


def test_interpolation_is_scipys_slerp(rng):
    a, b = some_poses(rng, 2)
    slerp = Slerp([0, 1], Rotation.from_matrix([a[:3, :3], b[:3, :3]]))
    for w in (0.0, 0.1, 0.5, 0.9, 1.0):
        T = interpolate(a, b, w)
        np.testing.assert_allclose(T[:3, :3], slerp(w).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(T[:3, 3], (1 - w) * a[:3, 3] + w * b[:3, 3])
        np.testing.assert_allclose(interpolate(b, a, 1 - w), T, atol=1e-12)  # the same way back
        M = some_poses(rng, 3)[2]
        np.testing.assert_allclose(interpolate(M @ a, M @ b, w), M @ T, atol=1e-9)  # it does not matter from where


def test_any_order_gives_the_same_trajectory(rng):
    poses = some_poses(rng, 9)
    times = rng.permutation(9) * 0.5
    a, order = Trajectory(times, poses), np.argsort(times)
    b = Trajectory(times[order], poses[order])
    for time in (0.0, 0.3, 2.0, 3.99, 4.0):
        np.testing.assert_array_equal(a.at(time), b.at(time))
    np.testing.assert_allclose(a.at(float(times[4])), poses[4], atol=1e-12)


def test_gaps_and_ends(rng):
    poses = some_poses(rng, 3)
    way = Trajectory([0.0, 1.0, 10.0], poses, "way")
    np.testing.assert_array_equal(way.at(10.4, tolerance=0.5), poses[2])
    with pytest.raises(
        NotFoundError, match=r"way has no pose at 10\.400000 s: expected one within 0\.1 s.*0\.400 s away"
    ):
        way.at(10.4, tolerance=0.1)
    with pytest.raises(NotFoundError):
        way.at(5.0, max_gap=2.0)
    np.testing.assert_array_equal(way.at(1.2, tolerance=0.3, max_gap=2.0), poses[1])
    with pytest.raises(DataError, match="holds no poses"):
        Trajectory([], poses[:0])
    later = Trajectory([0.0, 0.0], poses[:2])
    np.testing.assert_array_equal(later.at(0.0), poses[1])


def test_turn_up_is_a_rotation_that_lifts_its_axis():
    for name in ("x", "-x", "y", "-y", "z", "-z"):
        T = turn_up(name)
        axis = np.eye(3)["xyz".index(name[-1])] * (-1 if name[0] == "-" else 1)
        np.testing.assert_array_equal(T[:3, :3] @ axis, [0, 0, 1])
        np.testing.assert_array_equal(T @ invert(T), np.eye(4))
        assert np.linalg.det(T) == pytest.approx(1)
    with pytest.raises(ConfigError, match="up is not an axis"):
        turn_up("up")
