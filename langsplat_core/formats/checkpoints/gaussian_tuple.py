"""The tuple of a Gaussian model, as 3D Gaussian Splatting saves it and others extend it.

    index  element                                        shape
    0      active SH degree                               whole number
    1      positions                                      (N, 3)
    2, 3   SH coefficients: the constant one, the others  (N, 1, 3), (N, K - 1, 3)
    4      natural logarithms of scales                   (N, 3)
    5      rotations w x y z, any length                  (N, 4)
    6      logits of opacities                            (N, 1)
    7...   what a method adds, then the optimiser's state

It is wrapped as (tuple, iteration). How many elements follow tells nothing: two methods add two each.
"""

from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.formats.checkpoints.unpickling import plain_array
from langsplat_core.formats.inria_layout import REST_COUNTS
from langsplat_core.scene import Gaussians

GEOMETRY = 7  # elements that every method has


def model_tuple(content: Any) -> tuple[Any, ...] | None:
    """The elements of a Gaussian model in what a file holds; None where it is something else."""
    if isinstance(content, (tuple, list)) and len(content) == 2 and isinstance(content[0], (tuple, list)):
        content = content[0]
    if not isinstance(content, (tuple, list)) or len(content) <= GEOMETRY:
        return None
    return tuple(content) if isinstance(content[0], int) else None


def gaussians_of(elements: tuple[Any, ...], path: Path) -> Gaussians:
    """The Gaussians in elements 1 to 6. Raises FormatError where one has another shape."""
    means = _element(elements, 1, (None, 3), "positions (N, 3)", path)
    count = len(means)
    base = _element(elements, 2, (count, 1, 3), f"base colours ({count}, 1, 3)", path)
    rest = _element(elements, 3, (count, None, 3), f"SH coefficients ({count}, K, 3)", path)
    if 3 * rest.shape[1] not in REST_COUNTS:
        raise FormatError(
            f"{path}: {rest.shape[1]} SH coefficients beside the constant; expected 0, 3, 8, 15"
        )
    return Gaussians(
        means,
        _element(elements, 4, (count, 3), f"log scales ({count}, 3)", path),
        _element(elements, 5, (count, 4), f"rotations ({count}, 4)", path),
        _element(elements, 6, (count, 1), f"opacities ({count}, 1)", path)[:, 0],
        np.concatenate([base, rest], axis=1),
    )


def _element(
    elements: tuple[Any, ...], index: int, shape: tuple[int | None, ...], wanted: str, path: Path
) -> Array:
    array = plain_array(elements[index], path)
    if array is None or array.dtype.kind != "f":
        raise FormatError(f"{path}: element {index} holds no {wanted}; is it a checkpoint of Gaussians?")
    fits = array.ndim == len(shape) and all(
        size in (None, actual) for size, actual in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise FormatError(f"{path}: element {index} has the shape {array.shape}; expected {wanted}")
    return np.asarray(array, np.float32)
