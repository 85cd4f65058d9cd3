"""Packed keys in order of arrival, found by hashing."""

import numpy as np
from jaxtyping import Int32, Int64

from openvocab_occ.mapping import _hash_kernels as kernels

_SMALLEST = 1 << 12


class KeyTable:
    """Gives each different key a row, counted from 0. Finding and adding take the same time however many there are."""

    def __init__(self) -> None:
        self._table = np.zeros(_SMALLEST, dtype=np.int64)
        self._rows = np.full(_SMALLEST, -1, dtype=np.int32)
        self._keys = np.empty(_SMALLEST // 2, dtype=np.int64)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def keys(self) -> Int64[np.ndarray, " n"]:
        """The keys by row; a view that may not be written to."""
        keys = self._keys[: self._count]
        keys.flags.writeable = False
        return keys

    def find(self, packed: Int64[np.ndarray, " m"]) -> Int32[np.ndarray, " m"]:
        """Return the row of each key, -1 where there is none."""
        found = np.empty(len(packed), dtype=np.int32)
        kernels.look_up(self._table, self._rows, packed, found)
        return found

    def insert(self, packed: Int64[np.ndarray, " m"]) -> Int32[np.ndarray, " m"]:
        """Return the row of each key; keys not there yet, which may repeat, get the next rows in order."""
        rows = np.empty(len(packed), dtype=np.int32)
        for start in range(0, len(packed), _SMALLEST):  # in parts, so that repeats do not blow up the table
            part = packed[start : start + _SMALLEST]
            self._reserve(self._count + len(part))
            before = self._count
            self._count = int(kernels.insert(part, before, self._table, self._rows, rows[start : start + len(part)]))
            fresh = rows[start : start + len(part)] >= before
            self._keys[rows[start : start + len(part)][fresh]] = part[fresh]
        return rows

    def _reserve(self, count: int) -> None:
        """Keep the table at most half full."""
        if 2 * count <= len(self._table):
            return
        length = 1 << int(4 * count - 1).bit_length()
        self._table, self._rows = np.zeros(length, dtype=np.int64), np.full(length, -1, dtype=np.int32)
        kernels.insert(self._keys[: self._count], 0, self._table, self._rows, np.empty(self._count, dtype=np.int32))
        keys = np.empty(length // 2, dtype=np.int64)
        keys[: self._count] = self._keys[: self._count]
        self._keys = keys
