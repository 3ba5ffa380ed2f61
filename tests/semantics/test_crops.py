"""Masked crops: what CLIP is shown."""

import numpy as np
import pytest

from langsplat_core.semantics.store import masked_crop


def test_a_square_region_of_the_right_size_is_copied_exactly() -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    mask = np.zeros((20, 30), bool)
    mask[4:12, 10:18] = True
    mask[6, 12] = False
    crop = masked_crop(image, mask, 8)
    want = image[4:12, 10:18].copy()
    want[2, 2] = 0  # black outside the mask, inside the box too
    np.testing.assert_array_equal(crop, want)


def test_a_wide_region_is_centred_between_black_bars() -> None:
    image = np.full((20, 30, 3), 200, np.uint8)
    mask = np.zeros((20, 30), bool)
    mask[5:9, 2:14] = True  # 4 rows, 12 columns: 4 black rows above, 4 below
    crop = masked_crop(image, mask, 12)
    assert (crop[:4] == 0).all()
    assert (crop[4:8] == 200).all()
    assert (crop[8:] == 0).all()


def test_shrinking_averages_instead_of_picking_pixels() -> None:
    image = np.zeros((64, 64, 3), np.uint8)
    image[::2] = 255  # stripes of one pixel: picking would give 0 or 255 everywhere
    crop = masked_crop(image, np.ones((64, 64), bool), 8)
    assert abs(crop[2:-2].astype(float) - 127.5).max() < 8


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1)])
def test_thin_images_work(shape: tuple[int, int]) -> None:
    crop = masked_crop(np.full((*shape, 3), 90, np.uint8), np.ones(shape, bool), 16)
    assert crop.shape == (16, 16, 3)
    assert crop.dtype == np.uint8
    assert 60 <= crop.max() <= 90  # a thin line is interpolated towards the black beside it


def test_an_empty_mask_is_refused() -> None:
    with pytest.raises(ValueError, match="empty"):
        masked_crop(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), bool), 8)
