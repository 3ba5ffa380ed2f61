"""Relevancy maps and masks that another system rendered, as files.

    <view>/<phrase>.npy                  float (L, H, W) or (H, W) relevancy; L levels, at most three
    <view>/<phrase>.<level>.npy|.png     or one file per level: subpart, part, whole; any of them
    <view>/<phrase>.png                  a single map; for protocol direct-3d the drawn silhouette instead

A PNG of 8 or 16 bits holds relevancy from 0 to 1. A "/" in a phrase is "_" in its file's name. Maps of one
phrase have one size; it need not be the labels', whose masks are then brought to it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.parsing.npy import read_npy
from langsplat_core.parsing.pictures import opened
from langsplat_core.scene import LEVELS


@dataclass(frozen=True, eq=False)
class RelevancyMaps:
    """One phrase in one view."""

    maps: Array  # (L, H, W) float64, finite
    levels: tuple[int, ...]  # (L,) indices into LEVELS


def file_name(phrase: str) -> str:
    """The stem of a phrase's files."""
    return phrase.replace("/", "_")


def read_relevancy(folder: Path, phrase: str) -> RelevancyMaps | None:
    """The maps of `phrase` in a view's `folder`; None where there is none. FormatError for a damaged one."""
    name = file_name(phrase)
    whole = _existing(folder, name)
    if whole is not None:
        maps = _read(whole)
        maps = maps[None] if maps.ndim == 2 else maps
        return RelevancyMaps(maps, tuple(range(len(maps))))
    files = {level: _existing(folder, f"{name}.{word}") for level, word in enumerate(LEVELS)}
    there = {level: path for level, path in files.items() if path is not None}
    if not there:
        return None
    singles = {path: _read(path) for path in there.values()}
    first = next(iter(singles.values()))
    for path, values in singles.items():
        if values.ndim != 2 or values.shape != first.shape:
            raise FormatError(
                f"{path}: shape {values.shape}; the levels of one phrase are (H, W) of one size"
            )
    return RelevancyMaps(np.stack(list(singles.values())), tuple(there))


def _existing(folder: Path, name: str) -> Path | None:
    return next((path for s in (".npy", ".png") if (path := folder / f"{name}{s}").is_file()), None)


def _read(path: Path) -> Array:
    values = read_npy(path) if path.suffix == ".npy" else _picture(path)
    if values.ndim not in (2, 3) or 0 in values.shape or (values.ndim == 3 and len(values) > len(LEVELS)):
        raise FormatError(
            f"{path}: shape {values.shape}; expected (H, W), or (L, H, W) with at most 3 levels"
        )
    if not np.isfinite(values).all():
        raise FormatError(f"{path}: holds numbers that are not finite")
    return values.astype(np.float64)


def _picture(path: Path) -> Array:
    """(H, W) in [0, 1]."""
    with opened(path) as picture:
        if picture.mode.startswith("I"):
            return np.asarray(picture, np.float64) / 65535
        return np.asarray(picture.convert("L"), np.float64) / 255
