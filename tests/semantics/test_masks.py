"""Maps of masks, the segmenter without weights, and masks of the SAM family against plain loops."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import ndimage
from skimage.restoration import denoise_tv_chambolle
from transformers import Sam2Model, SamModel

from langsplat_core.config import MaskConfig
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.progress import silent
from langsplat_core.semantics import sam
from langsplat_core.semantics.masks import (
    GraphMasks,
    RegionGraph,
    box_nms,
    clean_regions,
    common_pixels,
    denoise,
    label_maps,
    mask_boxes,
    mask_nms,
    nested_partitions,
)
from langsplat_core.semantics.sam import SamMasks, load_mask_source, load_segmenter
from tests.support.tiny_models import SAM_SIDE as SIDE
from tests.support.tiny_models import change_json, tiny_sam, tiny_sam2, tiny_sam2_video

pytestmark = pytest.mark.long


def rendering() -> tuple[np.ndarray, np.ndarray]:
    """Three shaded balls on a grey floor: image (H, W, 3) uint8 and (H, W) which ball, -1 for the floor."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:120, 0:160]
    image = np.full((120, 160, 3), 0.55)
    ball = np.full((120, 160), -1)
    paints = [(0.8, 0.15, 0.1), (0.15, 0.6, 0.2), (0.15, 0.25, 0.8)]
    for k, (cx, cy, r) in enumerate([(35, 40, 24), (85, 75, 28), (125, 30, 18)]):
        u, v = (x - cx) / r, (y - cy) / r
        inside = u * u + v * v <= 1
        light = np.clip(-0.4 * u - 0.6 * v + 0.7 * np.sqrt(np.maximum(1 - u * u - v * v, 0)), 0, 1)
        image[inside] = ((0.3 + 0.7 * light)[..., None] * np.array(paints[k]))[inside]
        ball[inside] = k
    noisy = image + rng.normal(0, 0.01, image.shape)
    return (noisy.clip(0, 1) * 255).astype(np.uint8), ball


def test_later_masks_cover_earlier_ones_and_hidden_masks_have_no_row() -> None:
    left, right, everything = np.zeros((3, 2, 4), bool)
    left[:, :2], right[:, 2:], everything[:] = True, True, True
    first = np.stack([left, everything, right])  # `left` ends with no visible pixel
    second = np.stack([right])
    levels = (first, second, np.zeros((0, 2, 4), bool))
    maps = label_maps(levels)
    assert maps.dtype == np.int32
    assert maps[0].tolist() == [[0, 0, 1, 1]] * 2
    assert maps[1].tolist() == [[-1, -1, 2, 2]] * 2
    assert (maps[2] == -1).all()


@pytest.mark.parametrize("seed", range(3))
def test_partitions_are_nested_and_cover_everything(seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (12, 17, 3), dtype=np.uint8)
    image = np.kron(image, np.ones((8, 8, 1), np.uint8))  # coloured tiles: many regions at every level
    levels = nested_partitions(image)
    assert levels.shape == (3, 96, 136)
    counts = [labels.max() + 1 for labels in levels]
    assert counts[0] > counts[1] > counts[2] > 1
    assert [len(np.unique(labels)) for labels in levels] == counts
    for fine, coarse in pairwise(levels.reshape(3, -1)):  # a fine region lies in exactly one coarse region
        assert np.unique(np.stack([fine, coarse]), axis=1).shape[1] == fine.max() + 1
    np.testing.assert_array_equal(levels, nested_partitions(image))


