"""Comparisons bit for bit: a file that was written and read again is the same scene."""

import numpy as np

from langsplat_core.scene import Gaussians, LanguageField

FIELDS = ("means", "log_scales", "quats_wxyz", "opacity_logits", "sh")


def assert_same(got: Gaussians, want: Gaussians) -> None:
    """Bit for bit, NaN included."""
    for field in FIELDS:
        a, b = getattr(got, field), getattr(want, field)
        assert a.dtype == np.float32
        np.testing.assert_array_equal(a.view(np.uint32), b.view(np.uint32), field)


def assert_same_extras(got, want) -> None:
    assert list(got) == list(want)
    for name, values in want.items():
        assert got[name].dtype == values.dtype
        np.testing.assert_array_equal(got[name], values, name)


def assert_same_field(got: LanguageField, want: LanguageField) -> None:
    """Bit for bit: a saved scene must answer exactly like the one in memory."""
    for name in ("latents", "confidence", "canonical"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), name)
    assert (got.things is None) == (want.things is None)
    if want.things is not None:
        np.testing.assert_array_equal(got.things, want.things)
        assert got.things.dtype == np.uint16
    assert (got.everyday is None) == (want.everyday is None)
    if want.everyday is not None:
        np.testing.assert_array_equal(got.everyday, want.everyday)
    assert got.encoder_id == want.encoder_id
    assert got.reading == want.reading
    assert got.codec.kind == want.codec.kind
    assert got.codec.tensors().keys() == want.codec.tensors().keys()
    for name, tensor in want.codec.tensors().items():
        np.testing.assert_array_equal(got.codec.tensors()[name], tensor, name)
    assert list(got.phrasebook) == list(want.phrasebook)
    for phrase, vector in want.phrasebook.items():
        np.testing.assert_array_equal(got.phrasebook[phrase], vector)
