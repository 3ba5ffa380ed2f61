"""Squares in place of masks: what the method is without a segmenter."""

import json

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.progress import Progress
from langsplat_core.semantics.masks import LevelMasks

SIDES = (1 / 16, 1 / 8, 1 / 4)  # of the picture's height, at the levels subpart, part, whole


class TileMasks:
    """A `semantics.masks.MaskSource` that looks at nothing: a grid of squares at each level."""

    name = "tiles"
    key = json.dumps(["tiles", 1, SIDES])

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """The grids of an image (H, W, 3)."""
        subpart, part, whole = (_grid(image.shape[0], image.shape[1], share) for share in SIDES)
        progress("tiles", 1.0)
        scores = [np.ones(len(masks), np.float32) for masks in (subpart, part, whole)]
        return LevelMasks((subpart, part, whole), (scores[0], scores[1], scores[2]))


def _grid(height: int, width: int, share: float) -> Array:
    """(M, H, W) bool: squares from the upper left; the last ones may be cut off."""
    side = max(round(share * height), 1)
    rows, columns = np.arange(height) // side, np.arange(width) // side
    number = rows[:, None] * (columns[-1] + 1) + columns
    return np.asarray(number == np.arange(number.max() + 1)[:, None, None])
