"""The field's own packages, open_clip, segment_anything and sam2, with random weights at full size.

`make parity` puts them into a folder beside the environment, without torchvision: PyPI's is made for CUDA,
and its import fails beside the CPU build of torch. Of it they need the suppression of boxes, written here.
"""

import importlib
import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage
from tokenizers import Tokenizer
from torch.nn.functional import normalize
from transformers import CLIPTokenizer

from langsplat_core.arrays import Array
from langsplat_core.config import MaskConfig
from langsplat_core.progress import silent
from langsplat_core.semantics.encoders import load_encoder
from langsplat_core.semantics.sam import (
    MASKS_PER_POINT,
    EncodedImage,
    SamMasks,
    load_mask_source,
    load_segmenter,
)
from tests.support.backends import Measure

PARTS = ("segment_anything.automatic_mask_generator", "sam2.build_sam", "sam2.sam2_image_predictor")
NAMES = ("torchvision", "open_clip", "segment_anything", "sam2", "cv2")
ENDS = {"<start_of_text>": "<|startoftext|>", "<end_of_text>": "<|endoftext|>"}  # as the hub names them
SCALES = {"pos": 0.3, "rel_": 0.3, "token": 0.3, "no_mem": 0.3, "latent": 0.3, "class_embedding": 0.3}


@cache
def upstream() -> SimpleNamespace:
    """The packages as attributes; without them the test is skipped."""
    if missing := [name for name in NAMES if find_spec(name) is None]:
        pytest.skip(f"no {', '.join(missing)}: run `make parity`")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what they themselves import
        try:
            boxes = importlib.import_module("torchvision.ops.boxes")
        except RuntimeError:  # operator torchvision::nms does not exist
            for name in ("nms", "qnms"):
                torch.library.define(f"torchvision::{name}", "(Tensor a, Tensor b, float iou) -> Tensor")
            boxes = importlib.import_module("torchvision.ops.boxes")
            boxes.nms = plain_nms  # type: ignore[attr-defined]
        for part in PARTS:
            importlib.import_module(part)
        return SimpleNamespace(**{name: importlib.import_module(name) for name in NAMES})


def plain_nms(boxes: torch.Tensor, scores: torch.Tensor, iou_threshold: float) -> torch.Tensor:
    """As torchvision's nms: (K,) indices of the (M, 4) boxes that stay, by falling score."""
    area = (boxes[:, 2:] - boxes[:, :2]).prod(1)
    order, kept = torch.sort(scores, stable=True, descending=True).indices, []
    while len(order):
        best, order = order[0], order[1:]
        kept.append(best)
        corner = torch.maximum(boxes[best, :2], boxes[order, :2])
        common = (torch.minimum(boxes[best, 2:], boxes[order, 2:]) - corner).clamp(min=0).prod(1)
        order = order[~(common / (area[best] + area[order] - common) > iou_threshold)]
    return torch.stack(kept) if kept else torch.zeros(0, dtype=torch.int64)


def scrambled(build: Callable[..., Any], *arguments: str, **options: Any) -> Any:
    """A model with random weights, none of which is left at zero or one as some are when it is made."""
    torch.manual_seed(0)
    model = build(*arguments, **options)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            scale = next((SCALES[word] for word in SCALES if word in name), None)
            if scale is not None:
                weight.normal_(0, scale)
            elif weight.ndim > 1:
                weight.normal_(0, weight[0].numel() ** -0.5)  # signals stay as large as they are
            elif weight.ndim == 1:
                weight.add_(torch.randn_like(weight) * 0.1)
    return model.eval()


def save_clip(name: str, stated: Any, model: Any, folder: Path) -> None:
    """A CLIP of open_clip as its hub folders hold it, with OpenAI's words where it has no others."""
    torch.save(model.state_dict(), folder / "open_clip_pytorch_model.bin")
    both = {"model_cfg": stated, "preprocess_cfg": {}}
    (folder / "open_clip_config.json").write_text(json.dumps(both), encoding="utf-8")
    if (folder / "tokenizer.json").exists():
        return
    words = upstream().open_clip.get_tokenizer(name)
    numbers = {ENDS.get(token, token): number for token, number in words.encoder.items()}
    CLIPTokenizer(vocab=numbers, merges=list(words.bpe_ranks)).save_pretrained(folder)