def test_shaded_balls_are_found_whole() -> None:
    image, ball = rendering()
    wholes = nested_partitions(image)[2]
    for one in (ball == k for k in range(3)):
        found = (wholes == i for i in np.unique(wholes))
        assert max((some & one).sum() / (some | one).sum() for some in found) > 0.9


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (2, 3), (3, 500)])
@pytest.mark.parametrize("noise", [False, True])
def test_degenerate_pictures_work(shape: tuple[int, int], noise: bool) -> None:
    image = np.random.default_rng(0).integers(0, 256 if noise else 1, (*shape, 3), dtype=np.uint8)
    smooth = denoise_tv_chambolle(image / np.float32(255), 0.12, max_num_iter=60, channel_axis=-1)
    np.testing.assert_allclose(denoise(image / np.float32(255), 0.12), smooth, atol=1e-6)
    masks = GraphMasks()(image, silent)
    assert all((stack.sum(axis=0) == 1).all() for stack in masks)
    maps = label_maps(masks)
    assert maps.min() == 0
    if not noise:
        assert maps[2].max() - maps[1].max() == 1  # one colour is one region


def test_merging_follows_the_cheapest_pair() -> None:
    labels = np.repeat(np.arange(4), 5)[None].repeat(6, axis=0)  # four stripes
    colours = np.zeros((6, 20, 3))
    colours[..., 1] = np.array([0.0, 1.0, 30.0, 90.0])[labels]
    graph = RegionGraph(labels, colours)
    graph.merge_until(10.0, 0.0)
    assert graph.partition()[0].tolist() == np.repeat([0, 0, 1, 2], 5).tolist()
    graph.merge_until(1e9, 0.0)
    assert (graph.partition() == 0).all()


def test_small_regions_join_their_likest_neighbour() -> None:
    labels = np.zeros((20, 20), int)
    labels[:, 10:] = 1
    labels[8:12, 9:11] = 2  # 8 px on the border of both halves
    colours = np.zeros((20, 20, 3))
    colours[..., 1] = np.array([0.0, 80.0, 70.0])[labels]
    graph = RegionGraph(labels, colours)
    graph.merge_until(0.0, 0.05)
    merged = graph.partition()
    assert merged[10, 10] == merged[10, 15] != merged[0, 0]


# The filters of masks against plain loops.


def plain_mask_nms(masks: np.ndarray, scores: np.ndarray, config: MaskConfig) -> list[int]:
    """The rule of LangSplat's preprocessing, one pair at a time."""
    kept = []
    for i, mask in enumerate(masks):
        good = scores[i] > config.nms_score
        for j, other in enumerate(masks):
            if i == j:
                continue
            both = (mask & other).sum()
            if scores[j] > scores[i] and both / (mask | other).sum() > config.nms_iou:
                good = False
            mine, its = both / mask.sum(), both / other.sum()
            if mine >= 0.85 and its < 0.5 and 1 - mine * its > config.nms_inner:
                good = False
        if good:
            kept.append(i)
    return kept


def plain_box_nms(boxes: np.ndarray, scores: np.ndarray, limit: float) -> list[int]:
    drawn = np.zeros((len(boxes), 100, 100), bool)
    for image, (left, top, right, bottom) in zip(drawn, boxes, strict=True):
        image[top:bottom, left:right] = True
    kept: list[int] = []
    for i in sorted(range(len(boxes)), key=lambda k: (-scores[k], k)):
        if not any((drawn[i] & drawn[j]).sum() / (drawn[i] | drawn[j]).sum() > limit for j in kept):
            kept.append(i)
    return kept


