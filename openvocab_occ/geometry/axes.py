"""Axes of other conventions: cameras of OpenGL, cameras that are their own vehicle, worlds whose up is not z."""

from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from openvocab_occ.errors import ConfigError

T_EGO_CAM_AXES: Float[np.ndarray, "4 4"] = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""A camera at the ego's origin that looks forward: its z is the ego's x, its x the ego's -y, its y the ego's -z."""
T_OPENGL_OPENCV: Float[np.ndarray, "4 4"] = np.diag([1.0, -1.0, -1.0, 1.0])
"""Cameras of OpenGL (x right, y up, z backward) from those of OpenCV (x right, y down, z forward); its own inverse."""
_TURNS = MappingProxyType({
    "z": np.eye(3), "-z": np.diag([1.0, -1.0, -1.0]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), "-y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), "-x": np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]),
})  # fmt: skip


def turn_up(axis: str) -> Float[np.ndarray, "4 4"]:
    """Return the rotation that takes this axis of a source's world (`z`, `-z`, `y`, `-y`, `x`, `-x`) to our z."""
    if axis not in _TURNS:
        raise ConfigError("up is not an axis", expected=" or ".join(_TURNS), got=repr(axis))
    T = np.eye(4)
    T[:3, :3] = _TURNS[axis]
    return T
