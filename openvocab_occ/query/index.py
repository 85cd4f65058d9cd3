"""A map's objects as arrays, made once a map and kept as long as the map is."""

from collections.abc import Iterable, Mapping
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import REGION, SCENE, SceneObject
from openvocab_occ.query import colors
from openvocab_occ.query.boxes import Boxes
from openvocab_occ.query.relations import Anchor, Columns

_SPREAD_OUT = 0.5
"""Share of its box's footprint that a thing must fill to be compared by its box."""
_AT_ONCE = 1 << 16  # bounds the memory of naming colours
_SMALL = 9.0
"""Square metres below which a box always does."""


class Index:
    """Nodes of the tree, without the scene, in the order of the tree; rows of all arrays are they."""

    def __init__(self, scene: SceneMap) -> None:
        self.nodes: tuple[SceneObject, ...] = tuple(node for node in scene.objects.nodes if node.level != SCENE)
        self.ids: Int64[np.ndarray, " n"] = np.array([node.id for node in self.nodes], dtype=np.int64)
        self.boxes = Boxes.of(self.nodes)
        self.level_names, self.levels = _coded([node.level for node in self.nodes])
        self.state_names, self.states = _coded([node.state for node in self.nodes])
        self.label_names, self._labels = _coded([node.label for node in self.nodes])
        self._purity = np.array([node.score for node in self.nodes], dtype=np.float64)
        self._voxels = scene.voxels
        self._voxel_size = scene.voxels.voxel_size
        self._dim = scene.voxels.dim
        self._anchors: dict[int, Anchor] = {}

    def __len__(self) -> int:
        return len(self.nodes)

    @cached_property
    def embeddings(self) -> Float32[np.ndarray, "n c"]:
        """One row a node."""
        rows = [node.embedding for node in self.nodes]
        return np.stack(rows).astype(np.float32, copy=False) if rows else np.zeros((0, self._dim), np.float32)

    def said(self, worth: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " n"]:
        """Return what the labels of nodes are worth, given that of each name, by the share of what speaks for them."""
        return worth[self._labels] * self._purity

    @cached_property
    def regions_of_things(self) -> Bool[np.ndarray, " n"]:
        """Tell which nodes are regions without voxels of their own."""
        return np.array([node.level == REGION and not len(node.voxels) for node in self.nodes], dtype=bool)

    @cached_property
    def row_of(self) -> Mapping[int, int]:
        """Row of each id."""
        return {int(id): row for row, id in enumerate(self.ids)}

    @cached_property
    def _colors(self) -> UInt8[np.ndarray, "v 3"]:
        return self._voxels.colors

    @cached_property
    def voxel_color_names(self) -> UInt8[np.ndarray, " v"]:
        """Position in `colors.NAMES` of each voxel's colour; 255 where no image gave one."""
        parts = [slice(at, at + _AT_ONCE) for at in range(0, len(self._colors), _AT_ONCE)]
        names = np.concatenate([colors.names_of(self._colors[part]) for part in parts] or [np.zeros(0, np.uint8)])
        return np.where(self._colors.any(axis=1), names, 255).astype(np.uint8)  # black is where no image gave one

    def color_degrees(
        self, rows: Int64[np.ndarray, " m"]
    ) -> tuple[Float64[np.ndarray, "m names"], Bool[np.ndarray, " m"]]:
        """Return how far nodes are of each colour in `colors.NAMES`, and whether any colour of them was observed."""
        shown = [self._shown(int(row)) for row in rows]
        known = np.array([len(own) > 0 for own in shown], dtype=bool)
        degree = np.zeros((len(rows), len(colors.NAMES)))
        for i in np.flatnonzero(known):
            degree[i] = colors.degrees(shown[i], self._middle_light)
        return degree, known

    def lightness(self, rows: Int64[np.ndarray, " m"]) -> tuple[Float64[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
        """Return the median lightness of nodes, 0..1, and whether any colour of them was observed."""
        shown = [self._shown(int(row)) for row in rows]
        known = np.array([len(own) > 0 for own in shown], dtype=bool)
        light = np.zeros(len(rows))
        for i in np.flatnonzero(known):
            own = colors.oklab(np.clip(np.rint(shown[i][:, 1:]), 0, 255).astype(np.uint8))[:, 0]
            light[i] = _middle(own, shown[i][:, 0])
        return light, known

    def _shown(self, row: int) -> Float32[np.ndarray, "k 4"]:
        """Return the colours of a node: those its own pixels showed, else those of its voxels."""
        node = self.nodes[row]
        if node.colors is not None:
            return node.colors
        rgb = self._colors[node.voxels]
        rgb = rgb[rgb.any(axis=1)]  # black is where no image gave a colour
        return np.concatenate([np.full((len(rgb), 1), 1 / max(len(rgb), 1)), rgb], axis=1).astype(np.float32)

    @cached_property
    def _middle_light(self) -> float:
        """Median lightness of the map's voxels."""
        rgb = self._colors[self._colors.any(axis=1)]
        return float(np.median(colors.oklab(rgb[:: len(rgb) // _AT_ONCE + 1])[:, 0])) if len(rgb) else colors.MIDDLE

    def on_levels(self, names: Iterable[str]) -> Bool[np.ndarray, " n"]:
        """Tell which nodes are of some levels."""
        return np.array([name in set(names) for name in self.level_names] or [False])[self.levels]

    def in_states(self, names: Iterable[str]) -> Bool[np.ndarray, " n"]:
        """Tell which nodes are in some states of motion."""
        return np.array([name in set(names) for name in self.state_names] or [False])[self.states]

    def anchor(self, row: int) -> Anchor:
        """Return a node as something to compare with: its box, or its voxels where the box says too little."""
        if row not in self._anchors:
            box = self.boxes.take(np.array([row]))
            area = float(box.size[0, 0] * box.size[0, 1])
            points = self.nodes[row].points
            columns = Columns(points.astype(np.float64), self._voxel_size) if area > _SMALL and len(points) else None
            if columns is not None and columns.area >= _SPREAD_OUT * area:
                columns = None
            self._anchors[row] = Anchor(box, columns)
        return self._anchors[row]


def _middle(values: Float32[np.ndarray, " k"], weights: Float32[np.ndarray, " k"]) -> float:
    """Return the weighted median."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[int(np.searchsorted(total, total[-1] / 2))]])


def _coded(values: list[str]) -> tuple[list[str], Int64[np.ndarray, " n"]]:
    """Return the different texts, and the number of each value among them: numbers compare faster."""
    names = sorted(set(values))
    number = {name: i for i, name in enumerate(names)}
    return names, np.array([number[value] for value in values], dtype=np.int64)


_KEPT: "WeakKeyDictionary[SceneMap, Index]" = WeakKeyDictionary()


def index_of(scene: SceneMap) -> Index:
    """Return the index of a map, made at the first call."""
    index = _KEPT.get(scene)
    if index is None:
        index = _KEPT[scene] = Index(scene)
    return index
