"""How the CPU backend compiles its kernels and runs them on all cores.

A kernel works on items [first, last) of something and releases Python's lock; `Workers` cuts the range into
pieces and hands them to threads. Compared with numba's own parallel loops this compiles twice as fast,
balances uneven pieces, and two Python threads may render at the same time (one of numba's threading layers
aborts the process then).

Compiled code is cached on disk. numba notices a change in a kernel's own file only: after changing a helper
in another file, delete the `*.nbi` files in `__pycache__`.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numba import njit

from langsplat_core.arrays import Array

kernel = njit(cache=True, nogil=True, error_model="numpy")
helper = njit(forceinline=True, error_model="numpy")  # compiled into the kernels that call it

_PIECES_PER_THREAD = 4


def plain(array: Array) -> Array:
    """The array as float32, contiguous and writeable: one type for numba, which compiles once per type.

    Only a read-only array is copied for that reason; kernels never write to their inputs.
    """
    return np.require(array, np.float32, ["C", "W"])


class Workers:
    """A pool of threads; created idle, it costs nothing until used."""

    def __init__(self, threads: int | None = None) -> None:
        """`threads` defaults to the number of cores this process may use."""
        self.threads = threads or _cores()
        self._pool = ThreadPoolExecutor(self.threads, "rasterizer")

    def run(self, compiled: Callable[..., None], count: int, *arguments: Any) -> None:
        """compiled(first, last, *arguments) for pieces [first, last) that cover range(count)."""
        pieces = min(count, self.threads * _PIECES_PER_THREAD if self.threads > 1 else 1)
        if pieces <= 1:
            compiled(0, count, *arguments)
            return
        edges = [count * i // pieces for i in range(pieces + 1)]
        jobs = [self._pool.submit(compiled, edges[i], edges[i + 1], *arguments) for i in range(pieces)]
        for job in jobs:
            job.result()


@cache
def shared_workers(threads: int | None = None) -> Workers:
    """One pool per number of threads for the whole process, however many rasterizers there are."""
    return Workers(threads)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return max(len(os.sched_getaffinity(0)), 1)
    return os.cpu_count() or 1
