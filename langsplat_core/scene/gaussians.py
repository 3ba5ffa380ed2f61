"""The Gaussians of a scene, stored as the INRIA PLY stores them: raw, not activated."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, check_array

SH_COUNTS = {0: 1, 1: 4, 2: 9, 3: 16}  # degree -> coefficients per colour channel
LARGEST_COEFFICIENT = 1e20  # of the spherical harmonics: sums of sixteen and their gradients fit a float32


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N anisotropic Gaussians as a structure of float32 arrays. Rows may be invalid (NaN, zero
    quaternion): backends drop and count them, nothing here repairs them silently."""

    means: Array  # (N, 3) world units
    log_scales: Array  # (N, 3) natural logarithm of world units; -inf is a flat axis
    quats_wxyz: Array  # (N, 4) any non-zero length, normalised on use
    opacity_logits: Array  # (N,) +-inf allowed: opacity 1 and 0
    sh: Array  # (N, K, 3) spherical harmonics, K = 1, 4, 9 or 16; colour = 0.5 + SH(direction)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = np.ascontiguousarray(getattr(self, field.name), dtype=np.float32)
            object.__setattr__(self, field.name, value)
        dims = check_array("means", self.means, ("N", 3))
        check_array("log_scales", self.log_scales, ("N", 3), dims)
        check_array("quats_wxyz", self.quats_wxyz, ("N", 4), dims)
        check_array("opacity_logits", self.opacity_logits, ("N",), dims)
        check_array("sh", self.sh, ("N", "K", 3), dims)
        if self.sh.shape[1] not in SH_COUNTS.values():
            raise ValueError(f"sh: expected 1, 4, 9 or 16 coefficients, got {self.sh.shape[1]}")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """0 to 3."""
        return {count: degree for degree, count in SH_COUNTS.items()}[self.sh.shape[1]]

    def take(self, rows: Array) -> "Gaussians":
        """The Gaussians at `rows`: indices or a boolean mask of length N."""
        return Gaussians(*(getattr(self, field.name)[rows] for field in fields(self)))

    def valid(self) -> Array:
        """(N,) True where a row can be drawn: finite mean, a non-zero finite quaternion, scales and colours
        that are not NaN or so large that they overflow, an opacity that is not NaN."""
        usable = np.ones(len(self), bool)
        for _, sound in self._requirements():
            usable &= sound
        return usable

    def invalid_rows(self) -> dict[str, int]:
        """Why rows are not valid: reason -> count, for those reasons that occur.

        A row counts once, under its first reason, so that the counts add up to the rows dropped.
        """
        counts = {}
        unexplained = np.ones(len(self), bool)
        for reason, sound in self._requirements():
            faulty = unexplained & ~sound
            unexplained &= sound
            if faulty.any():
                counts[reason] = int(faulty.sum())
        return counts

    def _requirements(self) -> tuple[tuple[str, Any], ...]:
        """What a row must fulfil to be drawn: name of the fault, (N,) True where there is none."""
        with np.errstate(over="ignore", invalid="ignore"):
            length_squared = (self.quats_wxyz.astype(np.float64) ** 2).sum(1)
            sound_colour = (np.abs(self.sh) <= LARGEST_COEFFICIENT).all((1, 2))
        return (
            ("position not finite", np.isfinite(self.means).all(1)),
            # exp(88.7) overflows float32; NaN compares False
            ("scale not a number or above e^80", (self.log_scales <= 80).all(1)),
            ("rotation zero or not finite", np.isfinite(length_squared) & (length_squared > 1e-24)),
            ("opacity not a number", ~np.isnan(self.opacity_logits)),
            ("colour not finite or above 1e20", sound_colour),
        )
