"""Greedy choice of leaders from a matrix of similarities."""

from typing import no_type_check

from openvocab_occ._jit import kernel


@kernel
@no_type_check
def choose_leaders(similar, least, out, out_leaders):
    """Give each row the first leader it is similar to, or make it one; return how many leaders there are."""
    count = 0
    for i in range(len(similar)):
        out[i] = -1
        for k in range(count):
            if similar[i, out_leaders[k]] >= least:
                out[i] = k
                break
        if out[i] < 0:
            out[i], out_leaders[count] = count, i
            count += 1
    return count
