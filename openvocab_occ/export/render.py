"""The map as a camera sees it: for each pixel the voxel met, its depth and its object."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64

from openvocab_occ.arrays import ArrayLike
from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import MapError
from openvocab_occ.export.surface import Surface, surface_of
from openvocab_occ.export.surface import owners as owners
from openvocab_occ.geometry import Camera, GridSpec, invert, look_at, transform
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.occupancy.grid import GEOMETRY_CLASSES, OccupancyGrid
from openvocab_occ.occupancy.rays import trace

_OCCUPIED, _FREE = 0, 1  # of GEOMETRY_CLASSES
_RISE = 0.7  # metres up for each metre back, of an overview
_WHOLE = 1 << 25  # voxels of a dense grid that is kept; more are cut down to what a camera can see
_MARGIN = 32  # voxels by which a kept grid reaches farther than asked, so that the next view needs no other


@dataclass(frozen=True, eq=False)
class MapView:
    """What each pixel shows."""

    camera: Camera
    depth: Float32[np.ndarray, "h w"]
    """z-depth to the entry into the voxel, metres; `max_depth` where nothing is met."""
    voxel: Int32[np.ndarray, "h w"]
    """Row of the voxel met in `surface`, which is its position in the map where it is one of the map's; -1: none."""
    item: Int32[np.ndarray, "h w"]
    """Id of its object, 0 where none."""
    surface: Surface


