"""What the window's process keeps of memory, and gives back; on Linux, elsewhere nothing happens."""

import ctypes
import re
import sys
from collections.abc import Iterator
from pathlib import Path

_ARENA_MAX = -8  # M_ARENA_MAX of malloc.h
_PAGE_OUT = 21  # MADV_PAGEOUT of asm-generic/mman-common.h; Linux before 5.4 refuses it
# Compilers of kernels and, in software drivers of OpenGL, of shaders: needed only while one is loaded.
_COMPILERS = re.compile(r"^(\w+)-(\w+) r.*/lib(?:llvmlite|LLVM)\b.*$", re.MULTILINE)


def share_one_heap() -> None:
    """Have threads that begin after this take memory from one heap, where the C library allows it: with one
    each, all of them keep what they have freed."""
    _in_c_library("mallopt", _ARENA_MAX, 1)


def give_memory_back() -> None:
    """Return to the system what the C library keeps of memory that was freed, where it can (reading a scene
    leaves tens of megabytes of it), and the code of compilers: what is needed of it again is read again from
    its file."""
    _in_c_library("malloc_trim", 0)
    for start, size in _compilers():
        _in_c_library("madvise", ctypes.c_void_p(start), ctypes.c_size_t(size), _PAGE_OUT)


def _compilers() -> Iterator[tuple[int, int]]:
    """Address and size of every stretch of memory that shows one of their files."""
    if sys.platform != "linux":
        return
    for start, end in _COMPILERS.findall(Path("/proc/self/maps").read_text(errors="replace")):
        yield int(start, 16), int(end, 16) - int(start, 16)


def _in_c_library(name: str, *arguments: object) -> None:
    if sys.platform == "linux":
        function = getattr(ctypes.CDLL(None), name, None)  # not every C library has the first two
        if function is not None:
            function(*arguments)
