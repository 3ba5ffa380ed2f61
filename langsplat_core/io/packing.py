"""Codes that several formats of small files share.

They are bytes, quaternions without their largest component, and the signs of Gaussians along mirrored axes.
"""

import numpy as np

from langsplat_core.arrays import Array, unit

# Components beside the largest, by its index
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
# Whether each spherical harmonic from degree 1 on is odd in x, y, z
_ODD = np.array(
    [
        *([0, 1, 0], [0, 0, 1], [1, 0, 0]),
        *([1, 1, 0], [0, 1, 1], [0, 0, 0], [1, 0, 1], [0, 0, 0]),
        *([0, 1, 0], [1, 1, 1], [0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 0, 1], [1, 0, 0]),
    ],
    dtype=bool,
)


def to_bytes(values: Array) -> Array:
    """Round numbers and clip them to uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def smallest_three(three: Array, largest: Array) -> Array:
    """Return (N, 4) unit quaternions from their (N, 3) components other than the largest.

    largest: (N,) index of that one, which is positive.
    """
    out = np.empty((len(three), 4))
    rows = np.arange(len(three))[:, None]
    out[rows, OTHERS[largest]] = three
    out[rows[:, 0], largest] = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
    return out


def without_largest(quats: Array) -> tuple[Array, Array]:
    """Return (N, 3) components and (N,) index for `smallest_three`, of (N, 4) quaternions of any length."""
    turns = unit(quats.astype(np.float64), 1e-30)
    largest = np.abs(turns).argmax(axis=1)
    turns *= np.where(np.take_along_axis(turns, largest[:, None], 1) < 0, -1, 1)
    return np.take_along_axis(turns, OTHERS[largest], axis=1), largest


def quaternion_signs(signs: Array) -> Array:
    """Return the (4,) signs of w x y z where the axes have the (3,) `signs`.

    Mirroring an axis turns the two rotations about the others round.
    """
    return np.array([1, signs[1] * signs[2], signs[0] * signs[2], signs[0] * signs[1]])


def coefficient_signs(signs: Array, count: int) -> Array:
    """Return the (count,) signs of the coefficients from degree 1 on where the axes have the (3,) `signs`."""
    return np.where(_ODD, signs, 1).prod(axis=1)[:count]
