"""SAM's layers of crops: parts of a photograph that are looked at for themselves, for masks of small things.

Source: the mask generator of segment-anything, with the settings of LangSplat's public code.
"""

from math import ceil

import numpy as np

from langsplat_core.arrays import Array

OVERLAP = 512 / 1500  # of neighbouring crops, as a share of the picture's shorter side, in the first layer
EDGE = 20.0  # px: a box that ends this near to an edge touches it


def crop_boxes(shape: tuple[int, int], layers: int) -> Array:
    """(C, 4) int64 left, top, right, bottom, px, of the whole picture and its crops; the last two exclusive.

    shape: (height, width); layer k cuts 2^k x 2^k crops that overlap. The whole picture comes first.
    """
    height, width = shape
    boxes = [(0, 0, width, height)]
    for layer in range(1, layers + 1):
        count = 2**layer
        overlap = int(OVERLAP * min(shape) * 2 / count)
        columns, rows = _spans(width, count, overlap), _spans(height, count, overlap)
        boxes += [(left, top, right, bottom) for left, right in columns for top, bottom in rows]
    return np.array(boxes, np.int64)


def _spans(length: int, count: int, overlap: int) -> list[tuple[int, int]]:
    """`count` equal pieces that cover `length` px and share `overlap` px with the next."""
    size = ceil((overlap * (count - 1) + length) / count)
    starts = [int((size - overlap) * i) for i in range(count)]
    return [(start, min(start + size, length)) for start in starts if start < length]


def cut_by_crop(boxes: Array, crop: Array, shape: tuple[int, int]) -> Array:
    """(...,) bool: whether a mask's box ends at an edge of the crop that is no edge of the picture: what it
    shows goes on outside, and the next crop or the whole picture shows it better.

    boxes: (..., 4); crop: (4,) left, top, right, bottom, px of the picture; shape: its (height, width).
    """
    picture = np.array([0, 0, shape[1], shape[0]])
    at_crop, at_picture = np.abs(boxes - crop) <= EDGE, np.abs(boxes - picture) <= EDGE
    cut: Array = (at_crop & ~at_picture).any(axis=-1)
    return cut
