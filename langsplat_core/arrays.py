"""Small numerical helpers shared by every layer. NumPy only."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

Array = np.ndarray[Any, np.dtype[Any]]


def check_array(
    name: str,
    array: Array,
    shape: tuple[int | str, ...],
    dims: dict[str, int] | None = None,
    dtype: type | None = None,
    finite: bool = False,
) -> dict[str, int]:
    """Require `array` to have `shape`; letters in the shape must agree with `dims`, or are bound now.

    Returns the letters bound so far, so that calls can be chained over the fields of one object. Raises
    TypeError for a wrong dtype and ValueError for a wrong shape, and for numbers that are not finite where
    they must be, all naming the array: ``scales: expected shape (N, 3) with {'N': 6}, got (5, 3)``.
    """
    dims = dict(dims or {})
    if not isinstance(array, np.ndarray):
        raise TypeError(f"{name}: expected a NumPy array, got {type(array).__name__}")
    if dtype is not None and array.dtype != dtype:
        raise TypeError(f"{name}: expected {np.dtype(dtype).name}, got {array.dtype.name}")
    expected = ", ".join(str(size) for size in shape)
    problem = f"{name}: expected shape ({expected}) with {dims}, got {array.shape}"
    if array.ndim != len(shape):
        raise ValueError(problem)
    for size, actual in zip(shape, array.shape, strict=True):
        if dims.setdefault(size, actual) != actual if isinstance(size, str) else size != actual:
            raise ValueError(problem)
    if finite and not np.isfinite(array).all():
        raise ValueError(f"{name}: some are not finite, and would spoil all that they blend with")
    return dims


def pieces(count: int, size: int) -> list[slice]:
    """Return the slices that take `count` rows `size` at a time, so that what is made of them fits memory."""
    return [slice(start, start + size) for start in range(0, count, size)]


def sigmoid(x: Array) -> Array:
    """Logistic function, exact at +-infinity and free of overflow; dtype is kept."""
    x = np.asarray(x)
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0, e).astype(x.dtype) / (1 + e)


def logit(p: Array) -> Array:
    """Inverse of `sigmoid`; 0 and 1 give -infinity and +infinity."""
    p = np.asarray(p)
    with np.errstate(divide="ignore"):
        return np.log(p) - np.log1p(-p)


def unit(vectors: Array, epsilon: float = 1e-6) -> Array:
    """Scale the last axis to length 1. A vector shorter than `epsilon` stays short, never NaN."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, epsilon)


def across(direction: Array) -> Array:
    """Return (3,) a direction at a right angle to one (3,), of any length but zero."""
    return np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])


def decimals_of(lengths: Array, least: int) -> int:
    """Return the decimals that lengths are rounded to: the largest keeps `least` significant digits."""
    largest = np.abs(lengths).max(initial=0.0)
    return least if not 0 < largest < 0.1 else least - int(np.floor(np.log10(largest)))


def length_text(lengths: ArrayLike, between: str = " ", least: int = 3, origin: Array | float = 0.0) -> str:
    """Return lengths as text, all with as many decimals: see `decimals_of`; places from an origin with it."""
    values = np.atleast_1d(np.asarray(lengths, np.float64))
    decimals = decimals_of(values, least)
    return between.join(f"{value:.{decimals}f}" for value in values + origin)


def near_power(length: float) -> float:
    """Return the power of two nearest to `length` > 0, a unit to compute in that rounds nothing."""
    return float(np.exp2(np.round(np.log2(length))))


def mean_squared_error(a: Array, b: Array) -> float:
    """Return the mean squared difference of two arrays of one shape."""
    return float(np.mean((a.astype(np.float64) - b) ** 2))


def psnr(a: Array, b: Array) -> float:
    """Peak signal-to-noise ratio of two images with values in [0, 1], dB; at most 100, for equal ones."""
    return float(-10 * np.log10(max(mean_squared_error(a, b), 1e-10)))


@dataclass(frozen=True)
class ViewScore:
    """Scores of one photograph's reproduction."""

    name: str
    psnr: float  # dB
    ssim: float
    covered: float  # share of its pixels that the Gaussians cover by half and more
    psnr_exposed: float | None = None  # dB, with the exposure of each half fitted on the other
    psnr_small: float | None = None  # dB at 320 px, where trainings on photographs of any size compare


def rotation_matrices(quats_wxyz: Array) -> Array:
    """Return (..., 3, 3) rotations of (..., 4) quaternions in order w, x, y, z, of any length but zero."""
    w, x, y, z = np.moveaxis(unit(quats_wxyz, 1e-30), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def affine(linear: Array, offset: Array) -> Array:
    """Return the (4, 4) matrix of the map x -> linear @ x + offset, a (3, 3) matrix and (3,) numbers."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, offset
    return matrix


def quaternions(rotations: Array) -> Array:
    """Return (..., 4) float64 unit quaternions wxyz, w >= 0, of (..., 3, 3) rotations."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(np.asarray(rotations, np.float64), (-2, -1), (0, 1))
    rows = [  # 4 q q^T: each row is the quaternion times one of its numbers; the longest loses the least
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    products = np.stack([np.stack(row, -1) for row in rows], -2)
    largest = np.diagonal(products, axis1=-2, axis2=-1).argmax(-1)[..., None, None]
    found = unit(np.take_along_axis(products, largest, -2)[..., 0, :])
    return np.where(found[..., :1] < 0, -found, found)


def linear_light(display: Array) -> Array:
    """Return what display values of sRGB, in [0, 1], are in linear light (IEC 61966-2-1)."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
