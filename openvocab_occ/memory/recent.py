"""Decoded tiles that a writer is likely to write again."""

import threading
from collections import OrderedDict
from collections.abc import Mapping

from openvocab_occ.memory.schema import Tile

_LIMIT = 64 * 2**20  # bytes; a window of 80 m touches some 30 MB of tiles


class Recent:
    """Tiles by name, each with the chunk it was stored as; for several threads."""

    def __init__(self) -> None:
        self._tiles: OrderedDict[str, tuple[bytes, Tile]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def take(self, name: str, stored: bytes) -> Tile | None:
        """Give a tile away, to be altered, if it is what is stored."""
        with self._lock:
            chunk, tile = self._tiles.pop(name, (b"", None))
            self._bytes -= tile.record.nbytes if tile else 0
        return tile if chunk == stored else None

    def keep(self, tiles: Mapping[str, tuple[bytes, Tile]]) -> None:
        """Take tiles that are not altered any more."""
        with self._lock:
            for name, (chunk, tile) in tiles.items():
                before = self._tiles.pop(name, None)
                self._bytes += tile.record.nbytes - (before[1].record.nbytes if before else 0)
                self._tiles[name] = chunk, tile
            while self._bytes > _LIMIT:
                self._bytes -= self._tiles.popitem(last=False)[1][1].record.nbytes
