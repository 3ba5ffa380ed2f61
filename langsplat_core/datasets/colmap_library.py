"""pycolmap, imported so that it leaves signals alone.

Its logging library installs a handler of its own for SIGTERM, which prints a stack trace and kills the
process. Whatever was there before is put back. Import `pycolmap` from here.
"""

import ctypes
import signal
import sys

__all__ = ["pycolmap"]


def _handler(number: int, handler: int | None) -> int | None:
    """Set the C handler of a signal; returns what was there, as a pointer. Any thread may do this, unlike
    Python's own `signal.signal`."""
    install = ctypes.CDLL(None).signal
    install.restype, install.argtypes = ctypes.c_void_p, (ctypes.c_int, ctypes.c_void_p)
    before: int | None = install(number, handler)
    return before


if sys.platform == "win32":  # no such handler there
    import pycolmap
else:
    _before = _handler(signal.SIGTERM, None)
    try:
        import pycolmap
    finally:
        _handler(signal.SIGTERM, _before)
        signal.siginterrupt(signal.SIGTERM, True)  # as Python has it: a call that waits shall return
