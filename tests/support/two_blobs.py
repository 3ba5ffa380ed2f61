"""Two blobs of Gaussians with a meaning each, and random codecs, for tests of queries."""

from itertools import pairwise

import numpy as np

from langsplat_core.scene import (
    AutoencoderCodec,
    Gaussians,
    LanguageField,
    LinearCodec,
    Scene,
    look_at,
)
from tests.support.fakes import everyday_about

D = 16


def random_codec(rng: np.random.Generator, d: int = 3) -> AutoencoderCodec:
    """A smooth random autoencoder: untrained weights of moderate size."""

    def layers(widths):
        return tuple(
            (
                (rng.normal(size=(b, a)) * (1.6 / a**0.5)).astype(np.float32),
                (0.3 * rng.normal(size=b)).astype(np.float32),
            )
            for a, b in pairwise(widths)
        )

    return AutoencoderCodec(layers((D, 24, d)), layers((d, 24, 32, D)))


def blob(centre, count: int, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(centre) + 0.1 * rng.normal(size=(count, 3))


def two_blob_scene(linear: bool = True) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Two blobs 2 units apart whose vectors are the axes 0 and 1; canonical phrases are axes 8 to 11."""
    rng = np.random.default_rng(0)
    count = 60
    means = np.concatenate([blob((-1, 0, 4), count, rng), blob((1, 0, 4), count, rng)])
    gaussians = Gaussians(
        means=means,
        log_scales=np.full((2 * count, 3), np.log(0.08)),
        quats_wxyz=np.tile([1.0, 0, 0, 0], (2 * count, 1)),
        opacity_logits=np.full(2 * count, 2.0),
        sh=np.zeros((2 * count, 1, 3)),
    )
    basis = np.eye(D, dtype=np.float32)[:8]
    vectors = np.repeat(np.eye(D, dtype=np.float32)[:2], count, 0)
    codec = LinearCodec(basis)
    latents = np.stack([codec.encode(vectors)] * 3).astype(np.float32)
    latents[0] = 0  # subparts: nothing observed
    confidence = np.ones((3, 2 * count), np.float32)
    confidence[0] = 0
    field = LanguageField(latents, confidence, codec, np.eye(D, dtype=np.float32)[8:12], "none")
    phrasebook = {"Left": np.eye(D, dtype=np.float32)[0], "nowhere": np.eye(D, dtype=np.float32)[5]}
    everyday = everyday_about(np.eye(D)[8])
    field = LanguageField(latents, confidence, codec, field.canonical, "none", phrasebook, everyday=everyday)
    camera = look_at(np.zeros(3), np.array([0, 0, 4.0]), np.array([0, -1.0, 0]), (64, 48))
    return Scene(gaussians, field, (camera,)), means[:count], means[count:]
