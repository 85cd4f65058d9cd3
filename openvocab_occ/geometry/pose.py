"""Rigid motions as 4x4 float64 matrices. `T_a_b` takes points of frame b into frame a; compose by matching letters."""

import numpy as np
from jaxtyping import Float

from openvocab_occ.arrays import ArrayLike, as_floats
from openvocab_occ.errors import PoseError, ShapeError

_RIGID_TOLERANCE = 1e-3  # float32 poses of real data sets are off by 1e-6; a wrong one by far more


def as_pose(value: ArrayLike, name: str = "pose") -> Float[np.ndarray, "4 4"]:
    """Return `value` as a rigid motion, or raise PoseError that says why it is none.

    A (3, 4) matrix, as KITTI writes them, gets its last row.
    """
    try:
        rows = as_floats(value, (None, 4), name)
    except ShapeError:
        raise
    except ValueError as error:
        raise PoseError(
            f"{name} holds NaN or infinity",
            expected="a finite rigid motion",
            fix="drop the frame or interpolate its pose",
        ) from error
    T = np.vstack([rows, [0.0, 0.0, 0.0, 1.0]]) if rows.shape == (3, 4) else rows
    if T.shape != (4, 4):
        raise ShapeError(f"{name} has the wrong shape", expected="(4, 4) or (3, 4)", got=T.shape)
    if not np.allclose(T[3], [0, 0, 0, 1], atol=1e-6):
        raise PoseError(
            f"{name} has a wrong last row", expected="[0, 0, 0, 1]", got=T[3].tolist(), fix="is the matrix transposed?"
        )
    R = T[:3, :3]
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > _RIGID_TOLERANCE:
        raise PoseError(
            f"{name} is not a rotation",
            expected=f"R R^T = I within {_RIGID_TOLERANCE}",
            got=f"off by {error:.3g}",
            fix="remove scale or shear, or normalise the quaternion",
        )
    if np.linalg.det(R) < 0:
        raise PoseError(
            f"{name} is a reflection",
            expected="determinant +1",
            got="determinant -1",
            fix="one axis is flipped: check the handedness of the source",
        )
    return T


def pose(translation: ArrayLike = (0.0, 0.0, 0.0), wxyz: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> Float[np.ndarray, "4 4"]:
    """Build a pose from a translation in metres and a quaternion."""
    T = np.eye(4)
    T[:3, :3] = matrix_from_wxyz(wxyz)
    T[:3, 3] = as_floats(np.asarray(translation), (3,), "translation")
    return T


def invert(T_a_b: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Return T_b_a, by transposing the rotation."""
    R_t = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T = np.zeros_like(T_a_b)
    T[..., :3, :3] = R_t
    T[..., :3, 3] = -(R_t @ T_a_b[..., :3, 3:])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def transform(T_a_b: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return the points of frame b as seen from frame a, in float64."""
    return points.astype(np.float64) @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def matrix_from_wxyz(wxyz: ArrayLike) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of a quaternion, which need not be of unit length but not zero."""
    q = as_floats(np.asarray(wxyz), (4,), "quaternion")
    norm = float(np.linalg.norm(q))
    if norm < 1e-9:
        raise PoseError("quaternion is zero", expected="w, x, y, z of unit length", got=q.tolist())
    w, x, y, z = q / norm
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def wxyz_from_matrix(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 4"]:
    """Return the unit quaternion of a rotation, with w >= 0.

    The largest of the four squared components is found first, so that nothing is divided by a small number.
    """
    squared = np.array([1 + R[0, 0] + R[1, 1] + R[2, 2], 1 + R[0, 0] - R[1, 1] - R[2, 2],
                        1 - R[0, 0] + R[1, 1] - R[2, 2], 1 - R[0, 0] - R[1, 1] + R[2, 2]])  # fmt: skip
    wx, wy, wz = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    rows = np.array(
        [[squared[0], wx, wy, wz], [wx, squared[1], xy, xz], [wy, xy, squared[2], yz], [wz, xz, yz, squared[3]]]
    )
    q = rows[int(squared.argmax())]
    q = q / np.linalg.norm(q)
    return q if q[0] >= 0 else -q


def look_at(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Float[np.ndarray, "4 4"]:
    """Return T_world_cam of a camera at `position` that looks at `target` (x right, y down, z forward)."""
    eye = as_floats(np.asarray(position), (3,), "position")
    forward = as_floats(np.asarray(target), (3,), "target") - eye
    if np.linalg.norm(forward) < 1e-9:
        raise PoseError("a camera cannot look at its own position", got=eye.tolist())
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, as_floats(np.asarray(up), (3,), "up"))
    if np.linalg.norm(right) < 1e-6:  # straight up or down: any right will do
        right = np.cross(forward, [0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(forward, right), forward, eye
    return T
