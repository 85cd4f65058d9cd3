"""Kernels between logits and the bytes of a chunk."""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel


@kernel
@no_type_check
def quantise(logits, top, start, stop, out):
    """Write `top` for the first largest logit of a row, and top exp(-d / 2) for one that is d below it.

    No other logit gets `top`, so that the largest stays the largest.
    """
    for n in range(start, stop):
        best = 0
        for c in range(1, logits.shape[1]):
            if logits[n, c] > logits[n, best]:
                best = c
        for c in range(logits.shape[1]):
            below = np.float64(logits[n, best]) - logits[n, c]
            out[n, c] = np.uint8(min(top - 1.0, np.rint(top * np.exp(-0.5 * below))))
        out[n, best] = top


@kernel
@no_type_check
def _block(source, i, j, out):
    """Write 8 x 8 bytes of source to out, eight at a time: out[j, i / 8] holds source[i:i + 8, j], the first lowest."""
    for b in range(j, j + 8):
        word = np.uint64(0)
        for a in range(8):
            word |= np.uint64(source[i + a, b]) << np.uint64(8 * a)
        out[b, i >> 3] = word


@kernel
@no_type_check
def transposed(source, out):
    """Write bytes source[i, j] to bytes [j, i] of out, which is given as little-endian words; sides are multiples of 8.

    The longer side runs fastest: strides of 4096 bytes fall into one set of the first cache, which holds eight lines.
    """
    rows, columns = source.shape
    if columns > rows:
        for i in range(0, rows, 8):
            for j in range(0, columns, 8):
                _block(source, i, j, out)
    else:
        for j in range(0, columns, 8):
            for i in range(0, rows, 8):
                _block(source, i, j, out)
