"""Kernels between logits and the bytes of a chunk."""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel


@kernel
@no_type_check
def quantise(logits, reach, start, stop, out):
    """Write 255 for the first largest logit of a row, and for one d below it 255 (1 - sqrt(d / reach)), down to 0.

    No other logit gets 255, so that the largest stays the largest.
    """
    for n in range(start, stop):
        best = 0
        for c in range(1, logits.shape[1]):
            if logits[n, c] > logits[n, best]:
                best = c
        for c in range(logits.shape[1]):
            below = (np.float64(logits[n, best]) - logits[n, c]) / reach
            out[n, c] = np.uint8(min(254.0, np.rint(255.0 * (1.0 - np.sqrt(min(below, 1.0))))))
        out[n, best] = 255


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
