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
def transposed(source, out):
    """Write source[i, j] to out[j, i], in blocks that fit the first cache."""
    rows, columns = source.shape
    for i0 in range(0, rows, 64):
        for j0 in range(0, columns, 64):
            for i in range(i0, min(i0 + 64, rows)):
                for j in range(j0, min(j0 + 64, columns)):
                    out[j, i] = source[i, j]
