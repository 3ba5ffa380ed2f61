"""Masks by models of the SAM family: an image is encoded, prompted with a grid of points, and filtered.

The three masks of one point are the levels subpart, part and whole (LangSplat section 3.1). By default the
image is encoded as a whole; the method's public code, not its paper, encodes 2 x 2 crops of it too. Source:
the mask generator of segment-anything, with the settings of LangSplat's public code.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from math import ceil
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from PIL import Image

from langsplat_core import registry
from langsplat_core.arrays import Array
from langsplat_core.config import MaskConfig
from langsplat_core.errors import EncoderError, InputError, optional_imports
from langsplat_core.progress import Progress
from langsplat_core.semantics import weights as models
from langsplat_core.semantics.encoders import TorchText
from langsplat_core.semantics.masks import (
    GraphMasks,
    LevelMasks,
    MaskSource,
    box_nms,
    clean_regions,
    mask_boxes,
    mask_nms,
)
from langsplat_core.semantics.weights import Weights

Statistics = tuple[tuple[float, float, float], tuple[float, float, float]]  # mean and deviation of pixels
IMAGENET: Statistics = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)  # of values 0..255
MASKS_PER_POINT = 3  # masks per point


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """An encoded image, which can be prompted with points."""

    model: Any  # a transformers model
    seen: Mapping[str, Any]  # arguments of the model with the encoded image
    side: int  # of the model's square input, px
    size: tuple[int, int] | None  # (height, width) of the image in it; None if it fills the square
    shape: tuple[int, int]  # (height, width) of the image itself, px
    ordered: bool  # True if the three masks of a point are subpart, part, whole, in this order

    @models.asking_errors("the segmenter")
    def masks_at(self, points: Array) -> tuple[Any, Any]:
        """Return (P, 3) predicted IoU and (P, 3, h, w) small logits at (P, 2) float32 x, y, px."""
        import torch

        height, width = self.size or (self.side, self.side)
        scaled = points * np.array([width / self.shape[1], height / self.shape[0]], np.float32)
        given = torch.from_numpy(scaled)[None, :, None].to(self.model.device)
        answer = self.model(**self.seen, input_points=given, multimask_output=True)
        ious, logits = answer.iou_scores[0], answer.pred_masks[0]
        return (ious, logits) if self.ordered else by_area(ious, logits)

    def enlarge(self, logits: Any) -> Any:
        """Enlarge (B, h, w) logits to the (B, H, W) of the image."""
        from torch.nn.functional import interpolate

        square = logits[:, None].float()
        if self.size is not None:  # the padding can only be cut off at the resolution of its pixels
            square = interpolate(square, (self.side, self.side), mode="bilinear", align_corners=False)
            square = square[..., : self.size[0], : self.size[1]]
        return interpolate(square, self.shape, mode="bilinear", align_corners=False)[:, 0]


class Segmenter(Protocol):
    """A model that finds masks at points."""

    @property
    def name(self) -> str:
        """Name for messages, such as "SAM 2"."""

    def encode(self, image: Array) -> EncodedImage:
        """Encode an image (H, W, 3) uint8."""


class TextSegmenter(Protocol):
    """A model that outlines what a phrase names."""

    def segment(self, image: Array, phrases: Sequence[str]) -> Array:
        """Return (H, W, P) bool masks of all instances that each of P phrases names in (H, W, 3) uint8."""


def by_area(ious: Any, logits: Any) -> tuple[Any, Any]:
    """Return the (P, 3) scores and (P, 3, h, w) masks of P points, each from its smallest to its largest."""
    import torch

    order = torch.argsort((logits > 0).flatten(2).sum(2), dim=1, stable=True)
    points = torch.arange(len(order), device=order.device)[:, None]
    return ious[points, order], logits[points, order]


def normalised(
    image: Array, side: int, padded: bool, statistics: Statistics = IMAGENET
) -> tuple[Array, tuple[int, int]]:
    """Return (1, 3, side, side) float32 of (H, W, 3) uint8, and the (height, width) of the image in it.

    The image is stretched to the square, or with `padded` scaled to it, with zeros to the right or below.
    """
    mean, deviation = statistics
    height, width = image.shape[:2]
    scale = side / max(height, width)
    size = (max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5))) if padded else (side, side)
    resized = Image.fromarray(image).resize((size[1], size[0]), Image.Resampling.BILINEAR)
    pixels = np.zeros((side, side, 3), np.float32)
    pixels[: size[0], : size[1]] = (np.asarray(resized, np.float32) - mean) / deviation
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[None]), size


@dataclass(frozen=True)
class Sam:
    """Segment Anything (Kirillov et al. 2023), SAM 2, 2.1 and 3 (Ravi et al. 2024, Carion et al. 2025)."""

    name: str
    model: Any  # a transformers model
    side: int  # of the images it takes, px
    ordered: bool  # SAM: images are padded, and its three masks of a point are subpart, part and whole
    statistics: Statistics = IMAGENET

    @models.asking_errors("the segmenter")
    def encode(self, image: Array) -> EncodedImage:
        import torch

        pixels, size = normalised(image, self.side, self.ordered, self.statistics)
        given = torch.from_numpy(pixels).to(self.model.device)
        seen = {"image_embeddings": self.model.get_image_embeddings(given)}
        inside = size if self.ordered else None
        return EncodedImage(self.model, seen, self.side, inside, image.shape[:2], self.ordered)


def load_sam(weights: Weights) -> Sam:
    """Load a SAM; its three masks of a point are ordered."""
    from transformers import SamConfig, SamModel

    settings = models.load_config(SamConfig, weights, "SAM")
    # The value of segment_anything for norms between attentions; transformers has 1e-6.
    settings.mask_decoder_config.layer_norm_eps = 1e-5
    model = models.load_model(SamModel, weights, settings)
    return Sam("SAM", model, int(model.config.vision_config.image_size), ordered=True)


def load_sam2(weights: Weights) -> Sam:
    """Load the image half of a SAM 2; the hub's files have the configuration of the video model."""
    from transformers import Sam2Config, Sam2Model

    model = models.load_model(Sam2Model, weights, models.load_config(Sam2Config, weights, "SAM 2"))
    return Sam("SAM 2", model, int(model.config.prompt_encoder_config.image_size), ordered=False)


