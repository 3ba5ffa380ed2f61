"""Codecs: fitting, folding of batch normalisation, storage."""

from typing import get_args, get_type_hints

import numpy as np
import pytest
import torch

from langsplat_core.arrays import unit
from langsplat_core.config import CodecConfig
from langsplat_core.scene import AutoencoderCodec, LinearCodec, codec_from_tensors
from langsplat_core.scene.codec import KINDS
from langsplat_core.training.language.codec_fit import (
    FITTERS,
    codec_report,
    fit_codec,
    folded_layers,
    networks,
)
from tests.support.vocabulary import random_vocabulary

pytestmark = pytest.mark.long


def clustered(count: int = 400, clusters: int = 12, dim: int = 64) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    centres = unit(rng.normal(size=(clusters, dim)))
    labels = rng.integers(clusters, size=count)
    return unit(centres[labels] + 0.02 * rng.normal(size=(count, dim))).astype(np.float32), labels


WORDS = random_vocabulary(64)


@pytest.mark.parametrize("d", [2, 3])
def test_autoencoder_keeps_a_scenes_vectors_apart(d):
    vectors, labels = clustered()
    codec = fit_codec(vectors, CodecConfig("autoencoder", latent_dim=d, steps=700, batch=128, lr=2e-3), WORDS)
    latents = codec.encode(vectors)
    np.testing.assert_allclose(np.linalg.norm(latents, axis=1), 1, atol=1e-5)
    assert codec_report(codec, vectors, WORDS).cosine > 0.9
    # what a query needs: the decoded vector is closest to its own cluster
    centres = unit(np.stack([vectors[labels == c].mean(0) for c in range(12)]))
    right = (codec.decode(latents) @ centres.T).argmax(1) == labels
    assert right.mean() > 0.97


def test_linear_codec_is_the_best_subspace():
    vectors, _ = clustered()
    codec = fit_codec(vectors, CodecConfig(kind="linear", latent_dim=6), WORDS)
    assert isinstance(codec, LinearCodec)
    np.testing.assert_allclose(codec.basis @ codec.basis.T, np.eye(6), atol=1e-5)
    kept = ((vectors @ codec.basis.T) ** 2).sum()
    singular = np.linalg.svd(vectors.astype(np.float64), compute_uv=False)
    assert kept == pytest.approx((singular[:6] ** 2).sum(), rel=1e-5)


def test_folding_batch_normalisation_changes_nothing():
    torch.manual_seed(0)
    encoder, _ = networks(32, 3)
    data = torch.randn(200, 32)
    for _ in range(5):
        encoder(data)
    encoder.eval()
    with torch.no_grad():
        want = encoder(data).numpy()
    x = data.numpy()
    layers = folded_layers(encoder)
    for index, (weight, bias) in enumerate(layers):
        x = x @ weight.T + bias
        if index + 1 < len(layers):
            x = np.maximum(x, 0)
    np.testing.assert_allclose(x, want, atol=2e-5)


def test_codec_survives_its_tensors():
    vectors, _ = clustered(64)
    for kind in KINDS:
        codec = fit_codec(vectors, CodecConfig(kind=kind, steps=3), WORDS)
        again = codec_from_tensors(codec.kind, codec.tensors())
        assert type(again) is type(codec)
        np.testing.assert_array_equal(again.encode(vectors), codec.encode(vectors))
        latents = codec.encode(vectors)
        np.testing.assert_array_equal(again.decode(latents), codec.decode(latents))


def test_broken_tensors_are_named():
    with pytest.raises(ValueError, match="unknown codec kind"):
        codec_from_tensors("vq", {})
    with pytest.raises(ValueError, match="basis"):
        codec_from_tensors("linear", {})
    with pytest.raises(ValueError, match="encoder"):
        codec_from_tensors("autoencoder", {})
    w, b = np.zeros((3, 8), np.float32), np.zeros(3, np.float32)
    with pytest.raises(ValueError, match="mirror"):
        AutoencoderCodec(((w, b),), ((np.zeros((9, 3), np.float32), np.zeros(9, np.float32)),))
    with pytest.raises(ValueError, match="codec encoder"):
        AutoencoderCodec(((w, np.zeros(4, np.float32)),), ((w.T.copy(), np.zeros(8, np.float32)),))


def test_every_kind_in_the_settings_can_be_fitted_and_read_back() -> None:
    assert set(FITTERS) == set(KINDS) == set(get_args(get_type_hints(CodecConfig)["kind"]))


@pytest.mark.parametrize("kind", ["autoencoder", "linear"])
def test_similarities_are_the_cosines_of_what_is_decoded(kind: str) -> None:
    vectors, _ = clustered(60)
    codec = fit_codec(vectors, CodecConfig(kind=kind, latent_dim=4, steps=20), WORDS)  # type: ignore[arg-type]
    latents = 0.3 * codec.encode(vectors)  # blended latents are short
    latents[5] = 0
    texts = unit(np.random.default_rng(2).normal(size=(7, 64))).astype(np.float32)
    got = codec.similarities(latents, texts)
    directions = latents / np.maximum(np.linalg.norm(latents, axis=1, keepdims=True), 1e-12)
    want = codec.decode(directions).astype(np.float64) @ texts.T
    want[5] = 0
    assert got.dtype == np.float32
    if kind == "linear":  # decode normalises; a latent of length 1 decodes to length 1 already
        np.testing.assert_allclose(
            np.linalg.norm(directions[:5] @ codec.tensors()["basis"], axis=1), 1, atol=1e-5
        )
    np.testing.assert_allclose(got, want, atol=2e-6)


def test_similarities_of_a_codebook_are_those_of_its_codewords() -> None:
    vectors, _ = clustered(60)
    codec = fit_codec(vectors, CodecConfig(size=9), WORDS)
    latents = codec.encode(vectors)
    assert (latents.dtype, latents.shape) == (np.uint16, (60, 1))
    np.testing.assert_allclose(
        codec.similarities(latents, WORDS.phrases), codec.decode(latents) @ WORDS.phrases.T, atol=1e-6
    )
