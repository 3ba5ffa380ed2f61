"""The library pycolmap, imported so that it leaves signals alone and its libraries keep to one thread.

Its logging library installs a handler of its own for SIGTERM, which prints a stack trace and kills the
process: what was there before is put back. Its wheel brings OpenMP (and a package of other make may bring
OpenBLAS) of its own, which ask the environment how many threads to use when they are loaded, and never again.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["pycolmap"]


@contextmanager
def _one_thread() -> Iterator[None]:
    """Have what is loaded meanwhile keep to one thread."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _handler(number: int, handler: int | None) -> int | None:
    """Set the C handler of a signal; returns what was there, as a pointer. Any thread may do this, unlike
    Python's own `signal.signal`."""
    install = ctypes.CDLL(None).signal
    install.restype, install.argtypes = ctypes.c_void_p, (ctypes.c_int, ctypes.c_void_p)
    before: int | None = install(number, handler)
    return before


if sys.platform == "win32":  # no such handler there
    with _one_thread():
        import pycolmap
else:
    _before = _handler(signal.SIGTERM, None)
    try:
        with _one_thread():
            import pycolmap
    finally:
        _handler(signal.SIGTERM, _before)
        signal.siginterrupt(signal.SIGTERM, True)  # as Python has it: a call that waits shall return
