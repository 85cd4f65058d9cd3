"""One Zarr array of tiles: the base of a map, or what one log laid over it."""

import random
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, cast

from openvocab_occ._jit import in_slices
from openvocab_occ.errors import StorageError
from openvocab_occ.memory._tiles_kernels import merge_tiles
from openvocab_occ.memory.chunk import array_metadata, chunk_of, record_of
from openvocab_occ.memory.commit import Batch
from openvocab_occ.memory.recent import Recent
from openvocab_occ.memory.refusals import translated
from openvocab_occ.memory.schema import ORIGIN, MapSchema, Tile
from openvocab_occ.memory.store import Store

_ATTEMPTS = 60
_WAIT = 0.004  # s, doubled up to 64 times for each conflict; a commit takes about ten milliseconds


class TileKey(NamedTuple):
    """Which tile: floor, and place along x and y, in whole tiles from the world's origin; any sign."""

    floor: int
    x: int
    y: int


class Stored(NamedTuple):
    """What a store says of a chunk."""

    version: bytes
    value: bytes | None
    """None where it is absent, or still of the version that the asker knows."""
    absent: bool


Change = Callable[[TileKey, Tile], int]
"""Alters a tile and returns how many records it changed; called again, on a fresh tile, after a lost race."""


class Layer:
    """Tiles of one array. Reads see whole chunks; an update of a chunk is never lost to another writer."""

    def __init__(self, store: Store, prefix: str, schema: MapSchema, recent: Recent | None = None) -> None:
        self.prefix = prefix
        self.schema = schema
        self._store = store
        self._where = f"{store.name}/{prefix}".rstrip("/")
        self._kv: Any = cast(Any, store.kv)
        self._recent = recent or Recent()
        if store.read(f"{prefix}zarr.json") is None:
            store.write_json(f"{prefix}zarr.json", array_metadata(schema))

    def fetch(self, keys: Iterable[TileKey], known: Mapping[TileKey, bytes] | None = None) -> dict[TileKey, Stored]:
        """Return what is stored of each tile; no value where its version is the `known` one."""
        versions = known or {}
        with translated(self._where):
            futures = [(key, self._kv.read(self._name(key), if_not_equal=versions.get(key))) for key in keys]
            found = [(key, future.result()) for key, future in futures]
        chunks: dict[TileKey, Stored] = {}
        for key, result in found:
            if result.state == "unspecified":
                chunks[key] = Stored(versions[key], None, absent=False)
            else:
                absent = result.state == "missing"
                chunks[key] = Stored(result.stamp.generation, None if absent else result.value, absent)
        return chunks

    def stored(self) -> list[TileKey]:
        """Return the tiles that are stored, sorted. Lists the whole layer."""
        names = [name.removeprefix(self.prefix) for name in self._store.list(f"{self.prefix}c.")]
        chunks = [name.split(".")[1:] for name in names if name.count(".") == 4]
        return sorted(
            TileKey(int(f) - ORIGIN[0], int(x) - ORIGIN[1], int(y) - ORIGIN[2])
            for f, x, y, last in chunks
            if last == "0"
        )

    def sizes(self) -> dict[TileKey, int]:
        """Return the compressed bytes of each stored tile."""
        return {key: len(found.value or b"") for key, found in self.fetch(self.stored()).items()}

    def read(self, keys: Iterable[TileKey]) -> dict[TileKey, Tile]:
        """Return tiles, not to be altered; those never written are empty.

        Raises:
            MapError: A stored tile is damaged.
        """
        found = [*self.fetch(keys).items()]
        tiles: dict[TileKey, Tile] = {}

        def decode(start: int, stop: int) -> None:
            for key, stored in found[start:stop]:
                tiles[key] = self.tile(key, stored.value)

        in_slices(decode, len(found))
        return {key: tiles[key] for key, _ in found}

    def tile(self, key: TileKey, value: bytes | None) -> Tile:
        """Return a stored chunk as a tile, not to be altered; an empty one for None."""
        return Tile(self.schema, None if value is None else record_of(value, self.schema, self._at(key)))

    def update(self, keys: Iterable[TileKey], change: Change, *, first: Callable[[], object] | None = None) -> int:
        """Read tiles, let `change` alter them, and commit; durable on return. Return how many records changed.

        Each tile is committed whole or not at all, and only if nobody wrote it in between. When some were written by
        others the rest is committed and those are done again: `change` must bear that. `first` is called before
        anything is committed, and stops it by raising.

        Raises:
            MapError: A stored tile is damaged; nothing is written over it.
            StorageError: The store is full or read-only, or too many writers fight over a tile.
        """
        wanted = {self._name(key): key for key in keys}
        total = 0
        for attempt in range(_ATTEMPTS):
            with self._store.batch([*wanted]) as batch:
                altered = self._stage(batch, [*wanted.values()], change)
                if first is not None:
                    first()
                lost = batch.commit()
            done = {name: altered[key] for name, key in wanted.items() if name not in lost}
            total += sum(count for _, _, count in done.values())
            self._recent.keep({name: (chunk, tile) for name, (chunk, tile, _) in done.items() if chunk})
            if not lost:
                return total
            wanted = {name: wanted[name] for name in lost}
            time.sleep(random.random() * _WAIT * 2 ** min(attempt, 6))
        raise StorageError(
            f"{self._where} is fought over", expected=f"a commit within {_ATTEMPTS} tries", fix="write less often"
        )

    def merge(self, tiles: Mapping[TileKey, Tile]) -> int:
        """Put tiles in where their records are the greater ones, durably; return how many records changed."""

        def change(key: TileKey, tile: Tile) -> int:
            new = tiles[key]
            return merge_tiles(new.stamps, new.writers, new.payload, tile.stamps, tile.writers, tile.payload)

        return self.update(tiles, change)

    def drop(self, key: TileKey) -> None:
        """Remove a tile."""
        with self._store.batch([self._name(key)]), translated(self._at(key)):
            self._kv.write(self._name(key), None).result()

    def replace(self, tiles: dict[TileKey, Tile]) -> None:
        """Write tiles as they are, whatever was there; durable on return."""
        with self._store.batch([self._name(key) for key in tiles]) as batch:
            work = [*tiles.items()]

            def put(start: int, stop: int) -> None:
                for key, tile in work[start:stop]:
                    batch.put(self._name(key), chunk_of(tile))

            in_slices(put, len(work))
            batch.commit()

    def _stage(self, batch: Batch, keys: list[TileKey], change: Change) -> dict[TileKey, tuple[bytes, Tile, int]]:
        """Alter tiles and put them into a batch; return of each chunk, tile and records changed."""
        found = self.fetch(keys)
        done: dict[TileKey, tuple[bytes, Tile, int]] = {}

        def alter(start: int, stop: int) -> None:
            for key in keys[start:stop]:
                value = found[key].value
                tile = self._own(key, value)
                count = change(key, tile)
                if count:
                    value = chunk_of(tile)
                    batch.put(self._name(key), value, found[key].version)
                done[key] = value or b"", tile, count

        in_slices(alter, len(keys))
        return done

    def _own(self, key: TileKey, value: bytes | None) -> Tile:
        """Return a stored chunk as a tile that may be altered."""
        if value is None:
            return Tile(self.schema)
        return self._recent.take(self._name(key), value) or self.tile(key, value).copy()

    def _name(self, key: TileKey) -> str:
        return f"{self.prefix}{chunk_name(key)}"

    def _at(self, key: TileKey) -> str:
        return f"{self._where}/{chunk_name(key)}"


def chunk_name(key: TileKey) -> str:
    """Return the name of a tile's chunk in its array."""
    return f"c.{key.floor + ORIGIN[0]}.{key.x + ORIGIN[1]}.{key.y + ORIGIN[2]}.0"
