"""SAM masks: the real loading path, with a tiny model made here, against one point at a time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage
from transformers import SamConfig, SamModel

from langsplat_core.config import MaskConfig
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.progress import silent
from langsplat_core.semantics.mask_filters import (
    clean_regions,
    mask_boxes,
)
from langsplat_core.semantics.sam import grid_points, load_sam, preprocess, upscale
from langsplat_core.semantics.sources import load_mask_source
from tests.support.plain_filters import plain_box_nms, plain_mask_nms

pytestmark = pytest.mark.long  # transformers alone takes seconds to load

SIDE = 64
# Random weights give random scores: thresholds that let some masks through each filter, and stop some.
LOOSE = MaskConfig(
    source="sam",
    points_per_side=5,
    points_per_batch=7,
    predicted_iou=-0.8,
    stability=0.95,
    stability_offset=0.01,
    box_nms=0.99,
    min_region=12,
    nms_iou=0.95,
    nms_score=-9.0,
    nms_inner=0.9,
)


def tiny_sam(folder: Path) -> None:
    torch.manual_seed(9)
    size = {"image_size": SIDE, "patch_size": 16}
    model = SamModel(
        SamConfig(
            vision_config=size
            | {
                "hidden_size": 16,
                "num_hidden_layers": 2,
                "num_attention_heads": 2,
                "mlp_dim": 16,
                "output_channels": 16,
                "window_size": 2,
                "global_attn_indexes": [1],
                "num_pos_feats": 8,
            },
            prompt_encoder_config=size | {"hidden_size": 16, "image_embedding_size": SIDE // 16},
            mask_decoder_config={
                "hidden_size": 16,
                "mlp_dim": 16,
                "num_attention_heads": 2,
                "iou_head_hidden_dim": 16,
                "num_hidden_layers": 2,
            },
        )
    )
    with torch.no_grad():  # large enough weights that masks differ from point to point
        for parameter in model.mask_decoder.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.4)
        for parameter in model.prompt_encoder.parameters():
            parameter.mul_(20)
    model.save_pretrained(folder)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> MaskConfig:
    folder = tmp_path_factory.mktemp("sam")
    tiny_sam(folder)
    return replace(LOOSE, sam=str(folder))


def photograph(height: int = 48, width: int = 80) -> np.ndarray:
    noise = np.random.default_rng(2).uniform(0, 255, (height, width, 3))
    return ndimage.gaussian_filter(noise, (4, 4, 0)).clip(0, 255).astype(np.uint8)


def test_the_grid_is_made_of_cell_centres() -> None:
    points = grid_points(2, (40, 80))
    assert points.tolist() == [[20, 10], [60, 10], [20, 30], [60, 30]]


def test_preprocessing_scales_the_longer_side_and_pads() -> None:
    pixels, size = preprocess(np.full((10, 30, 3), 255, np.uint8), 64)
    assert size == (21, 64)
    assert pixels.shape == (1, 3, 64, 64)
    np.testing.assert_allclose(pixels[0, :, 0, 0], [2.2489, 2.4286, 2.6400], atol=1e-4)
    assert (pixels[0, :, 21:] == 0).all()


def test_upscaling_forgets_the_padding() -> None:
    logits = torch.arange(16.0).repeat(16, 1)[None]  # rises by 1 per column of 16: 4 px of 64
    full = upscale(logits, 64, (32, 64), (16, 32))
    assert full.shape == (1, 16, 32)
    columns = (np.arange(32) + 0.5) / 2 - 0.5
    np.testing.assert_allclose(full[0, 5, 1:-1], columns[1:-1], atol=1e-5)


def plain_level(image: np.ndarray, config: MaskConfig, level: int) -> list[np.ndarray]:
    """One level by the book: one point at a time through the whole model, lists and loops."""
    model = SamModel.from_pretrained(config.sam).eval()
    pixels, size = preprocess(image, SIDE)
    found = []
    for point in grid_points(config.points_per_side, size):
        with torch.no_grad():
            answer = model(
                pixel_values=torch.from_numpy(pixels), input_points=torch.from_numpy(point)[None, None, None]
            )
        iou = answer.iou_scores[0, 0, level].item()
        logits = upscale(answer.pred_masks[0, 0, level][None], SIDE, size, image.shape[:2])[0].numpy()
        offset = config.stability_offset
        stability = (logits > offset).sum() / max((logits > -offset).sum(), 1)
        if iou > config.predicted_iou and stability >= config.stability and (logits > 0).any():
            found.append((logits > 0, iou, stability))
    if not found:
        return []
    boxes = mask_boxes(np.stack([mask for mask, _, _ in found]))
    found = [found[i] for i in plain_box_nms(boxes, np.array([iou for _, iou, _ in found]), config.box_nms)]
    cleaned = [clean_regions(mask, config.min_region) for mask, _, _ in found]
    boxes = mask_boxes(np.stack([mask for mask, _ in cleaned]))
    again = plain_box_nms(boxes, np.array([not changed for _, changed in cleaned], float), config.box_nms)
    masks = [cleaned[i][0] for i in again]
    scores = np.array([found[i][1] * found[i][2] for i in again])
    return [masks[i] for i in plain_mask_nms(np.stack(masks), scores, config)]


def test_the_whole_source_agrees_with_one_point_at_a_time(config: MaskConfig) -> None:
    image = photograph()
    levels = load_sam(config, "cpu")(image, silent)
    counts = []
    for level in range(3):
        want = plain_level(image, config, level)
        counts.append(len(want))
        assert len(levels.masks[level]) == len(want)
        for got, mask in zip(levels.masks[level], want, strict=True):
            assert (got ^ mask).sum() <= 2  # batches of another size: float32 logits near zero may flip
    assert sum(counts) >= 4
    everything = replace(config, predicted_iou=-99.0, stability=0.0)
    loose = load_sam(everything, "cpu")(image, silent)
    assert sum(map(len, loose.masks)) > sum(counts)  # so both scores did filter something


def test_batches_do_not_change_the_masks(config: MaskConfig) -> None:
    one = load_sam(replace(config, points_per_batch=1), "cpu")
    all_at_once = load_sam(replace(config, points_per_batch=64), "cpu")
    assert one.key == all_at_once.key
    assert one.key != load_sam(replace(config, box_nms=0.6), "cpu").key
    for a, b in zip(one(photograph(), silent).masks, all_at_once(photograph(), silent).masks, strict=True):
        assert a.shape == b.shape
        assert (a ^ b).sum() <= 2 * len(a)


def test_no_mask_at_all_is_an_answer(config: MaskConfig) -> None:
    levels = load_sam(replace(config, predicted_iou=99.0), "cpu")(photograph(), silent)
    assert [masks.shape for masks in levels.masks] == [(0, 48, 80)] * 3


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (70, 1)])
def test_thin_pictures_work(config: MaskConfig, shape: tuple[int, int]) -> None:
    levels = load_sam(config, "cpu")(np.full((*shape, 3), 80, np.uint8), silent)
    assert all(masks.shape[1:] == shape for masks in levels.masks)


def test_progress_rises_to_one_and_may_interrupt(config: MaskConfig) -> None:
    seen: list[float] = []
    load_sam(config, "cpu")(photograph(), lambda _, fraction: seen.append(fraction))
    assert seen == sorted(seen)
    assert (seen[0], seen[-1]) == (0.0, 1.0)
    assert len(seen) == 5  # 25 points in batches of 7, and the end


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
    with pytest.raises(EncoderError, match="not Sam") as error:
        load_mask_source(MaskConfig(sam=str(tmp_path)))
    assert "\n" not in str(error.value)
