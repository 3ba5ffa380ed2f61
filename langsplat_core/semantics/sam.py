"""Masks by a model of the SAM family: a grid of points, three masks a point, filtered.

The three answers to one point are taken as the levels subpart, part and whole (LangSplat section 3.1). The
picture is seen once, as a whole; the method's public code, not its paper, sees 2 x 2 crops of it too.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
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
from langsplat_core.semantics.weights import torch_device

VERSION = 2
# Full-size masks of float logits held at one time: on a CPU 16 take twice as long as four times 4, since the
# system gives and takes back large memory page by page.
MASKS_AT_ONCE = 4
HALF_ON = "cuda"  # where products are float16's: bfloat16's error is seven times as large (docs/encoders.md)


def load_sam(config: MaskConfig, device: str = "auto") -> "SamMasks":
    """Load the weights that `config.sam` names: a folder in Hugging Face layout or a hub id.

    Raises EncoderError where they are absent or are not those of a SAM.
    """
    return SamMasks(load_segmenter(config.sam, device), config, torch_device(device).startswith(HALF_ON))


@dataclass(frozen=True, eq=False)
class Proposal:
    """A mask that is the best of those like it in its crop."""

    bits: Array  # (ceil(h w / 8),) uint8, packed, of its box: thousands of masks are held at once
    box: Array  # (4,) left, top, right, bottom, px of the picture; right and bottom exclusive
    predicted_iou: float
    stability: float
    crop_area: int  # px, of the crop that it was found in

    def mask(self, shape: tuple[int, int]) -> Array:
        """(H, W) bool: the mask in a picture of `shape`."""
        left, top, right, bottom = self.box
        size = bottom - top, right - left
        mask = np.zeros(shape, bool)
        mask[top:bottom, left:right] = np.unpackbits(self.bits, count=size[0] * size[1]).reshape(size)
        return mask


class SamMasks:
    """A `MaskSource` that asks a segmenter."""

    def __init__(self, segmenter: Segmenter, config: MaskConfig, half: bool = False) -> None:
        """half: whether the model multiplies in float16, see `HALF_ON`."""
        self._segmenter = segmenter
        self._config = config
        self._half = half

    @property
    def name(self) -> str:
        """See `MaskSource`."""
        return f"{self._segmenter.name} {self._config.sam}"

    @property
    def key(self) -> str:
        """See `MaskSource`. The size of batches changes no result."""
        settings = asdict(self._config) | {"source": "sam", "points_per_batch": 0}
        return json.dumps(["sam", VERSION, settings, *["float16"] * self._half], sort_keys=True)

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Masks of an image (H, W, 3) uint8, by falling predicted IoU; a level may have none."""
        return self.begin(image, progress)()

    def begin(self, image: Array, progress: Progress) -> Callable[[], LevelMasks]:
        """See `SplitMaskSource`: the model is asked here, pixels are compared there."""
        crops = crop_boxes(image.shape[:2], self._config.crop_layers)
        levels: list[list[Proposal]] = [[] for _ in range(LEVELS)]
        for index, crop in enumerate(crops):
            part = _part(progress, index, len(crops))
            try:
                found = self._in_crop(image, crop, part, self._half)
            except OverflowError:
                found = self._in_crop(image, crop, part, half=False)
            for proposals, more in zip(levels, found, strict=True):
                proposals += more
        progress("finding masks", 1.0)
        return partial(self._finish, levels, image.shape[:2])

    def _finish(self, levels: list[list[Proposal]], shape: tuple[int, int]) -> LevelMasks:
        kept = [filter_level(level, shape, self._config) for level in levels]
        return LevelMasks((kept[0][0], kept[1][0], kept[2][0]), (kept[0][1], kept[1][1], kept[2][1]))

    def _in_crop(self, image: Array, crop: Array, progress: Progress, half: bool) -> list[list[Proposal]]:
        """The proposals that one crop (4,) of the picture gives at each level, in pixels of the picture.

        Raises OverflowError for `half` where numbers are larger than float16 holds.
        """
        import torch

        left, top, right, bottom = crop
        part = np.ascontiguousarray(image[top:bottom, left:right])
        points = grid_points(self._config.points_per_side, part.shape[:2])
        step = self._config.points_per_batch
        found = []
        with torch.inference_mode():
            progress("finding masks", 0.0)
            with torch.autocast(HALF_ON, torch.float16, enabled=half):
                look = self._segmenter.look(part)
            for start in range(0, len(points), step):
                if start:
                    progress("finding masks", start / len(points))
                with torch.autocast(HALF_ON, torch.float16, enabled=half):
                    answer = look.ask(points[start : start + step])
                if half and not bool(answer[0].isfinite().all()):
                    raise OverflowError
                found.append(self._passing(look, answer, crop, image.shape[:2]))
            figures = np.concatenate([some for some, _ in found])
            logits = torch.cat([some for _, some in found])
            return [self._best(look, figures, logits, level, crop) for level in range(LEVELS)]

    def _passing(
        self, look: Look, answer: tuple[Any, Any], crop: Array, shape: tuple[int, int]
    ) -> tuple[Array, Any]:
        """Of the masks that pass the tests for themselves: (M, 7) level, predicted IoU, stability and box in
        the picture, and (M, h, w) logits, low resolution, still on the device."""
        import torch

        ious, logits = (found.flatten(0, 1).float() for found in answer)
        rows = torch.nonzero(ious > self._config.predicted_iou)[:, 0]
        offset = self._config.stability_offset
        measured = [measure(look.enlarge(logits[some]), offset) for some in rows.split(MASKS_AT_ONCE)]
        columns = [rows % LEVELS, ious[rows], *torch.cat(measured).unbind(1)]
        figures = torch.stack(columns, dim=1).cpu().numpy()  # the one transfer
        figures[:, 3:] += np.tile(crop[:2], 2)
        boxes = figures[:, 3:]
        good = (figures[:, 2] >= self._config.stability) & (boxes[:, 0] < boxes[:, 2])
        good &= ~cut_by_crop(boxes, crop, shape)
        return figures[good], logits[rows[torch.from_numpy(good).to(rows.device)]]

    def _best(self, look: Look, figures: Array, logits: Any, level: int, crop: Array) -> list[Proposal]:
        """Those of a level whose box no better one resembles: only they are enlarged and leave the device."""
        rows = np.flatnonzero(figures[:, 0] == level)
        rows = rows[box_nms(figures[rows, 3:], figures[rows, 1], self._config.box_nms)]
        area = int((crop[2] - crop[0]) * (crop[3] - crop[1]))
        proposals = []
        for start in range(0, len(rows), MASKS_AT_ONCE):
            some = rows[start : start + MASKS_AT_ONCE]
            masks = (look.enlarge(logits[some]) > 0).cpu().numpy()
            for mask, (_, iou, stability, *edges) in zip(masks, figures[some].tolist(), strict=True):
                box = np.array(edges, int)
                left, top, right, bottom = box - np.tile(crop[:2], 2)
                bits = np.packbits(mask[top:bottom, left:right])
                proposals.append(Proposal(bits, box, iou, stability, area))
        return proposals


