"""One Zarr array of tiles: the base of a map, or what one log laid over it."""

import random
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, cast

import numpy as np
import tensorstore as ts

from openvocab_occ._jit import in_slices
from openvocab_occ.errors import StorageError
from openvocab_occ.memory._codec_kernels import transposed
from openvocab_occ.memory.schema import ORIGIN, SHAPE, TILE, MapSchema, Tile
from openvocab_occ.memory.store import Conflict, Store, translated

_ATTEMPTS = 60
_WAIT = 0.004  # s, doubled up to 64 times for each conflict; a commit takes about ten milliseconds


class TileKey(NamedTuple):
    """Which tile: floor, and place along x and y, in whole tiles from the world's origin; any sign."""

    floor: int
    x: int
    y: int


Change = Callable[[TileKey, Tile], int]
"""Alters a tile and returns how many records it changed; called again, on a fresh tile, after a lost race."""


class Layer:
    """Tiles of one array. Reads see whole chunks; an update of a chunk is never lost to another writer."""

    def __init__(self, store: Store, prefix: str, schema: MapSchema) -> None:
        self.prefix = prefix
        self.schema = schema
        self._store = store
        self._where = f"{store.name}/{prefix}".rstrip("/")
        spec = {"driver": "zarr3", "kvstore": store.under(prefix), "metadata": array_metadata(schema)}
        with translated(self._where):
            options = {"open": True, "create": True, "context": store.context, "recheck_cached_data": True}
            self._array: Any = cast(Any, ts.open(spec, **options).result())
        self._kv: Any = self._array.kvstore

    def generation(self, keys: Iterable[TileKey], known: dict[TileKey, bytes]) -> dict[TileKey, bytes | None]:
        """Return what version of each tile is stored, None if absent; `known` are versions seen before."""
        with translated(self._where):
            futures = [(key, self._kv.read(chunk_name(key), if_not_equal=known.get(key))) for key in keys]
            found = [(key, future.result()) for key, future in futures]
        return {
            key: known[key]
            if result.state == "unspecified"
            else (result.stamp.generation if result.state == "value" else None)
            for key, result in found
        }

    def stored(self) -> list[TileKey]:
        """Return the tiles that are stored, sorted. Lists the whole layer."""
        with translated(self._where):
            names = [name.decode() for name in self._kv.list().result()]
        chunks = [name.split(".")[1:] for name in names if name.startswith("c.") and name.count(".") == 4]
        return sorted(
            TileKey(int(f) - ORIGIN[0], int(x) - ORIGIN[1], int(y) - ORIGIN[2])
            for f, _, x, y in chunks
            if y.isdigit()  # not a lock file
        )

    def sizes(self) -> dict[TileKey, int]:
        """Return the compressed bytes of each stored tile."""
        with translated(self._where):
            futures = [(key, self._kv.read(chunk_name(key))) for key in self.stored()]
            return {key: len(future.result().value) for key, future in futures}

    def read(self, keys: Iterable[TileKey], *, into: Mapping[TileKey, np.ndarray] | None = None) -> dict[TileKey, Tile]:
        """Return tiles; those never written are empty. Those that `into` has a record for are read into that.

        Raises:
            MapError: A stored tile is damaged.
        """
        wanted = [*keys]
        futures = [_part(self._array, key).read(order="C") for key in wanted]
        given = into or {}
        tiles = [Tile(self.schema, given[key] if key in given else self._record()) for key in wanted]

        def unpack(start: int, stop: int) -> None:
            for n in range(start, stop):
                with translated(self._at(wanted[n])):
                    transposed(_words(futures[n].result()), tiles[n].record.view("<u8"))

        in_slices(unpack, len(wanted))
        return dict(zip(wanted, tiles, strict=True))

    def update(self, keys: Iterable[TileKey], change: Change) -> int:
        """Read tiles, let `change` alter them, and commit; durable on return. Return how many records changed.

        Each tile is committed whole or not at all, and only if nobody wrote it in between. When some were written by
        others the rest is committed and those are done again: `change` must bear that.

        Raises:
            MapError: A stored tile is damaged; nothing is written over it.
            StorageError: The store is full or read-only, or too many writers fight over a tile.
        """
        wanted = [*keys]
        counts = dict.fromkeys(wanted, 0)
        for attempt in range(_ATTEMPTS):
            transaction = ts.Transaction(repeatable_read=True)
            try:
                with self._store.locked([f"{self.prefix}{chunk_name(key)}" for key in wanted]):
                    changed = self._stage(transaction, wanted, change)
                    for key, count in changed.items():
                        counts[key] = max(counts[key], count)
                    if any(changed.values()):
                        with translated(self._where):
                            transaction.commit_async().result()
                    else:
                        transaction.abort()
                return sum(counts.values())
            except Conflict:  # in a bucket, or with a writer that is not ours
                transaction.abort()
                time.sleep(random.random() * _WAIT * 2 ** min(attempt, 6))
            except BaseException:
                transaction.abort()
                raise
        raise StorageError(
            f"{self._where} is fought over", expected=f"a commit within {_ATTEMPTS} tries", fix="write less often"
        )

    def drop(self, key: TileKey) -> None:
        """Remove a tile."""
        with self._store.locked([f"{self.prefix}{chunk_name(key)}"]), translated(self._at(key)):
            self._kv.write(chunk_name(key), None).result()

    def replace(self, tiles: dict[TileKey, Tile]) -> None:
        """Write tiles as they are, whatever was there; durable on return."""
        with self._store.locked([f"{self.prefix}{chunk_name(key)}" for key in tiles]), translated(self._where):
            futures = [_part(self._array, key).write(self._packed(tile)) for key, tile in tiles.items()]
            for future in futures:
                future.result()

    def _stage(self, transaction: Any, keys: list[TileKey], change: Change) -> dict[TileKey, int]:
        """Put the changed tiles into a transaction; return the records changed of each."""
        array = self._array.with_transaction(transaction)
        futures = [_part(array, key).read(order="C") for key in keys]
        counts: dict[TileKey, int] = {}

        def alter(start: int, stop: int) -> None:
            for n in range(start, stop):
                tile = Tile(self.schema, self._record())
                with translated(self._at(keys[n])):
                    transposed(_words(futures[n].result()), tile.record.view("<u8"))
                counts[keys[n]] = change(keys[n], tile)
                if counts[keys[n]]:
                    with translated(self._at(keys[n])):
                        _part(array, keys[n]).write(
                            self._packed(tile), can_reference_source_data_indefinitely=True
                        ).result()

        in_slices(alter, len(keys))
        return counts

    def _record(self) -> np.ndarray:
        return np.empty((TILE * TILE, self.schema.planes), np.uint8)

    def _packed(self, tile: Tile) -> np.ndarray:
        planes = np.empty((self.schema.planes, TILE * TILE), np.uint8)
        transposed(tile.record.view("<u8"), planes.view("<u8"))
        return planes.reshape(-1, TILE, TILE)

    def _at(self, key: TileKey) -> str:
        return f"{self._where}/{chunk_name(key)}"


