"""Coloured points, which other programs open without knowing Gaussians."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.io.ply import CHANNELS, POSITION
from langsplat_core.io.quantised import to_bytes
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.scene.transform import C0


def base_colours(gaussians: Gaussians) -> Array:
    """Return (N, 3) float64 display values in [0, 1]: of every Gaussian, the same from all sides."""
    colours = 0.5 + C0 * gaussians.sh[:, 0].astype(np.float64)
    return np.clip(np.nan_to_num(colours), 0, 1)


def check_suffix(path: Path | str, suffixes: Sequence[str]) -> Path:
    """Return `path`; InputError unless it ends in one of `suffixes`."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: this is written as {' or '.join(suffixes)}; choose such a name")
    return path


def coloured_columns(scene: Scene, places: Array, colours: Array) -> dict[str, Array]:
    """Return columns of a PLY; places are float64 where the scene lies far away."""
    places = scene.in_world(places) if scene.origin.any() else places.astype(np.float32)
    columns = dict(zip(POSITION, places.T, strict=True))
    return columns | dict(zip(CHANNELS, to_bytes(255 * colours).T, strict=True))
