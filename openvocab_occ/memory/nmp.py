"""The layout `nmp4x4`: the dense tiles of Neural Map Prior, for comparison with what was published.

As its code does it, with its flaws: a city is 4 x 4 rectangles of float32 in memory; the place of the ego decides which
rectangle is read or written, and cells beyond its edge are dropped; z is ignored; a write goes forward, cell to nearest
cell, so that turned windows leave holes, and covers all of the footprint, seen or not; 0 means never written, and
nothing else is known of a cell. `TileMap` does none of this.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32

from openvocab_occ.arrays import ArrayLike, check_shape
from openvocab_occ.errors import ConfigError, PoseError
from openvocab_occ.geometry import GridSpec, as_pose

_TILES = 4
NMP_CITIES = {
    "singapore-onenorth": ((118.0, 408.0), (1232.0, 1777.0)),
    "boston-seaport": ((298.0, 328.0), (2527.0, 1896.0)),
    "singapore-queenstown": ((347.0, 862.0), (2686.0, 3333.0)),
    "singapore-hollandvillage": ((442.0, 902.0), (2490.0, 2839.0)),
}
"""Corners of the cities of nuScenes, metres in their own frames: those of its training and validation scenes."""
NMP_PADDING = 33.54
"""Metres around a city: half the diagonal of NMP's 60 x 30 m footprint. 80 x 80 m would need 56.57."""


@dataclass(eq=False)
class NmpMap:
    """One city; `low` and `high` are its corners, metres. Rectangles take memory once they are written."""

    low: tuple[float, float]
    high: tuple[float, float]
    channels: int = 288
    """Of a cell: heights times classes, heights first."""
    cell: float = 0.4
    padding: float = NMP_PADDING
    tiles: dict[tuple[int, int], np.ndarray] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self._low = np.asarray(self.low) - self.padding
        self._interval = (np.asarray(self.high) + self.padding - self._low) / _TILES
        if not (self._interval > self.cell).all() or self.channels < 1:
            raise ConfigError("city is not usable", expected="high above low, a channel or more", got=self)
        self.shape = tuple(int(n) for n in np.ceil(self._interval / self.cell))
        """Cells of a rectangle along x and y."""

    @staticmethod
    def of_city(name: str, *, channels: int = 288, cell: float = 0.4) -> "NmpMap":
        """Return an empty map of a city of nuScenes."""
        if name not in NMP_CITIES:
            raise ConfigError("city is not known", expected=" or ".join(NMP_CITIES), got=name)
        return NmpMap(*NMP_CITIES[name], channels=channels, cell=cell)

    @property
    def tile_bytes(self) -> int:
        """Bytes of a rectangle."""
        return self.shape[0] * self.shape[1] * self.channels * 4

    def read(self, T_world_ego: ArrayLike, spec: GridSpec) -> Float32[np.ndarray, "x y channels"]:
        """Return the cell that holds each column's centre at z = 0 of the ego; 0 where none is."""
        key, x, y, inside = self._cells(T_world_ego, spec)
        out = np.zeros((*spec.shape[:2], self.channels), dtype=np.float32)
        if key in self.tiles:
            out[inside] = self.tiles[key][x[inside], y[inside]]
        return out

    def write(self, values: Float[np.ndarray, "x y channels"], T_world_ego: ArrayLike, spec: GridSpec) -> None:
        """Replace the cells that hold the columns' centres; of several in a cell the last in C order stays."""
        check_shape(values, (*spec.shape[:2], self.channels), "values")
        key, x, y, inside = self._cells(T_world_ego, spec)
        if key not in self.tiles:
            self.tiles[key] = np.zeros((*self.shape, self.channels), dtype=np.float32)
        self.tiles[key][x[inside], y[inside]] = values[inside]

    def _cells(
        self, T_world_ego: ArrayLike, spec: GridSpec
    ) -> tuple[tuple[int, int], np.ndarray, np.ndarray, np.ndarray]:
        """Return the ego's rectangle, the cell of each column in it, and which lie inside."""
        T = as_pose(T_world_ego, "T_world_ego")
        i, j = (int(n) for n in np.floor((T[:2, 3] - self._low) / self._interval))
        if not (0 <= i < _TILES and 0 <= j < _TILES):
            raise PoseError("the ego is outside the city", expected=(self.low, self.high), got=T[:2, 3].tolist())
        index = np.stack(np.meshgrid(*(np.arange(n) for n in spec.shape[:2]), [0], indexing="ij"), axis=-1)
        centers = np.asarray(spec.centers(index))[:, :, 0]
        centers[..., 2] = 0.0
        world = centers @ T[:2, :3].T + T[:2, 3]
        at = np.floor((world - self._low - np.array([i, j]) * self._interval) / self.cell).astype(np.int64)
        inside = np.asarray(((at >= 0) & (at < self.shape)).all(axis=-1))
        return (i, j), at[..., 0], at[..., 1], inside