def chunk_name(key: TileKey) -> str:
    """Return the name of a tile's chunk in its array."""
    return f"c.{key.floor + ORIGIN[0]}.0.{key.x + ORIGIN[1]}.{key.y + ORIGIN[2]}"


def array_metadata(schema: MapSchema) -> dict[str, Any]:
    """Return the Zarr v3 metadata of a layer."""
    codecs: list[dict[str, Any]] = [
        {"name": "bytes"},
        {"name": "zstd", "configuration": {"level": 1, "checksum": False}},
        {"name": "crc32c"},
    ]
    return {
        "shape": [SHAPE[0], schema.planes, SHAPE[1] * TILE, SHAPE[2] * TILE],
        "data_type": "uint8",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [1, schema.planes, TILE, TILE]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
        "fill_value": 0,
        "codecs": codecs,
        "dimension_names": ["floor", "plane", "x", "y"],
        "attributes": schema.attributes(),
    }


def _part(array: Any, key: TileKey) -> Any:
    x, y = (key.x + ORIGIN[1]) * TILE, (key.y + ORIGIN[2]) * TILE
    return array[key.floor + ORIGIN[0], :, x : x + TILE, y : y + TILE]


def _words(planes: np.ndarray) -> np.ndarray:
    """Return planes as rows of eight bytes each."""
    return planes.reshape(len(planes), TILE * TILE).view("<u8")
