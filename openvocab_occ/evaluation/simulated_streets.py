"""Occupancy along a route that was really driven, in streets that are made up around it.

Synthetic: road, sidewalk, buildings with gaps, trees and parked cars stand at fixed distances from the route. Logits
are the true label with correlated and white noise, seen is what no building hides. It measures a map, not a perception.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from openvocab_occ.geometry import GridSpec, transform
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE

_CAR, _ROAD, _SIDEWALK, _TERRAIN, _MANMADE, _VEGETATION = (
    OCC3D_CLASSES.index(n) for n in ("car", "driveable surface", "sidewalk", "terrain", "manmade", "vegetation")
)
_CAM_TO_EGO = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_BLOCK = 12.0  # m, of what stands beside the road
_RAYS = 1440
_MARGIN = 5.0  # logit of the true label above the others


def kitti_route(path: PathLike, *, spacing: float = 5.0) -> Float64[np.ndarray, "n 4 4"]:
    """Read a KITTI odometry file as T_world_ego, a pose every `spacing` metres; world z up, x forward at the start."""
    rows = np.loadtxt(existing(path, "trajectory")).reshape(-1, 3, 4)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows
    T = _CAM_TO_EGO @ T @ np.linalg.inv(_CAM_TO_EGO)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])
    return T[np.searchsorted(way, np.arange(0.0, way[-1], spacing))]


@dataclass(frozen=True, eq=False)
class SimulatedStreets:
    """A city along a route."""

    route: Float64[np.ndarray, "n 4 4"]
    """T_world_ego, densely; the ground lies `height` below."""
    height: float = 0.0
    noise: float = 0.3
    """Standard deviation of white noise in the logits; correlated noise is three times as strong."""
    seed: int = 0
    _tree: KDTree = field(init=False, repr=False)
    _banks: dict[tuple[int, ...], np.ndarray] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", KDTree(self.route[:, :2, 3]))

    def labels(self, points: Float64[np.ndarray, "x y z 3"]) -> Int64[np.ndarray, "x y z"]:
        """Return the true class at world points whose x and y do not depend on the last index."""
        columns = points[:, :, 0, :2]
        away, nearest = self._tree.query(columns)
        up = points[..., 2] - (self.route[nearest, 2, 3] - self.height)[..., None]
        block = np.floor(columns / _BLOCK).astype(np.int64)
        dice = ((block[..., 0] * 73856093) ^ (block[..., 1] * 19349663) ^ self.seed) % 97 / 97
        inner = np.abs(columns / _BLOCK - block - 0.5) * 2  # 0 in the middle of a block, 1 at its edge
        house = (away > 9) & (dice < 0.6)
        tree = (away > 7) & (dice >= 0.6) & (dice < 0.85) & (inner.max(axis=-1) < 0.35)
        car = (away > 4.2) & (away < 6.2) & (dice > 0.5) & (inner.max(axis=-1) < 0.4)
        ground = np.select([away < 6.5, away < 9], [_ROAD, _SIDEWALK], _TERRAIN)
        tall = np.select([house, tree, car], [3 + 6 * dice, 4.5, 1.6], 0.0)
        thing = np.select([house, tree, car], [_MANMADE, _VEGETATION, _CAR], OCC3D_FREE)
        out = np.where(up < 0, ground[..., None], OCC3D_FREE)
        return np.where((up >= 0) & (up < tall[..., None]), thing[..., None], out)

    def observe(
        self, T_world_ego: Float[np.ndarray, "4 4"], spec: GridSpec, number: int = 0
    ) -> tuple[Float32[np.ndarray, "x y z c"], Bool[np.ndarray, "x y z"], Int64[np.ndarray, "x y z"]]:
        """Return logits, what is seen, and true labels of a grid; `number` picks the noise."""
        index = np.stack(np.meshgrid(*(np.arange(n) for n in spec.shape), indexing="ij"), axis=-1)
        local = np.asarray(spec.centers(index))
        labels = self.labels(transform(T_world_ego, local))
        bank = self._noise(spec.shape)
        rng = np.random.default_rng((self.seed, number))
        logits = np.roll(bank, tuple(rng.integers(0, spec.shape)), axis=(0, 1, 2)).copy()
        np.put_along_axis(logits, labels[..., None], np.take_along_axis(logits, labels[..., None], -1) + _MARGIN, -1)
        return logits, self._seen(local, labels), labels

    def _seen(self, local: np.ndarray, labels: Int64[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
        """Tell what is not behind a wall; of solid things the outer 0.6 m are seen."""
        solid = (labels != OCC3D_FREE).sum(axis=-1) > 6  # columns that nothing is seen beyond
        where = local[:, :, 0, :2]
        reach = np.hypot(where[..., 0], where[..., 1])
        ray = np.floor((np.arctan2(where[..., 1], where[..., 0]) / (2 * np.pi) % 1.0) * _RAYS).astype(int) % _RAYS
        wall = np.full(_RAYS, np.inf)
        for shift in (-1, 0, 1):  # a column near the eye covers several rays
            np.minimum.at(wall, (ray[solid] + shift) % _RAYS, reach[solid])
        open_ = reach <= wall[ray] + 0.6
        above = np.zeros(labels.shape, dtype=np.bool_)
        above[..., :-1] = labels[..., 1:] != OCC3D_FREE
        buried = above & (labels != OCC3D_FREE) & ~solid[..., None]
        return open_[..., None] & ~buried

    def _noise(self, shape: tuple[int, int, int]) -> Float32[np.ndarray, "x y z c"]:
        if shape not in self._banks:
            rng = np.random.default_rng(self.seed)
            white = rng.standard_normal((*shape, len(OCC3D_CLASSES)), dtype=np.float32)
            smooth = gaussian_filter(white, (1.5, 1.5, 1.0, 0.0), mode="wrap")
            smooth *= 3 * self.noise / float(smooth.std())
            fresh = rng.standard_normal(white.shape, dtype=np.float32)
            self._banks[shape] = (smooth + self.noise * fresh).astype(np.float32)
        return self._banks[shape]
