"""What segmenters of the SAM family do alike: a picture is seen once and then asked about points."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array

PIXEL_MEAN = (123.675, 116.28, 103.53)  # ImageNet's, values 0..255; of every model here
PIXEL_STD = (58.395, 57.12, 57.375)
LEVELS = 3  # masks per point


@dataclass(frozen=True, eq=False)
class Look:
    """A picture as a model has seen it."""

    model: Any  # a transformers model
    seen: Mapping[str, Any]  # arguments of the model that stand for the picture
    side: int  # of the square that the model sees, px
    size: tuple[int, int] | None  # (height, width) of the picture in it; None where it fills the square
    shape: tuple[int, int]  # (height, width) of the picture itself, px
    ordered: bool  # whether the three answers to a point are subpart, part, whole, in this order

    def ask(self, points: Array) -> tuple[Any, Any]:
        """(P, 2) float32 points x, y, px of the picture -> (P, 3) predicted IoU and (P, 3, h, w) logits, low
        resolution, of the masks subpart, part, whole at each point."""
        import torch

        height, width = self.size or (self.side, self.side)
        scaled = points * np.array([width / self.shape[1], height / self.shape[0]], np.float32)
        given = torch.from_numpy(scaled)[None, :, None].to(self.model.device)
        answer = self.model(**self.seen, input_points=given, multimask_output=True)
        ious, logits = answer.iou_scores[0], answer.pred_masks[0]
        return (ious, logits) if self.ordered else by_area(ious, logits)

    def enlarge(self, logits: Any) -> Any:
        """(B, h, w) low-resolution logits -> (B, H, W) of the picture."""
        return upscale(logits, self.side, self.size, self.shape)


class Segmenter(Protocol):
    """A model that finds masks at points."""

    @property
    def name(self) -> str:
        """What the user is told, such as "SAM 2"."""

    def look(self, image: Array) -> Look:
        """See (H, W, 3) uint8 once."""


def by_area(ious: Any, logits: Any) -> tuple[Any, Any]:
    """The (P, 3) scores and (P, 3, h, w) masks of each point from the smallest mask to the largest."""
    import torch

    order = torch.argsort((logits > 0).flatten(2).sum(2), dim=1, stable=True)
    points = torch.arange(len(order), device=order.device)[:, None]
    return ious[points, order], logits[points, order]


def padded(image: Array, side: int) -> tuple[Array, tuple[int, int]]:
    """Scale the longer side of (H, W, 3) uint8 to `side`, normalise, pad with zeros to the right and below.

    Returns (1, 3, side, side) float32 and the (height, width) of the picture in it, px.
    """
    height, width = image.shape[:2]
    scale = side / max(height, width)
    size = max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5))
    pixels = np.zeros((side, side, 3), np.float32)
    pixels[: size[0], : size[1]] = _normalised(image, size)
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[None]), size


def squashed(image: Array, side: int) -> Array:
    """(H, W, 3) uint8 -> (1, 3, side, side) float32, normalised; a picture's proportions are lost."""
    return np.ascontiguousarray(_normalised(image, (side, side)).transpose(2, 0, 1)[None])


def _normalised(image: Array, size: tuple[int, int]) -> Array:
    resized = Image.fromarray(image).resize((size[1], size[0]), Image.Resampling.BILINEAR)
    scaled: Array = (np.asarray(resized, np.float32) - PIXEL_MEAN) / PIXEL_STD
    return scaled.astype(np.float32)


def upscale(logits: Any, side: int, size: tuple[int, int] | None, shape: tuple[int, int]) -> Any:
    """(B, h, w) low-resolution logits of the square -> (B, H, W) of the photograph; `size` as in `Look`."""
    from torch.nn.functional import interpolate

    square = logits[:, None].float()
    if size is not None:  # the padding can only be cut off at the resolution of its pixels
        square = interpolate(square, (side, side), mode="bilinear", align_corners=False)
        square = square[..., : size[0], : size[1]]
    return interpolate(square, shape, mode="bilinear", align_corners=False)[:, 0]