def blobs(count: int, seed: int) -> np.ndarray:
    """Masks of many sizes, many of them nested, doubled or nearly so."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:40, 0:50]
    masks = []
    for _ in range(count):
        centre, radius = rng.uniform((5, 5), (35, 45)), rng.choice([3, 5, 8, 12, 15])
        masks.append((y - centre[0]) ** 2 + (x - centre[1]) ** 2 <= radius**2)
        if rng.random() < 0.5:
            masks.append(np.roll(masks[-1], rng.integers(-2, 3, 2), (0, 1)))
    return np.stack(masks)


@pytest.mark.parametrize("seed", range(5))
def test_suppression_agrees_with_double_loops(seed: int) -> None:
    masks = blobs(40, seed)
    scores = np.random.default_rng(seed).uniform(0.6, 1, len(masks))
    boxes = mask_boxes(masks)
    assert box_nms(boxes, scores, 0.7).tolist() == plain_box_nms(boxes, scores, 0.7)
    kept = mask_nms(masks, scores, MaskConfig()).tolist()
    assert kept == plain_mask_nms(masks, scores, MaskConfig())
    assert 3 < len(kept) < len(masks) - 10


def test_common_pixels_are_exact_beyond_one_product() -> None:
    masks = np.random.default_rng(0).random((3, 300, 400)) < 0.7  # two chunks of 65536
    want = [[(a & b).sum() for b in masks] for a in masks]
    np.testing.assert_array_equal(common_pixels(masks), want)


def plain_clean(mask: np.ndarray, min_region: int) -> np.ndarray:
    """Holes, then islands, on the whole picture, one component at a time."""
    mask = mask.copy()
    for value in (False, True):
        parts, count = ndimage.label(mask == value, np.ones((3, 3)))
        sizes = [(parts == i).sum() for i in range(1, count + 1)]
        small = [i for i, size in enumerate(sizes, 1) if size < min_region]
        if value and len(small) == count:
            small.remove(1 + int(np.argmax(sizes)))
        for i in small:
            mask[parts == i] = not value
    return mask


@pytest.mark.parametrize("seed", range(30))
def test_cleaning_agrees_with_the_whole_picture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = rng.integers(6, 40, 2)
    noise = ndimage.gaussian_filter(rng.normal(size=shape), rng.choice([0.7, 1.5, 3]))
    mask = noise > np.quantile(noise, rng.choice([0.1, 0.5, 0.9]))
    if seed % 3 == 0:
        mask[: rng.integers(1, 4)] = mask[:, : rng.integers(1, 4)] = False
    if not mask.any():
        mask[-1, -1] = True
    for min_region in (2, 12, 60):
        want = plain_clean(mask, min_region)
        got, changed = clean_regions(mask, min_region)
        np.testing.assert_array_equal(got, want)
        assert changed == (want != mask).any()


def test_a_box_tied_at_the_limit_stays() -> None:
    boxes = np.array([[0, 0, 9, 10], [0, 0, 9, 7]])  # 63 of 90 px, though 0.7 * 90 is less than 63 in floats
    assert box_nms(boxes, np.array([0.9, 0.8]), 0.7).tolist() == [0, 1]
    assert box_nms(boxes, np.array([0.9, 0.8]), 0.69).tolist() == [0]


# The crops that SAM sees beside the whole picture, and what becomes of the masks that they give.


def test_crops_are_those_of_the_public_code() -> None:
    # overlap int(1080 * 512 / 1500) = 368; width (1440 + 368) / 2 = 904, height (1080 + 368) / 2 = 724
    corners = [(0, 0), (0, 356), (536, 0), (536, 356)]
    want = [(0, 0, 1440, 1080), *((x, y, x + 904, y + 724) for x, y in corners)]
    assert sam.crop_boxes((1080, 1440), 1).tolist() == [list(box) for box in want]
    assert sam.crop_boxes((1080, 1440), 0).tolist() == [[0, 0, 1440, 1080]]
    assert len(sam.crop_boxes((1080, 1440), 2)) == 1 + 4 + 16
    for shape in [(1, 1), (1, 70), (7, 3)]:
        boxes = sam.crop_boxes(shape, 2)
        assert (boxes[:, :2] < boxes[:, 2:]).all()
        assert boxes.max(axis=0).tolist() == [*boxes[:, :2].max(axis=0), shape[1], shape[0]]


# SAM masks: the real loading path, with a tiny model made here, against one point at a time.


# Random weights give random scores: thresholds that let some masks through each filter, and stop some.

FILTERS = {"predicted_iou": -0.8, "stability": 0.95, "stability_offset": 0.01, "box_nms": 0.99}
FILTERS |= {"nms_iou": 0.95, "nms_score": -9.0, "nms_inner": 0.9}

LOOSE = MaskConfig(source="sam", points_per_side=5, points_per_batch=7, min_region=12, **FILTERS)

FAMILIES: dict[str, tuple[Callable[[Path], Any], Any, MaskConfig]] = {
    "sam": (tiny_sam, SamModel, LOOSE),
    "sam2": (tiny_sam2, Sam2Model, replace(LOOSE, predicted_iou=0.4)),
    "sam2_video": (tiny_sam2_video, Sam2Model, replace(LOOSE, predicted_iou=0.5)),
}


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> MaskConfig:
    folder = tmp_path_factory.mktemp("sam")
    tiny_sam(folder)
    return replace(LOOSE, sam=str(folder))


def photograph(height: int = 48, width: int = 80) -> np.ndarray:
    noise = np.random.default_rng(2).uniform(0, 255, (height, width, 3))
    return ndimage.gaussian_filter(noise, (4, 4, 0)).clip(0, 255).astype(np.uint8)


def test_the_grid_is_made_of_cell_centres() -> None:
    assert sam.grid_points(2, (40, 80)).tolist() == [[20, 10], [60, 10], [20, 30], [60, 30]]


def test_preprocessing_scales_the_longer_side_and_pads() -> None:
    pixels, size = sam.normalised(np.full((10, 30, 3), 255, np.uint8), 64, padded=True)
    assert size == (21, 64)
    assert pixels.shape == (1, 3, 64, 64)
    np.testing.assert_allclose(pixels[0, :, 0, 0], [2.2489, 2.4286, 2.6400], atol=1e-4)
    assert (pixels[0, :, 21:] == 0).all()


def test_upscaling_forgets_the_padding() -> None:
    logits = torch.arange(16.0).repeat(16, 1)[None]  # rises by 1 per column of 16: 4 px of 64
    full = sam.EncodedImage(None, {}, 64, (32, 64), (16, 32), ordered=True).enlarge(logits)
    assert full.shape == (1, 16, 32)
    columns = (np.arange(32) + 0.5) / 2 - 0.5
    np.testing.assert_allclose(full[0, 5, 1:-1], columns[1:-1], atol=1e-5)


def test_boxes_and_stability_are_those_of_whole_masks() -> None:
    rng = np.random.default_rng(0)
    logits = ndimage.gaussian_filter(rng.normal(size=(9, 30, 41)), (0, 3, 3)) * 20 - 1.5
    logits[0], logits[1] = -5, 5
    logits[2], logits[2, 29, 40] = -0.5, 0.5  # one pixel, in the corner
    found = sam.measure(torch.from_numpy(logits.astype(np.float32)), 1.0).numpy()
    assert found[0].tolist() == [0] * 5  # nothing at all
    assert found[2].tolist() == [0, 40, 29, 41, 30]
    np.testing.assert_array_equal(found[1:, 1:], mask_boxes(logits[1:] > 0))
    for row, mask in zip(found, logits, strict=True):
        assert row[0] == pytest.approx((mask > 1).sum() / max((mask > -1).sum(), 1), rel=1e-6)


def plain_answer(model: Any, image: np.ndarray, point: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (3,) scores and (3, H, W) logits of subpart, part and whole at one point, by the whole model."""
    height, width = image.shape[:2]
    pixels, size = sam.normalised(image, SIDE, padded=not isinstance(model, Sam2Model))
    scale = np.array([size[1] / width, size[0] / height])
    given = torch.from_numpy((point * scale).astype(np.float32))[None, None, None]
    with torch.no_grad():
        answer = model(pixel_values=torch.from_numpy(pixels), input_points=given)
    ious, low = answer.iou_scores[0, 0], answer.pred_masks[0, 0]
    padding = None if isinstance(model, Sam2Model) else size
    full = sam.EncodedImage(model, {}, SIDE, padding, (height, width), ordered=True).enlarge(low)
    if not isinstance(model, SamModel):
        order = sorted(range(3), key=lambda k: int((low[k] > 0).sum()))
        ious, full = ious[order], full[order]
    return ious, full


