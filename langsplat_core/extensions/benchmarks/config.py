"""Settings of `langsplat bench raster` and `langsplat bench query`: speed against error on this machine.

And the resident memory of this process, as Linux tells it.
"""

import ctypes
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from langsplat_core.config import Count, CountOrZero, Positive, Range

Pixels = Annotated[int, Range(1, 65_536)]
Size = tuple[Pixels, Pixels]  # width and height of an image
Channels = Annotated[int, Range(1, 4_096)]  # values per Gaussian


@dataclass(frozen=True)
class RasterBenchConfig:
    """Scenes and images of the rasterizer benchmark."""

    counts: tuple[Count, ...] = (10_000, 31_000, 100_000, 200_000, 1_000_000)
    """Sizes of the random scenes, drawn at the middle one of --sizes."""
    sizes: Annotated[tuple[Size, ...], Range(1, 65_536, some=True)] = ((320, 240), (640, 480), (960, 720))
    """Widths and heights of the image, pixels; all are drawn with --pivot Gaussians."""
    pivot: Count = 200_000
    """Gaussians of the random scene that is drawn at every size."""
    channels: Annotated[tuple[Channels, ...], Range(1, 4_096, some=True)] = (3, 12)
    """Values per Gaussian."""
    scenes: tuple[Path, ...] = ()
    """Real scenes to measure beside the random ones, from their first camera, else one that frames them."""
    limit: Positive = 60.0
    """Seconds that a single call may be expected to take; what would take longer is named and left out."""


@dataclass(frozen=True)
class QueryBenchConfig:
    """Phrases that one scene is asked for, in every order of work."""

    size: Size = (1440, 1080)
    """Width and height of the image, pixels; that of the paper's figures."""
    count: CountOrZero = 0
    """Gaussians; the scene's are repeated, each beside itself, until there are so many. 0: as they are."""
    phrases: Count = 8
    """Phrases that errors are averaged and times taken over; the paper's order is timed with one."""
    together: Count = 100
    """Phrases that are asked at once, and one by one."""
    repeats: Count = 5
    """Timings of a view and an image, of which the median is taken."""
    codec_steps: Count = 3_000
    """Training steps of the autoencoder that stands beside the codebook."""


# Memory.

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def resident_memory() -> int | None:
    """Bytes of this process now; None where the system does not tell."""
    return _status("VmRSS")


def peak_memory() -> int | None:
    """Most bytes of this process since it began or since `restart_peak`.

    Not getrusage: its maximum is inherited from the parent process on Linux.
    """
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