SAM3_PIXELS = (127.5,) * 3, (127.5,) * 3
SAM3_FOUND = 0.5  # least score of an instance, as in Meta's own code


class Sam3Text(TorchText):
    """The detector of a SAM 3, which outlines all instances of a short noun phrase; a `TextSegmenter`."""

    padded = True

    def __init__(self, weights: Weights, name: str = "Sam3") -> None:
        """name: prefix of the model's classes in transformers."""
        import transformers

        with models.loading_errors(weights.id, "SAM 3"):
            kind, settings = getattr(transformers, f"{name}Model"), getattr(transformers, f"{name}Config")
        config = models.load_config(settings, weights, "SAM 3")  # of a video model, that of its detector
        super().__init__(kind, weights, config, "", 0, "<|startoftext|>")
        self._length = min(self._length, 32)  # as its processor pads
        self._side = int(config.image_size)
        self._read: dict[str, tuple[Any, Any]] = {}  # features of phrases and their attention masks

    @models.asking_errors("the segmenter")
    def segment(self, image: Array, phrases: Sequence[str]) -> Array:
        import torch

        pixels, _ = normalised(image, self._side, padded=False, statistics=SAM3_PIXELS)
        with torch.inference_mode():
            seen = self._model.get_vision_features(torch.from_numpy(pixels).to(self._device))
            return np.stack([self._outlined(seen, phrase, image.shape[:2]) for phrase in phrases], -1)

    def _outlined(self, seen: Any, phrase: str, shape: tuple[int, int]) -> Array:
        """Return (H, W) bool of `shape`: the union of all instances of a phrase in an encoded image."""
        from torch.nn.functional import interpolate

        if phrase not in self._read:
            ids, mask = self.tokens([phrase])
            self._read[phrase] = self._model.get_text_features(ids, mask, return_dict=True), mask
        texts, mask = self._read[phrase]
        found = self._model(vision_embeds=seen, text_embeds=texts, attention_mask=mask)
        scores = found.pred_logits[0].sigmoid() * found.presence_logits[0].sigmoid()
        inside = np.zeros(shape, bool)
        for logits in found.pred_masks[0, scores > SAM3_FOUND]:  # one at a time: there may be 200
            share = interpolate(logits.sigmoid()[None, None], shape, mode="bilinear", align_corners=False)
            inside |= (share[0, 0] > 0.5).cpu().numpy()
        return inside