Found = tuple[np.ndarray, float, float]  # mask, predicted IoU, stability


def plain_proposals(
    model: Any, image: np.ndarray, crop: tuple[int, ...], config: MaskConfig, level: int
) -> list[Found]:
    left, top, right, bottom = crop
    part = image[top:bottom, left:right]
    found = []
    for point in sam.grid_points(config.points_per_side, part.shape[:2]):
        ious, logits = plain_answer(model, part, point)
        iou, logits = ious[level].item(), logits[level].numpy()
        offset = config.stability_offset
        stability = (logits > offset).sum() / max((logits > -offset).sum(), 1)
        if iou > config.predicted_iou and stability >= config.stability and (logits > 0).any():
            mask = np.zeros(image.shape[:2], bool)
            mask[top:bottom, left:right] = logits > 0
            if not plain_cut(mask, crop):
                found.append((mask, iou, stability))
    return plain_suppression(found, [iou for _, iou, _ in found], config)


def plain_cut(mask: np.ndarray, crop: tuple[int, ...]) -> bool:
    box, picture = mask_boxes(mask[None])[0], (0, 0, mask.shape[1], mask.shape[0])
    sides = zip(box, crop, picture, strict=True)
    return any(abs(b - c) <= 20 and abs(b - p) > 20 for b, c, p in sides)


