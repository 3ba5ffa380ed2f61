"""Where the time goes, and how right the picture is: what the panel "Timing" knows."""

import math
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import numpy as np

from langsplat_core.arrays import Array

KEPT = 31  # measurements of which the median is told
STEPS = {  # names of laps, and what they are called; in the order of the panel
    "projection": "Projection",
    "sort": "Sort",
    "blend": "Blend",
    "upload": "Upload",
    "compose": "Compose",
    "picture": "Picture, all of it",
    "panels": "Panels",
    "search": "Search",
}


@dataclass(frozen=True)
class Comparison:
    """What is shown against the reference, at a small size; errors in display values, 0 to 255."""

    size: tuple[int, int]  # pixels
    largest: int
    mean: float
    psnr: float  # dB; infinite where they are the same
    backend: str  # that was compared


def compared(shown: Array, reference: Array, backend: str) -> Comparison:
    """Of two (H, W, C) uint8 pictures of one size."""
    errors = np.abs(shown.astype(np.float64) - reference)
    squared = float((errors**2).mean())
    psnr = math.inf if squared == 0 else 10 * math.log10(255**2 / squared)
    height, width = shown.shape[:2]
    return Comparison((width, height), int(errors.max()), float(errors.mean()), psnr, backend)


@dataclass(eq=False)
class Timing:
    """A part of the viewer's state."""

    wanted: bool = False  # this frame is measured: the panel is seen
    laps: dict[str, deque[float]] = field(default_factory=dict)  # milliseconds by the names of STEPS
    comparison: Comparison | None = None  # the last one

    def add(self, name: str, milliseconds: float) -> None:
        """One measurement more."""
        self.laps.setdefault(name, deque(maxlen=KEPT)).append(milliseconds)

    def medians(self) -> list[tuple[str, float]]:
        """What was measured, in words, and the median of its last measurements in milliseconds."""
        return [(title, median(self.laps[name])) for name, title in STEPS.items() if self.laps.get(name)]


def memory_bytes() -> int | None:
    """What this process holds in memory; None where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    resident = [line for line in lines if line.startswith("VmRSS:")]
    return 1024 * int(resident[0].split()[1]) if resident else None
