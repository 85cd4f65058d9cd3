"""Kernels between logits and the bytes of a chunk."""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

_STRIP = 64  # bytes: a cache line
_HALF, _PAIR, _BYTE = np.uint64(0x00000000FFFFFFFF), np.uint64(0x0000FFFF0000FFFF), np.uint64(0x00FF00FF00FF00FF)
_4, _2, _1 = np.uint64(32), np.uint64(16), np.uint64(8)


@kernel
@no_type_check
def quantise(logits, table, steps, top, start, stop, out):
    """Write `top` for the first largest logit of a row, and table[d steps] for one that is d below it.

    No other logit gets `top`, so that the largest stays the largest. Beyond the table's end is its last code.
    """
    last = np.float32(len(table) - 1)
    for n in range(start, stop):
        best = 0
        for c in range(1, logits.shape[1]):
            if logits[n, c] > logits[n, best]:
                best = c
        high = logits[n, best]
        for c in range(logits.shape[1]):
            out[n, c] = table[int(min(last, (high - logits[n, c]) * steps + np.float32(0.5)))]
        out[n, best] = top


@kernel
@no_type_check
def _swap(high, low, shift, mask):
    """Exchange the upper of each pair of parts of one word for the lower of another."""
    moved = ((high >> shift) ^ low) & mask
    return high ^ (moved << shift), low ^ moved


@kernel
@no_type_check
def _block(source, row, word, out):
    """Write a block of 8 x 8 bytes transposed, eight bytes at a time."""
    a, b, c, d = source[row, word], source[row + 1, word], source[row + 2, word], source[row + 3, word]
    e, f, g, h = source[row + 4, word], source[row + 5, word], source[row + 6, word], source[row + 7, word]
    if a | b | c | d | e | f | g | h:
        a, e = _swap(a, e, _4, _HALF)
        b, f = _swap(b, f, _4, _HALF)
        c, g = _swap(c, g, _4, _HALF)
        d, h = _swap(d, h, _4, _HALF)
        a, c = _swap(a, c, _2, _PAIR)
        b, d = _swap(b, d, _2, _PAIR)
        e, g = _swap(e, g, _2, _PAIR)
        f, h = _swap(f, h, _2, _PAIR)
        a, b = _swap(a, b, _1, _BYTE)
        c, d = _swap(c, d, _1, _BYTE)
        e, f = _swap(e, f, _1, _BYTE)
        g, h = _swap(g, h, _1, _BYTE)
    to, at = word * 8, row >> 3
    out[to, at], out[to + 1, at], out[to + 2, at], out[to + 3, at] = a, b, c, d
    out[to + 4, at], out[to + 5, at], out[to + 6, at], out[to + 7, at] = e, f, g, h


@kernel
@no_type_check
def transposed(source, out):
    """Write a matrix of bytes transposed; both are given as rows of little-endian words, sides are multiples of 8.

    The longer side is walked in strips of a cache line: rows 4096 bytes apart fall into one set of the first cache,
    which holds eight lines, so that no more than eight are read or written at once.
    """
    rows, words = source.shape
    if words * 8 > rows:
        for strip in range(0, words, _STRIP // 8):
            for row in range(0, rows, 8):
                for word in range(strip, min(strip + _STRIP // 8, words)):
                    _block(source, row, word, out)
    else:
        for strip in range(0, rows, _STRIP):
            for word in range(words):
                for row in range(strip, min(strip + _STRIP, rows), 8):
                    _block(source, row, word, out)
