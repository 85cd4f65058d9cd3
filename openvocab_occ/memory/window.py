"""Geometry between a posed local grid and the lattice of tiles."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32

from openvocab_occ.arrays import ArrayLike
from openvocab_occ.errors import GridError, PoseError
from openvocab_occ.geometry import GridSpec, as_pose, invert
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.schema import ORIGIN, SHAPE, TILE, MapSchema

_SNAP = 0.01  # cells; more than what rounding does to a plane between two floors
_MOST_TILES = 100_000  # 32 GB of them; more is a wrong spec


@dataclass(frozen=True, eq=False)
class Prior:
    """What the map knows of a local grid."""

    logits: Float32[np.ndarray, "x y z classes"]
    """Class-centred log-probabilities, 0 where not known."""
    known: Bool[np.ndarray, "x y z"]


class Window:
    """A grid at a pose, as seen from the lattice."""

    def __init__(self, T_world_ego: ArrayLike, spec: GridSpec, schema: MapSchema) -> None:
        self.T_world_ego = as_pose(T_world_ego, "T_world_ego")
        self.spec = spec
        self.schema = schema
        self._z0 = np.array([0.0, 0.0, schema.z0])
        rotation = self.T_world_ego[:3, :3]
        corner = self.T_world_ego[:3, 3] + rotation @ np.asarray(spec.origin) - self._z0
        self._span = np.array([TILE, TILE, schema.heights])
        self._matrix = rotation * (spec.size / schema.cell)  # lattice steps of one voxel
        shift = corner / schema.cell
        ends = np.stack(np.meshgrid(*([0.0, n] for n in spec.shape), indexing="ij"), axis=-1).reshape(-1, 3)
        lattice = ends @ self._matrix.T + shift
        reach = np.array([1.0, 1.0, _SNAP])  # bilinear looks one cell further in x and y
        # a map voxel is reached from the middle of it, or by the middle of a voxel of the grid: not by a touch
        half = np.minimum(np.abs(self._matrix).sum(axis=1), 1.0) / 2
        low = np.floor((lattice.min(axis=0) + half - reach) / self._span).astype(np.int64)
        high = np.floor((lattice.max(axis=0) - half + reach) / self._span).astype(np.int64)
        limits = np.array([ORIGIN[1], ORIGIN[2], ORIGIN[0]])
        if (np.abs(np.stack([low, high])) >= limits - 1).any():
            raise PoseError(
                "the pose lies outside what a map can hold",
                expected=f"within {SHAPE[1] / 2 * TILE * schema.cell / 1000:.0f} km of the origin",
                got=f"{self.T_world_ego[:3, 3].tolist()} m",
            )  # fmt: skip
        if np.prod(high - low + 1) > _MOST_TILES:
            raise GridError("the grid covers too many tiles", expected=f"at most {_MOST_TILES}", got=spec.shape)
        self.low = TileKey(int(low[2]), int(low[0]), int(low[1]))
        self.counts = tuple(int(n) for n in (high - low + 1)[[2, 0, 1]])
        """Tiles along floor, x, y."""
        self._shift = shift - low * self._span

    @property
    def to_lattice(self) -> np.ndarray:
        """[3, 4]: grid voxels to map voxels counted from the first tile."""
        return np.column_stack([self._matrix, self._shift])

    def to_grid(self, key: TileKey) -> np.ndarray:
        """[3, 4]: voxels of a tile to grid voxels."""
        back = invert(self.T_world_ego)
        corner = np.array([key.x, key.y, key.floor]) * self._span * self.schema.cell + self._z0
        local = back[:3, :3] @ (corner - self.T_world_ego[:3, 3]) - np.asarray(self.spec.origin)
        return np.column_stack([back[:3, :3] * self.schema.cell, local]) / self.spec.size[:, None]

    def tiles(self) -> list[TileKey]:
        """Return every tile that the grid touches, or bilinear reading near it."""
        corner = np.array(list(np.ndindex(*self.counts)))[:, [1, 2, 0]] * self._span
        back = np.linalg.inv(self._matrix)  # lattice to grid
        ends = np.stack(np.meshgrid(*([-1.0, n + 1] for n in self._span), indexing="ij"), axis=-1).reshape(-1, 3)
        local = (corner[:, None] + ends - self._shift) @ back.T
        touched = ((local.max(axis=1) >= 0) & (local.min(axis=1) <= self.spec.shape)).all(axis=1)
        at = corner[touched] // self._span
        return [TileKey(self.low.floor + int(f), self.low.x + int(x), self.low.y + int(y)) for x, y, f in at]

    def table(self, slots: Mapping[TileKey, int]) -> Int32[np.ndarray, "floors nx ny"]:
        """Return the slots of tiles by floor, x and y from the first; -1 where there is none."""
        out = np.full(self.counts, -1, dtype=np.int32)
        for key, slot in slots.items():
            out[key.floor - self.low.floor, key.x - self.low.x, key.y - self.low.y] = slot
        return out
