"""Positions in 8 bytes: 21 bits an axis, between the corners of their box.

They tell which Gaussian was which after a PLY was edited; a 2 millionth of the box is closer than that
needs, also where a few floaters make the box a thousand times larger than what is looked at.
"""

import numpy as np

from langsplat_core.arrays import Array

BITS = 21
NOWHERE = np.uint64(2**64 - 1)  # of a position that is not finite
_STEPS = 2**BITS - 1


def pack_positions(means: Array) -> tuple[Array, Array]:
    """(N, 3) float32 -> (N,) uint64 and (2, 3) float32 lower and upper corner of what is finite."""
    finite = np.isfinite(means).all(1)
    if not finite.any():
        return np.full(len(means), NOWHERE), np.zeros((2, 3), np.float32)
    corners = np.stack([means[finite].min(0), means[finite].max(0)]).astype(np.float32)
    low, span = _box(corners)
    steps = np.rint((means[finite].astype(np.float64) - low) / span * _STEPS).astype(np.uint64)
    packed = np.full(len(means), NOWHERE)
    packed[finite] = steps[:, 0] | steps[:, 1] << np.uint64(BITS) | steps[:, 2] << np.uint64(2 * BITS)
    return packed, corners


def unpack_positions(packed: Array, corners: Array) -> Array:
    """The inverse, (N, 3) float64 to half a `step` on each axis; NaN for what was not finite."""
    low, span = _box(corners)
    axes = [(packed >> np.uint64(shift)) & np.uint64(_STEPS) for shift in (0, BITS, 2 * BITS)]
    means = np.stack(axes, 1).astype(np.float64) / _STEPS * span + low
    means[packed == NOWHERE] = np.nan
    return means


def step(corners: Array) -> float:
    """Largest distance between two neighbouring packed numbers, in the units of the positions."""
    return float(_box(corners)[1].max() / _STEPS)


def _box(corners: Array) -> tuple[Array, Array]:
    """Lower corner and extent, float64; an axis without extent gets 1."""
    low, high = corners.astype(np.float64)
    return low, np.where(high > low, high - low, 1.0)