# Loading by hub id, folder or file. A new family is a function above and one row here.

FAMILIES: Mapping[str, Callable[[Weights], Segmenter]] = MappingProxyType(  # by `model_type` of config.json
    {"sam": load_sam, "sam2": load_sam2, "sam2_video": load_sam2}
)
TEXT_FAMILIES: Mapping[str, Callable[[Weights], TextSegmenter]] = MappingProxyType(
    {"sam3": Sam3Text, "sam3_video": Sam3Text, "sam3_lite_text": partial(Sam3Text, name="Sam3LiteText")}
)
HALF_ON = "cuda"  # device type with float16 products; the error of bfloat16 is seven times as large


def load_segmenter(model: str, device: str = "auto") -> Segmenter:
    """Load `model`: a folder in Hugging Face layout, a file of segment_anything or sam2, or a hub id."""
    weights = models.open_weights(model, models.weights_path(model, "--masks.sam"), device)
    return models.family_of(weights, FAMILIES, "segmenters")(weights)


@optional_imports(EncoderError)
def load_text_segmenter(model: str, device: str = "auto") -> TextSegmenter:
    """Load `model`, a folder in Hugging Face layout or a hub id, for segmentation by phrases."""
    weights = models.open_weights(model, models.weights_path(model, "--segmenter"), device)
    return models.family_of(weights, TEXT_FAMILIES, "text_segmenters")(weights)


def load_mask_source(config: MaskConfig, device: str = "auto") -> MaskSource:
    """Return the mask source of `config`; "auto": SAM if weights are named, else the graph."""
    if config.source == "graph" or (config.source == "auto" and not config.sam):
        return GraphMasks()
    if config.source not in ("auto", "sam"):
        more = registry.references("mask_sources")
        if config.source not in more:
            known = ", ".join(("auto", "sam", "graph", *more))
            raise InputError(f"masks.source {config.source}: choose one of {known}")
        return registry.part("mask_sources", config.source)(config, device)
    if not config.sam:
        raise InputError("masks.source sam: name weights too, such as `--masks.sam facebook/sam-vit-huge`")
    half_on = HALF_ON if models.torch_device(device).startswith(HALF_ON) else None
    return SamMasks(load_segmenter(config.sam, device), config, half_on)


# The grid of points, and layers of crops: parts of a photograph encoded by themselves, for small things.

OVERLAP = 512 / 1500  # of neighbouring crops, as a share of the image's shorter side, in the first layer
EDGE = 20.0  # px: largest distance at which a box touches an edge


def grid_points(per_side: int, size: tuple[int, int]) -> Array:
    """Return (per_side^2, 2) float32 x, y: centres of equal cells of an image of `size` (height, width)."""
    centres = (np.arange(per_side) + 0.5) / per_side
    x, y = np.meshgrid(centres * size[1], centres * size[0])
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32)


def crop_boxes(shape: tuple[int, int], layers: int) -> Array:
    """Return (C, 4) int64 left, top, right, bottom, exclusive: the image, then 2^k x 2^k crops a layer."""
    height, width = shape
    boxes = [(0, 0, width, height)]
    for layer in range(1, layers + 1):
        count = 2**layer
        overlap = int(OVERLAP * min(shape) * 2 / count)
        columns, rows = _spans(width, count, overlap), _spans(height, count, overlap)
        boxes += [(left, top, right, bottom) for left, right in columns for top, bottom in rows]
    return np.array(boxes, np.int64)


def _spans(length: int, count: int, overlap: int) -> list[tuple[int, int]]:
    """Return `count` equal intervals that cover `length` px and share `overlap` px with the next."""
    size = ceil((overlap * (count - 1) + length) / count)
    starts = [(size - overlap) * i for i in range(count)]
    return [(start, min(start + size, length)) for start in starts if start < length]