def plain_suppression(found: list[Found], scores: list[float], config: MaskConfig) -> list[Found]:
    if not found:
        return []
    boxes = mask_boxes(np.stack([mask for mask, _, _ in found]))
    return [found[i] for i in plain_box_nms(boxes, np.array(scores), config.box_nms)]


def plain_level(
    model: Any, image: np.ndarray, crops: list[tuple[int, ...]], config: MaskConfig, level: int
) -> list[np.ndarray]:
    """One level by the book: one point at a time through the whole model, lists and loops."""
    found, areas = [], []
    for crop in crops:
        more = plain_proposals(model, image, crop, config, level)
        found += more
        areas += [(crop[2] - crop[0]) * (crop[3] - crop[1])] * len(more)
    found = plain_suppression(found, [1 / area for area in areas], config)
    if not found:
        return []
    cleaned = [clean_regions(mask, config.min_region) for mask, _, _ in found]
    boxes = mask_boxes(np.stack([mask for mask, _ in cleaned]))
    again = plain_box_nms(boxes, np.array([not changed for _, changed in cleaned], float), config.box_nms)
    masks = [cleaned[i][0] for i in again]
    scores = np.array([found[i][1] * found[i][2] for i in again])
    return [masks[i] for i in plain_mask_nms(np.stack(masks), scores, config)]


def compare(config: MaskConfig, model: Any, image: np.ndarray, crops: list[tuple[int, ...]]) -> list[int]:
    """The masks of every level against the plain ones; returns how many there are."""
    levels = load_mask_source(config, "cpu")(image, silent)
    for level in range(3):
        want = plain_level(model, image, crops, config, level)
        assert len(levels[level]) == len(want)
        for got, mask in zip(levels[level], want, strict=True):
            assert (got ^ mask).sum() <= 2  # batches of another size: float32 logits near zero may flip
    return [len(masks) for masks in levels]


@pytest.mark.parametrize("family", FAMILIES)
def test_the_whole_source_agrees_with_one_point_at_a_time(family: str, tmp_path: Path) -> None:
    make, kind, thresholds = FAMILIES[family]
    make(tmp_path)
    config, image = replace(thresholds, sam=str(tmp_path)), photograph()
    counts = compare(config, kind.from_pretrained(tmp_path).eval(), image, [(0, 0, 80, 48)])
    assert sum(counts) >= 3
    everything = replace(config, predicted_iou=-99.0, stability=0.0)
    loose = load_mask_source(everything, "cpu")(image, silent)
    assert sum(map(len, loose)) > sum(counts)  # so both scores did filter something


