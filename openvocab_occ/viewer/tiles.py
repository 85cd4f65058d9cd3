"""The voxels of a map in cubes of space, each at several levels of detail, and which level a camera needs."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64

from openvocab_occ.mapping.keys import pack
from openvocab_occ.mapping.voxel_map import VoxelMap

TILE_EDGE = 32.0  # metres; points go to the browser as float16, which is within 8 mm at 16 m from a tile's centre
LEVELS = 4  # each of twice the voxel size of the one before
BUDGET = 2_000_000
"""Points that one browser is sent: about what a laptop's graphics draws fluently."""
_LEAST_PX = 1.0  # a level is fine enough when its voxels measure so many pixels


@dataclass(frozen=True, eq=False)
class Level:
    """A tile at one level of detail."""

    size: float
    """Edge of its voxels, metres."""
    points: Float32[np.ndarray, "m 3"]
    """Their centres, relative to the tile's."""
    member: Int64[np.ndarray, " m"]
    """Position in the map of the voxel whose colour each takes: the highest of those it stands for."""
    cell: Int64[np.ndarray, " n"]
    """Which of the points each voxel of the tile became."""

    def representatives(
        self, voxels: Int64[np.ndarray, " n"], emphasis: Bool[np.ndarray, " map"] | None
    ) -> Int64[np.ndarray, " m"]:
        """Return the voxel that each point shows: one of `emphasis` where there is any, so that no hit gets lost."""
        if emphasis is None or len(self.member) == len(voxels):
            return self.member
        chosen = np.flatnonzero(emphasis[voxels])
        member = self.member.copy()
        member[self.cell[chosen]] = voxels[chosen]
        return member


@dataclass(frozen=True, eq=False)
class Tile:
    """Voxels of one cube of space."""

    name: str
    """Name of its node in the scene."""
    center: Float64[np.ndarray, " 3"]
    """Middle of the cube, world, metres; the node is put here."""
    voxels: Int64[np.ndarray, " n"]
    """Positions in the map."""
    keys: Int32[np.ndarray, "n 3"]
    voxel_size: float

    @cached_property
    def levels(self) -> tuple[Level, ...]:
        """All levels, the finest first."""
        return tuple(self._level(number) for number in range(LEVELS))

    def _level(self, number: int) -> Level:
        size = self.voxel_size * 2**number
        if number == 0:
            points = ((self.keys + 0.5) * size - self.center).astype(np.float32)
            return Level(size, points, self.voxels, np.arange(len(self.voxels)))
        coarse = (self.keys >> number).astype(np.int32)
        order = np.lexsort((-self.keys[:, 2], pack(coarse)))  # the highest voxel of each cell comes first
        first = np.flatnonzero(np.diff(pack(coarse)[order], prepend=-1))
        cell = np.empty(len(order), dtype=np.int64)
        cell[order] = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(order))))
        chosen = order[first]
        points = ((coarse[chosen] + 0.5) * size - self.center).astype(np.float32)
        return Level(size, points, self.voxels[chosen], cell)


def tile_voxels(voxels: VoxelMap, edge: float = TILE_EDGE) -> list[Tile]:
    """Sort voxels into cubes of about this edge; each voxel is in exactly one."""
    if not len(voxels):
        return []
    steps = max(round(edge / voxels.voxel_size) >> (LEVELS - 1), 1) << (LEVELS - 1)  # no coarse voxel is cut
    cells, members = np.unique(voxels.keys // steps, axis=0, return_inverse=True)
    members = members.reshape(-1)
    order = np.argsort(members, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(members))[:-1])
    return [
        Tile(
            name="/map/tile_{}_{}_{}".format(*cell.tolist()).replace("-", "m"),
            center=(cell + 0.5) * steps * voxels.voxel_size,
            voxels=group,
            keys=voxels.keys[group],
            voxel_size=voxels.voxel_size,
        )
        for cell, group in zip(cells, groups, strict=True)
    ]


def tile_bounds(tiles: list[Tile]) -> Float64[np.ndarray, "t 2 3"]:
    """Return the lower and upper corner of the voxels of each tile, metres."""
    return np.array([[t.keys.min(axis=0), t.keys.max(axis=0) + 1] for t in tiles], dtype=np.float64).reshape(
        -1, 2, 3
    ) * np.array([t.voxel_size for t in tiles]).reshape(-1, 1, 1)


def distances(bounds: Float[np.ndarray, "t 2 3"], position: Float[np.ndarray, " 3"]) -> Float64[np.ndarray, " t"]:
    """Return the metres from a position to each box, 0 within it."""
    outside = np.maximum(np.maximum(bounds[:, 0] - position, position - bounds[:, 1]), 0.0)
    return np.linalg.norm(outside, axis=1)


def choose_levels(
    away: Float[np.ndarray, " t"],
    counts: Int[np.ndarray, "t levels"],
    *,
    voxel_size: float,
    focal_px: float,
    budget: int = BUDGET,
) -> Int64[np.ndarray, " t"]:
    """Return the level of each tile, -1 for none: as fine as pixels can tell, then coarser from afar until all fit.

    `away` is the distance of each tile in metres, `counts` how many points it has at each level. No tile is finer than
    one that is nearer, as long as none is left out.
    """
    last = counts.shape[1] - 1
    with np.errstate(divide="ignore"):
        wanted = np.ceil(np.log2(_LEAST_PX * away / (voxel_size * focal_px)))
    levels = np.clip(np.nan_to_num(wanted, neginf=0.0, posinf=last), 0, last).astype(np.int64)
    rows = np.arange(len(levels))
    far_first = np.argsort(-away, kind="stable")
    total = int(counts[rows, levels].sum())
    for level in range(1, last + 1):
        for tile in far_first:
            if total <= budget:
                return levels
            if levels[tile] < level:
                total += int(counts[tile, level]) - int(counts[tile, levels[tile]])
                levels[tile] = level
    for tile in far_first:
        if total <= budget:
            break
        total -= int(counts[tile, levels[tile]])
        levels[tile] = -1
    return levels
