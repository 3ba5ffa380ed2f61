"""Masks by Segment Anything (Kirillov et al. 2023): a grid of points, three masks a point, filtered.

SAM's three answers to one point are taken as the levels subpart, part and whole (LangSplat section 3.1).
The picture is seen once, as a whole: the paper mentions no crops, its public code adds a 2 x 2 layer.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.config import MaskConfig
from langsplat_core.progress import Progress
from langsplat_core.semantics.mask_filters import box_nms, clean_regions, mask_boxes, mask_nms
from langsplat_core.semantics.masks import LevelMasks
from langsplat_core.semantics.weights import load_model, loading_errors, torch_device, weights_folder

VERSION = 1
PIXEL_MEAN = (123.675, 116.28, 103.53)  # SAM's normalisation, values 0..255
PIXEL_STD = (58.395, 57.12, 57.375)
CHANNELS = 3  # mask channels 0, 1, 2 are the levels 0, 1, 2
MASKS_AT_ONCE = 16  # full-size masks of float logits held at one time


def load_sam(config: MaskConfig, device: str = "auto") -> "SamMasks":
    """Load the weights that `config.sam` names: a folder in Hugging Face layout or a hub id.

    Raises EncoderError where they are absent or are not those of a SAM.
    """
    from transformers import SamConfig, SamModel

    device = torch_device(device)
    folder = weights_folder(config.sam, "--masks.sam")
    with loading_errors(config.sam, "SAM"):
        settings = SamConfig.from_pretrained(folder, local_files_only=True)
    return SamMasks(load_model(SamModel, config.sam, folder, settings).to(device), config)


class SamMasks:
    """A `MaskSource` that asks a SAM."""

    def __init__(self, model: Any, config: MaskConfig) -> None:
        self._model = model
        self._config = config

    @property
    def name(self) -> str:
        """See `MaskSource`."""
        return f"SAM {self._config.sam}"

    @property
    def key(self) -> str:
        """See `MaskSource`. The size of batches changes no result."""
        settings = asdict(self._config) | {"source": "sam", "points_per_batch": 0}
        return json.dumps(["sam", VERSION, settings], sort_keys=True)

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Masks of an image (H, W, 3) uint8, by falling predicted IoU; a level may have none."""
        height, width = image.shape[:2]
        proposals: tuple[list[_Proposal], ...] = ([], [], [])
        for proposal in self._proposals(image, progress):
            proposals[proposal.level].append(proposal)
        kept = [filter_level(level, (height, width), self._config) for level in proposals]
        progress("finding masks", 1.0)
        return LevelMasks(
            (kept[0][0], kept[1][0], kept[2][0]),
            (kept[0][1], kept[1][1], kept[2][1]),
        )

    def _proposals(self, image: Array, progress: Progress) -> "Iterator[_Proposal]":
        import torch

        side = int(self._model.config.vision_config.image_size)
        pixels, size = preprocess(image, side)
        points = torch.from_numpy(grid_points(self._config.points_per_side, size)).to(self._model.device)
        step = self._config.points_per_batch
        with torch.inference_mode():
            embedding = self._model.get_image_embeddings(torch.from_numpy(pixels).to(self._model.device))
            for start in range(0, len(points), step):
                progress("finding masks", start / len(points))
                answer = self._model(
                    image_embeddings=embedding,
                    input_points=points[None, start : start + step, None],
                    multimask_output=True,
                )
                ious = answer.iou_scores[0].flatten()
                good = torch.nonzero(ious > self._config.predicted_iou)[:, 0]
                logits = answer.pred_masks[0].flatten(0, 1)
                for rows in good.split(MASKS_AT_ONCE):
                    full = upscale(logits[rows], side, size, image.shape[:2])
                    yield from self._stable(full, ious[rows], rows % CHANNELS)

    def _stable(self, logits: Any, ious: Any, levels: Any) -> "Iterator[_Proposal]":
        """Those of a few masks whose area hardly depends on the threshold."""
        offset = self._config.stability_offset
        tight, loose = ((logits > cut).flatten(1).sum(1) for cut in (offset, -offset))
        stability = (tight / loose.clamp(min=1)).cpu().numpy()
        masks = (logits > 0).cpu().numpy()
        for mask, iou, stable, level in zip(masks, ious.tolist(), stability, levels.tolist(), strict=True):
            if stable >= self._config.stability and mask.any():
                yield _Proposal(level, np.packbits(mask), mask_boxes(mask[None])[0], iou, float(stable))


