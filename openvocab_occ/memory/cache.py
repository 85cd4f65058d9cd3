"""Decoded tiles in memory, in one block that the window kernel reads from."""

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from openvocab_occ.memory._tiles_kernels import merge_tiles
from openvocab_occ.memory.layer import Layer, TileKey
from openvocab_occ.memory.schema import CELLS, MapSchema, Tile

Versions = tuple[TileKey, tuple[tuple[str, bytes], ...]]
"""A tile and the layers that hold something of it, each with the version stored there."""


class TileCache:
    """The tiles read last; a stored version that has changed is read anew. Not for several threads at once."""

    def __init__(self, schema: MapSchema, limit: int) -> None:
        self.schema = schema
        heights, classes = schema.heights, schema.num_classes
        self._whole = schema.dtype == "uint8"  # then whole records are kept, and values and stamps are views of them
        size = CELLS * (schema.planes if self._whole else heights * (8 + classes * 4))
        self._slots: OrderedDict[Versions, int] = OrderedDict()
        self._seen: dict[str, dict[TileKey, bytes]] = {}
        self._allocate(max(1, limit // size))

    def load(self, keys: Sequence[TileKey], layers: Sequence[Layer]) -> np.ndarray:
        """Bring tiles in, each the merge of its layers; return the slot of each, -1 where there is none."""
        versions = self._versions(keys, layers)
        stored = [v for v in versions if v[1]]
        if len(stored) > len(self.stamps):
            self._allocate(len(stored))
        hits = {v: self._slots[v] for v in stored if v in self._slots}
        for version in hits:
            self._slots.move_to_end(version)
        self._fill([v for v in stored if v not in hits], {layer.prefix: layer for layer in layers}, hits)
        return np.array([hits.get(v, -1) for v in versions], dtype=np.int32)

    def clear(self) -> None:
        """Forget everything."""
        self._slots.clear()
        self._seen.clear()
        self._free = [*range(len(self.stamps))]

    def _allocate(self, count: int) -> None:
        heights, classes = self.schema.heights, self.schema.num_classes
        if self._whole:
            self._records = np.empty((count, CELLS, self.schema.planes), dtype=np.uint8)
            logits = self._records[..., 12 * heights : heights * (12 + classes)]
            self.values = logits.reshape(count, CELLS, heights, classes)
            self.stamps = self._records[..., : 8 * heights].view("<u8")
        else:
            self.values = np.empty((count, CELLS, heights, classes), dtype=np.float32)
            self.stamps = np.empty((count, CELLS, heights), dtype=np.uint64)
        self._slots.clear()
        self._free = [*range(count)]

    def _versions(self, keys: Sequence[TileKey], layers: Sequence[Layer]) -> list[Versions]:
        found: list[list[tuple[str, bytes]]] = [[] for _ in keys]
        for layer in layers:
            seen = self._seen.setdefault(layer.prefix, {})
            now = layer.generation(keys, seen)
            for entry, key in zip(found, keys, strict=True):
                generation = now[key]
                if generation is None:
                    seen.pop(key, None)
                else:
                    seen[key] = generation
                    entry.append((layer.prefix, generation))
        return [(key, tuple(entry)) for key, entry in zip(keys, found, strict=True)]

    def _fill(self, missing: list[Versions], layers: dict[str, Layer], slots: dict[Versions, int]) -> None:
        """Read what is missing, each into a slot, and enter it in `slots`."""
        new = {key: self._free.pop() if self._free else self._evict(slots) for key, _ in missing}
        try:
            parts: dict[str, dict[TileKey, Tile]] = {}
            for prefix, layer in layers.items():
                wanted = {key: sources[0][0] for key, sources in missing if any(p == prefix for p, _ in sources)}
                own = {key: self._records[new[key]] for key, at in wanted.items() if at == prefix and self._whole}
                if wanted:
                    parts[prefix] = layer.read(wanted, into=own)
            for key, sources in missing:
                tile = merged([parts[prefix][key] for prefix, _ in sources])
                if not self._whole:
                    self.stamps[new[key]] = tile.stamps
                    self.values[new[key]] = self.schema.decode(tile.payload)
        except BaseException:
            self._free += new.values()
            raise
        for version in missing:
            self._slots[version] = slots[version] = new[version[0]]

    def _evict(self, in_use: dict[Versions, int]) -> int:
        for version in self._slots:
            if version not in in_use:
                return self._slots.pop(version)
        raise AssertionError("a window never needs more slots than there are")


def merged(tiles: Sequence[Tile]) -> Tile:
    """Return the greatest record of each voxel; the first tile is altered."""
    for tile in tiles[1:]:
        merge_tiles(tile.stamps, tile.writers, tile.payload, tiles[0].stamps, tiles[0].writers, tiles[0].payload)
    return tiles[0]
