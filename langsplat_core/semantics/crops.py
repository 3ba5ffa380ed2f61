"""The picture that CLIP is shown of one mask."""

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array


def masked_crop(image: Array, mask: Array, size: int) -> Array:
    """Cut one region out: black outside the mask, bounding box, centred on a black square, resized.

    image: (H, W, 3) uint8; mask: (H, W) bool with at least one pixel set; size: side of the result, px.
    Returns (size, size, 3) uint8. Bilinear, with antialiasing when shrinking. This is the crop of the
    method's public code (LangSplat `preprocess.py`), which the encoder must also be trained with.
    Raises ValueError for an empty mask, which has no bounding box.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        raise ValueError("masked_crop: the mask is empty")
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    patch = np.where(mask[box][..., None], image[box], np.uint8(0))
    height, width = patch.shape[:2]
    side = max(height, width)
    square = np.zeros((side, side, 3), np.uint8)
    top, left = (side - height) // 2, (side - width) // 2
    square[top : top + height, left : left + width] = patch
    if side == size:
        return square
    return np.asarray(Image.fromarray(square).resize((size, size), Image.Resampling.BILINEAR))
