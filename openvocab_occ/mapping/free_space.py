"""Where cameras have looked through: how often each cell of the world was seen to be empty."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int32, UInt8

from openvocab_occ._jit import in_slices
from openvocab_occ.arrays import check_shape
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.geometry import Camera, invert, transform
from openvocab_occ.mapping._free_kernels import keep_free, see_through
from openvocab_occ.mapping.key_table import KeyTable
from openvocab_occ.mapping.keys import keys_of, pack, packable, unpack
from openvocab_occ.occupancy import OccupancyGrid

EDGE = 8
"""Cells along each edge of a block; a block is what is stored."""
_SMALLEST_CELL = 0.2  # metres; emptiness needs no finer record, and a finer one costs with the third power
_MOST = 255  # where a counter stops


class FreeSpace:
    """A counter for each cell of the world: the frames that saw through it. It grows by `integrate` and `merge`.

    A cell is the smallest 2^k voxels of the map that measures at least 0.2 m.
    """

    def __init__(self, voxel_size: float) -> None:
        self.factor = 1
        """Voxels of the map along an edge of a cell."""
        while voxel_size * self.factor < _SMALLEST_CELL - 1e-9:
            self.factor *= 2
        self.voxel_size = voxel_size
        self.cell = voxel_size * self.factor
        """Metres."""
        self._table = KeyTable()
        self._counts = np.zeros((0, EDGE**3), dtype=np.uint8)

    def __len__(self) -> int:
        return len(self._table)

    @property
    def blocks(self) -> tuple[Int32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 512"]]:
        """Keys of blocks, sorted, and the counters of their cells in C order."""
        order = np.argsort(self._table.keys)
        return unpack(self._table.keys[order]), self._counts[order]

    def integrate(
        self,
        looks: Sequence[tuple[Camera, Float[np.ndarray, "h w"]]],
        *,
        grid: OccupancyGrid | None = None,
        max_depth: float,
    ) -> None:
        """Count the cells that at least one camera of a frame looks through.

        A camera looks through a cell when the depth at the centre's pixel is greater by half the cell's diagonal. Where
        the depth is a grid's, the centre must also lie in a voxel that is known and free; where it was measured, pass
        no grid, and pixels without depth say nothing.
        """
        if not looks:
            return
        low, shape = self._window(looks, grid, max_depth)
        if not min(shape):
            return
        window = np.zeros(shape, dtype=np.uint8)
        origin, margin = low * self.cell, self.cell * 3**0.5 / 2
        for camera, depth in looks:
            self._look(camera, depth, origin, margin, window)
        if grid is not None:
            free = grid.labels == grid.free_label
            free = free if grid.known is None else free & grid.known
            T = invert(grid.T_world_grid)[:3]
            T[:, 3] -= grid.spec.origin
            T /= grid.spec.size[:, None]
            in_slices(lambda a, b: keep_free(origin, self.cell, T, free, a, b, window), len(window), grain=8)
        n = np.array(shape) // EDGE
        cells = window.reshape(n[0], EDGE, n[1], EDGE, n[2], EDGE).transpose(0, 2, 4, 1, 3, 5)
        filled = cells.any(axis=(3, 4, 5))
        keys = (np.argwhere(filled) + low // EDGE).astype(np.int32)
        self._add(keys, cells[filled].reshape(-1, EDGE**3))

    def count(self, keys: Int32[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
        """Return how many frames saw through the cell that holds each voxel of the map; 255 stands for more."""
        cells = keys // self.factor
        rows = self._table.find(pack((cells // EDGE).astype(np.int32)))
        inner = cells % EDGE
        flat = (inner[:, 0] * EDGE + inner[:, 1]) * EDGE + inner[:, 2]
        counts = np.zeros(len(keys), dtype=np.uint8)
        there = rows >= 0
        counts[there] = self._counts[rows[there], flat[there]]
        return counts

    def merge(self, other: "FreeSpace") -> None:
        """Add another record of the same voxel size."""
        if other.voxel_size != self.voxel_size:
            raise ConfigError("free space of another voxel size", expected=self.voxel_size, got=other.voxel_size)
        self._add(*other.blocks)

    def copy(self) -> "FreeSpace":
        """Return a record of its own."""
        twin = FreeSpace(self.voxel_size)
        twin.merge(self)
        return twin

    def moved(self, T_new_old: Float[np.ndarray, "4 4"]) -> "FreeSpace":
        """Return the record after a rigid motion of the world: each cell goes to the one its centre comes to lie in."""
        keys, counts = self.blocks
        block, inner = np.nonzero(counts)
        cells = keys[block] * EDGE + np.stack(np.unravel_index(inner, (EDGE, EDGE, EDGE)), axis=1)
        to = keys_of(transform(T_new_old, (cells + 0.5) * self.cell), self.cell)
        packed, where = np.unique(pack((to // EDGE).astype(np.int32)), return_inverse=True)
        at = to % EDGE
        there = np.zeros((len(packed), EDGE**3), dtype=np.uint8)
        np.maximum.at(there, (where, (at[:, 0] * EDGE + at[:, 1]) * EDGE + at[:, 2]), counts[block, inner])
        return FreeSpace.from_blocks(self.voxel_size, unpack(packed), there)

    @classmethod
    def from_blocks(
        cls, voxel_size: float, keys: Int32[np.ndarray, "n 3"], counts: UInt8[np.ndarray, "n 512"]
    ) -> "FreeSpace":
        """Build a record from what `blocks` gave."""
        space = cls(voxel_size)
        check_shape(counts, (len(keys), EDGE**3), "counters of free space")
        if not packable(keys).all():
            raise DataError("blocks of free space are out of reach", got=np.abs(keys).max())
        space._add(keys, counts)
        return space

    def _add(self, keys: Int32[np.ndarray, "n 3"], counts: UInt8[np.ndarray, "n 512"]) -> None:
        rows = self._table.insert(pack(keys))
        if len(self._table) > len(self._counts):
            room = np.zeros((2 * len(self._table), EDGE**3), dtype=np.uint8)
            room[: len(self._counts)] = self._counts
            self._counts = room
        old = self._counts[rows]
        self._counts[rows] = old + np.minimum(counts, _MOST - old)

    def _look(self, camera: Camera, depth: np.ndarray, origin: np.ndarray, margin: float, window: np.ndarray) -> None:
        if camera.lens == "pinhole":
            T, seen = invert(camera.T_world_cam), np.ascontiguousarray(depth, dtype=np.float32)
            in_slices(
                lambda a, b: see_through(origin, self.cell, T, camera.K, seen, margin, a, b, window),
                len(window),
                grain=8,
            )
            return
        for i in range(len(window)):  # a plane at a time bounds the memory of projecting
            index = np.stack(np.meshgrid([i], *map(np.arange, window.shape[1:]), indexing="ij"), axis=-1).reshape(-1, 3)
            pixels, z = camera.project(origin + (index + 0.5) * self.cell)
            inside = np.flatnonzero(camera.inside(pixels))
            u, v = np.floor(pixels[inside] + 0.5).astype(int).T
            through = np.isfinite(depth[v, u]) & (depth[v, u] > z[inside] + margin)
            window[i].reshape(-1)[inside[through]] = 1

    def _window(
        self, looks: Sequence[tuple[Camera, np.ndarray]], grid: OccupancyGrid | None, max_depth: float
    ) -> tuple[np.ndarray, tuple[int, int, int]]:
        """Return the lowest cell and the shape, in whole blocks, of a box around all that can be seen through."""
        if grid is not None:
            corners = np.stack(grid.spec.bounds)[np.array(list(np.ndindex(2, 2, 2))), [0, 1, 2]]
            points = corners @ grid.T_world_grid[:3, :3].T + grid.T_world_grid[:3, 3]
        else:
            points = np.concatenate([_reach(camera, depth, max_depth) for camera, depth in looks])
        blocks = np.floor(points / (self.cell * EDGE)).astype(np.int64)
        keys_of(points, self.voxel_size)  # raises where the map cannot reach
        low, high = blocks.min(axis=0), blocks.max(axis=0) + 1
        x, y, z = ((high - low) * EDGE).tolist()
        return low * EDGE, (x, y, z)


def _reach(camera: Camera, depth: np.ndarray, max_depth: float) -> Float[np.ndarray, "n 3"]:
    """Return points around all that a camera with measured depth sees."""
    good = depth[np.isfinite(depth) & (depth > 0)]
    far = min(float(good.max(initial=0.0)), max_depth)
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9))
    rays = camera.unproject(np.stack([u, v], axis=-1)).reshape(-1, 3)
    ends = rays[np.isfinite(rays).all(axis=1)] * far
    return np.concatenate([ends, np.zeros((1, 3))]) @ camera.T_world_cam[:3, :3].T + camera.position
