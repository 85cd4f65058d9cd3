"""Kernels between logits and the bytes of a chunk."""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

_LARGEST = np.float32(np.finfo(np.float32).max)


def _crc_table() -> np.ndarray:
    """Return uint32[8, 256]: what a byte does to a CRC-32C (Castagnoli, reflected), n bytes further on in row n."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ np.uint32(0x82F63B78), table >> 1)
    rows = [table]
    for _ in range(7):
        rows.append(rows[-1] >> 8 ^ table[rows[-1] & 255])
    return np.stack(rows)


CRC_TABLE = _crc_table()


@kernel
@no_type_check
def crc32c(data, table):
    """Return the CRC-32C of bytes, eight at a time."""
    crc = np.uint32(0xFFFFFFFF)
    eights = len(data) // 8 * 8
    for n in range(0, eights, 8):
        crc = (
            table[7, data[n] ^ (crc & 255)]
            ^ table[6, data[n + 1] ^ (crc >> 8 & 255)]
            ^ table[5, data[n + 2] ^ (crc >> 16 & 255)]
            ^ table[4, data[n + 3] ^ (crc >> 24)]
            ^ table[3, data[n + 4]]
            ^ table[2, data[n + 5]]
            ^ table[1, data[n + 6]]
            ^ table[0, data[n + 7]]
        )
    for n in range(eights, len(data)):
        crc = np.uint32(crc >> 8) ^ table[0, (crc ^ data[n]) & 255]
    return crc ^ np.uint32(0xFFFFFFFF)


@kernel
@no_type_check
def quantise(logits, mask, table, steps, top, start, stop, row, flat, out):
    """Write the codes of rows start..stop where `mask` to out, from `row` on, and their numbers to flat.

    `top` for the first largest logit of a row, table[d steps] for one that is d below it, beyond the table's end its
    last code. No other logit gets `top`, so that the largest stays the largest. Returns how many rows are not finite.
    """
    last = np.float32(len(table) - 1)
    bad = 0
    for n in range(start, stop):
        if not mask[n]:
            continue
        best = 0
        high = logits[n, 0]
        finite = True
        for c in range(logits.shape[1]):
            value = logits[n, c]
            finite &= abs(value) <= _LARGEST
            if value > high:
                best, high = c, value
        if finite:
            for c in range(logits.shape[1]):
                out[row, c] = table[int(min(last, (high - logits[n, c]) * steps + np.float32(0.5)))]
            out[row, best] = top
        bad += not finite
        flat[row] = n
        row += 1
    return bad