@dataclass(frozen=True, eq=False)
class Panorama:
    """All around a place, level: a column is a direction, the left end and the right end are behind."""

    position: Float[np.ndarray, " 3"]
    heading: float
    """Radians from the world's x axis, of the middle column."""
    elevation: tuple[float, float]
    """Radians of the lowest and the highest row against the level."""
    distance: Float32[np.ndarray, "h w"]
    """Metres along the ray; `max_range` where nothing is met."""
    voxel: Int32[np.ndarray, "h w"]
    """As in MapView."""
    item: Int32[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class _Window:
    """A part of the map as a dense grid."""

    low: Int64[np.ndarray, " 3"]
    grid: OccupancyGrid
    row: Int32[np.ndarray, " n"]
    """Row of the surface for each voxel of the grid; -1 where it is free, and once more at the end."""


class Renderer:
    """Draws one map from many places; keeps the part of it around the last place as a dense grid with its faces."""

    def __init__(self, scene: SceneMap, *, filled: bool = False, device: str | None = None) -> None:
        """Take a map.

        Args:
            scene: The map.
            filled: Close holes of one voxel in surfaces, for pictures that people look at.
            device: Of `render_depth`, for `view`: `cuda` walks the rays on a GPU.
        """
        self.surface = surface_of(scene)
        self.filled, self.device = filled, device
        self._window: _Window | None = None
        keys = self.surface.keys
        self._bounds = (keys.min(axis=0).astype(np.int64), keys.max(axis=0).astype(np.int64) + 1) if len(keys) else None

    def view(self, camera: Camera, max_depth: float = 100.0) -> MapView:
        """Cast a ray through each pixel and find the first voxel within `max_depth`."""
        size = (camera.height, camera.width)
        window = self._around(*_reach(camera, max_depth))
        if window is None:
            depth = np.full(size, max_depth, np.float32)
            return MapView(camera, depth, np.full(size, -1, np.int32), np.zeros(size, np.int32), self.surface)
        image = render_depth(window.grid, camera, max_depth=max_depth, device=self.device)
        voxel = window.row[image.voxel]  # -1 reads the last entry
        return MapView(camera, image.depth, voxel, self._items(voxel), self.surface)

    def panorama(
        self,
        position: ArrayLike,
        heading: float = 0.0,
        *,
        width: int = 2048,
        elevation: tuple[float, float] = (-0.6, 0.4),
        max_range: float = 100.0,
    ) -> Panorama:
        """Look all around; pixels are square in angle, which gives the height."""
        place = np.asarray(position, dtype=np.float64)
        step = 2 * np.pi / width
        height = max(round((elevation[1] - elevation[0]) / step), 1)
        azimuth = heading + np.pi - (np.arange(width) + 0.5) * step  # from behind over left, ahead and right
        rise = elevation[1] - (np.arange(height) + 0.5) * (elevation[1] - elevation[0]) / height
        level = np.cos(rise)[:, None]
        rays = np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(rise)[:, None] + 0 * azimuth], axis=-1
        ).reshape(-1, 3)
        window = self._around(place - max_range, place + max_range)
        if window is None:
            t, voxel = np.full(len(rays), max_range, np.float32), np.full(len(rays), -1, np.int32)
        else:
            t, voxel = trace(window.grid, place[None], rays, max_range)
            voxel = window.row[voxel]
        voxel = voxel.reshape(height, width)
        low_high = (float(elevation[0]), float(elevation[1]))
        return Panorama(place, heading, low_high, t.reshape(height, width), voxel, self._items(voxel))

    def _items(self, voxel: Int32[np.ndarray, "h w"]) -> Int32[np.ndarray, "h w"]:
        return np.append(self.surface.item, np.int32(0))[voxel]  # -1 reads the appended 0

    def _around(self, low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]) -> _Window | None:
        """Return a dense grid that holds all voxels of a box in the world; None where there are none."""
        if self._bounds is None:
            return None
        first, last = self._bounds
        if np.prod((last - first).astype(np.float64)) > _WHOLE:
            size = self.surface.voxel_size
            a = np.maximum(np.floor(np.clip(low / size, -1e8, 1e8)).astype(np.int64) - 1, first)
            b = np.minimum(np.ceil(np.clip(high / size, -1e8, 1e8)).astype(np.int64) + 1, last)
            if (a >= b).any():
                return None
            kept = self._window
            if kept is not None and (kept.low <= a).all() and (b <= kept.low + kept.grid.spec.shape).all():
                return kept
            wide = np.maximum(a - _MARGIN, first), np.minimum(b + _MARGIN, last)
            first, last = wide if np.prod((wide[1] - wide[0]).astype(np.float64)) <= _WHOLE else (a, b)
            self._window = None
        if self._window is None:
            self._window = self._built(first, last)
        return self._window

    def _built(self, low: Int64[np.ndarray, " 3"], high: Int64[np.ndarray, " 3"]) -> _Window | None:
        keys = self.surface.keys
        rows = np.flatnonzero(((keys >= low) & (keys < high)).all(axis=1)).astype(np.int32)
        if not len(rows):
            return None
        shape = high - low
        size = self.surface.voxel_size
        spec = GridSpec(tuple((low * size).tolist()), size, tuple(shape.tolist()))
        flat = spec.flat(keys[rows].astype(np.int64) - low)
        row = np.full(spec.num_voxels + 1, -1, np.int32)
        row[flat] = rows
        if self.filled:
            holes, beside = _holes((row[:-1] >= 0).reshape(spec.shape))
            row[holes] = row[beside]
        labels = np.where(row[:-1] >= 0, np.uint8(_OCCUPIED), np.uint8(_FREE)).reshape(spec.shape)
        grid = OccupancyGrid(labels, spec, free_label=_FREE, class_names=GEOMETRY_CLASSES)
        return _Window(low, grid, row)


def render_map(scene: SceneMap, camera: Camera, max_depth: float = 100.0) -> MapView:
    """Cast a ray through each pixel and find the first voxel of the map within `max_depth`."""
    return renderer_of(scene).view(camera, max_depth)


def renderer_of(scene: SceneMap, *, filled: bool = False) -> Renderer:
    """Return a map's renderer, made at the first call."""
    kept = _KEPT[filled]
    if scene not in kept:
        kept[scene] = Renderer(scene, filled=filled)
    return kept[scene]


