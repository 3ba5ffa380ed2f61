"""Kernels: compiled by numba, kept on disk, run on all cores.

A kernel works on items [first, last) of something and releases Python's lock; `Workers` cuts the range into
pieces and hands them to threads. Compared with numba's own parallel loops this compiles twice as fast,
balances uneven pieces, and two Python threads may render at the same time (one of numba's threading layers
aborts the process then).

Compiled code is kept on disk. numba notices a change in a kernel's own file only, and a kernel is made of
helpers and constants of other files too: so every kernel's folder is named by a digest of its file and of all
files of this package that it imports, directly or not.
"""

import atexit
import hashlib
import logging
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core.compiler_lock import global_compiler_lock

from langsplat_core.arrays import Array

try:
    import fcntl
except ImportError:  # Windows; there processes that begin at once compile the same twice
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger("langsplat")

_PIECES_PER_THREAD = 4
_PACKAGE = Path(__file__).resolve().parent
_compiling: set[Path] = set()  # locks that this process holds
_IMPORT = re.compile(rf"^\s*from {_PACKAGE.name}([\w.]*) import (\([^)]*\)|.*)$", re.MULTILINE)


def helper(function: Callable[..., Any], **options: Any) -> Any:
    """Compile `function` into the kernels that call it. options: as of `kernel`."""
    return numba.njit(forceinline=True, error_model="numpy", **options)(function)


def kernel(function: Callable[..., Any], **options: Any) -> Any:
    """Compile `function` at its first call, or take the machine code of an earlier process.

    options: further ones of `numba.njit`, such as `fastmath`.
    """
    folder = kernel_folder(Path(function.__code__.co_filename))
    with _cache_folder(folder) if folder else nullcontext():
        made = numba.njit(cache=folder is not None, nogil=True, error_model="numpy", **options)(function)
    if folder:
        cache_of_it = made._cache  # noqa: SLF001  numba has no other way to it
        cache_of_it.save_overload = partial(_kept_if_there_is_room, cache_of_it.save_overload)
        made.compile = partial(_compiled_once, folder / f"{function.__name__}.lock", made.compile)
    return made


def _compiled_once(lock: Path, compiled: Callable[..., Any], signature: Any) -> Any:
    """Compile a kernel, or wait for the process that does and take its machine code: numba's index knows no
    locks, and processes that compile at once would mix up their files."""
    with global_compiler_lock, ExitStack() as held:  # in this order in every thread
        if fcntl is not None and lock not in _compiling:
            _compiling.add(lock)
            held.callback(_compiling.discard, lock)
            with suppress(OSError):  # a full disk, or a file system that knows no locks
                file = held.enter_context(lock.open("ab"))
                fcntl.flock(file, fcntl.LOCK_EX)
                held.callback(fcntl.flock, file, fcntl.LOCK_UN)
        return compiled(signature)


def _kept_if_there_is_room(save: Callable[..., None], *overload: Any) -> None:
    """Keep a kernel's machine code; on a full disk the next process compiles it again.

    numba renames what it wrote, so that nothing is left half.
    """
    try:
        save(*overload)
    except OSError as error:
        _say_once(f"kernels are compiled for this run only, which takes some seconds: {error.strerror}")


@cache
def _say_once(text: str) -> None:
    log.warning(text)


def kernel_folder(source: Path) -> Path | None:
    """Folder of the machine code of the kernels in `source`: below `$NUMBA_CACHE_DIR` where that is set,
    else beside the package, else in the user's cache folder: the first of these that can be written to. Where
    none can, in a folder of this process alone, which is said once; None where there is not even that."""
    root = _cache_root(numba.config.CACHE_DIR)
    if root is None:
        return None
    source = source.resolve()
    inside = source.is_relative_to(_PACKAGE)
    name = ".".join(source.relative_to(_PACKAGE).with_suffix("").parts) if inside else source.stem
    return root / name / digest_of_sources(source)


def is_compiled(source: Path) -> bool:
    """Return True where an earlier process has left machine code of the kernels in `source` as they are
    now."""
    folder = kernel_folder(source)
    return folder is not None and any(folder.rglob("*.nbc"))


