"""Kernels: compiled by numba, kept on disk, run on all cores.

A kernel works on items [first, last) of something and releases Python's lock; `Workers` cuts the range into
pieces and hands them to threads. Compared with numba's own parallel loops this compiles twice as fast,
balances uneven pieces, and lets two Python threads render at the same time.

Machine code is kept by numba's own cache: in `$NUMBA_CACHE_DIR` where that is set, else beside the source,
else in the user's cache folder. numba looks at a kernel's own file only; here code is stale once any file of
this package changes that the kernel imports, directly or not.
"""

import hashlib
import logging
import os
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite.binding import add_symbol
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.runtime import _nrt_python as runtime

from langsplat_core.arrays import Array, check_array

log = logging.getLogger("langsplat")

_PIECES_PER_THREAD = 4
_SEEN = "0.68."  # numba whose kept code calls nothing but what `load_overload` names; a missing name crashes
_PACKAGE = Path(__file__).resolve().parent
_IMPORT = re.compile(rf"^\s*from {_PACKAGE.name}([\w.]*) import (\([^)]*\)|.*)$", re.MULTILINE)


def helper(function: Callable[..., Any], **options: Any) -> Any:
    """Compile `function` into the kernels that call it. options: as of `kernel`."""
    return numba.njit(forceinline=True, error_model="numpy", **options)(function)


def kernel(function: Callable[..., Any], shapes: str = "", **options: Any) -> Any:
    """Compile `function` at its first call, or take the machine code of an earlier process.

    shapes: of arguments whose arrays may come from files, "values M D, table.steps M": a kernel reads beyond
    an array that is too short, so `Workers` compares them before it runs one. options: further ones of
    `numba.njit`, such as `fastmath`.
    """
    made = numba.njit(nogil=True, error_model="numpy", **options)(function)
    if shapes:
        _SHAPES[made] = [tuple(entry.split()) for entry in shapes.split(",")]
    try:
        made._cache = _KernelCache(function)  # noqa: SLF001  numba has no other way to it
    except RuntimeError:
        _say_once("no folder for them can be written to; set NUMBA_CACHE_DIR to one that can")
    return made


_SHAPES: dict[Any, list[tuple[str, ...]]] = {}  # of kernels: name of an argument, and letters of its axes


def _check_shapes(compiled: Any, arguments: Sequence[Any]) -> None:
    """Raise ValueError where arguments behind the first two are not of the shapes that a kernel states."""
    names = compiled.py_func.__code__.co_varnames[2:]
    given, dims = dict(zip(names, arguments, strict=False)), dict[str, int]()
    for name, *axes in _SHAPES[compiled]:
        argument, _, part = name.partition(".")
        array = getattr(given[argument], part) if part else given[argument]
        dims = check_array(name, array, tuple(axes), dims)


class _KernelFiles(IndexDataCacheFile):
    """Names files by signature: numba numbers them, and processes at once would take each other's numbers."""

    def save(self, key: Any, data: Any) -> None:
        overloads = self._load_index()
        if key not in overloads:
            overloads[key] = self._data_name(zlib.crc32(repr(key[:2]).encode()))
            self._save_index(overloads)
        self._save_data(overloads[key], data)


class _KernelCache(FunctionCache):
    """The machine code of one kernel, one set of files whatever becomes of its sources."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        source = Path(function.__code__.co_filename)
        digest = digest_of_sources(source)
        self._cache_file = _KernelFiles(self.cache_path, f"{source.stem}.{function.__name__}", digest)
        # Looked at before the index, whose types may be gone, is unpickled.
        self._cache_file._version = f"{numba.__version__} {digest}"  # noqa: SLF001

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return code that is kept, else None. numba would set up compiling first: 26 MB, 0.2 seconds."""
        if not numba.__version__.startswith(_SEEN):
            return super().load_overload(sig, target_context)
        for name, address in runtime.c_helpers.items():  # all that kept code calls of numba's runtime
            add_symbol(name if name.startswith("_") else f"NRT_{name}", address)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def save_overload(self, *overload: Any) -> None:
        """Keep code; on a full disk the next process compiles it again. numba leaves no half files."""
        try:
            super().save_overload(*overload)
        except OSError as error:
            _say_once(str(error.strerror))


def is_compiled(kernel: Any) -> bool:
    """Return True where an earlier process has left machine code of `kernel` as its sources are now."""
    kept = kernel._cache  # noqa: SLF001
    return isinstance(kept, _KernelCache) and bool(kept._cache_file._load_index())  # noqa: SLF001


@cache
def _say_once(reason: str) -> None:
    log.warning("kernels are compiled for this run only, which takes some seconds: %s", reason)


@cache
def digest_of_sources(source: Path) -> str:
    """Digest of a file and all files of this package that it imports, directly or not."""
    found, waiting = set(), [source.resolve()]  # however it is reached
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imported(path.read_text(encoding="utf-8"))
    digest = hashlib.sha256()
    for path in sorted(found):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _imported(text: str) -> Iterator[Path]:
    """Yield the package's files that a source imports, whatever else it imports."""
    for module, names in _IMPORT.findall(text):
        base = _PACKAGE.joinpath(*module.split(".")[1:])
        for candidate in (base, *(base / name for name in re.findall(r"\w+", names))):
            yield from (p for p in (candidate.with_suffix(".py"), candidate / "__init__.py") if p.is_file())


def plain(array: Array) -> Array:
    """Return contiguous, writeable float32, a copy where need be: numba compiles once per type."""
    return np.require(array, np.float32, ["C", "W"])


class Workers:
    """A pool of threads; created idle, it costs nothing until used."""

    def __init__(self, threads: int | None = None) -> None:
        """`threads` defaults to the number of cores this process may use."""
        self.threads = threads or numba.config.NUMBA_DEFAULT_NUM_THREADS
        self._begin()

    def _begin(self) -> None:
        self._pool, self._process = ThreadPoolExecutor(self.threads, "kernels"), os.getpid()

    def run(self, compiled: Callable[..., Any], count: int, *arguments: Any) -> list[Any]:
        """Return what compiled(first, last, *arguments) returns, in order, for pieces of range(count)."""
        if compiled in _SHAPES:
            _check_shapes(compiled, arguments)
        pieces = min(count, self.threads * _PIECES_PER_THREAD if self.threads > 1 else 1)
        edges = [count * i // max(pieces, 1) for i in range(max(pieces, 1) + 1)]
        return self.each(compiled, [(*edge, *arguments) for edge in pairwise(edges)])

    def each(self, compiled: Callable[..., Any], calls: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Run compiled(*call) for every call; return what they return.

        The caller's thread takes calls too: handing one over and waiting for it costs more than small ones.
        """
        if len(calls) <= 1 or self.threads <= 1:
            return [compiled(*call) for call in calls]
        if self._process != os.getpid():  # after a fork, which takes no threads along
            self._begin()
        left, results = iter(range(len(calls))), [None] * len(calls)

        def take() -> None:
            for number in left:
                results[number] = compiled(*calls[number])

        jobs = [self._pool.submit(take) for _ in range(min(self.threads, len(calls)) - 1)]
        take()
        for job in jobs:
            if not job.cancel():  # it has not begun: others were faster
                job.result()
        return results


@cache
def shared_workers(threads: int | None = None) -> Workers:
    """Return the process's only pool of so many threads, however many rasterizers there are."""
    return Workers(threads)
