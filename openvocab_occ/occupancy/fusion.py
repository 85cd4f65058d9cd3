"""Many sweeps and depth images in one grid: log-odds of being occupied, free space carved, unknown kept apart.

Within one scan a voxel counts once, and a return beats whatever passes through the voxel (OctoMap, Hornung et al.
2013), so that grazing rays do not eat the ground they end on. The walk is that of `grid_from_lidar`; the sums that
follow it are a handful of numpy operations, which is why there is no kernel of their own.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from openvocab_occ._jit import in_slices
from openvocab_occ.arrays import ArrayLike, as_floats, check_shape
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera, GridSpec, as_pose, invert, transform
from openvocab_occ.occupancy._rays_kernels import mark_crossed
from openvocab_occ.occupancy.grid import GEOMETRY_CLASSES, OccupancyGrid

_OCCUPIED, _FREE = range(len(GEOMETRY_CLASSES))
_GRAIN = 512  # rays worth a thread


@dataclass(frozen=True, kw_only=True)
class LogOdds:
    """What one scan says of a voxel. A return is believed twice as much as a passing ray, as in OctoMap."""

    hit: float = 0.85
    """Added where a ray ends: ln(0.7 / 0.3)."""
    miss: float = -0.4
    """Added where rays only pass: ln(0.4 / 0.6)."""
    lower: float = -2.0
    """Nothing falls below this, so that what moves in later is soon seen: ln(0.12 / 0.88)."""
    upper: float = 3.5
    """Nothing rises above this: ln(0.97 / 0.03)."""
    occupied: float = 0.0
    """Known voxels above this are occupied."""

    def __post_init__(self) -> None:
        if not (self.miss < 0 < self.hit and self.lower < self.occupied < self.upper):
            raise ConfigError(
                "log-odds make no sense", expected="miss < 0 < hit and lower < occupied < upper", got=self
            )


class OccupancyFuser:
    """Collects scans in a grid that stands still."""

    def __init__(self, spec: GridSpec, T_world_grid: ArrayLike | None = None, *, odds: LogOdds | None = None) -> None:
        """Begin with nothing known."""
        self.spec = spec
        self.T_world_grid = np.eye(4) if T_world_grid is None else as_pose(T_world_grid, "T_world_grid")
        self._odds = odds or LogOdds()
        self.log_odds = np.zeros(spec.shape, dtype=np.float32)
        """Of being occupied, natural logarithm; 0 also where nothing was seen."""
        self.seen = np.zeros(spec.shape, dtype=np.bool_)
        """Voxels that a ray was in."""

    def add_points(
        self,
        points: Float[np.ndarray, "n 3"],
        origin: Float[np.ndarray, " 3"],
        *,
        min_range: float = 0.0,
        max_range: float = math.inf,
    ) -> None:
        """Add a scan.

        Args:
            points: Returns in the world, metres. Those outside the grid still clear the way to them.
            origin: The sensor in the world.
            min_range: Returns nearer to the sensor are dropped, metres: they lie on the own vehicle.
            max_range: Returns further away are dropped too.
        """
        returns = as_floats(points, (None, 3), "points of a scan")
        sensor = as_floats(origin, (3,), "origin of a scan")
        if min_range > 0.0 or max_range < math.inf:
            distance = np.linalg.norm(returns - sensor, axis=1)
            returns = returns[(distance >= min_range) & (distance <= max_range)]
        T_grid_world = invert(self.T_world_grid)
        lower, size = np.asarray(self.spec.origin), self.spec.size
        ends = (transform(T_grid_world, returns) - lower) / size
        start = (transform(T_grid_world, sensor[None])[0] - lower) / size
        crossed = np.zeros(self.spec.shape, dtype=np.uint8)
        in_slices(lambda a, b: mark_crossed(start, ends, a, b, crossed), len(ends), grain=_GRAIN)
        cells = self.spec.flat(np.floor(ends).astype(np.int64))
        cells = np.unique(cells[cells >= 0])
        crossed.reshape(-1)[cells] = 0
        passed = np.flatnonzero(crossed)
        flat, seen, odds = self.log_odds.reshape(-1), self.seen.reshape(-1), self._odds
        for where, change in ((passed, odds.miss), (cells, odds.hit)):
            flat[where] = np.clip(flat[where] + np.float32(change), odds.lower, odds.upper)
            seen[where] = True

    def add_depth(
        self, depth: Float[np.ndarray, "h w"], camera: Camera, *, stride: int = 1, max_depth: float = math.inf
    ) -> None:
        """Add a depth image: z-depth in metres, 0 or not finite where there is none.

        Args:
            depth: The image.
            camera: Its camera.
            stride: Use every so manieth row and column.
            max_depth: Pixels beyond it are dropped, metres: stereo and structured light err there.
        """
        check_shape(depth, (camera.height, camera.width), "depth image")
        points = points_of_depth(depth, camera, stride=stride, max_depth=max_depth)
        self.add_points(points, camera.position)

    def grid(self) -> OccupancyGrid:
        """Return what is known so far, of the classes `occupied` and `free`."""
        occupied = self.seen & (self.log_odds > self._odds.occupied)
        labels = np.where(occupied, _OCCUPIED, _FREE).astype(np.uint8)
        return OccupancyGrid(
            labels, self.spec, self.T_world_grid, _FREE, known=self.seen.copy(), class_names=GEOMETRY_CLASSES
        )


def points_of_depth(
    depth: Float[np.ndarray, "h w"], camera: Camera, *, stride: int = 1, max_depth: float = math.inf
) -> Float[np.ndarray, "n 3"]:
    """Return the world points of the pixels that have a depth within `max_depth`, metres, row by row."""
    picked = depth[::stride, ::stride].astype(np.float64)
    v, u = np.mgrid[: camera.height : stride, : camera.width : stride].astype(np.float64)
    good = np.isfinite(picked) & (picked > 0) & (picked <= max_depth)
    rays = camera.unproject(np.stack([u[good], v[good]], axis=-1))
    points = rays * picked[good][:, None]
    return transform(camera.T_world_cam, points[np.isfinite(points).all(axis=1)])
