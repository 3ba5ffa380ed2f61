"""The protocols' rules, against plain loops and by hand."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from langsplat_core.evaluation.profiles import (
    LERF_PROFILES,
    OVS_PROFILES,
    MapRule,
    SilhouetteRule,
    mean_filtered,
    peak_pixels,
    read_maps,
    read_silhouette,
    voted,
)

CODE = LERF_PROFILES["langsplat-code"].rule
PLAIN = MapRule(1, 1.0, "mirror", "peak", True, 0.7, "none", 1, 1, False)


def plain_mean(values: np.ndarray, window: int, inside: bool) -> np.ndarray:
    """Every window by itself; NumPy's "reflect" is cv2's reflect101: d c b | a b c d | c b a."""
    before, after = window // 2, window - window // 2 - 1
    if inside:
        padded = np.pad(values, (before, after), constant_values=np.nan)
    else:
        padded = np.pad(values, (before, after), mode="reflect")
    return np.nanmean(sliding_window_view(padded, (window, window)), axis=(2, 3))


@pytest.mark.parametrize("window", [2, 5, 6])
@pytest.mark.parametrize("border", ["mirror", "inside"])
def test_mean_filter(window, border):
    values = np.random.default_rng(window).uniform(size=(11, 9))
    expected = plain_mean(values, window, border == "inside")
    np.testing.assert_allclose(mean_filtered(values, window, border), expected, atol=1e-12)


def looped_vote(mask: np.ndarray, clipped: bool) -> np.ndarray:
    """LangSplat's loop slices up to the last row and column, which it never counts; V2 counts all."""
    rows, columns = mask.shape
    last = 1 if clipped else 0
    out = np.zeros(mask.shape, bool)
    for y in range(rows):
        for x in range(columns):
            seen = mask[max(0, y - 3) : min(y + 4, rows - last), max(0, x - 3) : min(x + 4, columns - last)]
            out[y, x] = 2 * seen.sum() > seen.size
    return out


@pytest.mark.parametrize("vote", ["clipped", "inside"])
def test_vote(vote):
    mask = np.random.default_rng(0).uniform(size=(14, 12)) > 0.5
    np.testing.assert_array_equal(voted(mask, vote, 7), looped_vote(mask, vote == "clipped"))


def test_ties_and_flat_maps():
    mask = np.zeros((8, 8), bool)
    mask[:, :4] = True
    assert not voted(mask, "inside", 40).any()  # the window is the whole picture: 32 of 64
    mask[0, 4] = True
    assert voted(mask, "inside", 40).all()
    flat = np.zeros((1, 2, 3))
    flat[0, 0, 1] = flat[0, 1, 2] = 0.5
    assert peak_pixels(flat, replace(PLAIN, ties=True)).tolist() == [[1, 0], [2, 1]]
    assert peak_pixels(flat, PLAIN).tolist() == [[1, 0]]
    assert not read_maps(np.full((3, 40, 40), 0.55), CODE).mask.any()


def test_the_code_cuts_the_blend_at_seven_tenths_of_its_range():
    maps = np.random.default_rng(1).uniform(0.4, 0.6, size=(3, 40, 50))
    maps[1, 10:30, 10:30] += 0.3
    answer = read_maps(maps, CODE)
    blend = 0.5 * (plain_mean(maps[1], 30, False) + maps[1])
    cut = blend.min() + 0.7 * (blend.max() - blend.min())
    assert answer.level == 1
    np.testing.assert_array_equal(answer.mask, looped_vote(blend > cut, True))
    column, row = answer.peaks[0]
    smooth = plain_mean(maps[1], 30, False)
    assert smooth[row, column] == pytest.approx(smooth.max(), abs=1e-12)


def test_the_level_is_chosen_before_min_max():
    """After it, every level's peak would be 1, and the first would always win."""
    maps = np.zeros((3, 6, 6))
    maps[0, 0, 0], maps[2, 5, 5] = 0.5, 0.6
    answer = read_maps(maps, PLAIN)
    assert answer.level == 2
    assert answer.mask.sum() == 1
    assert answer.peaks.tolist() == [[5, 5]]


def test_the_place_has_its_own_level():
    """A lone high pixel wins the raw maps, a broad one the filtered ones."""
    maps = np.zeros((2, 12, 12))
    maps[0, 1, 1] = 1.0
    maps[1, 5:10, 5:10] = 0.8
    answer = read_maps(maps, replace(PLAIN, peak_window=5))
    assert answer.level == 0
    assert answer.peaks.tolist() == [[7, 7]]


def test_3d_ovs_takes_the_level_that_is_highest_inside_its_mask():
    rule = OVS_PROFILES["langsplat-paper"].rule
    maps = np.full((3, 5, 5), 0.1)
    maps[0, :2], maps[1, 3:, 3:], maps[2] = 0.5, 0.9, 0.4  # 0.4 itself is not above 0.4
    maps[0, 4, 4] = 0.95  # the highest pixel, but 0.54 on average
    answer = read_maps(maps, rule)
    assert answer.level == 1
    assert answer.mask.sum() == 4
    assert not read_maps(np.full((3, 5, 5), 0.4), rule).mask.any()


def test_silhouette():
    rule = SilhouetteRule()
    alpha = np.array([[0.7, 0.71, 1.0, 1.0]])
    grey = np.array([200, 200, 10, 11]) / 255
    colours = np.repeat(grey[None, :, None], 3, 2)
    assert read_silhouette(colours, alpha, rule).tolist() == [[False, True, False, True]]
