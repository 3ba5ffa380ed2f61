"""Masks by a model of the SAM family: a grid of points, three masks a point, filtered.

The three answers to one point are taken as the levels subpart, part and whole (LangSplat section 3.1). The
picture is seen once, as a whole; the method's public code, not its paper, sees 2 x 2 crops of it too.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import MaskConfig
from langsplat_core.progress import Progress
from langsplat_core.semantics.crop_layers import crop_boxes, cut_by_crop
from langsplat_core.semantics.mask_filters import box_nms, clean_regions, mask_boxes, mask_nms
from langsplat_core.semantics.masks import LevelMasks
from langsplat_core.semantics.segmenter import LEVELS, Look, Segmenter
from langsplat_core.semantics.segmenters import load_segmenter

VERSION = 2
MASKS_AT_ONCE = 16  # full-size masks of float logits held at one time


def load_sam(config: MaskConfig, device: str = "auto") -> "SamMasks":
    """Load the weights that `config.sam` names: a folder in Hugging Face layout or a hub id.

    Raises EncoderError where they are absent or are not those of a SAM.
    """
    return SamMasks(load_segmenter(config.sam, device), config)


@dataclass(frozen=True, eq=False)
class Proposal:
    """A mask that passed the model's own scores."""

    level: int
    bits: Array  # (ceil(h w / 8),) uint8, packed, of its box: thousands of masks are held at once
    box: Array  # (4,) left, top, right, bottom, px; right and bottom exclusive
    predicted_iou: float
    stability: float
    crop_area: int = 0  # px, of the crop that it was found in

    def mask(self, shape: tuple[int, int]) -> Array:
        """(H, W) bool: the mask in a picture of `shape`."""
        left, top, right, bottom = self.box
        size = bottom - top, right - left
        mask = np.zeros(shape, bool)
        mask[top:bottom, left:right] = np.unpackbits(self.bits, count=size[0] * size[1]).reshape(size)
        return mask