@cache
def _cache_root(given: str) -> Path | None:
    """Return the first folder that can be written to; `given`: as the user asked for, or empty."""
    places = [Path(given)] if given else [_PACKAGE / "__pycache__" / "kernels", *_user_cache()]
    found = next(filter(_is_writable, places), None)
    if found is not None:
        return found
    log.warning(
        "kernels are compiled for this run only, which takes some seconds: %s cannot be written to; set "
        "NUMBA_CACHE_DIR to a folder that can",
        " and ".join(map(str, places)),
    )
    try:
        private = Path(tempfile.mkdtemp(prefix="langsplat-kernels-"))
    except OSError:
        return None
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    return private


def _user_cache() -> list[Path]:
    """Return the user's cache folder; none for users without a home."""
    try:
        cache_home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return []
    return [Path(cache_home) / "langsplat" / "kernels"]


def _is_writable(folder: Path) -> bool:
    """Return True where files can be made in `folder`, which is made if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


@cache
def digest_of_sources(source: Path) -> str:
    """Digest of a file and all files of this package that it imports."""
    digest = hashlib.sha256()
    for path in sorted(_with_imports(source)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def _with_imports(source: Path) -> set[Path]:
    """`source` and the files of this package that it imports, directly or not."""
    found, waiting = set(), [source]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imported(path.read_text(encoding="utf-8"))
    return found


def _imported(text: str) -> Iterator[Path]:
    """Return the package's files that a source imports.

    Names of a module that are no files are passed over.
    """
    for module, names in _IMPORT.findall(text):
        base = _PACKAGE.joinpath(*module.split(".")[1:])
        candidates = [base, *(base / name for name in re.findall(r"\w+", names))]
        for candidate in candidates:
            yield from (p for p in (candidate.with_suffix(".py"), candidate / "__init__.py") if p.is_file())


@contextmanager
def _cache_folder(folder: Path) -> Iterator[None]:
    """numba puts the code of functions decorated meanwhile into `folder`.

    Where that lies beside the package, the code of older sources goes.
    """
    if folder.is_relative_to(_PACKAGE) and not folder.exists():
        for older in folder.parent.glob("*"):
            if older != folder:  # another process may have made it meanwhile
                shutil.rmtree(older, ignore_errors=True)
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder)
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


def plain(array: Array) -> Array:
    """The array as float32, contiguous and writeable: one type for numba, which compiles once per type. Only
    a read-only array is copied for that reason; kernels never write to their inputs."""
    return np.require(array, np.float32, ["C", "W"])


class Workers:
    """A pool of threads; created idle, it costs nothing until used."""

    def __init__(self, threads: int | None = None) -> None:
        """`threads` defaults to the number of cores this process may use."""
        self.threads = threads or _cores()
        self._begin()

    def _begin(self) -> None:
        self._pool, self._process = ThreadPoolExecutor(self.threads, "kernels"), os.getpid()

    def run(self, compiled: Callable[..., Any], count: int, *arguments: Any) -> list[Any]:
        """compiled(first, last, *arguments) for pieces [first, last) that cover range(count), in order; what
        they return."""
        pieces = min(count, self.threads * _PIECES_PER_THREAD if self.threads > 1 else 1)
        edges = [count * i // max(pieces, 1) for i in range(max(pieces, 1) + 1)]
        return self.each(compiled, [(*edge, *arguments) for edge in pairwise(edges)])

    def each(self, compiled: Callable[..., Any], calls: Sequence[tuple[Any, ...]]) -> list[Any]:
        """compiled(*call) for every call; what they return."""
        if len(calls) <= 1 or self.threads <= 1:
            return [compiled(*call) for call in calls]
        if self._process != os.getpid():  # after a fork, which takes no threads along
            self._begin()
        jobs = [self._pool.submit(compiled, *call) for call in calls]
        return [job.result() for job in jobs]


@cache
def shared_workers(threads: int | None = None) -> Workers:
    """One pool per number of threads for the whole process, however many rasterizers there are."""
    return Workers(threads)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return max(len(os.sched_getaffinity(0)), 1)
    return os.cpu_count() or 1
