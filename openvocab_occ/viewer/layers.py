"""What can be shown beside the voxels of a map; the list is open: anything with a name that can draw itself."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64, Int64

from openvocab_occ.export.palette import label_colors
from openvocab_occ.mapping.keys import pack
from openvocab_occ.memory.tile_map import TileMap
from openvocab_occ.objects.compare import diff_objects
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.pipeline.compare import diff
from openvocab_occ.viewer.drawing import PATH_COLOR, box_edges, draw_line, draw_points
from openvocab_occ.viewer.markup import swatches

if TYPE_CHECKING:
    import viser

APPEARED_COLOR, VANISHED_COLOR, CHANGED_COLOR = (0, 114, 178), (213, 94, 0), (240, 228, 66)
FREE_COLOR, UNKNOWN_COLOR = (86, 180, 233), (70, 70, 70)
_MOST_POINTS = 500_000  # of one layer
_PATH_RISE = 1.0  # metres above the ego's origin, clear of the voxels of the ground


@runtime_checkable
class Layer(Protocol):
    """Something to switch on and off on the page; one serves all browsers, from several threads."""

    @property
    def name(self) -> str:
        """What the switch says; no two of a viewer alike."""
        ...

    @property
    def shown(self) -> bool:
        """Whether it is on at first."""
        ...

    def draw(self, nodes: "viser.SceneApi", folder: str) -> str:
        """Add nodes below `folder`, a name such as /layers/3, and return the legend as HTML, "" for none.

        Text that comes from data is escaped by `markup.escape`. Called off the callback threads; may take its time.
        """
        ...


@dataclass(frozen=True, eq=False)
class PathLayer:
    """The way of the ego."""

    path: Float64[np.ndarray, "n 3"]
    name: str = "drive"
    shown: bool = True

    def draw(self, nodes: "viser.SceneApi", folder: str) -> str:
        """Draw a line through all frames."""
        draw_line(nodes, f"{folder}/line", self.path + np.array([0.0, 0.0, _PATH_RISE]), PATH_COLOR)
        return ""


@dataclass(frozen=True, eq=False)
class GridLayer:
    """A grid on the ground, whose squares are ten metres wide."""

    scene: SceneMap
    name: str = "10 m grid"
    shown: bool = False

    def draw(self, nodes: "viser.SceneApi", folder: str) -> str:
        """Draw lines at whole tens of metres, on the lowest tenth of the map."""
        centers = self.scene.voxels.centers
        low, high = np.floor(centers.min(axis=0) / 10) * 10, np.ceil(centers.max(axis=0) / 10) * 10
        z = float(np.percentile(centers[:, 2], 10))
        lines = [[(x, low[1], z), (x, high[1], z)] for x in np.arange(low[0], high[0] + 1, 10.0)]
        lines += [[(low[0], y, z), (high[0], y, z)] for y in np.arange(low[1], high[1] + 1, 10.0)]
        nodes.add_line_segments(
            f"{folder}/lines", np.array(lines, np.float32), (140, 140, 140), thickness=1.0, thickness_units="screen"
        )
        return "lines at whole tens of metres"


@dataclass(frozen=True, eq=False)
class SliceLayer:
    """What is free and what nobody saw, in a level cut through the map."""

    scene: SceneMap
    above: float = 1.0
    """Metres above the ground (the lowest tenth of the map) at which the cut lies."""
    name: str = "free space"
    shown: bool = False

    def draw(self, nodes: "viser.SceneApi", folder: str) -> str:
        """Draw a square for each cell of the cut that holds no voxel."""
        free, unknown, cell = self.cells()
        for name, points, color in (("free", free, FREE_COLOR), ("unknown", unknown, UNKNOWN_COLOR)):
            if len(points):
                draw_points(nodes, f"{folder}/{name}", points, color, 0.6 * cell)
        area = cell * cell
        return f"a level cut {self.above:g} m above the ground" + swatches(
            [
                (FREE_COLOR, "free", f"{len(free) * area:,.0f} m²"),
                (UNKNOWN_COLOR, "unknown", f"{len(unknown) * area:,.0f} m²"),
            ]
        )

    def cells(self) -> tuple[Float64[np.ndarray, "f 3"], Float64[np.ndarray, "u 3"], float]:
        """Return the middles of free and of unknown cells, and their edge, metres; cells with a voxel are neither."""
        voxels = self.scene.voxels
        factor = voxels.free.factor
        while np.prod(np.ptp(voxels.keys[:, :2], axis=0).astype(float) / factor + 1) > _MOST_POINTS:
            factor *= 2
        cell = voxels.voxel_size * factor
        z = float(np.percentile(voxels.centers[:, 2], 10)) + self.above
        layer = int(np.floor(z / voxels.voxel_size))
        low, high = voxels.keys[:, :2].min(axis=0) // factor, voxels.keys[:, :2].max(axis=0) // factor
        x, y = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
        flat = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        middle = np.column_stack([flat * factor + factor // 2, np.full(len(flat), layer)]).astype(np.int32)
        here = np.abs(voxels.keys[:, 2] - layer) <= factor // 2
        occupied = np.unique(
            pack(np.column_stack([voxels.keys[here, :2] // factor, np.zeros(here.sum())]).astype(np.int32))
        )
        held = np.isin(pack(np.column_stack([flat, np.zeros(len(flat))]).astype(np.int32)), occupied)
        free = voxels.free.count(middle) > 0
        points = np.column_stack([(flat + 0.5) * cell, np.full(len(flat), z)])
        return points[free & ~held], points[~free & ~held], cell


@dataclass(frozen=True, eq=False)
class ChangesLayer:
    """What differs from an earlier map of the same place."""

    scene: SceneMap
    earlier: SceneMap
    name: str = "changes"
    shown: bool = True

    def draw(self, nodes: "viser.SceneApi", folder: str) -> str:
        """Draw voxels and boxes of what appeared, vanished or changed, where both maps looked."""
        voxels = diff(self.earlier, self.scene)
        objects = diff_objects(self.earlier, self.scene)
        size = self.scene.voxels.voxel_size
        rows = [
            ("appeared", self.scene.voxels.centers[voxels.appeared], APPEARED_COLOR, objects.appeared),
            ("vanished", self.earlier.voxels.centers[voxels.vanished], VANISHED_COLOR, objects.gone),
            ("changed", self.scene.voxels.centers[voxels.changed], CHANGED_COLOR, tuple(b for _, b in objects.moved)),
        ]
        for name, points, color, items in rows:
            if len(points):
                draw_points(nodes, f"{folder}/{name}", points, color, 1.15 * size)
            _draw_edges(nodes, f"{folder}/{name}_boxes", items, color, 0.75 * size)
        looked = len(voxels.not_observed_in_a) + len(voxels.not_observed_in_b)
        return (
            swatches(
                (color, f"{name}: {len(items)} object{'s' * (len(items) != 1)}", f"{len(points):,} voxels")
                for name, points, color, items in rows
            )
            + f"{looked:,} voxels where one map did not look are not shown"
        )


@dataclass(frozen=True, eq=False)
class TileMapLayer:
    """The global map that a fleet wrote, as far as it lies within or around the scene."""

    tiles: TileMap
    around: float = 60.0
    """Metres beyond the scene."""
    scene: SceneMap | None = None
    by: Literal["agent", "class"] = "agent"
    """What colours tell: who saw a voxel last, or what it is."""
    shown: bool = False

    @property
    def name(self) -> str:
        """What the switch says."""
        return f"global map by {self.by}"

    def draw(self, nodes: "viser.SceneApi", folder: str) -> str:
        """Draw what is occupied."""
        points, numbers, names = self.surface()
        colors = label_colors(names)
        if len(points):
            draw_points(nodes, f"{folder}/surface", points, colors[numbers], self.tiles.schema.cell)
        counts = np.bincount(numbers, minlength=len(names))
        return swatches((colors[i].tolist(), names[i], f"{counts[i]:,}") for i in np.argsort(-counts)[:8] if counts[i])

    def surface(self) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, " n"], tuple[str, ...]]:
        """Return middles of occupied voxels, the number of the agent or class of each, and their names."""
        from openvocab_occ.memory.merge import surface

        found = surface(self.tiles)
        keep = np.ones(len(found.points), dtype=bool)
        if self.scene is not None and len(self.scene.voxels):
            centers = self.scene.voxels.centers
            low, high = centers.min(axis=0) - self.around, centers.max(axis=0) + self.around
            keep = ((found.points >= low) & (found.points <= high)).all(axis=1)
        at = np.flatnonzero(keep)
        at = at[:: max(1, -(-len(at) // _MOST_POINTS))]
        if self.by == "agent":
            return found.points[at], found.agents[at], found.agent_names
        return found.points[at], found.labels[at], tuple(self.tiles.schema.class_names)


def _draw_edges(
    nodes: "viser.SceneApi", name: str, items: tuple[SceneObject, ...], color: tuple[int, int, int], margin: float
) -> None:
    if items:
        edges = np.concatenate([box_edges(item.box, margin) for item in items])
        nodes.add_line_segments(name, edges, color, thickness=3.0, thickness_units="screen")