class SamMasks:
    """A `MaskSource` that asks a segmenter."""

    def __init__(self, segmenter: Segmenter, config: MaskConfig) -> None:
        self._segmenter = segmenter
        self._config = config

    @property
    def name(self) -> str:
        """See `MaskSource`."""
        return f"{self._segmenter.name} {self._config.sam}"

    @property
    def key(self) -> str:
        """See `MaskSource`. The size of batches changes no result."""
        settings = asdict(self._config) | {"source": "sam", "points_per_batch": 0}
        return json.dumps(["sam", VERSION, settings], sort_keys=True)

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Masks of an image (H, W, 3) uint8, by falling predicted IoU; a level may have none."""
        shape = image.shape[:2]
        crops = crop_boxes(shape, self._config.crop_layers)
        proposals: list[Proposal] = []
        for index, crop in enumerate(crops):
            found = list(self._in_crop(image, crop, _part(progress, index, len(crops))))
            for level in range(LEVELS):
                same = [proposal for proposal in found if proposal.level == level]
                scores = [proposal.predicted_iou for proposal in same]
                proposals += suppress_boxes(same, scores, self._config.box_nms)
        levels = [[proposal for proposal in proposals if proposal.level == i] for i in range(LEVELS)]
        kept = [filter_level(level, shape, self._config) for level in levels]
        progress("finding masks", 1.0)
        return LevelMasks(
            (kept[0][0], kept[1][0], kept[2][0]),
            (kept[0][1], kept[1][1], kept[2][1]),
        )

    def _in_crop(self, image: Array, crop: Array, progress: Progress) -> Iterator[Proposal]:
        """The proposals that one crop (4,) of the picture gives, in pixels of the picture."""
        import torch

        left, top, right, bottom = crop
        part = np.ascontiguousarray(image[top:bottom, left:right])
        points = grid_points(self._config.points_per_side, part.shape[:2])
        step = self._config.points_per_batch
        with torch.inference_mode():
            progress("finding masks", 0.0)
            look = self._segmenter.look(part)
            for start in range(0, len(points), step):
                if start:
                    progress("finding masks", start / len(points))
                for proposal in self._at_points(look, points[start : start + step]):
                    placed = _placed(proposal, crop)
                    if not cut_by_crop(placed.box, crop, image.shape[:2]):
                        yield placed

    def _at_points(self, look: Look, points: Array) -> Iterator[Proposal]:
        import torch

        ious, logits = (found.flatten(0, 1) for found in look.ask(points))
        good = torch.nonzero(ious > self._config.predicted_iou)[:, 0]
        for rows in good.split(MASKS_AT_ONCE):
            yield from self._stable(look.enlarge(logits[rows]), ious[rows], rows % LEVELS)

    def _stable(self, logits: Any, ious: Any, levels: Any) -> Iterator[Proposal]:
        """Those of a few masks whose area hardly depends on the threshold."""
        offset = self._config.stability_offset
        tight, loose = ((logits > cut).flatten(1).sum(1) for cut in (offset, -offset))
        stability = (tight / loose.clamp(min=1)).cpu().numpy()
        masks = (logits > 0).cpu().numpy()
        for mask, iou, stable, level in zip(masks, ious.tolist(), stability, levels.tolist(), strict=True):
            if stable >= self._config.stability and mask.any():
                box = mask_boxes(mask[None])[0]
                bits = np.packbits(mask[box[1] : box[3], box[0] : box[2]])
                yield Proposal(level, bits, box, iou, float(stable))


def suppress_boxes(proposals: list[Proposal], scores: list[float], iou: float) -> list[Proposal]:
    """Those whose box no better one resembles, by falling score; see `mask_filters.box_nms`."""
    if not proposals:
        return []
    boxes = np.stack([proposal.box for proposal in proposals])
    return [proposals[i] for i in box_nms(boxes, np.array(scores), iou)]


def filter_level(
    proposals: list[Proposal], shape: tuple[int, int], config: MaskConfig
) -> tuple[Array, Array]:
    """What remains of one level: (M, H, W) bool masks and (M,) float32 scores, stability times IoU.

    proposals: of each crop those that `suppress_boxes` left. Order of the steps as in SAM's mask generator
    with LangSplat's mask suppression behind it: boxes of different crops, where the smaller crop shows more
    of a thing, crumbs, boxes again (there an untouched mask beats a cleaned one), pixels.
    """
    chosen = suppress_boxes(proposals, [1 / p.crop_area for p in proposals], config.box_nms)
    if not chosen:
        return np.zeros((0, *shape), bool), np.zeros(0, np.float32)
    cleaned = [clean_regions(proposal.mask(shape), config.min_region) for proposal in chosen]
    masks = np.stack([mask for mask, _ in cleaned])
    untouched = np.array([not changed for _, changed in cleaned], float)
    scores = np.array([p.stability * p.predicted_iou for p in chosen])
    again = box_nms(mask_boxes(masks), untouched, config.box_nms)
    masks, scores = masks[again], scores[again]
    kept = mask_nms(masks, scores, config)
    return masks[kept], scores[kept].clip(0, 1).astype(np.float32)


def grid_points(per_side: int, size: tuple[int, int]) -> Array:
    """(per_side^2, 2) float32 points x, y in a picture of `size` (height, width): centres of equal cells,
    row by row."""
    centres = (np.arange(per_side) + 0.5) / per_side
    x, y = np.meshgrid(centres * size[1], centres * size[0])
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32)


def _placed(proposal: Proposal, crop: Array) -> Proposal:
    """A proposal of a crop, in pixels of the picture."""
    box = proposal.box + np.tile(crop[:2], 2)
    area = int((crop[2] - crop[0]) * (crop[3] - crop[1]))
    return replace(proposal, box=box, crop_area=area)


def _part(progress: Progress, index: int, count: int) -> Progress:
    """Reports the work on one crop of `count` as a part of the whole."""
    return lambda label, fraction: progress(label, (index + fraction) / count)
