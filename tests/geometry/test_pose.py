"""Laws of rigid motions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from openvocab_occ.errors import PoseError, ShapeError
from openvocab_occ.geometry import as_pose, invert, look_at, matrix_from_wxyz, pose, transform, wxyz_from_matrix


def random_poses(rng: np.random.Generator, count: int) -> list[np.ndarray]:
    return [pose(rng.normal(scale=50, size=3), rng.normal(size=4)) for _ in range(count)]


def test_a_pose_and_its_inverse_cancel(rng):
    for T in random_poses(rng, 50):
        np.testing.assert_allclose(invert(T) @ T, np.eye(4), atol=1e-12)
        np.testing.assert_allclose(invert(invert(T)), T, atol=1e-12)
        np.testing.assert_allclose(invert(T), np.linalg.inv(T), atol=1e-10)


def test_inverse_works_on_stacks(rng):
    stack = np.stack(random_poses(rng, 6)).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(invert(stack) @ stack, np.broadcast_to(np.eye(4), stack.shape), atol=1e-12)


def test_moving_twice_is_moving_by_the_product(rng):
    A, B = random_poses(rng, 2)
    points = rng.normal(size=(7, 5, 3)).astype(np.float32)
    np.testing.assert_allclose(transform(A @ B, points), transform(A, transform(B, points)), atol=1e-10)
    assert transform(A, points).dtype == np.float64


def test_rotations_agree_with_scipy(rng):
    for q in rng.normal(size=(50, 4)):
        np.testing.assert_allclose(
            matrix_from_wxyz(q), Rotation.from_quat(q, scalar_first=True).as_matrix(), atol=1e-12
        )


def quaternions(rng: np.random.Generator) -> np.ndarray:
    """Random ones, the half turns (w = 0, where a formula that divides by w fails), and near half turns."""
    half_turns = np.concatenate([np.eye(4)[1:], [[0, 1, 1, 0], [0, 1, 0, -1], [0, 1, 2, 3], [1, 0, 0, 0]]])
    near = half_turns + rng.normal(scale=1e-9, size=half_turns.shape)
    return np.concatenate([rng.normal(size=(200, 4)), half_turns, near])


def test_quaternions_survive_the_round_trip(rng):
    for q in quaternions(rng):
        R = matrix_from_wxyz(q)
        again = wxyz_from_matrix(R)
        assert again[0] >= 0
        assert np.linalg.norm(again) == pytest.approx(1, abs=1e-12)
        np.testing.assert_allclose(matrix_from_wxyz(again), R, atol=1e-12)
        assert abs(again @ q) / np.linalg.norm(q) == pytest.approx(1, abs=1e-12)  # the same turn, up to sign


@pytest.mark.parametrize("target", [(5, 3, 1), (-4, 0, 0), (1, 2, 30), (1, 2, -30), (1.0, 2.0, 4.0)])
def test_look_at_puts_the_target_on_the_axis_and_up_above(target):
    eye = np.array([1.0, 2.0, 3.0])
    T = as_pose(look_at(eye, target))
    local = transform(invert(T), np.asarray([target, eye], dtype=np.float64))
    np.testing.assert_allclose(local[0], [0, 0, np.linalg.norm(np.array(target) - eye)], atol=1e-12)
    np.testing.assert_allclose(local[1], 0, atol=1e-12)
    assert T[2, 1] <= 1e-12  # the camera's y axis points down


def test_look_at_its_own_position_is_refused():
    with pytest.raises(PoseError, match="a camera cannot look at its own position: got"):
        look_at([1, 2, 3], [1, 2, 3])


def test_a_kitti_row_gets_its_last_row():
    np.testing.assert_array_equal(as_pose(np.eye(4)[:3]), np.eye(4))


def changed(row: int, column: int, value: float) -> np.ndarray:
    T = pose([1, 2, 3], [0.9, 0.1, 0.2, 0.3])
    T[row, column] = value
    return T


@pytest.mark.parametrize(
    ("bad", "error", "message"),
    [
        (
            changed(0, 3, np.nan),
            PoseError,
            r"T_a_b holds NaN or infinity: expected a finite rigid motion; drop the frame",
        ),
        (changed(1, 1, np.inf), PoseError, "T_a_b holds NaN or infinity"),
        (np.diag([1.0, 1, -1, 1]), PoseError, "T_a_b is a reflection: expected determinant \\+1"),
        (
            np.diag([2.0, 2, 2, 1]),
            PoseError,
            "T_a_b is not a rotation: expected R R\\^T = I within 0.001, got off by 3",
        ),
        (changed(0, 1, 5.0), PoseError, "T_a_b is not a rotation"),
        (pose([1, 2, 3]).T, PoseError, r"T_a_b has a wrong last row: .* is the matrix transposed\?"),
        (np.eye(3), ShapeError, r"T_a_b has the wrong shape: expected \(any, 4\), got \(3, 3\)"),
        (np.zeros((5, 4)), ShapeError, r"T_a_b has the wrong shape: expected \(4, 4\) or \(3, 4\), got \(5, 4\)"),
        ("north", ShapeError, "T_a_b is not an array of numbers: got str"),
    ],
)
def test_what_is_no_pose_is_refused(bad, error, message):
    with pytest.raises(error, match=message):
        as_pose(bad, "T_a_b")


def test_a_zero_quaternion_is_refused():
    with pytest.raises(PoseError, match="quaternion is zero: expected w, x, y, z of unit length"):
        pose([0, 0, 0], [0, 0, 0, 0])
