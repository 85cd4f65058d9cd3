"""The rig of nuScenes in round numbers: six cameras that fire one after the other, and a 32-beam LiDAR."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32

from openvocab_occ.geometry import Camera, look_at

PERIOD = 0.5
"""Seconds between keyframes."""
FULL_SIZE = (1600, 900)
"""Width and height that the intrinsics are given for."""


@dataclass(frozen=True)
class CameraMount:
    """A camera on the ego frame (x forward, y left, z up, ground at 0)."""

    name: str
    yaw_deg: float
    position: tuple[float, float, float]
    focal: float
    """Pixels of the full image."""
    center: tuple[float, float]
    """Principal point, pixels of the full image."""
    delay: float
    """When it fires, seconds after the LiDAR's time; negative is before."""

    def T_ego_cam(self) -> Float[np.ndarray, "4 4"]:
        """Return its pose; it looks along the horizon."""
        yaw = np.deg2rad(self.yaw_deg)
        eye = np.array(self.position)
        return look_at(eye, eye + np.array([np.cos(yaw), np.sin(yaw), 0.0]))

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera of an image of a width; of the scaled image the lower rows are kept, as BEVDet does.

        (1600, 900) is the full image, (704, 256) and (128, 48) are BEVDet's and a small one.
        """
        K = np.array([[self.focal, 0, self.center[0]], [0, self.focal, self.center[1]], [0, 0, 1.0]])
        rows = max(round(FULL_SIZE[1] * width / FULL_SIZE[0]), height)
        scaled = Camera(K, *FULL_SIZE).resized(width, rows)
        return scaled.cropped(0, rows - height, width, height)


RIG: tuple[CameraMount, ...] = (
    CameraMount("CAM_FRONT", 0.0, (1.70, 0.016, 1.51), 1266.0, (816.0, 491.0), -0.035),
    CameraMount("CAM_FRONT_RIGHT", -56.0, (1.55, -0.49, 1.50), 1261.0, (808.0, 495.0), -0.028),
    CameraMount("CAM_FRONT_LEFT", 55.0, (1.52, 0.49, 1.51), 1273.0, (827.0, 480.0), -0.043),
    CameraMount("CAM_BACK", 180.0, (0.03, 0.003, 1.58), 809.0, (829.0, 482.0), -0.010),
    CameraMount("CAM_BACK_LEFT", 108.0, (1.04, 0.48, 1.56), 1257.0, (792.0, 493.0), -0.001),
    CameraMount("CAM_BACK_RIGHT", -110.0, (1.01, -0.48, 1.57), 1260.0, (807.0, 501.0), -0.020),
)
"""Cameras, in the order of nuScenes' files."""
T_EGO_LIDAR: Float[np.ndarray, "4 4"] = np.array(
    [[0.0, 1.0, 0.0, 0.94], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.84], [0.0, 0.0, 0.0, 1.0]]
)
"""LiDAR (x right, y forward, z up) to ego."""
_BEAMS, _COLUMNS = 32, 1086
_ELEVATION_DEG = (-30.67, 10.67)
LIDAR_RANGE = 80.0
"""Metres."""
LIDAR_NOISE = 0.02
"""Standard deviation of a measured range, metres."""


@lru_cache(maxsize=1)
def lidar_directions() -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]]:
    """Return unit directions in the LiDAR frame, and the ring of each."""
    elevation = np.deg2rad(np.linspace(*_ELEVATION_DEG, _BEAMS))
    azimuth = -np.arange(_COLUMNS) * 2 * np.pi / _COLUMNS  # clockwise, as it turns
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    directions = np.stack([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)], axis=-1)
    rings = np.tile(np.arange(_BEAMS, dtype=np.float32), _COLUMNS)
    return directions.reshape(-1, 3).astype(np.float32), rings
