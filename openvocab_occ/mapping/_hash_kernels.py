"""A hash table of packed keys with open addressing, and sums over the rows it names.

Two arrays of one length, a power of two: `table` holds keys, `rows` what they map to, -1 where the place is empty.
"""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel


@kernel
@no_type_check
def _slot(table, rows, key):
    """Return where `key` is in the table, or would be. Fibonacci hashing."""
    mask = len(table) - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    at = np.int64((mixed ^ (mixed >> np.uint64(29))) & np.uint64(mask))
    while rows[at] >= 0 and table[at] != key:
        at = (at + 1) & mask
    return at


@kernel
@no_type_check
def look_up(table, rows, keys, out):
    """Write the row of each key, -1 where the table has none."""
    for i in range(len(keys)):
        out[i] = rows[_slot(table, rows, keys[i])]


@kernel
@no_type_check
def insert(keys, count, out_table, out_rows, out):
    """Write the row of each key, giving those not yet there the rows from `count` on; return the new count.

    The table must have room.
    """
    for i in range(len(keys)):
        at = _slot(out_table, out_rows, keys[i])
        if out_rows[at] < 0:
            out_table[at], out_rows[at] = keys[i], count
            count += 1
        out[i] = out_rows[at]
    return count


@kernel
@no_type_check
def add_shares(rows, source, share, sums, out):
    """Add share[i] sums[source[i]] to out[rows[i]], for all i in order."""
    for i in range(len(rows)):
        r, s, f = rows[i], source[i], share[i]
        for c in range(sums.shape[1]):
            out[r, c] += f * sums[s, c]