@dataclass(frozen=True, eq=False)
class _Proposal:
    """A mask that passed SAM's own scores."""

    level: int
    bits: Array  # (ceil(H W / 8),) uint8, packed: a thousand masks of a photograph are held at once
    box: Array  # (4,) left, top, right, bottom, px; right and bottom exclusive
    predicted_iou: float
    stability: float


def filter_level(
    proposals: "list[_Proposal]", shape: tuple[int, int], config: MaskConfig
) -> tuple[Array, Array]:
    """What remains of one level: (M, H, W) bool masks and (M,) float32 scores, stability times IoU.

    Order of the steps as in SAM's mask generator with LangSplat's mask suppression behind it: boxes,
    crumbs, boxes again (there an untouched mask beats a cleaned one), pixels.
    """
    if not proposals:
        return np.zeros((0, *shape), bool), np.zeros(0, np.float32)
    ious = np.array([proposal.predicted_iou for proposal in proposals])
    boxes = np.stack([proposal.box for proposal in proposals])
    chosen = [proposals[i] for i in box_nms(boxes, ious, config.box_nms)]
    count = shape[0] * shape[1]
    cleaned = [
        clean_regions(np.unpackbits(p.bits, count=count).reshape(shape).view(bool), config.min_region)
        for p in chosen
    ]
    masks = np.stack([mask for mask, _ in cleaned])
    untouched = np.array([not changed for _, changed in cleaned], float)
    scores = np.array([p.stability * p.predicted_iou for p in chosen])
    again = box_nms(mask_boxes(masks), untouched, config.box_nms)
    masks, scores = masks[again], scores[again]
    kept = mask_nms(masks, scores, config)
    return masks[kept], scores[kept].clip(0, 1).astype(np.float32)


def preprocess(image: Array, side: int) -> tuple[Array, tuple[int, int]]:
    """Scale the longer side of (H, W, 3) uint8 to `side`, normalise, pad with zeros to the right and below.

    Returns (1, 3, side, side) float32 and the (height, width) of the picture in it, px.
    """
    height, width = image.shape[:2]
    scale = side / max(height, width)
    size = max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5))
    resized = Image.fromarray(image).resize((size[1], size[0]), Image.Resampling.BILINEAR)
    padded = np.zeros((side, side, 3), np.float32)
    padded[: size[0], : size[1]] = (np.asarray(resized, np.float32) - PIXEL_MEAN) / PIXEL_STD
    return np.ascontiguousarray(padded.transpose(2, 0, 1)[None]), size


def grid_points(per_side: int, size: tuple[int, int]) -> Array:
    """(per_side^2, 2) float32 points x, y in a picture of `size` (height, width): centres of equal cells,
    row by row."""
    centres = (np.arange(per_side) + 0.5) / per_side
    x, y = np.meshgrid(centres * size[1], centres * size[0])
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32)


def upscale(logits: Any, side: int, size: tuple[int, int], shape: tuple[int, int]) -> Any:
    """(B, h, w) low-resolution logits of the padded square -> (B, H, W) of the photograph."""
    from torch.nn.functional import interpolate

    square = interpolate(logits[:, None].float(), (side, side), mode="bilinear", align_corners=False)
    picture = square[..., : size[0], : size[1]]
    return interpolate(picture, shape, mode="bilinear", align_corners=False)[:, 0]
