"""What is damaged, and what a map holds."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from openvocab_occ.errors import MapError
from openvocab_occ.memory import journal
from openvocab_occ.memory.fold import check_journal
from openvocab_occ.memory.foundation import foundation, pruned
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.schema import TILE
from openvocab_occ.memory.tile_map import TileMap


@dataclass(frozen=True)
class Health:
    """What `verify` found."""

    tiles: int
    damaged: dict[str, list[TileKey]]
    """Tiles that cannot be read, by layer."""
    entries: int
    damaged_entries: list[str]
    """Journal entries whose content does not fit their checksum."""

    @property
    def sound(self) -> bool:
        """True when everything can be read."""
        return not self.damaged and not self.damaged_entries


def verify(city: TileMap, *, progress: Callable[[int, int], None] | None = None) -> Health:
    """Read every tile and every journal entry, whose checksums tell whether they are as they were written."""
    beneath = foundation(city)
    layers = [(layer, layer.stored()) for layer in (*city.layers(), *([beneath] if beneath else []))]
    total, done = sum(len(keys) for _, keys in layers), 0
    damaged: dict[str, list[TileKey]] = {}
    for layer, keys in layers:
        for key in keys:
            try:
                layer.read([key])
            except MapError:
                damaged.setdefault(layer.prefix, []).append(key)
            done += 1
            if progress:
                progress(done, total)
    return Health(total, damaged, len(journal.names(city.store)), check_journal(city))


def describe(city: TileMap) -> dict[str, Any]:
    """Return the numbers of a map: what it holds, where, and how large it is."""
    s = city.schema
    layers = {layer.prefix.rstrip("/"): layer.sizes() for layer in city.layers()}
    places = {(key.x, key.y) for sizes in layers.values() for key in sizes}
    side = TILE * s.cell
    area = len(places) * side * side / 1e6
    stored = sum(sum(sizes.values()) for sizes in layers.values())
    low = [min(p[i] for p in places) * side for i in range(2)] if places else None
    high = [(max(p[i] for p in places) + 1) * side for i in range(2)] if places else None
    return {
        "map": city.store.name,
        "classes": list(s.class_names),
        "heights": s.heights,
        "cell_m": s.cell,
        "z0_m": s.z0,
        "dtype": s.dtype,
        "tiles": sum(map(len, layers.values())),
        "layers": {prefix: len(sizes) for prefix, sizes in layers.items()},
        "floors": sorted({key.floor for sizes in layers.values() for key in sizes}),
        "bounds_m": [low, high] if places else None,
        "tile_area_km2": round(area, 6),
        "tile_bytes": stored,
        "gb_per_km2": round(stored / 1e9 / area, 4) if area else None,
        "dense_float32_gb_per_km2": round((1000 / s.cell) ** 2 * s.heights * s.num_classes * 4 / 1e9, 3),
        "agents": city.agents(),
        "logs": city.logs(),
        "journal_entries": len(journal.names(city.store)),
        "pruned_entries": pruned(city).entries,
    }
