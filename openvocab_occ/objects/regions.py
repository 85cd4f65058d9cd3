"""Regions of a scene: stretches of road, junctions, lots, sidewalks, greens; and the lane graph of the roads."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int32

from openvocab_occ.mapping import VoxelMap
from openvocab_occ.objects.ground import FLAT, GREEN, SIDEWALK, Ground, Junction, RegionKind, find_junctions

_MIN_AREA = 12.0  # square metres
_LOT_WIDTH = 5.0  # metres to the rim: wider than half of a street
_ON_PATH = 6.0  # metres: a road that was driven passes this near


@dataclass(frozen=True, eq=False)
class Region:
    """A piece of ground."""

    kind: RegionKind
    area: float
    """Square metres."""
    junction: Junction | None = None


@dataclass(frozen=True)
class LaneEdge:
    """A stretch of road between junctions."""

    region: int
    """Number of the region."""
    junctions: tuple[int, ...]
    """Numbers of the junctions it touches: two, one where it leads out of the map, or none."""
    length: float
    """Metres along its longer side."""


@dataclass(frozen=True)
class LaneGraph:
    """Junctions and the stretches of road between them."""

    junctions: tuple[Junction, ...]
    edges: tuple[LaneEdge, ...]


@dataclass(frozen=True, eq=False)
class Regions:
    """The regions of a map."""

    ground: Ground
    number: Int32[np.ndarray, "x y"]
    """Region of each column, from 1; 0 for none."""
    regions: tuple[Region, ...]
    """Region n is `regions[n - 1]`."""
    lanes: LaneGraph

    def nearest(self, xy: Float[np.ndarray, "n 2"]) -> int:
        """Return the region that most of some points lie in, else the one nearest to their middle; 0 for none."""
        inside = self.ground.at(self.number, xy)
        if inside.any():
            return int(np.bincount(inside[inside > 0]).argmax())
        cells = np.argwhere(self.number)
        if not len(cells):
            return 0
        off = np.abs(cells - self.ground.cells(xy.mean(axis=0))).max(axis=1)
        return int(self.number[tuple(cells[off.argmin()])])


def find_regions(voxels: VoxelMap, names: Sequence[str], path: Float[np.ndarray, "n 2"]) -> Regions:
    """Cut the ground of a map into regions.

    Args:
        voxels: With occupancy classes, or of a model with labels.
        names: Of the classes.
        path: Where the ego drove, metres along x and y; junctions and roads are told near it.
    """
    from scipy.ndimage import label
    from scipy.spatial import KDTree

    ground = Ground.of(voxels, names)
    size = ground.voxel_size
    number = np.zeros(ground.classes.shape, dtype=np.int32)
    regions: list[Region] = []
    junctions = find_junctions(ground, path)
    where = (np.argwhere(np.ones(number.shape, bool)) + ground.origin + 0.5) * size
    road = ground.road.copy()
    for junction in junctions:
        disc = (np.linalg.norm(where - np.array(junction.center), axis=1) <= junction.radius).reshape(number.shape)
        number[disc & road] = len(regions) + 1
        regions.append(Region("junction", float((disc & road).sum()) * size**2, junction))
        road &= ~disc
    tree = KDTree(path) if len(path) else None
    rest = [(road, "road"), *((ground.classes == c, k) for c, k in
            ((SIDEWALK, "sidewalk"), (GREEN, "green"), (FLAT, "other ground")))]  # fmt: skip
    for mask, kind in rest:
        parts, count = label(mask & (number == 0), np.ones((3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
        for n in range(1, count + 1):
            cells = parts == n
            area = float(cells.sum()) * size**2
            if area < _MIN_AREA:
                continue
            what: RegionKind = "road segment" if kind == "road" else kind  # pyright: ignore[reportAssignmentType]
            if kind == "road" and tree is not None and ground.width[cells].max() > _LOT_WIDTH:
                xy = (np.argwhere(cells) + ground.origin + 0.5) * size
                joins = any(np.linalg.norm(xy - j.center, axis=1).min() <= j.radius + 1.5 for j in junctions)
                what = "parking lot" if tree.query(xy)[0].min() > _ON_PATH and not joins else what
            number[cells] = len(regions) + 1
            regions.append(Region(what, area))
    return Regions(ground, number, tuple(regions), _lanes(number, regions, junctions, size))


def _lanes(number: np.ndarray, regions: Sequence[Region], junctions: Sequence[Junction], size: float) -> LaneGraph:
    """Join stretches of road to the junctions they touch."""
    from scipy.ndimage import binary_dilation, find_objects

    edges = []
    boxes = find_objects(number)
    for n, region in enumerate(regions, start=1):
        box = boxes[n - 1] if n <= len(boxes) else None
        if region.kind != "road segment" or box is None:
            continue
        wide = tuple(slice(max(s.start - 3, 0), s.stop + 3) for s in box)
        around = np.asarray(binary_dilation(number[wide] == n, np.ones((3, 3), bool), iterations=2), dtype=np.bool_)
        met = sorted({int(m) for m in np.unique(number[wide][around]) if 0 < m <= len(junctions)})
        length = max(s.stop - s.start for s in box) * size
        edges.append(LaneEdge(n, tuple(m - 1 for m in met), float(length)))
    return LaneGraph(tuple(junctions), tuple(edges))
