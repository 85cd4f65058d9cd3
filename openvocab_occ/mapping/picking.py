"""The first voxel of a map that a ray meets: what lies under a pointer."""

from collections import OrderedDict
from threading import Lock
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from openvocab_occ.geometry import GridSpec
from openvocab_occ.mapping.voxel_map import VoxelMap
from openvocab_occ.occupancy.grid import GEOMETRY_CLASSES, OccupancyGrid
from openvocab_occ.occupancy.rays import cast_rays

_EDGE = 64  # voxels along a block; its grid is 256 kB
_KEPT = 64  # blocks


class Pick(NamedTuple):
    """What a ray met."""

    voxel: int
    """Position in the map."""
    point: Float64[np.ndarray, " 3"]
    """Where it went in, metres, world."""
    distance: float
    """Metres from the origin."""


class Picker:
    """Rays through a map of any extent: block by block, those the ray crosses, nearest first."""

    def __init__(self, voxels: VoxelMap) -> None:
        self._voxels = voxels
        cells, members = np.unique(voxels.keys // _EDGE, axis=0, return_inverse=True)
        self._blocks = cells.astype(np.int64)
        order = np.argsort(members.reshape(-1), kind="stable")
        counts = np.bincount(members.reshape(-1), minlength=len(cells))
        self._members = np.split(order, np.cumsum(counts)[:-1]) if len(cells) else []
        self._grids: OrderedDict[int, OccupancyGrid] = OrderedDict()
        self._lock = Lock()

    def pick(self, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]) -> Pick | None:
        """Return the first voxel that a ray meets, or None."""
        entry = self._entries(origin, direction)
        best: Pick | None = None
        for block in np.argsort(entry, kind="stable"):
            if not np.isfinite(entry[block]) or (best is not None and entry[block] > best.distance):
                break
            grid = self._grid(int(block))
            hits = cast_rays(grid, origin, direction[None])
            if hits.voxel[0] < 0 or (best is not None and hits.distance[0] >= best.distance):
                continue
            key = grid.spec.unflat(hits.voxel[:1]) + self._blocks[block] * _EDGE
            at = int(self._voxels.index(key.astype(np.int32))[0])
            unit = direction / np.linalg.norm(direction)
            best = Pick(at, np.asarray(origin + unit * float(hits.distance[0]), np.float64), float(hits.distance[0]))
        return best

    def _entries(self, origin: np.ndarray, direction: np.ndarray) -> Float64[np.ndarray, " b"]:
        """Return the distance at which a ray enters each block, inf where it does not."""
        edge = _EDGE * self._voxels.voxel_size
        unit = direction / np.linalg.norm(direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            near = (self._blocks * edge - origin) / unit
            far = ((self._blocks + 1) * edge - origin) / unit
        start = np.nan_to_num(np.minimum(near, far), nan=-np.inf).max(axis=1, initial=0.0)
        stop = np.nan_to_num(np.maximum(near, far), nan=np.inf).min(axis=1, initial=np.inf)
        return np.where(start <= stop, start, np.inf)

    def _grid(self, block: int) -> OccupancyGrid:
        with self._lock:
            grid = self._grids.get(block)
            if grid is not None:
                self._grids.move_to_end(block)
                return grid
        corner = self._blocks[block] * _EDGE
        labels = np.ones((_EDGE, _EDGE, _EDGE), np.uint8)
        labels[tuple((self._voxels.keys[self._members[block]] - corner).T)] = 0
        size = self._voxels.voxel_size
        spec = GridSpec(tuple((corner * size).tolist()), size, (_EDGE, _EDGE, _EDGE))
        grid = OccupancyGrid(labels, spec, free_label=1, class_names=GEOMETRY_CLASSES)
        with self._lock:
            self._grids[block] = grid
            while len(self._grids) > _KEPT:
                self._grids.popitem(last=False)
        return grid