def cut_by_crop(boxes: Array, crop: Array, shape: tuple[int, int]) -> Array:
    """Return (...,) bool: True if a box touches an edge of the crop that is no edge of the image.

    Such a mask is cut off; the next crop or the whole image has it complete. boxes: (..., 4); crop: (4,)
    left, top, right, bottom, px of the image; shape: its (height, width).
    """
    whole = np.array([0, 0, shape[1], shape[0]])
    at_crop, at_edge = np.abs(boxes - crop) <= EDGE, np.abs(boxes - whole) <= EDGE
    return (at_crop & ~at_edge).any(axis=-1)


# Prompting with points, and filtering of the masks.

VERSION = 2
# Full-size masks of float logits held at a time. On a CPU 16 take twice as long as four times 4, since large
# memory is mapped page by page.
MASKS_AT_ONCE = 4


@dataclass(frozen=True, eq=False)
class Proposal:
    """A mask that remains after suppression in its crop."""

    bits: Array  # (ceil(h w / 8),) uint8, packed, of its box: thousands of masks are held at once
    box: Array  # (4,) left, top, right, bottom, px of the image; right and bottom exclusive
    predicted_iou: float
    stability: float
    crop_area: int  # px, of its crop

    def mask(self, shape: tuple[int, int]) -> Array:
        """Return (H, W) bool: the mask in an image of `shape`."""
        left, top, right, bottom = self.box
        size = bottom - top, right - left
        mask = np.zeros(shape, bool)
        mask[top:bottom, left:right] = np.unpackbits(self.bits, count=size[0] * size[1]).reshape(size)
        return mask


@dataclass(frozen=True)
class SamMasks(MaskSource):
    """Masks of a segmenter that is prompted with a grid of points."""

    segmenter: Segmenter
    config: MaskConfig
    half_on: str | None = None  # device type on which the model multiplies in float16; None: in float32

    @property
    def name(self) -> str:
        return f"{self.segmenter.name} {self.config.sam}"

    @property
    def key(self) -> str:
        """The settings that masks depend on, as JSON, without the batch size."""
        settings = asdict(self.config) | {"source": "sam", "points_per_batch": 0}
        return json.dumps(["sam", VERSION, settings, *["float16"] * bool(self.half_on)], sort_keys=True)

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Return the masks of an image (H, W, 3) uint8; a level may have none."""
        return self.begin(image, progress)()

    def begin(self, image: Array, progress: Progress) -> Callable[[], LevelMasks]:
        """Run the model; the returned function filters by pixels and returns the masks."""
        crops = crop_boxes(image.shape[:2], self.config.crop_layers)
        levels: list[list[Proposal]] = [[] for _ in range(MASKS_PER_POINT)]
        for index, crop in enumerate(crops):
            part = progress.part(index, len(crops))
            try:
                found = self._in_crop(image, crop, part, self.half_on)
            except OverflowError:
                found = self._in_crop(image, crop, part, None)
            for proposals, more in zip(levels, found, strict=True):
                proposals += more
        progress("finding masks", 1.0)
        subparts, parts, wholes = (partial(filter_level, of, image.shape[:2], self.config) for of in levels)
        return lambda: (subparts(), parts(), wholes())

    def _in_crop(
        self, image: Array, crop: Array, progress: Progress, half_on: str | None
    ) -> list[list[Proposal]]:
        """Return the proposals of each level in one crop (4,); OverflowError beyond float16's range."""
        import torch

        left, top, right, bottom = crop
        part = np.ascontiguousarray(image[top:bottom, left:right])
        points = grid_points(self.config.points_per_side, part.shape[:2])
        step = self.config.points_per_batch
        half = partial(torch.autocast, half_on or "cpu", torch.float16, enabled=half_on is not None)
        found = []
        with torch.inference_mode():
            progress("finding masks", 0.0)
            with half():
                encoded = self.segmenter.encode(part)
            for start in range(0, len(points), step):
                if start:
                    progress("finding masks", start / len(points))
                with half():
                    answer = encoded.masks_at(points[start : start + step])
                if half_on and not bool(answer[0].isfinite().all()):
                    raise OverflowError
                found.append(self._passing(encoded, answer, crop, image.shape[:2]))
            figures = np.concatenate([some for some, _ in found])
            logits = torch.cat([some for _, some in found])
            return [self._best(encoded, figures, logits, level, crop) for level in range(MASKS_PER_POINT)]

    def _passing(
        self, encoded: EncodedImage, answer: tuple[Any, Any], crop: Array, shape: tuple[int, int]
    ) -> tuple[Array, Any]:
        """Return (M, 7) level, IoU, stability, box of accepted masks, and (M, h, w) logits on the device."""
        import torch

        ious, logits = (found.flatten(0, 1).float() for found in answer)
        rows = torch.nonzero(ious > self.config.predicted_iou)[:, 0]
        offset = self.config.stability_offset
        measured = [measure(encoded.enlarge(logits[some]), offset) for some in rows.split(MASKS_AT_ONCE)]
        columns = [rows % MASKS_PER_POINT, ious[rows], *torch.cat(measured).unbind(1)]
        figures = torch.stack(columns, dim=1).cpu().numpy()  # a single transfer
        figures[:, 3:] += np.tile(crop[:2], 2)
        boxes = figures[:, 3:]
        good = (figures[:, 2] >= self.config.stability) & (boxes[:, 0] < boxes[:, 2])
        good &= ~cut_by_crop(boxes, crop, shape)
        return figures[good], logits[rows[torch.from_numpy(good).to(rows.device)]]

    def _best(
        self, encoded: EncodedImage, figures: Array, logits: Any, level: int, crop: Array
    ) -> list[Proposal]:
        """Return the proposals of a level after suppression by box; only these leave the device."""
        rows = np.flatnonzero(figures[:, 0] == level)
        rows = rows[box_nms(figures[rows, 3:], figures[rows, 1], self.config.box_nms)]
        area = int((crop[2] - crop[0]) * (crop[3] - crop[1]))
        proposals = []
        for start in range(0, len(rows), MASKS_AT_ONCE):
            some = rows[start : start + MASKS_AT_ONCE]
            masks = (encoded.enlarge(logits[some]) > 0).cpu().numpy()
            for mask, (_, iou, stability, *edges) in zip(masks, figures[some].tolist(), strict=True):
                box = np.array(edges, int)
                left, top, right, bottom = box - np.tile(crop[:2], 2)
                bits = np.packbits(mask[top:bottom, left:right])
                proposals.append(Proposal(bits, box, iou, stability, area))
        return proposals


