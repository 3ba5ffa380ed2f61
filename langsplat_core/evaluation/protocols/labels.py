"""What the benchmarks label: phrases in frames, and where they are true. Masks are drawn when asked for."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from PIL import Image, ImageDraw

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.parsing.pictures import PHOTO_SUFFIXES, opened

Size = tuple[int, int]  # width and height, pixels
SAME_SHAPE = 0.02  # relative difference of aspect up to which two sizes may be of one picture


class Truth(Protocol):
    """Where something is in a frame."""

    def draw(self, size: Size) -> Array:
        """(H, W) bool on a grid of `size`; by the nearest pixel where that is not the label's own grid."""


@dataclass(frozen=True, eq=False)
class Outlines:
    """Polygons on the label's grid; several of one category in a frame are joined."""

    size: Size
    polygons: tuple[Array, ...]  # (K, 2) float x, y each, K >= 3

    def draw(self, size: Size) -> Array:
        """See `Truth`. Corners are cut to whole pixels and the outline belongs to the inside."""
        canvas = Image.new("L", self.size)
        brush = ImageDraw.Draw(canvas)
        for polygon in self.polygons:
            brush.polygon([(int(x), int(y)) for x, y in polygon], fill=1, outline=1)
        return resized(np.asarray(canvas) > 0, size)


@dataclass(frozen=True)
class MaskFile:
    """A picture that is bright inside."""

    path: Path

    def draw(self, size: Size) -> Array:
        """See `Truth`. Bright is above half of 255, or above 0 where the file holds no more than 0 and 1."""
        grey = read_grey(self.path)
        return resized(grey > (127 if grey.max(initial=0) > 1 else 0), size)


@dataclass(frozen=True, eq=False)
class Label:
    """One phrase that is asked in one frame."""

    phrase: str
    truth: Truth
    boxes: (
        Array | None
    )  # (B, 4) left, top, right, bottom on the label's grid, inclusive; None: no place is scored


@dataclass(frozen=True, eq=False)
class Frame:
    """A labelled view."""

    name: str  # of its photograph, without extension; dots inside belong to it
    size: Size  # of the label's grid
    labels: tuple[Label, ...]
    photograph: Path | None = None  # to draw on


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """A scene of a benchmark."""

    name: str
    frames: tuple[Frame, ...]
    dataset: Path  # where its photographs and cameras lie, if it has them
    left_out: tuple[str, ...] = ()  # labels that cannot be asked, each "frame: phrase (why)"


@dataclass(frozen=True, eq=False)
class Benchmark:
    """All scenes that a folder holds."""

    name: str
    scenes: Mapping[str, LabelledScene]


def read_grey(path: Path) -> Array:
    """(H, W) uint8 brightness of a picture file; FormatError where it cannot be read."""
    with opened(path) as picture:
        return np.asarray(picture.convert("L"))


def resized(mask: Array, size: Size) -> Array:
    """(H, W) bool on a grid of `size`, each pixel the nearest one's."""
    if mask.shape == (size[1], size[0]):
        return mask
    picture = Image.fromarray(mask.astype(np.uint8))
    return np.asarray(picture.resize(size, Image.Resampling.NEAREST)) > 0


def check_same_picture(frame: str, drawn: Size, labelled: Size) -> None:
    """InputError where a map or camera cannot show the labelled picture: another shape."""
    (columns, rows), (width, height) = drawn, labelled
    slack = max(SAME_SHAPE * width * rows, width, height, columns, rows)  # a pixel of rounding is allowed
    if abs(columns * height - width * rows) > slack:
        raise InputError(
            f"frame {frame}: the view is {columns}x{rows}, the labels are {width}x{height}: not of one "
            "picture; use views and labels of the same photographs"
        )


def without_suffix(name: str) -> str:
    """A view's name without a photograph's extension; other dots stay."""
    stem, dot, suffix = name.rpartition(".")
    return stem if dot and f".{suffix.lower()}" in PHOTO_SUFFIXES else name


def photograph_of(folder: Path, name: str) -> Path | None:
    """The photograph called `name` in a folder, whatever its kind."""
    candidates = (folder / f"{name}{suffix}" for suffix in (*PHOTO_SUFFIXES, ".JPG", ".JPEG", ".PNG"))
    return next((path for path in candidates if path.is_file()), None)