# Vectors and masks against those of open_clip, segment_anything and sam2 themselves, at full size with the
# same random weights. `make parity` installs them and runs this; else it is skipped.

pytestmark = pytest.mark.slow
PLAIN = ["red mug", "a photo of a chair", "the handle of a green mug", "object", "things", "naïve café"]
PLAIN += ["crème brûlée", "ein Fenster", "日本", "3 yellow bananas", "UPPER Case WORDS", "x y z", "texture"]
MARKED = ["it's", "it’s", "“quoted” mug", "salt &amp; pepper", "of\ufb01ce chair", "mug, not red"]
MARKED += ["mug 🍵", "3.5 mm jack", "what is this?", "a&b", "co₂", "½ apple", "  two  spaces "]
MARKED += ["don`t", "a/b (c)", "a-b"]


@pytest.fixture(scope="module", autouse=True)
def field() -> SimpleNamespace:
    """The packages, imported before transformers looks for torchvision."""
    return upstream()


def squares(side: int, count: int = 4) -> Array:
    """Smooth pictures in bright colours, (count, side, side, 3) uint8."""
    noise = np.random.default_rng(1).uniform(0, 255, (count, side // 16, side // 16, 3)).astype(np.uint8)
    return np.stack([np.asarray(Image.fromarray(some).resize((side, side))) for some in noise])


def close(what: str, got: Any, want: Any, most: float, measured: Measure) -> None:
    """At most `most` apart, where rows of `want` themselves are a hundred times as far from each other."""
    got, want = torch.as_tensor(got), torch.as_tensor(want)
    apart = (got - want).abs().max().item()
    measured(what, "largest difference", apart)
    assert got.shape == want.shape
    assert apart <= most
    assert (want[0] - want[1]).abs().max() > 100 * most


WORLDWIDE = "ViT-L-14-worldwide-quickgelu"


@pytest.mark.parametrize("name", ["ViT-B-16", "ViT-L-14-quickgelu", WORLDWIDE])
def test_a_clip_of_open_clip(name: str, field: SimpleNamespace, tmp_path: Path, measured: Measure) -> None:
    """MetaCLIP 2, the worldwide one, has few words: its own tokenizer is on the hub alone."""
    stated, phrases = field.open_clip.get_model_config(name), PLAIN + MARKED
    length = stated["text_cfg"]["context_length"]
    if name == WORLDWIDE:
        from tests.support.tiny_models import unigram_tokenizer  # after torchvision

        stated["text_cfg"] |= {"vocab_size": unigram_tokenizer(tmp_path, "<s> $A </s>"), "eos_id": 1}
        del stated["text_cfg"]["tokenizer_kwargs"]  # which Meta's own models do not have
        words, phrases = Tokenizer.from_file(str(tmp_path / "tokenizer.json")), PLAIN
        ids = [row.ids + [0] * (length - len(row.ids)) for row in words.encode_batch(phrases)]
    else:
        ids = field.open_clip.get_tokenizer(name)(phrases)
    model = scrambled(field.open_clip.CLIP, **stated)
    save_clip(name, stated, model, tmp_path)
    encoder = load_encoder(str(tmp_path), "cpu")
    see = field.open_clip.transform.image_transform(encoder.image_size, is_train=False)
    pictures = squares(encoder.image_size)
    with torch.inference_mode():
        texts = normalize(model.encode_text(torch.as_tensor(ids)))
        seen = normalize(model.encode_image(torch.stack([see(Image.fromarray(some)) for some in pictures])))
    close(f"{name}, text", encoder.encode_texts(phrases), texts, 1e-5, measured)
    close(f"{name}, pictures", encoder.encode_images(pictures), seen, 1e-5, measured)


PASSING = {"nms_iou": 2.0, "nms_score": -1.0, "nms_inner": 2.0}
POINTS = np.array([[100, 200], [700, 500], [1300, 1000]], np.float32) / (1440, 1080)  # shares of a picture


def compare(
    name: str, encoded: EncodedImage, embedding: Any, points: Array, want: tuple[Any, Any], measured: Measure
) -> None:
    """Compare an image's embedding (1, C, h, w), scores (P, 3) and full-size logits (P, 3, H, W)."""
    field = upstream()
    scores, full = want
    seen = encoded.seen["image_embeddings"]
    mine, alike = (seen[-1], [*seen[:-1], embedding]) if isinstance(seen, list) else (seen, embedding)
    scaled = (some[0] / embedding.std() for some in (mine, embedding))
    close(f"{name}, embedding / sd", *scaled, 5e-5, measured)
    for what, given in (("alone", alike), ("and picture", seen)):
        ious, logits = replace(encoded, seen={"image_embeddings": given}, ordered=True).masks_at(points)
        enlarged = torch.stack([encoded.enlarge(masks) for masks in logits])
        measured(f"{name}, decoder {what}", "predicted IoU", (ious - scores).abs().max().item())
        share = ((enlarged > 0) != (full > 0)).float().mean().item()
        measured(f"{name}, decoder {what}", "share of pixels otherwise", share)
        assert share < 1e-4
        if what == "alone":
            stability = field.segment_anything.utils.amg.calculate_stability_score
            found, wanted = (stability(masks, 0.0, 1.0) for masks in (enlarged, full))
            close(f"{name}, predicted IoU", ious, scores, 7e-5, measured)
            close(f"{name}, stability", found, wanted, 1.5e-4, measured)
            close(f"{name}, logits / sd", enlarged / full.std(), full / full.std(), 5.6e-4, measured)


def test_sam_of_segment_anything(field: SimpleNamespace, tmp_path: Path, measured: Measure) -> None:
    model = scrambled(field.segment_anything.build_sam_vit_b)
    torch.save(model.state_dict(), tmp_path / "sam_vit_b_01ec64.pth")
    segmenter = load_segmenter(str(tmp_path / "sam_vit_b_01ec64.pth"), "cpu")
    photograph = np.asarray(Image.fromarray(squares(1024, 1)[0]).resize((1440, 1080)))
    points = POINTS * (1440, 1080)
    predictor = field.segment_anything.SamPredictor(model)
    with torch.inference_mode():
        predictor.set_image(photograph)
        given = torch.from_numpy(predictor.transform.apply_coords(points, photograph.shape[:2]))[:, None]
        full, scores, _ = predictor.predict_torch(given, torch.ones(len(points), 1), return_logits=True)
        encoded = segmenter.encode(photograph)
        compare("SAM ViT-B", encoded, predictor.features, points.astype(np.float32), (scores, full), measured)


def test_sam_2_of_sam2(field: SimpleNamespace, tmp_path: Path, measured: Measure) -> None:
    """On a square of its own size: others are rounded to bytes here when they are resized, not in sam2."""
    file = tmp_path / "sam2.1_hiera_tiny.pt"
    model = scrambled(field.sam2.build_sam.build_sam2, "configs/sam2.1/sam2.1_hiera_t.yaml", device="cpu")
    torch.save({"model": model.state_dict()}, file)
    segmenter = load_segmenter(str(file), "cpu")
    predictor = field.sam2.sam2_image_predictor.SAM2ImagePredictor(model)
    square = squares(1024, 1)[0]
    points = (POINTS * 1024).astype(np.float32)
    with torch.inference_mode():
        predictor.set_image(square)
        asked = {"multimask_output": True, "return_logits": True}
        answers = [predictor.predict(point[None], np.ones(1), **asked) for point in points]
        want = tuple(torch.from_numpy(np.stack([answer[part] for answer in answers])) for part in (1, 0))
        embedding = predictor.get_image_embedding()
        compare("SAM 2.1 tiny", segmenter.encode(square), embedding, points, (want[0], want[1]), measured)
    every = MaskConfig(sam=str(file), points_per_side=2, predicted_iou=0, stability=0, **PASSING)
    levels = load_mask_source(every, "cpu")(square, silent)
    assert [len(masks) > 0 for masks in levels] == [True] * MASKS_PER_POINT


class Drawn:
    """A segmenter and, for some levels, a predictor of segment_anything, which answer each point with uneven
    ellipses. The pictures they see hold the position of each pixel in the whole, for the crops."""

    name, device, shape = "drawn", "cpu", (320, 420)
    model = SimpleNamespace(mask_threshold=0.0, image_encoder=SimpleNamespace(img_size=1024))
    transform = SimpleNamespace(apply_coords=lambda points, size: points.astype(np.float32))
    picture = np.stack(np.mgrid[: shape[0], : shape[1]][::-1], axis=2)

    def __init__(self, levels: tuple[int, ...] = tuple(range(MASKS_PER_POINT))) -> None:
        rng = np.random.default_rng(0)
        self._noise = ndimage.gaussian_filter(rng.normal(size=self.shape), 1.5) * 4
        self._ellipses = [
            (rng.uniform((0, 0), self.shape[::-1], (n, 2)), rng.uniform(*radii, (n, 2)))
            for n, radii in ((120, (5, 16)), (60, (12, 34)), (20, (25, 60)))
        ]
        self._levels = list(levels)

    def encode(self, image: Array) -> Any:
        """See `Segmenter`."""
        self._seen = image
        return SimpleNamespace(masks_at=self._ask, enlarge=lambda logits: logits)

    set_image = encode

    def reset_image(self) -> None:
        del self._seen

    def predict_torch(self, points: torch.Tensor, *_: object, **__: object) -> tuple[Any, Any, None]:
        return *self._ask(points[:, 0].numpy())[::-1], None

    def _ask(self, points: Array) -> tuple[Any, Any]:
        answers = [self._answer(point) for point in points + self._seen[0, 0]]
        ious, logits = (torch.from_numpy(np.stack(part)) for part in zip(*answers, strict=True))
        return ious, logits

    def _answer(self, point: Array) -> tuple[Array, Array]:
        rng = np.random.default_rng((point * 4).astype(int))
        shifts, stretches = (
            rng.normal(size=(MASKS_PER_POINT, 2)),
            np.exp(rng.normal(size=(MASKS_PER_POINT, 2)) * 0.08),
        )
        roughness, ious = rng.uniform(0.2, 1.5, MASKS_PER_POINT), rng.uniform(0.6, 1, MASKS_PER_POINT)
        x, y = self._seen[0, :, 0], self._seen[:, 0, 1, None]
        logits = []
        for n in self._levels:
            centres, radii = self._ellipses[n]
            nearest = np.argmin((((centres - point) / radii) ** 2).sum(1))
            (u, v), (a, b) = centres[nearest] + shifts[n], radii[nearest] * stretches[n]
            smooth = np.clip(20 * (1 - ((x - u) / a) ** 2 - ((y - v) / b) ** 2), -8, 8)
            logits.append((smooth + self._noise[y, x] * roughness[n]).astype(np.float32))
        return ious[self._levels].astype(np.float32), np.stack(logits)


def test_the_filters_of_segment_anything_but_for_its_boxes(field, monkeypatch, measured):
    """Its boxes end at the last pixel, ours behind it: with ours in their place every mask is the same, bit
    by bit. What LangSplat adds, `mask_nms`, lets all pass here: test_masks.py has it."""
    config = MaskConfig(points_per_side=16, crop_layers=1, min_region=30, **PASSING)
    module = field.segment_anything.automatic_mask_generator
    theirs = module.batched_mask_to_box

    def generated(level: int) -> list[bytes]:
        generator = module.SamAutomaticMaskGenerator(
            Drawn.model,
            points_per_side=config.points_per_side,
            pred_iou_thresh=config.predicted_iou,
            stability_score_thresh=config.stability,
            box_nms_thresh=config.box_nms,
            crop_n_layers=config.crop_layers,
            crop_nms_thresh=config.box_nms,
            min_mask_region_area=config.min_region,
        )
        generator.predictor = Drawn((level,))
        found = generator.generate(Drawn.picture)
        return sorted(np.packbits(mask["segmentation"]).tobytes() for mask in found)

    ours = [
        sorted(np.packbits(mask).tobytes() for mask in masks)
        for masks in SamMasks(Drawn(), config)(Drawn.picture, silent)
    ]
    as_they_are = [generated(level) for level in range(MASKS_PER_POINT)]
    for level, (mine, other) in enumerate(zip(ours, as_they_are, strict=True)):
        for whose, masks in (("ours", mine), ("segment_anything's", other), ("both", {*mine} & {*other})):
            measured(f"masks of level {level}", whose, len(masks))
    assert as_they_are != ours
    after = torch.tensor([0, 0, 1, 1])
    monkeypatch.setattr(module, "batched_mask_to_box", lambda masks: theirs(masks) + after)
    assert [generated(level) for level in range(MASKS_PER_POINT)] == ours
    assert min(map(len, ours)) > 20
