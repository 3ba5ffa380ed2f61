"""Comparing a fast rasterizer with the reference: tight everywhere, a counted allowance at the cut-offs.

Image formation has steps: an alpha of just 1/255 counts or does not, a transmittance of just 1e-4 stops a
pixel or does not. Pixels where rounding may decide are the *band*; they may differ, by little, and few may.
"""

from collections.abc import Callable

import numpy as np

from langsplat_core.arrays import Array

BAND = 1e-4  # relative distance to a cut-off; float32 kernels are within about 1e-6 of it


def assert_close_off_cuts(got: Array, want: Array, band: Array, atol: float = 2e-5) -> None:
    """`got` equals `want` within `atol` outside the band; in the band at most half the pixels are off.

    The band must be small (under 2 % of the pixels), or the comparison would say little.
    """
    assert got.shape == want.shape
    assert np.isfinite(got).all()
    error = np.abs(got - want).reshape(*band.shape, -1).max(-1)
    assert band.mean() < 0.02, f"{band.sum()} of {band.size} pixels lie at a cut-off: change the scene"
    worst = float(error[~band].max(initial=0))
    assert worst <= atol, f"off by {worst:.2e} in {(error[~band] > atol).sum()} pixels away from cut-offs"
    flipped = error[band] > atol
    assert flipped.sum() <= max(0.5 * band.sum(), 1), f"{flipped.sum()} of {band.sum()} band pixels flipped"


def assert_adjoint(
    splat: Callable[[Array], Array], gather: Callable[[Array], Array], x: Array, y: Array, rtol: float = 1e-5
) -> None:
    """<W x, y> = <x, W^T y>, relative to |W x| |y|."""
    image = splat(x).astype(np.float64)
    left, right = np.vdot(image, y), np.vdot(x.astype(np.float64), gather(y))
    scale = np.linalg.norm(image) * np.linalg.norm(y)
    assert abs(left - right) <= rtol * scale, f"{left} against {right}, scale {scale}"


def assert_gradient(name: str, got: Array, want: Array, rtol: float = 1e-3) -> None:
    """Equal within `rtol` of each entry, plus 1e-5 of the largest one for float32 sums."""
    allowed = rtol * np.abs(want) + 1e-5 * np.abs(want).max()
    off = np.abs(got - want) > allowed
    assert not off.any(), f"{name}: {off.sum()} of {off.size} off, worst {np.abs(got - want).max():.2e}"
