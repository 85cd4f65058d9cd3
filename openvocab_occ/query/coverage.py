"""What a map has looked at: the ground below everything that some camera saw."""

from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Int64

from openvocab_occ.objects.scene_map import SceneMap

CELL = 1.0
"""Metres; side of the square cells in which observed ground is counted."""
_SHIFT = 1 << 31


class Coverage:
    """Squares of ground that hold a voxel which was seen, be it occupied or free."""

    def __init__(self, scene: SceneMap) -> None:
        columns = np.unique(scene.voxels.keys[:, :2], axis=0)
        places = (columns + 0.5) * scene.voxels.voxel_size
        self._cells = np.unique(_packed(np.concatenate([places, *_free_places(scene)])))

    @property
    def area(self) -> float:
        """Square metres."""
        return len(self._cells) * CELL**2

    def seen(self, places: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Tell which places lie in an observed square."""
        return np.isin(_packed(places), self._cells)


def _free_places(scene: SceneMap) -> list[Float[np.ndarray, "n 2"]]:
    """Return where space was seen to be free, where the map keeps that."""
    free = getattr(scene.voxels, "free", None)
    if free is None or not len(free):
        return []
    keys, counts = free.blocks
    edge = round(counts.shape[1] ** (1 / 3))
    open_columns = counts.reshape(-1, edge, edge, edge).any(axis=3)
    block, x, y = np.nonzero(open_columns)
    return [((keys[block, :2] * edge + np.stack([x, y], axis=1)) + 0.5) * free.cell]


def _packed(places: Float[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
    cells = np.floor(np.clip(places, -1e8, 1e8) / CELL).astype(np.int64)
    return (cells[:, 0] + _SHIFT) * (2 * _SHIFT) + cells[:, 1] + _SHIFT


_KEPT: "WeakKeyDictionary[SceneMap, Coverage]" = WeakKeyDictionary()


def coverage_of(scene: SceneMap) -> Coverage:
    """Return the coverage of a map, made at the first call."""
    coverage = _KEPT.get(scene)
    if coverage is None:
        coverage = _KEPT[scene] = Coverage(scene)
    return coverage
