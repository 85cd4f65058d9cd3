"""Rows of the lift, and the voxels of the map that each of them is about."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64

from openvocab_occ._jit import in_slices
from openvocab_occ.arrays import check_shape
from openvocab_occ.depth.render import DepthImage
from openvocab_occ.errors import DataError
from openvocab_occ.geometry import Camera, invert, transform
from openvocab_occ.mapping._cover_kernels import held, packed_points
from openvocab_occ.mapping.key_table import KeyTable
from openvocab_occ.mapping.keys import keys_of, unpack
from openvocab_occ.mapping.lift import lens_rays
from openvocab_occ.occupancy import OccupancyGrid


@dataclass(frozen=True, eq=False)
class Cover:
    """Which voxels of the map the rows of a lift are about: pairs of a row and a key."""

    row: Int32[np.ndarray, " p"]
    keys: Int32[np.ndarray, "p 3"]
    share: Float32[np.ndarray, " p"]
    """Part of the row that goes to the key; the shares of a row add up to 1."""

    def only(self, wanted: np.ndarray) -> "Cover":
        """Return the pairs whose row is wanted, bool[m]."""
        chosen = wanted[self.row]
        return Cover(self.row[chosen], self.keys[chosen], self.share[chosen])


def rows_from_grid(
    depth_image: DepthImage, grid: OccupancyGrid
) -> tuple[Int32[np.ndarray, "h w"], Int64[np.ndarray, " m"]]:
    """Return the row of each pixel, and the flat index of each row's voxel: a row for each voxel that is seen."""
    row_of = np.zeros(grid.spec.num_voxels + 1, dtype=np.int32)
    row_of[depth_image.voxel.reshape(-1)] = 1  # index -1, of pixels that see nothing, is the last
    row_of[-1] = 0
    flat = np.flatnonzero(row_of)
    row_of[:] = -1
    row_of[flat] = np.arange(len(flat), dtype=np.int32)
    return row_of[depth_image.voxel], flat


def cover_grid(flat: Int64[np.ndarray, " m"], grid: OccupancyGrid, voxel_size: float) -> Cover:
    """Return the voxels of the map that belong to voxels of a grid, given by flat index, one row each.

    A voxel of the map belongs to the voxel of the grid that holds its centre. However the grid is turned, no voxel
    of the map inside the seen ones is left out, none belongs to two, and a sheet one voxel thick has no tunnels.
    A voxel of the grid that holds no centre (one in twelve of a turned grid of the map's own size; all of a finer one
    in a coarse map) gives to the voxel that holds its own centre, so that thin things do not fall through.
    """
    spec = grid.spec
    index = np.ascontiguousarray(spec.unflat(flat), dtype=np.int64)
    T_map_grid, T_grid_map = np.empty((3, 4)), np.empty((3, 4))  # in voxels of each
    T_map_grid[:, :3] = grid.T_world_grid[:3, :3] * spec.size / voxel_size
    T_map_grid[:, 3] = transform(grid.T_world_grid, np.asarray(spec.origin)) / voxel_size
    T_grid_world = invert(grid.T_world_grid)
    T_grid_map[:, :3] = T_grid_world[:3, :3] * voxel_size / spec.size[:, None]
    T_grid_map[:, 3] = (T_grid_world[:3, 3] - np.asarray(spec.origin)) / spec.size
    return _covered(index, T_grid_map, T_map_grid, int(np.prod(spec.size / voxel_size)))


def cover_moved(keys: Int32[np.ndarray, "m 3"], voxel_size: float, T_new_old: Float[np.ndarray, "4 4"]) -> Cover:
    """Return the voxels that those of a map belong to after a motion of the world, by the rule of `cover_grid`."""
    there, back = T_new_old[:3].copy(), invert(T_new_old)[:3]
    there[:, 3] /= voxel_size
    back[:, 3] /= voxel_size
    return _covered(keys.astype(np.int64), back, there, 1)


def _covered(
    index: Int64[np.ndarray, "m 3"],
    T_grid_map: Float[np.ndarray, "3 4"],
    T_map_grid: Float[np.ndarray, "3 4"],
    each: int,
) -> Cover:
    """Return the cover of voxels of a grid; both poses are in voxels. `each` voxel of it holds about so many keys."""
    room = len(index) * (1 + each) + 64
    while True:
        row, keys = np.empty(room, dtype=np.int32), np.empty((room, 3), dtype=np.int32)
        count = held(index, T_grid_map, T_map_grid, 0, len(index), row, keys)
        if count >= 0:
            break
        room *= 2
    own = np.bincount(row[:count], minlength=len(index))
    empty = np.flatnonzero(own == 0)
    middles = (index[empty] + 0.5) @ T_map_grid[:, :3].T + T_map_grid[:, 3]
    row = np.concatenate([row[:count], empty.astype(np.int32)])
    keys = np.concatenate([keys[:count], keys_of(middles, 1.0)])
    return Cover(row, keys, (1 / np.maximum(own, 1))[row].astype(np.float32))


def rows_from_depth(
    depth: Float[np.ndarray, "h w"], camera: Camera, voxel_size: float, *, max_depth: float = np.inf
) -> tuple[Int32[np.ndarray, "h w"], Int32[np.ndarray, "m 3"]]:
    """Return the row of each pixel and the key of each row, from measured z-depth in metres.

    Pixels at 0, not finite, or beyond `max_depth` have none; a negative depth raises DataError.
    """
    check_shape(depth, (camera.height, camera.width), "depth")
    if (depth < 0).any():
        raise DataError("measured depth is negative", expected="metres, 0 where there is none", got=depth.min())
    packed = np.zeros(depth.shape, dtype=np.int64)
    good = np.zeros(depth.shape, dtype=np.uint8)
    rays, reached = lens_rays(camera), []

    def walk(start: int, stop: int) -> None:
        reached.append(
            packed_points(depth, max_depth, camera.K, rays, camera.T_world_cam, voxel_size, start, stop, packed, good)
        )

    in_slices(walk, len(depth), grain=32)
    if not all(reached):  # let keys_of say what is wrong
        flat = np.flatnonzero((depth.reshape(-1) > 0) & (depth.reshape(-1) <= max_depth))
        points = camera.rays().reshape(-1, 3)[flat] * depth.reshape(-1)[flat, None].astype(np.float64)
        keys_of(transform(camera.T_world_cam, points[np.isfinite(points).all(axis=1)]), voxel_size)
    chosen = good != 0
    table = KeyTable()
    rows = np.full(depth.shape, -1, dtype=np.int32)
    rows[chosen] = table.insert(packed[chosen])
    return rows, unpack(table.keys)


def cover_keys(keys: Int32[np.ndarray, "m 3"]) -> Cover:
    """Return the cover of rows that are about one key each."""
    return Cover(np.arange(len(keys), dtype=np.int32), keys, np.ones(len(keys), dtype=np.float32))
