"""CLIP vectors of the regions of a photograph."""

from typing import Protocol

import numpy as np
from scipy import ndimage

from langsplat_core.arrays import Array
from langsplat_core.semantics.crops import masked_crop


class ImageEncoder(Protocol):
    """The image half of a CLIP model, with its name."""

    @property
    def id(self) -> str:
        """Hub id or folder."""

    @property
    def image_size(self) -> int:
        """Side of the pictures it takes, px."""

    def encode_images(self, crops: Array) -> Array:
        """(M, S, S, 3) uint8 -> (M, D) float32 unit vectors."""


def embed_regions(image: Array, label_maps: Array, encoder: ImageEncoder) -> Array:
    """(M, D) float32 unit vectors of the M regions that `label_maps` numbers.

    image: (H, W, 3) uint8; label_maps: (3, H, W) int32 as of `masks.label_maps`. A region is shown as it
    is visible in its map, on black; where masks of one level overlap, LangSplat shows the covered part too.
    """
    crops = np.zeros((int(label_maps.max()) + 1, encoder.image_size, encoder.image_size, 3), np.uint8)
    for labels in label_maps:
        for row, box in enumerate(ndimage.find_objects(labels + 1)):
            if box is not None:  # a row of another level
                crops[row] = masked_crop(image[box], labels[box] == row, encoder.image_size)
    return encoder.encode_images(crops)
