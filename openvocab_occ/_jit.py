"""How kernels are compiled, and how they are spread over the cores.

Kernels release the GIL and are called on slices of their work by a pool of plain threads. Unlike numba's own
threading layers this may be done from many Python threads at once (a viewer, a test runner), needs no OpenMP or TBB,
never spins against another library's threads, and survives a fork.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from typing import Any

import numba

kernel: Callable[..., Any] = numba.njit(nogil=True, cache=True, error_model="numpy", fastmath=False)
"""Decorator of every kernel, above `@typing.no_type_check` (the shape checks of the tests cannot be compiled).

Keep a kernel and all it calls in one file: numba's cache does not see edits in other files.
"""

_num_threads: ContextVar[int | None] = ContextVar("openvocab_occ_num_threads", default=None)
_pool: ThreadPoolExecutor | None = None


def num_threads() -> int:
    """Threads that kernels may use: the cores this process may run on, unless set by `limit_threads`."""
    return _num_threads.get() or len(
        os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    )


@contextmanager
def limit_threads(count: int) -> Iterator[None]:
    """Use `count` threads within this block, in this thread of Python."""
    token = _num_threads.set(count)
    try:
        yield
    finally:
        _num_threads.reset(token)


def _forget_pool() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)  # a forked child inherits the pool but none of its threads


def in_slices(work: Callable[[int, int], Any], count: int, *, grain: int = 1) -> None:
    """Call `work(start, stop)` on slices of range(count) that are at least `grain` long, on several threads."""
    global _pool
    threads = max(1, min(num_threads(), count // max(grain, 1)))
    if threads == 1:
        work(0, count)
        return
    if _pool is None:
        _pool = ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="openvocab_occ")
    # a few slices a thread, because slices of a picture differ in cost
    edges = [count * i // (4 * threads) for i in range(4 * threads + 1)]
    jobs = [(a, b) for a, b in pairwise(edges) if b > a]
    shared = iter(jobs)  # list iterators hand out each job once, also to several threads

    def drain() -> None:
        for start, stop in shared:
            work(start, stop)

    for future in [_pool.submit(drain) for _ in range(threads)]:
        future.result()
