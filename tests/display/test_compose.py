"""Composition of channels into a picture."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.config import PictureConfig
from langsplat_core.display.colour_maps import TURBO, turbo
from langsplat_core.display.compose import Channels, compose
from langsplat_core.display.displays import DISPLAYS

PICTURE = PictureConfig()


def channels(relevancy: float = 0.9, alpha: float = 1.0) -> Channels:
    shape = (4, 5)
    full = np.full(shape, alpha)
    return Channels(
        rgb=np.full((*shape, 3), 0.5 * alpha),
        alpha=full,
        latent=np.full((*shape, 3), 0.25 * alpha),
        relevancies=np.full((*shape, 1), relevancy * alpha),
        depth_sum=2.0 * full,
        depth_range=(1.0, 3.0),
    )


def test_turbo_runs_from_dark_blue_over_green_to_dark_red():
    assert TURBO.shape == (256, 3)
    low, middle, high = TURBO[0].astype(int), TURBO[128].astype(int), TURBO[255].astype(int)
    assert low.sum() < 150
    assert middle.argmax() == 1
    assert high.argmax() == 0
    np.testing.assert_allclose(turbo(np.array([0.0, 1.0])), TURBO[[0, 255]] / 255)


@pytest.mark.parametrize("display", DISPLAYS)
def test_every_display_is_a_picture(display):
    picture = compose(channels(), replace(PICTURE, display=display), ((0.5, 0.9),))
    assert picture.shape == (4, 5, 3)
    assert picture.dtype == np.uint8
    assert (picture == picture[0, 0]).all()


def test_colours_lie_over_the_background():
    half = compose(channels(alpha=0.5), replace(PICTURE, background=(1.0, 1.0, 1.0)))
    assert half[0, 0].tolist() == [191, 191, 191]  # 0.25 + 0.5


def test_uncovered_pixels_are_never_relevant():
    faint = compose(channels(relevancy=1.0, alpha=0.05), replace(PICTURE, display="relevancy"))
    dark = compose(channels(relevancy=0.0, alpha=0.05), replace(PICTURE, display="relevancy"))
    assert (faint == dark).all()


def test_heat_starts_at_the_lower_end_of_its_range_and_saturates_at_the_upper():
    heat = replace(PICTURE, display="relevancy", heat_opacity=1.0)
    below = compose(channels(relevancy=0.49), heat, ((0.5, 0.9),))
    assert below[0, 0].tolist() == [round(255 * 0.5 * PICTURE.dim)] * 3
    at_peak = compose(channels(relevancy=0.9), heat, ((0.5, 0.9),))
    np.testing.assert_allclose(at_peak[0, 0], TURBO[255], atol=1)


def test_a_query_without_a_range_is_hot_over_all_of_0_to_1():
    heat = replace(PICTURE, display="relevancy", heat_opacity=1.0)
    for value in (0.0, 0.3, 1.0):
        plain = compose(channels(relevancy=value), heat)
        assert (plain == compose(channels(relevancy=value), heat, ((0.0, 1.0),))).all()


def test_missing_layers_show_plain_colours():
    plain = Channels(rgb=np.full((2, 2, 3), 0.5), alpha=np.ones((2, 2)))
    for display in (row.name for row in DISPLAYS.values() if row.extra != "none"):
        assert (compose(plain, replace(PICTURE, display=display)) == 128).all()
