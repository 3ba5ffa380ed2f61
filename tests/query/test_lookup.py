"""Relevancy of every Gaussian, by whatever the codec allows, against the definition."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import unit
from langsplat_core.query.lookup import build_lookup
from langsplat_core.scene import LanguageField, Reading
from langsplat_core.semantics.relevancy import relevancy
from tests.support.file_samples import random_field

TOLERANCE = {"codebook": 1e-6, "linear": 1e-5, "autoencoder": 0.05}  # the last interpolates in a table


def wanted(field: LanguageField, phrase: np.ndarray) -> np.ndarray:
    flat = field.latents.reshape(-1, field.latents.shape[2])
    vectors = field.codec.decode(flat)
    t = field.reading.temperature
    values = relevancy(vectors.astype(np.float64), phrase[None], field.canonical, t)[:, 0]
    return np.where(field.known.reshape(-1), values, 0)


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("temperature", [10.0, 25.0])
@pytest.mark.parametrize("exact", [False, True])
def test_every_lookup_finds_the_relevancy_of_what_latents_stand_for(kind, temperature, exact):
    field = replace(random_field(300, kind), reading=Reading(temperature))
    field.confidence[1, 5:20] = 0
    phrase = unit(np.random.default_rng(3).normal(size=field.codec.vector_dim)).astype(np.float32)
    got = next(build_lookup(field, exact).relevancies(phrase[None]))
    error = np.abs(got - wanted(field, phrase))
    assert error.max() < (1e-5 if exact else TOLERANCE[kind])
    assert (got.reshape(3, 300)[1, 5:20] == 0).all()


def test_codeword_zero_is_a_meaning_like_any_other():
    field = random_field(10, "codebook")
    field.latents[:] = 0
    field.confidence[:] = 1
    field.confidence[2, 4] = 0
    values = next(build_lookup(field).relevancies(field.codec.vectors[:1])).reshape(3, 10)
    assert values[2, 4] == 0
    assert (np.delete(values[2], 4) > 0.5).all()
