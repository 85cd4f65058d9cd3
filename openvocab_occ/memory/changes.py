"""What has become different: between two maps, or between two times of one."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from openvocab_occ.errors import ConfigError
from openvocab_occ.memory.fold import rebuild
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.schema import TILE, MapSchema, Tile
from openvocab_occ.memory.tile_map import TileMap

Kind = Literal["appeared", "vanished", "changed"]


@dataclass(frozen=True, eq=False)
class Changes:
    """Voxels known before and after whose label differs. Rows of the arrays belong together."""

    class_names: tuple[str, ...]
    points: Float64[np.ndarray, "n 3"]
    """Centres in the world, metres."""
    before: Int64[np.ndarray, " n"]
    after: Int64[np.ndarray, " n"]
    """Labels."""
    compared: int
    """Voxels known in both."""
    learnt: int
    """Voxels known only afterwards."""
    forgotten: int
    """Voxels known only before."""
    free: int

    def of(self, kind: Kind) -> np.ndarray:
        """Return bool[n]: `appeared` was free, `vanished` is free, `changed` is another thing."""
        was, now = self.before == self.free, self.after == self.free
        return {"appeared": was, "vanished": now, "changed": ~was & ~now}[kind]

    def summary(self) -> dict[str, object]:
        """Return how many voxels of which label did what."""
        report: dict[str, object] = {"compared": self.compared, "learnt": self.learnt, "forgotten": self.forgotten}
        kinds: tuple[Kind, ...] = ("appeared", "vanished", "changed")
        for kind in kinds:
            rows = self.of(kind)
            labels = (self.before if kind == "vanished" else self.after)[rows]
            names, counts = np.unique(labels, return_counts=True)
            found = {self.class_names[n]: int(c) for n, c in zip(names, counts, strict=True)}
            report[kind] = {"voxels": int(rows.sum()), "labels": found}
        return report


def diff(before: TileMap, after: TileMap) -> Changes:
    """Compare two maps of the same lattice and classes."""
    a, b = before.schema, after.schema
    if (a.class_names, a.heights, a.cell, a.z0) != (b.class_names, b.heights, b.cell, b.z0):
        raise ConfigError("the maps have another lattice or other classes", expected=a, got=b)
    parts, tallies = [], np.zeros(3, dtype=np.int64)
    for key, old, new in _pairs(before, after):
        was, now = old.stamps > 0, new.stamps > 0
        tallies += [(was & now).sum(), (now & ~was).sum(), (was & ~now).sum()]
        cell, height = np.nonzero(was & now & (old.payload != new.payload).any(axis=-1))
        x, y = a.decode(old.payload[cell, height]).argmax(axis=-1), b.decode(new.payload[cell, height]).argmax(axis=-1)
        rows = x != y
        parts.append((centers(a, key, cell[rows], height[rows]), x[rows], y[rows]))
    parts.append((np.empty((0, 3)), *[np.empty(0, dtype=np.int64)] * 2))
    points, x, y = (np.concatenate(part) for part in zip(*parts, strict=True))
    compared, learnt, forgotten = map(int, tallies)
    return Changes(a.class_names, points, x.astype(np.int64), y.astype(np.int64), compared, learnt, forgotten, a.free)


def diff_times(city: TileMap, before: float, after: float) -> Changes:
    """Compare a map with itself as it was, folded from its journal up to two Unix times in a temporary folder."""
    if not before < after:
        raise ConfigError("the times are not in order", expected="before < after", got=(before, after))
    with tempfile.TemporaryDirectory(prefix="openvocab_occ-") as folder:
        for name, until in (("before", before), ("after", after)):
            rebuild(city, out=Path(folder) / name, until=until)
        return diff(TileMap.open(Path(folder) / "before"), TileMap.open(Path(folder) / "after"))


def centers(
    schema: MapSchema, key: TileKey, cell: Int64[np.ndarray, " n"], height: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Return the centres of voxels of a tile in the world, metres."""
    index = np.stack([key.x * TILE + cell // TILE, key.y * TILE + cell % TILE, key.floor * schema.heights + height], -1)
    return (index + 0.5) * schema.cell + [0.0, 0.0, schema.z0]


def _pairs(before: TileMap, after: TileMap) -> Iterator[tuple[TileKey, Tile, Tile]]:
    keys = sorted({key for city in (before, after) for layer in city.layers() for key in layer.stored()})
    for key in keys:
        old, new = (next((tile for _, tile in city.tiles(keys=[key])), Tile(city.schema)) for city in (before, after))
        yield key, old, new
