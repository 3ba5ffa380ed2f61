"""Composition of channels into a picture."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from langsplat_core.config import ColourMap, PictureConfig
from langsplat_core.display.displays import COLOUR_MAPS, DISPLAYS, NODES, TURBO, Channels, compose, mapped

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
    np.testing.assert_allclose(mapped(np.array([0.0, 1.0])), TURBO[[0, 255]] / 255)


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


@pytest.mark.parametrize("name", ["viridis", "cividis", "magma"])
def test_published_colour_maps_are_as_published(name):
    colormaps = pytest.importorskip("matplotlib").colormaps
    expected = np.rint(255 * colormaps[name](np.arange(256))[:, :3])
    np.testing.assert_array_equal(COLOUR_MAPS[name], expected)


def test_every_colour_map_that_can_be_chosen_has_a_table():
    assert tuple(COLOUR_MAPS) == get_args(ColourMap)
    assert all(table.shape == (NODES, 3) and table.dtype == np.uint8 for table in COLOUR_MAPS.values())
    assert mapped(np.array(0.25), "grey").tolist() == pytest.approx([0.25] * 3)
    assert mapped(np.array(2.0), "magma").tolist() == (COLOUR_MAPS["magma"][-1] / 255).tolist()


@pytest.mark.parametrize("name", ["viridis", "cividis", "magma", "grey"])
def test_what_is_hotter_is_brighter_where_colours_may_not_be_told_apart(name):
    luminance = COLOUR_MAPS[name] / 255.0 @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(luminance[::8]) > 0).all()


@pytest.mark.parametrize("display", DISPLAYS)
def test_a_transparent_picture_over_its_background_is_the_opaque_one(display):
    """Colours that are not premultiplied, as PNG has them: laid over a background they give what is drawn
    there, where the display draws the scene's own colours or latents."""
    picture = replace(PICTURE, display=display, background=(0.2, 0.5, 0.9))
    for alpha in (0.0, 0.2, 0.6, 1.0):
        clear = compose(channels(alpha=alpha), replace(picture, transparent=True), ((0.5, 0.9),)) / 255
        assert clear.shape == (4, 5, 4)
        share = clear[..., 3:]
        over = clear[..., :3] * share + (1 - share) * picture.background
        if display in ("rgb", "latent", "depth", "alpha") or alpha == 1:
            np.testing.assert_allclose(
                over, compose(channels(alpha=alpha), picture, ((0.5, 0.9),)) / 255, atol=0.01
            )
        if display not in ("alpha", "depth"):
            np.testing.assert_allclose(share, alpha, atol=0.003)


def test_missing_layers_show_plain_colours():
    plain = Channels(rgb=np.full((2, 2, 3), 0.5), alpha=np.ones((2, 2)))
    for display in (row.name for row in DISPLAYS.values() if row.extra != "none"):
        assert (compose(plain, replace(PICTURE, display=display)) == 128).all()