def measure(logits: Any, offset: float) -> Any:
    """Return (B, 5) float32 stability, left, top, right, bottom of (B, H, W) full-size logits.

    On their device, px; right and bottom exclusive, a box of zeros for an empty mask. At full size, as in
    segment_anything: at the decoder's own size, areas and boxes of small masks differ.
    """
    import torch

    inside = ((logits > cut).view(torch.uint8).flatten(1) for cut in (offset, -offset))
    areas = [pixels.sum(1, dtype=torch.int32) for pixels in inside]
    found = [areas[0] / areas[1].clamp(min=1)]
    filled = (logits.amax(1) > 0).byte(), (logits.amax(2) > 0).byte()  # columns, rows
    found += [line.argmax(1) for line in filled]
    found += [(line.shape[1] - line.flip(1).argmax(1)) * line.amax(1) for line in filled]
    return torch.stack([column.float() for column in found], dim=1)


def filter_level(proposals: list[Proposal], shape: tuple[int, int], config: MaskConfig) -> Array:
    """Return the (M, H, W) bool masks of one level that remain after filtering.

    The steps are those of SAM's mask generator followed by LangSplat's mask suppression: suppression by box
    between crops, in favour of the smaller crop; removal of small regions; suppression by box again, in
    favour of masks that this left unchanged; suppression by pixels, with stability times IoU as the score.
    """
    if not proposals:
        return np.zeros((0, *shape), bool)
    closeness = np.array([1 / proposal.crop_area for proposal in proposals])
    boxes = np.stack([proposal.box for proposal in proposals])
    chosen = [proposals[i] for i in box_nms(boxes, closeness, config.box_nms)]
    cleaned = [clean_regions(proposal.mask(shape), config.min_region) for proposal in chosen]
    masks = np.stack([mask for mask, _ in cleaned])
    untouched = np.array([not changed for _, changed in cleaned], float)
    scores = np.array([p.stability * p.predicted_iou for p in chosen])
    again = box_nms(mask_boxes(masks), untouched, config.box_nms)
    masks = masks[again]
    return np.asarray(masks[mask_nms(masks, scores[again], config)])
