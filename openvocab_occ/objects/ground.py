"""The ground seen from above: which class lies where, and how the road runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Int64, UInt8

from openvocab_occ.mapping import VoxelMap

RegionKind = Literal[
    "road segment", "junction", "parking lot", "sidewalk", "green", "building front", "other ground"
]  # fmt: skip
JunctionKind = Literal["T", "cross", "Y", "star"]
_SURFACES = {
    1: ("road", "driveable", "drivable", "lane", "street", "asphalt", "crosswalk"),
    2: ("sidewalk", "pavement", "curb", "kerb", "path"),
    3: ("terrain", "grass", "lawn", "soil", "ground", "dirt", "sand", "gravel"),
    4: ("flat", "floor", "parking", "water"),
}
ROAD, SIDEWALK, GREEN, FLAT = 1, 2, 3, 4
_CLOSING = 2.4  # metres: gaps in the road as wide as what stands on it
_ARM = 2.4  # metres: a way off that is narrower is a drive, not a street
_NEAR = 22.0  # metres from the trajectory within which junctions are told
_BETWEEN = 20.0  # metres between junctions, at least
_DIRECTIONS = 72


def surface_of(name: str) -> int:
    """Return ROAD, SIDEWALK, GREEN or FLAT for the name of a ground class, 0 for others."""
    words = name.lower().split()
    return next((kind for kind, known in _SURFACES.items() if any(word in words for word in known)), 0)


@dataclass(frozen=True)
class Junction:
    """Where roads meet."""

    center: tuple[float, float]
    """Metres, world."""
    kind: JunctionKind
    arms: tuple[float, ...]
    """Directions in which roads leave it, radians, ascending."""
    radius: float
    """Metres from the centre to where its arms begin."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A raster of the ground's classes."""

    classes: UInt8[np.ndarray, "x y"]
    """ROAD, SIDEWALK, GREEN, FLAT; 0 where no ground was seen."""
    origin: tuple[int, int]
    """Key, along x and y, of the first column."""
    voxel_size: float
    voxels: Int64[np.ndarray, " n"]
    """Positions in the map of the ground's voxels."""
    columns: Int[np.ndarray, "n 2"]
    """Column of each of them."""

    @classmethod
    def of(cls, voxels: VoxelMap, names: Sequence[str]) -> "Ground":
        """Look from above at a map whose occupancy classes, or else whose model's labels, are called `names`."""
        table = np.zeros(256, dtype=np.uint8)
        table[: len(names)] = [surface_of(name) for name in names]
        classes = voxels.labels
        if voxels.contract == "logits" and len(names) == voxels.dim and len(voxels) and (classes >= len(names)).all():
            classes = voxels.features.argmax(axis=1).astype(np.uint8)
        kind = table[classes]
        at = np.flatnonzero(kind)
        keys = voxels.keys[at]
        low = keys[:, :2].min(axis=0) if len(at) else np.zeros(2, np.int32)
        shape = np.ptp(keys[:, :2], axis=0) + 1 if len(at) else np.ones(2, np.int32)
        columns = keys[:, :2] - low
        raster = np.zeros(tuple(shape), dtype=np.uint8)
        order = np.argsort(-keys[:, 2], kind="stable")  # the lowest is written last
        raster[tuple(columns[order].T)] = kind[at][order]
        return cls(raster, (int(low[0]), int(low[1])), voxels.voxel_size, at, columns)

    def cells(self, xy: Float[np.ndarray, "*n 2"]) -> Int[np.ndarray, "*n 2"]:
        """Return the columns that points of the world lie in; they may lie outside."""
        return np.floor(xy / self.voxel_size).astype(np.int64) - self.origin

    def at(self, raster: np.ndarray, xy: Float[np.ndarray, "*n 2"]) -> np.ndarray:
        """Return what a raster of the same size holds at points of the world; 0 outside."""
        cells = self.cells(xy)
        inside = np.all((cells >= 0) & (cells < raster.shape), axis=-1)
        clipped = np.clip(cells, 0, np.array(raster.shape) - 1)
        return np.where(inside, raster[clipped[..., 0], clipped[..., 1]], 0)

    @cached_property
    def road(self) -> Bool[np.ndarray, "x y"]:
        """Where the road is, the places under what stands on it and small gaps included."""
        from scipy.ndimage import binary_closing, binary_opening

        steps = max(round(_CLOSING / self.voxel_size / 2), 1)
        wide = np.pad(self.classes == ROAD, steps + 1)
        closed = binary_closing(wide, np.ones((3, 3), bool), iterations=steps)
        other = np.pad(np.isin(self.classes, (SIDEWALK, GREEN)), steps + 1)
        opened = binary_opening(
            np.asarray(closed, dtype=np.bool_) & ~other, np.ones((3, 3), bool), iterations=max(steps // 2, 1)
        )
        return opened[steps + 1 : -steps - 1, steps + 1 : -steps - 1]

    @cached_property
    def width(self) -> Float[np.ndarray, "x y"]:
        """Metres from each cell of the road to its rim."""
        from scipy.ndimage import distance_transform_edt

        inner = np.asarray(distance_transform_edt(np.pad(self.road, 1)))
        return inner[1:-1, 1:-1] * self.voxel_size

    def arms(self, center: Float[np.ndarray, " 2"], radius: float) -> list[float]:
        """Return the directions in which roads cross a circle, radians: the middle of each stretch of road on it."""
        angles = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
        rim = np.asarray(center) + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        on = self.at(self.road, rim) > 0
        if on.all() or not on.any():
            return []
        start = int(np.flatnonzero(on & ~np.roll(on, 1))[0])
        rolled = np.roll(on, -start)
        edges = np.flatnonzero(np.diff(np.r_[0, rolled.astype(int), 0]))
        found = []
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if (b - a) * radius * 2 * np.pi / _DIRECTIONS >= _ARM:
                found.append(float((angles[0] + (start + (a + b - 1) / 2) * 2 * np.pi / _DIRECTIONS) % (2 * np.pi)))
        return sorted(found)


def find_junctions(ground: Ground, path: Float[np.ndarray, "n 2"]) -> list[Junction]:
    """Return the junctions near a trajectory, west to east.

    A cell of the road's middle is a junction's when roads leave it three ways or more at two distances. Such cells that
    lie together are one junction; its centre is where the road is widest.
    """
    from scipy.ndimage import binary_dilation, label, maximum_filter
    from scipy.spatial import KDTree

    if not len(path) or not ground.road.any():
        return []
    width, size = ground.width, ground.voxel_size
    middle = np.argwhere((width >= maximum_filter(width, 5)) & (width > 1.5))
    xy = (middle + ground.origin + 0.5) * size
    near = KDTree(path).query(xy)[0] <= _NEAR if len(xy) else np.empty(0, bool)
    votes = np.zeros(width.shape, dtype=bool)
    for cell, center in zip(middle[near], xy[near], strict=True):
        reach = float(width[tuple(cell)])
        counts = [len(ground.arms(center, reach + more)) for more in (4.0, 7.0)]
        votes[tuple(cell)] = min(counts) >= 3
    blobs, count = label(binary_dilation(votes, np.ones((3, 3), bool), iterations=max(round(4.0 / size), 1)))  # pyright: ignore[reportGeneralTypeIssues]
    found = []
    for number in range(1, count + 1):
        cells = np.argwhere(votes & (blobs == number))
        best = cells[np.argmax(width[tuple(cells.T)])]
        center = (0.5 * (cells.mean(axis=0) + best) + ground.origin + 0.5) * size
        reach = float(width[tuple(best)])
        arms = max((ground.arms(center, reach + more) for more in (4.0, 6.0, 8.0)), key=len)
        if len(arms) >= 3:
            kind = junction_kind(arms)
            found.append(Junction((float(center[0]), float(center[1])), kind, tuple(arms), reach + 3.0))
    found.sort(key=lambda j: (-len(j.arms), -j.radius))
    kept: list[Junction] = []
    for junction in found:  # mouths of one junction are not junctions of their own
        if all(np.hypot(*np.subtract(junction.center, other.center)) > _BETWEEN for other in kept):
            kept.append(junction)
    return sorted(kept, key=lambda j: j.center)


def junction_kind(arms: Sequence[float]) -> JunctionKind:
    """Return how roads meet, by the directions in which they leave: three of which two go on straight are a T."""
    if len(arms) == 4:
        return "cross"
    if len(arms) > 4:
        return "star"
    gaps = np.diff(np.r_[np.sort(arms), np.min(arms) + 2 * np.pi])
    return "T" if gaps.max() >= np.deg2rad(150) else "Y"
