"""Boxes that stand upright: a rectangle on the ground of least area, and a height."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from openvocab_occ.arrays import as_floats
from openvocab_occ.errors import DataError

_TIE = 1e-9
"""Relative difference of areas that counts as none; the angle nearest the axes wins then."""


@dataclass(frozen=True, eq=False)
class Box:
    """A box turned about the vertical only."""

    center: Float64[np.ndarray, " 3"]
    """Metres, world."""
    size: Float64[np.ndarray, " 3"]
    """Length (along yaw), width, height, metres; length >= width for boxes made by `around`."""
    yaw: float
    """Angle of the length against the world's x axis, radians, in (-pi/2, pi/2]: a box has no front."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", as_floats(self.center, (3,), "box center"))
        object.__setattr__(self, "size", as_floats(self.size, (3,), "box size"))
        if (self.size < 0).any() or not np.isfinite(self.yaw):
            raise DataError(
                "box is none", expected="lengths of at least 0 m and a finite yaw", got=(self.size, self.yaw)
            )

    @classmethod
    def around(cls, keys: Int[np.ndarray, "n 3"], voxel_size: float) -> "Box":
        """Return the upright box of least volume around whole voxels, given by their keys."""
        if not len(keys):
            raise DataError("a box needs voxels", expected="at least 1", got=0)
        steps = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
        corners = np.unique((np.unique(keys[:, :2], axis=0).astype(np.int64)[:, None] + steps).reshape(-1, 2), axis=0)
        middle, length, width, yaw = least_rectangle(corners.astype(np.float64))
        bottom, top = int(keys[:, 2].min()), int(keys[:, 2].max()) + 1
        center = np.array([middle[0], middle[1], (bottom + top) / 2])
        return cls(center * voxel_size, np.array([length, width, top - bottom]) * voxel_size, yaw)

    @property
    def volume(self) -> float:
        """Cubic metres."""
        return float(self.size.prod())

    @property
    def axes(self) -> Float64[np.ndarray, "3 3"]:
        """Directions of length, width and height in the world, one a column."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    @property
    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """Corners in the world; the lower four first, each four counter-clockwise seen from above."""
        signs = np.array([[x, y, z] for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]) / 2
        return self.center + (signs * self.size) @ self.axes.T

    def contains(self, points: Float[np.ndarray, "n 3"], tolerance: float = 1e-6) -> Bool[np.ndarray, " n"]:
        """Tell which points lie in the box, or at most `tolerance` metres outside each face."""
        return np.all(np.abs((points - self.center) @ self.axes) <= self.size / 2 + tolerance, axis=1)


def least_rectangle(points: Float64[np.ndarray, "n 2"]) -> tuple[Float64[np.ndarray, " 2"], float, float, float]:
    """Return centre, length, width and angle of the rectangle of least area around points that span an area.

    One of its sides lies on an edge of the convex hull (Freeman and Shapira 1975), so each edge's angle is tried.
    """
    from scipy.spatial import ConvexHull

    hull = points[ConvexHull(points).vertices]
    edges = np.roll(hull, -1, axis=0) - hull
    angles = np.arctan2(edges[:, 1], edges[:, 0]) % (np.pi / 2)
    angles = np.sort(np.append(np.where(angles > np.pi / 4, angles - np.pi / 2, angles), 0.0))
    along = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    on = np.stack([hull @ along.T, hull @ across.T])  # 2 directions x hull points x angles
    low, high = on.min(axis=1), on.max(axis=1)
    area = (high - low).prod(axis=0)
    good = np.flatnonzero(area <= area.min() * (1 + _TIE))
    best = good[np.argmin(np.abs(angles[good]))]
    middle = (low[0, best] + high[0, best]) / 2 * along[best] + (low[1, best] + high[1, best]) / 2 * across[best]
    length, width = (float(side) for side in high[:, best] - low[:, best])
    yaw = float(angles[best])
    if width > length * (1 + _TIE):
        length, width, yaw = width, length, yaw + np.pi / 2 if yaw <= 0 else yaw - np.pi / 2
    return middle, length, width, yaw


def principal_yaw(points: Float64[np.ndarray, "n 2"]) -> float:
    """Return the angle, in (-pi/2, pi/2], of the direction along which points spread most; 0 for a round spread."""
    if len(points) < 2:
        return 0.0
    (xx, xy), (_, yy) = np.cov(points.T)
    if np.hypot(xx - yy, 2 * xy) <= _TIE * (xx + yy):
        return 0.0
    yaw = 0.5 * float(np.arctan2(2 * xy, xx - yy))
    return yaw + np.pi if yaw <= -np.pi / 2 else yaw
