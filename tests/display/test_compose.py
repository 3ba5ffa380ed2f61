"""Composition of channels into a picture."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.config import PictureConfig
from langsplat_core.display.compose import TURBO, Channels, compose, latent_colours, turbo
from langsplat_core.scene import LanguageField, LinearCodec

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


@pytest.mark.parametrize("display", ["rgb", "latent", "relevancy", "segmentation", "depth", "alpha"])
def test_every_display_is_a_picture(display):
    picture = compose(channels(), replace(PICTURE, display=display), (0.9,))
    assert picture.shape == (4, 5, 3)
    assert picture.dtype == np.uint8
    assert (picture == picture[0, 0]).all()


def test_colours_lie_over_the_background():
    half = compose(channels(alpha=0.5), replace(PICTURE, background=(1.0, 1.0, 1.0)))
    assert half[0, 0].tolist() == [191, 191, 191]  # 0.25 + 0.5


def test_uncovered_pixels_are_never_relevant():
    faint = compose(channels(relevancy=1.0, alpha=0.05), replace(PICTURE, display="relevancy"), (1.0,))
    dark = compose(channels(relevancy=0.0, alpha=0.05), replace(PICTURE, display="relevancy"), (1.0,))
    assert (faint == dark).all()


def test_heat_starts_at_the_floor_and_saturates_at_the_peak():
    heat = replace(PICTURE, display="relevancy", heat_opacity=1.0)
    below = compose(channels(relevancy=0.49), heat, (0.9,))
    assert below[0, 0].tolist() == [round(255 * 0.5 * PICTURE.dim)] * 3
    at_peak = compose(channels(relevancy=0.9), heat, (0.9,))
    np.testing.assert_allclose(at_peak[0, 0], TURBO[255], atol=1)


def test_a_peak_near_the_floor_is_not_stretched_to_full_heat():
    heat = replace(PICTURE, display="relevancy", heat_opacity=1.0)
    absent = compose(channels(relevancy=0.52), heat, (0.52,))[0, 0].astype(int)
    assert absent[2] > absent[0] + 30  # cold: 0.02 over a span of at least 0.1


def test_missing_layers_show_plain_colours():
    plain = Channels(rgb=np.full((2, 2, 3), 0.5), alpha=np.ones((2, 2)))
    for display in ("latent", "relevancy", "segmentation", "depth"):
        assert (compose(plain, replace(PICTURE, display=display)) == 128).all()


@pytest.mark.parametrize("d", [1, 2, 3, 8])
def test_latent_colours_for_any_dimension(d):
    rng = np.random.default_rng(d)
    codec = LinearCodec(np.eye(12, dtype=np.float32)[:d])
    latents = rng.normal(size=(3, 50, d)).astype(np.float32)
    confidence = np.ones((3, 50), np.float32)
    confidence[:, 10] = 0
    field = LanguageField(latents, confidence, codec, np.eye(12, dtype=np.float32)[:4], "none")
    colours = latent_colours(field)
    assert colours.shape == (3, 50, 3)
    assert colours.min() >= 0
    assert colours.max() <= 1
    assert (colours[:, 10] == 0.5).all()
    assert np.ptp(colours[:, :10]) > 0.5
