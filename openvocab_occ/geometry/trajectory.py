"""Poses over time, asked for at any moment."""

import numpy as np
from jaxtyping import Float

from openvocab_occ.arrays import ArrayLike, as_floats, check_shape
from openvocab_occ.errors import DataError, NotFoundError
from openvocab_occ.geometry.pose import as_pose, pose, wxyz_from_matrix


class Trajectory:
    """Timed poses of one frame in another. Between two of them the position moves evenly and the rotation by slerp."""

    def __init__(self, times: ArrayLike, poses: Float[np.ndarray, "n 4 4"], name: str = "trajectory") -> None:
        """Sort by time; of two poses at one time the later given wins.

        Args:
            times: Seconds.
            poses: T_a_b at these times.
            name: What error messages call it.
        """
        stamps = as_floats(times, (None,), f"times of {name}")
        check_shape(poses, (len(stamps), 4, 4), f"poses of {name}")
        if not len(stamps):
            raise DataError(f"{name} holds no poses", expected="at least 1", got=0)
        order = np.argsort(stamps, kind="stable")
        keep = np.append(np.diff(stamps[order]) > 0, True)
        self.times = stamps[order][keep]
        """Strictly increasing, seconds."""
        self._poses = poses[order][keep]
        self._name = name

    def at(self, time: float, *, tolerance: float = 0.0, max_gap: float = np.inf) -> Float[np.ndarray, "4 4"]:
        """Return T_a_b at a time.

        Args:
            time: Seconds.
            tolerance: Before the first and after the last pose, and in a gap, the nearest holds for so many seconds.
            max_gap: Nothing is interpolated between poses that lie further apart than this, seconds.

        Raises:
            NotFoundError: The nearest pose is further away than `tolerance`, and there is none to interpolate with.
        """
        after = int(np.searchsorted(self.times, time))
        near = [i for i in (after - 1, after) if 0 <= i < len(self.times)]
        first, last = near[0], near[-1]
        gap = float(self.times[last] - self.times[first])
        if first != last and gap <= max_gap:
            return interpolate(self._poses[first], self._poses[last], (time - float(self.times[first])) / gap)
        nearest = min(near, key=lambda i: abs(self.times[i] - time))
        away = abs(float(self.times[nearest]) - time)
        if away > tolerance:
            raise NotFoundError(
                f"{self._name} has no pose at {time:.6f} s",
                expected=f"one within {tolerance:g} s",
                got=f"the nearest {away:.3f} s away",
                fix="allow a larger tolerance, or drop the frame",
            )
        return self._poses[nearest].copy()


def interpolate(
    T_a_b0: Float[np.ndarray, "4 4"], T_a_b1: Float[np.ndarray, "4 4"], weight: float
) -> Float[np.ndarray, "4 4"]:
    """Return the pose a share `weight` of the way from the first to the second, along the shorter turn."""
    q0, q1 = wxyz_from_matrix(as_pose(T_a_b0)[:3, :3]), wxyz_from_matrix(as_pose(T_a_b1)[:3, :3])
    cosine = float(q0 @ q1)
    if cosine < 0:
        q1, cosine = -q1, -cosine
    angle = float(np.arccos(min(cosine, 1.0)))
    if angle < 1e-7:
        q = (1 - weight) * q0 + weight * q1
    else:
        q = (np.sin((1 - weight) * angle) * q0 + np.sin(weight * angle) * q1) / np.sin(angle)
    return pose((1 - weight) * T_a_b0[:3, 3] + weight * T_a_b1[:3, 3], q)