def measure(logits: Any, offset: float) -> Any:
    """(B, 5) float32 of (B, H, W) full-size logits, on their device: stability, left, top, right, bottom, px;
    right and bottom exclusive, all 0 of an empty mask.

    At full size, as in segment_anything: at the decoder's own, areas and boxes of small masks differ.
    """
    import torch

    inside = ((logits > cut).view(torch.uint8).flatten(1) for cut in (offset, -offset))
    areas = [pixels.sum(1, dtype=torch.int32) for pixels in inside]
    found = [areas[0] / areas[1].clamp(min=1)]
    filled = (logits.amax(1) > 0).byte(), (logits.amax(2) > 0).byte()  # columns, rows
    found += [line.argmax(1) for line in filled]
    found += [(line.shape[1] - line.flip(1).argmax(1)) * line.amax(1) for line in filled]
    return torch.stack([column.float() for column in found], dim=1)


def filter_level(
    proposals: list[Proposal], shape: tuple[int, int], config: MaskConfig
) -> tuple[Array, Array]:
    """What remains of one level: (M, H, W) bool masks and (M,) float32 scores, stability times IoU.

    proposals: of each crop those that no better one resembled. Order of the steps as in SAM's mask generator
    with LangSplat's mask suppression behind it: boxes of different crops, where the smaller crop shows more
    of a thing, crumbs, boxes again (there an untouched mask beats a cleaned one), pixels.
    """
    if not proposals:
        return np.zeros((0, *shape), bool), np.zeros(0, np.float32)
    closeness = np.array([1 / proposal.crop_area for proposal in proposals])
    boxes = np.stack([proposal.box for proposal in proposals])
    chosen = [proposals[i] for i in box_nms(boxes, closeness, config.box_nms)]
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


def _part(progress: Progress, index: int, count: int) -> Progress:
    """Reports the work on one crop of `count` as a part of the whole."""
    return lambda label, fraction: progress(label, (index + fraction) / count)
