"""Resident memory of this process, as Linux tells it."""

import ctypes
import re
import sys
from pathlib import Path

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def resident_memory() -> int | None:
    """Bytes of this process now; None where the system does not tell."""
    return _status("VmRSS")


def peak_memory() -> int | None:
    """Most bytes of this process since it began or since `restart_peak`. Not getrusage: its maximum is
    inherited from the parent process on Linux."""
    return _status("VmHWM")


def restart_peak() -> int | None:
    """Give free pages back and forget the peak; returns the bytes now, None where that cannot be done."""
    if not (sys.platform.startswith("linux") and _CLEAR.exists()):
        return None
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc has it
    try:
        if trim is not None:
            trim(0)
        _CLEAR.write_text("5")
    except OSError:
        return None
    return resident_memory()


def _status(key: str) -> int | None:
    try:
        found = re.search(rf"{key}:\s*(\d+) kB", _STATUS.read_text())
    except OSError:
        return None
    return int(found[1]) * 1024 if found else None
