"""Decoded tiles in memory, in one block that the window kernel reads from."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence

import numpy as np

from openvocab_occ._jit import in_slices
from openvocab_occ.memory._tiles_kernels import merge_tiles
from openvocab_occ.memory.layer import Layer, Stored, TileKey
from openvocab_occ.memory.schema import CELLS, MapSchema, Tile

Versions = tuple[TileKey, tuple[tuple[str, bytes], ...]]
"""A tile and the layers that hold something of it, each with the version stored there."""


class TileCache:
    """The tiles read last; a stored version that has changed is read anew. Not for several threads at once."""

    def __init__(self, schema: MapSchema, limit: int) -> None:
        self.schema = schema
        heights, classes = schema.heights, schema.num_classes
        self._whole = schema.dtype == "uint8"  # then whole records are kept, and values and stamps are views of them
        size = CELLS * (schema.cell_bytes if self._whole else heights * (8 + classes * 4))
        self._slots: OrderedDict[Versions, int] = OrderedDict()
        self._seen: dict[str, dict[TileKey, bytes]] = {}
        self._allocate(max(1, limit // size))

    def load(self, keys: Sequence[TileKey], layers: Sequence[Layer]) -> dict[TileKey, int]:
        """Bring tiles in, each the merge of its layers; return the slots of those that there are."""
        found = [layer.fetch(keys, self._seen.setdefault(layer.prefix, {})) for layer in layers]
        versions = [self._version(key, layers, found) for key in keys]
        stored = [v for v in versions if v[1]]
        if len(stored) > len(self.stamps):
            self._allocate(len(stored))
        slots = {v: self._slots[v] for v in stored if v in self._slots}
        for version in slots:
            self._slots.move_to_end(version)
        missing = [v for v in stored if v not in slots]
        new = [self._free.pop() if self._free else self._evict(slots) for _ in missing]
        try:
            in_slices(lambda a, b: self._fill(missing[a:b], new[a:b], layers, found), len(missing))
        except BaseException:
            self._free += new
            raise
        for version, slot in zip(missing, new, strict=True):
            self._slots[version] = slots[version] = slot
        return {version[0]: slot for version, slot in slots.items()}

    def clear(self) -> None:
        """Forget everything."""
        self._slots.clear()
        self._seen.clear()
        self._free = [*range(len(self.stamps))]

    def _allocate(self, count: int) -> None:
        heights, classes = self.schema.heights, self.schema.num_classes
        if self._whole:
            self._records = np.empty((count, CELLS, self.schema.cell_bytes), dtype=np.uint8)
            logits = self._records[..., 12 * heights : heights * (12 + classes)]
            self.values = logits.reshape(count, CELLS, heights, classes)
            self.stamps = self._records[..., : 8 * heights].view("<u8")
        else:
            self.values = np.empty((count, CELLS, heights, classes), dtype=np.float32)
            self.stamps = np.empty((count, CELLS, heights), dtype=np.uint64)
        self._slots.clear()
        self._free = [*range(count)]

    def _version(self, key: TileKey, layers: Sequence[Layer], found: Sequence[Mapping[TileKey, Stored]]) -> Versions:
        """Return the version of a tile in each layer that has it, and remember them."""
        sources: list[tuple[str, bytes]] = []
        for layer, chunks in zip(layers, found, strict=True):
            seen = self._seen[layer.prefix]
            if chunks[key].absent:
                seen.pop(key, None)
            else:
                seen[key] = chunks[key].version
                sources.append((layer.prefix, seen[key]))
        return key, tuple(sources)

    def _fill(
        self, missing: Sequence[Versions], slots: Sequence[int], layers: Sequence[Layer],
        found: Sequence[Mapping[TileKey, Stored]],
    ) -> None:  # fmt: skip
        """Decode tiles, each into its slot."""
        for (key, _), slot in zip(missing, slots, strict=True):
            parts = [
                layer.read([key])[key] if chunks[key].value is None else layer.tile(key, chunks[key].value)
                for layer, chunks in zip(layers, found, strict=True) if not chunks[key].absent
            ]  # fmt: skip
            tile = merged(parts)
            if self._whole:
                self._records[slot] = tile.record
            else:
                self.stamps[slot] = tile.stamps
                self.values[slot] = self.schema.decode(tile.payload)

    def _evict(self, in_use: dict[Versions, int]) -> int:
        for version in self._slots:
            if version not in in_use:
                return self._slots.pop(version)
        raise AssertionError("a window never needs more slots than there are")


def merged(tiles: Sequence[Tile]) -> Tile:
    """Return the greatest record of each voxel; the tiles are not altered."""
    if len(tiles) == 1:
        return tiles[0]
    out = tiles[0].copy()
    for tile in tiles[1:]:
        merge_tiles(tile.stamps, tile.writers, tile.payload, out.stamps, out.writers, out.payload)
    return out
