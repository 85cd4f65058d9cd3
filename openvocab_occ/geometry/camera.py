"""Cameras: pixels to rays and points to pixels.

Pixel centres are at integer (u, v): the ray of pixel (u, v) is K^-1 [u, v, 1] (LMPOcc Eq. 5, nuScenes, OpenCV).
Depth is along the camera's z axis, never along the ray.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from openvocab_occ.arrays import ArrayLike, as_floats
from openvocab_occ.errors import CameraError, OpenVocabOccError
from openvocab_occ.geometry.pose import as_pose, invert, transform

Lens = Literal["pinhole", "brown", "fisheye"]
_COEFFICIENTS: dict[str, tuple[int, ...]] = {"pinhole": (0,), "brown": (4, 5, 8, 12, 14), "fisheye": (4,)}
_RAY_TOLERANCE = 0.5  # pixels between a pixel and the projection of its ray; beyond, the lens model has no ray there


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera at a pose."""

    K: Float[np.ndarray, "3 3"]
    """Intrinsics, pixels."""
    width: int
    height: int
    T_world_cam: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Camera (x right, y down, z forward) to world."""
    distortion: tuple[float, ...] = ()
    """Coefficients in OpenCV's order: 4, 5, 8, 12 or 14 for `brown`, 4 for `fisheye`."""
    lens: Lens = "pinhole"
    """`pinhole`, `brown` (Brown-Conrady, OpenCV's main model) or `fisheye` (Kannala-Brandt, cv2.fisheye)."""

    def __post_init__(self) -> None:
        try:
            K = as_floats(self.K, (3, 3), "camera matrix K")
        except OpenVocabOccError as error:
            raise CameraError(str(error)) from error
        if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.allclose(K[2], [0, 0, 1]) or K[1, 0] != 0:
            raise CameraError(
                "camera matrix K cannot be inverted to rays",
                expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0",
                got=K.tolist(),
            )
        if int(self.width) < 1 or int(self.height) < 1:
            raise CameraError(
                "image has no pixels", expected="width and height of at least 1", got=(self.width, self.height)
            )
        coefficients = tuple(float(c) for c in np.ravel(self.distortion))
        lens: Lens = "brown" if coefficients and self.lens == "pinhole" else self.lens
        if lens not in _COEFFICIENTS:
            raise CameraError("lens model is not known", expected=" or ".join(_COEFFICIENTS), got=lens)
        if len(coefficients) not in _COEFFICIENTS[lens] or not np.isfinite(coefficients).all():
            raise CameraError(
                f"distortion does not fit the {lens} lens",
                expected=f"{' or '.join(map(str, _COEFFICIENTS[lens]))} finite coefficients",
                got=coefficients,
            )
        if lens != "pinhole" and K[0, 1] != 0:
            raise CameraError(
                "skew and distortion together are not supported",
                expected="K[0, 1] = 0",
                got=K[0, 1],
                fix="undistort the images first",
            )
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))
        object.__setattr__(self, "T_world_cam", as_pose(self.T_world_cam, "T_world_cam"))
        object.__setattr__(self, "distortion", coefficients)
        object.__setattr__(self, "lens", lens)

    @property
    def position(self) -> Float[np.ndarray, " 3"]:
        """Centre of projection in the world, metres."""
        return self.T_world_cam[:3, 3]

    def rays(self) -> Float[np.ndarray, "h w 3"]:
        """Return for each pixel the direction (x, y, 1) of its ray in the camera frame, float64.

        A point at z-depth d on it is d (x, y, 1). Where a distorted lens has no such ray (90 degrees and more off the
        axis, or beyond the reach of its polynomial) the direction is NaN.
        """
        v, u = np.mgrid[: self.height, : self.width].astype(np.float64)
        return self.unproject(np.stack([u, v], axis=-1))

    def unproject(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Return the directions (x, y, 1) of rays through pixels (u, v), which need not be integers; NaN where none."""
        if self.lens == "pinhole":
            y = (pixels[..., 1] - self.K[1, 2]) / self.K[1, 1]
            x = (pixels[..., 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
            return np.stack([x, y, np.ones_like(x)], axis=-1)
        if not pixels.size:  # OpenCV refuses them
            return np.empty((*pixels.shape[:-1], 3))
        import cv2

        flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2), dtype=np.float64)
        coefficients = np.asarray(self.distortion)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        if self.lens == "fisheye":
            xy: Any = cv2.fisheye.undistortPoints(flat, self.K, coefficients, criteria=criteria)
        else:
            # OpenCV 5 takes the criteria in undistortPoints, OpenCV 4 in a function of its own
            undistort: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
            xy = undistort(flat, self.K, coefficients, R=np.eye(3), P=np.eye(3), criteria=criteria)
        xy = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        again = self._pixels(rays)
        off = np.hypot(again[:, 0] - flat[:, 0, 0], again[:, 1] - flat[:, 0, 1])
        rays[~(off < _RAY_TOLERANCE)] = np.nan
        return rays.reshape(*pixels.shape[:-1], 3)

    def project(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """Return pixels (u, v) and z-depths of points in the world.

        The pixel is NaN for points not in front, and for those so far off the axis that the distortion would fold them
        back into the image.
        """
        local = transform(invert(self.T_world_cam), points)
        depth = local[:, 2].copy()
        pixels = np.full((len(local), 2), np.nan)
        front = depth > 0
        pixels[front] = self._pixels(local[front])
        return pixels, depth

    def _pixels(self, local: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Project points of the camera frame that lie in front of it."""
        if self.lens == "pinhole":
            return (local @ self.K.T)[:, :2] / local[:, 2:]
        if not len(local):
            return np.empty((0, 2))
        import cv2

        radius = np.hypot(local[:, 0], local[:, 1]) / local[:, 2]
        finite = (np.arctan(radius) if self.lens == "fisheye" else radius) < self._reach  # false for NaN
        pixels = np.full((len(local), 2), np.nan)
        zero = np.zeros(3)
        points = np.ascontiguousarray(local[finite, None])
        if len(points):
            project: Any = cv2.fisheye.projectPoints if self.lens == "fisheye" else cv2.projectPoints
            found, _ = project(points, zero, zero, self.K, np.asarray(self.distortion))[:2]
            pixels[finite] = np.asarray(found).reshape(-1, 2)
        return pixels

    @cached_property
    def _reach(self) -> float:
        """Radius hypot(x, y), of a fisheye the angle, at which the radial distortion turns back or has a pole."""
        k = self.distortion
        if self.lens == "fisheye":
            moved = np.polynomial.Polynomial([0, 1, 0, k[0], 0, k[1], 0, k[2], 0, k[3]])
            roots = moved.deriv().trim().roots()
        else:
            k1, k2, _, _, k3, k4, k5, k6 = (*k, *[0.0] * 8)[:8]
            moved = np.polynomial.Polynomial([0, 1, 0, k1, 0, k2, 0, k3])
            divisor = np.polynomial.Polynomial([1, 0, k4, 0, k5, 0, k6]).trim()
            slope = (moved.deriv() * divisor - moved * divisor.deriv()).trim()
            roots = np.concatenate([slope.roots(), divisor.roots()])
        turns = roots[np.abs(roots.imag) < 1e-9].real
        return float(turns[turns > 0].min(initial=np.inf))

    def inside(self, pixels: Float[np.ndarray, "*n 2"]) -> np.ndarray:
        """Tell which pixels lie on the image, within half a pixel of a pixel centre, bool[*n]."""
        u, v = pixels[..., 0], pixels[..., 1]
        with np.errstate(invalid="ignore"):
            return (u >= -0.5) & (u < self.width - 0.5) & (v >= -0.5) & (v < self.height - 0.5)

    def at(self, T_world_cam: ArrayLike) -> "Camera":
        """Return this camera at another pose."""
        return replace(self, T_world_cam=np.asarray(T_world_cam))

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the image squashed to this size: cx' = (cx + 0.5) s - 0.5."""
        scale = np.array([width / self.width, height / self.height])
        K = self.K.copy()
        K[:2] *= scale[:, None]
        K[:2, 2] = (self.K[:2, 2] + 0.5) * scale - 0.5
        return replace(self, K=K, width=width, height=height)

    def cropped(self, left: int, top: int, width: int, height: int) -> "Camera":
        """Return the camera of a window of the image."""
        K = self.K.copy()
        K[:2, 2] -= [left, top]
        return replace(self, K=K, width=width, height=height)
