"""Maps of masks, and the segmenter that needs no weights."""

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core.progress import silent
from langsplat_core.semantics.masks import GraphMasks, LevelMasks, RegionGraph, label_maps, nested_partitions

pytestmark = pytest.mark.long

DATA = Path(os.environ.get("LANGSPLAT_TEST_DATA", Path(__file__).parents[3] / "shared" / "data"))
PHOTOGRAPH = DATA / "banana" / "colmap_640" / "images" / "DSC_0428.JPG"


def level_masks(*levels: np.ndarray) -> LevelMasks:
    return LevelMasks(levels, tuple(np.ones(len(masks), np.float32) for masks in levels))


def rendering(seed: int = 0, height: int = 120, width: int = 160) -> tuple[np.ndarray, np.ndarray]:
    """Three shaded balls on a grey floor: image (H, W, 3) uint8 and (H, W) which ball, -1 for the floor."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] * (120 / height)
    image = np.full((height, width, 3), 0.55)
    ball = np.full((height, width), -1)
    paints = [(0.8, 0.15, 0.1), (0.15, 0.6, 0.2), (0.15, 0.25, 0.8)]
    for k, (cx, cy, r) in enumerate([(35, 40, 24), (85, 75, 28), (125, 30, 18)]):
        u, v = (x - cx) / r, (y - cy) / r
        inside = u * u + v * v <= 1
        light = np.clip(-0.4 * u - 0.6 * v + 0.7 * np.sqrt(np.maximum(1 - u * u - v * v, 0)), 0, 1)
        image[inside] = ((0.3 + 0.7 * light)[..., None] * np.array(paints[k]))[inside]
        ball[inside] = k
    noisy = image + rng.normal(0, 0.01, image.shape)
    return (noisy.clip(0, 1) * 255).astype(np.uint8), ball


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_later_masks_cover_earlier_ones_and_hidden_masks_have_no_row() -> None:
    left, right, everything = np.zeros((3, 2, 4), bool)
    left[:, :2], right[:, 2:], everything[:] = True, True, True
    first = np.stack([left, everything, right])  # `left` ends with no visible pixel
    second = np.stack([right])
    maps = label_maps(level_masks(first, second, np.zeros((0, 2, 4), bool)))
    assert maps.dtype == np.int32
    assert maps[0].tolist() == [[0, 0, 1, 1]] * 2
    assert maps[1].tolist() == [[-1, -1, 2, 2]] * 2
    assert (maps[2] == -1).all()


def test_levels_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"masks\[1\]"):
        level_masks(np.ones((1, 4, 4), bool), np.ones((1, 4, 5), bool), np.ones((1, 4, 4), bool))


def assert_nested(levels: np.ndarray) -> None:
    for fine, coarse in pairwise(levels):
        pairs = np.unique(np.stack([fine.ravel(), coarse.ravel()]), axis=1)
        assert pairs.shape[1] == len(np.unique(fine))  # a fine region lies in exactly one coarse region


@pytest.mark.parametrize("seed", range(3))
def test_partitions_are_nested_and_cover_everything(seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (12, 17, 3), dtype=np.uint8)
    image = np.kron(image, np.ones((8, 8, 1), np.uint8))  # coloured tiles: many regions at every level
    levels = nested_partitions(image)
    assert levels.shape == (3, 96, 136)
    counts = [labels.max() + 1 for labels in levels]
    assert counts[0] > counts[1] > counts[2] > 1
    assert [len(np.unique(labels)) for labels in levels] == counts
    assert_nested(levels)
    np.testing.assert_array_equal(levels, nested_partitions(image))


def test_shaded_balls_are_found_whole() -> None:
    image, ball = rendering()
    wholes = nested_partitions(image)[2]
    for k in range(3):
        assert max(iou(wholes == i, ball == k) for i in np.unique(wholes)) > 0.9


def test_a_photograph_larger_than_the_working_size_keeps_its_size() -> None:
    image, ball = rendering(height=600, width=800)
    levels = nested_partitions(image)
    assert levels.shape == (3, 600, 800)
    assert_nested(levels)
    assert max(iou(levels[2] == i, ball == 1) for i in np.unique(levels[2])) > 0.9


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (2, 3), (3, 500)])
@pytest.mark.parametrize("noise", [False, True])
def test_degenerate_pictures_work(shape: tuple[int, int], noise: bool) -> None:
    image = np.full((*shape, 3), 128, np.uint8)
    if noise:
        image = np.random.default_rng(0).integers(0, 256, image.shape, dtype=np.uint8)
    masks = GraphMasks()(image, silent)
    for stack in masks.masks:
        assert (stack.sum(axis=0) == 1).all()
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


@pytest.mark.skipif(not PHOTOGRAPH.exists(), reason="no photographs here")
def test_a_bunch_of_bananas_is_few_regions() -> None:
    image = np.asarray(Image.open(PHOTOGRAPH))
    levels = nested_partitions(image)
    rgb = image.astype(int)
    yellow = (rgb[..., 0] - rgb[..., 2] > 50) & (rgb[..., 0] > 90)
    assert yellow.mean() > 0.03
    best = max(iou(levels[2] == i, yellow) for i in np.unique(levels[2]))
    assert best > 0.75  # `yellow` itself lacks the sticker and the brown specks
    assert levels[2].max() + 1 <= 6
