"""The filters of masks against plain loops."""

import numpy as np
import pytest
from scipy import ndimage

from langsplat_core.config import MaskConfig
from langsplat_core.semantics.sam import box_nms, clean_regions, common_pixels, mask_boxes, mask_nms
from tests.support.plain_filters import plain_box_nms, plain_mask_nms

pytestmark = pytest.mark.long


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


def test_a_small_mask_inside_a_large_one_goes_whatever_its_score() -> None:
    masks = np.zeros((2, 20, 20), bool)
    masks[0, 2:18, 2:18] = True
    masks[1, 5:10, 5:10] = True
    assert mask_nms(masks, np.array([0.75, 0.99]), MaskConfig()).tolist() == [0]


def test_of_equal_masks_the_first_stays() -> None:
    masks = np.ones((3, 4, 4), bool)
    assert mask_nms(masks, np.array([0.9, 0.9, 0.9]), MaskConfig()).tolist() == [0]


def test_crumbs_are_removed_and_small_holes_filled() -> None:
    mask = np.zeros((40, 40), bool)
    mask[5:30, 5:30] = True
    want = mask.copy()
    mask[10:13, 10:13] = False  # a hole of 9 px
    mask[35:38, 35:38] = True  # an island of 9 px
    want[15:28, 15:25] = mask[15:28, 15:25] = False  # a hole of 130 px stays
    cleaned, changed = clean_regions(mask, 100)
    np.testing.assert_array_equal(cleaned, want)
    assert changed
    assert not clean_regions(want, 100)[1]


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


def test_the_largest_island_always_stays() -> None:
    mask = np.zeros((30, 30), bool)
    mask[1:3, 1:3] = mask[10:14, 10:14] = True
    cleaned, _ = clean_regions(mask, 100)
    assert cleaned.sum() == 16
    assert cleaned[10:14, 10:14].all()


def test_a_box_tied_at_the_limit_stays() -> None:
    boxes = np.array([[0, 0, 9, 10], [0, 0, 9, 7]])  # 63 of 90 px, though 0.7 * 90 is less than 63 in floats
    assert box_nms(boxes, np.array([0.9, 0.8]), 0.7).tolist() == [0, 1]
    assert box_nms(boxes, np.array([0.9, 0.8]), 0.69).tolist() == [0]