_KEPT: "dict[bool, WeakKeyDictionary[SceneMap, Renderer]]" = {False: WeakKeyDictionary(), True: WeakKeyDictionary()}


def overview(scene: SceneMap, aspect: float = 16 / 9, fov: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a position and a target, metres, from which all of the map but outliers is seen from behind and above."""
    centers = scene.voxels.centers
    if not len(centers):
        raise MapError("the map has no voxels to look at", fix="map at least one frame with an occupancy grid or depth")
    low, high = np.percentile(centers, (0.5, 99.5), axis=0)
    target = (low + high) / 2
    back = np.array([0.0, 0.0, _RISE]) - heading(scene)
    back /= np.linalg.norm(back)
    corners = np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i, j, k in np.ndindex(2, 2, 2)])
    local = transform(invert(look_at(target + back, target)), corners) - [0.0, 0.0, 1.0]  # z from the target on
    # a camera d behind the target has a corner in view when |x| <= tan (z + d), and likewise for y
    tan = np.tan(fov / 2) * np.array([aspect, 1.0])
    distance = float((np.abs(local[:, :2]) / tan - local[:, 2:]).max())
    return target + back * max(1.05 * distance, 4 * scene.voxels.voxel_size), target


def overview_camera(scene: SceneMap, width: int, height: int, fov: float = 1.0) -> Camera:
    """Return the camera of `overview`; `fov` is its vertical field of view, radians."""
    position, target = overview(scene, width / height, fov)
    return pinhole(width, height, fov, look_at(position, target))


def pinhole(width: int, height: int, fov: float, T_world_cam: ArrayLike) -> Camera:
    """Return a camera with square pixels and its principal point in the middle; `fov` is vertical, radians."""
    focal = height / 2 / np.tan(fov / 2)
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera(K, width, height, np.asarray(T_world_cam))


def heading(scene: SceneMap) -> Float[np.ndarray, " 3"]:
    """Return the level direction in which the ego looked on the whole; x where there is no frame."""
    total = np.zeros(3)
    for frame in scene.frames:
        total += frame.T_world_ego[:3, 0]
    total[2] = 0.0
    length = float(np.linalg.norm(total))
    return total / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])


def _holes(occupied: Bool[np.ndarray, "x y z"]) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]:
    """Return the holes of one voxel in surfaces, and for each an occupied voxel beside it, as flat indices.

    A hole is free and has its four neighbours in one of the lattice's planes occupied.
    """
    wide = np.pad(occupied, 1)
    beside = [
        wide[1 + x : wide.shape[0] - 1 + x, 1 + y : wide.shape[1] - 1 + y, 1 + z : wide.shape[2] - 1 + z]
        for axis in np.eye(3, dtype=int)
        for x, y, z in (axis, -axis)
    ]
    pairs = [beside[0] & beside[1], beside[2] & beside[3], beside[4] & beside[5]]
    holes = ((pairs[0] & pairs[1]) | (pairs[0] & pairs[2]) | (pairs[1] & pairs[2])) & ~occupied
    index = np.argwhere(holes)
    strides = np.array([occupied.shape[1] * occupied.shape[2], occupied.shape[2], 1])
    flat = index @ strides
    along_x = pairs[0][holes]
    return flat, flat + np.where(along_x, strides[0], strides[1])


def _reach(camera: Camera, max_depth: float) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Return the corners of a box around all that the rays of a camera can meet."""
    u = np.linspace(0, camera.width - 1, 9)
    v = np.linspace(0, camera.height - 1, 9)
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 3)
    if camera.lens != "pinhole":
        rays = camera.rays().reshape(-1, 3)
    rays = rays[np.isfinite(rays[:, 0])]
    ends = np.concatenate([rays * max_depth, np.zeros((1, 3))])
    points = transform(camera.T_world_cam, ends)
    return points.min(axis=0), points.max(axis=0)
