"""Intrinsics: the inner geometry of a pinhole camera, on a pixel grid of a certain size."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths and principal point. Sizes may be fractions where no picture is meant."""

    width: float  # pixels, > 0
    height: float
    fx: float  # pixels, > 0
    fy: float
    cx: float  # pixels from the left edge; the first pixel's centre is at 0.5
    cy: float  # pixels from the top edge

    def __post_init__(self) -> None:
        if not (self.width > 0 and self.height > 0):
            raise ValueError(f"a picture of {self.width}x{self.height} pixels")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and min(self.fx, self.fy) > 0):
            raise ValueError("focal lengths must be positive and the principal point finite")

    def resized(self, width: float, height: float) -> "Intrinsics":
        """The same camera on another pixel grid over the same picture."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    def fitted(self, width: float, height: float) -> "Intrinsics":
        """The same camera in a window that holds its whole picture, centred, as large as it goes, with
        square pixels kept square."""
        scale = min(width / self.width, height / self.height)
        cx = (self.cx - self.width / 2) * scale + width / 2
        cy = (self.cy - self.height / 2) * scale + height / 2
        return Intrinsics(width, height, self.fx * scale, self.fy * scale, cx, cy)

    @property
    def fov_degrees(self) -> float:
        """Angle of view across the shorter side."""
        return math.degrees(2 * math.atan(0.5 * min(self.width, self.height) / min(self.fx, self.fy)))