@pytest.mark.parametrize("family", ["sam", "sam2"])
def test_a_layer_of_crops_agrees_with_crops_one_after_another(family: str, tmp_path: Path) -> None:
    make, kind, thresholds = FAMILIES[family]
    make(tmp_path)
    config, image = replace(thresholds, sam=str(tmp_path), crop_layers=1, points_per_side=3), photograph()
    # overlap int(48 * 512 / 1500) = 16; width (80 + 16) / 2 = 48, height (48 + 16) / 2 = 32
    crops = [(0, 0, 48, 32), (0, 16, 48, 48), (32, 0, 80, 32), (32, 16, 80, 48)]
    compare(config, kind.from_pretrained(tmp_path).eval(), image, [(0, 0, 80, 48), *crops])
    assert load_mask_source(config, "cpu").key != load_mask_source(replace(config, crop_layers=0), "cpu").key


def test_sam_decoder_norms_have_the_published_epsilon(tmp_path: Path) -> None:
    tiny_sam(tmp_path)
    answers = []
    for epsilon in (1e-6, 0.5):
        own = {"layer_norm_eps": epsilon}
        change_json(tmp_path / "config.json", lambda top, own=own: top["mask_decoder_config"].update(own))
        with torch.inference_mode():
            encoded = load_segmenter(str(tmp_path), "cpu").encode(photograph())
            answers.append(encoded.masks_at(sam.grid_points(2, (48, 80))))
    assert torch.equal(answers[0][1], answers[1][1])


def test_no_mask_is_an_answer_and_thin_pictures_work(config: MaskConfig) -> None:
    levels = load_mask_source(replace(config, predicted_iou=99.0), "cpu")(photograph(), silent)
    assert [masks.shape for masks in levels] == [(0, 48, 80)] * 3
    for shape in ((1, 1), (1, 70), (70, 1)):
        levels = load_mask_source(config, "cpu")(np.full((*shape, 3), 80, np.uint8), silent)
        assert all(masks.shape[1:] == shape for masks in levels)


def test_sources_are_chosen_and_absences_named(config: MaskConfig, tmp_path: Path) -> None:
    assert load_mask_source(MaskConfig()).name == "graph (no weights)"
    assert load_mask_source(replace(config, source="auto"), "cpu").name == f"SAM {config.sam}"
    assert load_mask_source(replace(config, source="graph")).name == "graph (no weights)"
    with pytest.raises(InputError, match=r"--masks\.sam facebook/sam-vit-huge"):
        load_mask_source(MaskConfig(source="sam"))
    with pytest.raises(EncoderError, match=r"`--masks\.sam FOLDER`"):
        load_mask_source(MaskConfig(sam=str(tmp_path / "absent")))
    (tmp_path / "config.json").write_text('{"model_type": "clip"}', encoding="utf-8")
    (tmp_path / "model.safetensors").write_bytes(b"")
    with pytest.raises(EncoderError, match="none of the segmenters"):
        load_mask_source(MaskConfig(sam=str(tmp_path)))


def test_overflow_of_float16_is_computed_in_float32(config: MaskConfig) -> None:
    segmenter, asked = load_segmenter(config.sam, "cpu"), []

    class Overflowing:
        name = "overflowing"

        def encode(self, image: np.ndarray) -> sam.EncodedImage:
            asked.append(torch.is_autocast_enabled("cpu"))
            encoded = segmenter.encode(image)
            if asked[-1]:
                encoded.seen["image_embeddings"].fill_(torch.inf)
            return encoded

    found = SamMasks(Overflowing(), config, half_on="cpu")(photograph(), silent)
    for got, want in zip(found, SamMasks(segmenter, config)(photograph(), silent), strict=True):
        np.testing.assert_array_equal(got, want)
    assert asked == [True, False]
