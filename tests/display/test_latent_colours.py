"""Colours of latents."""

import numpy as np
import pytest

from langsplat_core.display.displays import latent_colours
from langsplat_core.scene import LanguageField, LinearCodec


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
