"""From masks with vectors to a language field: memberships, codec, latents, each kept in the work folder."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy import sparse

from langsplat_core.arrays import Array
from langsplat_core.config import LiftConfig, TrainConfig
from langsplat_core.errors import InputError
from langsplat_core.pipeline.stages import Arrays, features_digest, gaussians_digest, kept, stage_key
from langsplat_core.progress import Progress
from langsplat_core.raster import LiftingRasterizer, load_lifting_rasterizer
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    Camera,
    Codec,
    Gaussians,
    LanguageField,
    codec_from_tensors,
)
from langsplat_core.scene.phrases import phrase_key
from langsplat_core.semantics.clip import ClipEncoder
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language.codec_fit import fit_codec, reconstruction_cosine
from langsplat_core.training.language.gradient_lift import lift_by_gradient
from langsplat_core.training.language.lift import Memberships, find_memberships, lift_latents, lift_vectors

Views = list[tuple[Camera, ImageFeatures]]
Lifted = list[tuple[Array, Array]]  # per level: (N, D) float16 unit vectors, (N,) float32 confidence
Latents = tuple[Array, Array]  # (3, N, d) and (3, N) float32
CODEC_SAMPLE = 20_000  # lifted vectors that the codec is fitted to beside the masks' own


def language_field(
    gaussians: Gaussians,
    views: Views,
    encoder: ClipEncoder,
    config: TrainConfig,
    work: Path,
    progress: Progress,
) -> tuple[LanguageField, float]:
    """The language field of the views' mask vectors, and the codec's mean cosine on these.

    Raises InputError where no view has a mask.
    """
    mask_vectors = np.concatenate([features.vectors for _, features in views])
    if len(mask_vectors) == 0:
        raise InputError(
            "no masks were found in any photograph; try --masks.source graph, or larger photographs"
        )
    stages = _Stages(gaussians, views, mask_vectors, config, work, progress)
    codec = stages.codec()
    latents, confidence = stages.latents(codec)
    field = LanguageField(
        latents=latents,
        confidence=confidence,
        codec=codec,
        canonical=encoder.encode_texts(list(CANONICAL_PHRASES)),
        encoder_id=encoder.id,
        phrasebook=_phrasebook(encoder, config.phrases),
    )
    return field, reconstruction_cosine(codec, mask_vectors)


class _Stages:
    """What is made on the way, each at most once, and not at all where it is kept."""

    def __init__(
        self,
        gaussians: Gaussians,
        views: Views,
        mask_vectors: Array,
        config: TrainConfig,
        work: Path,
        progress: Progress,
    ) -> None:
        self._gaussians, self._views, self._mask_vectors = gaussians, views, mask_vectors
        self._config, self._work, self._progress = config, work, progress
        self._lift = _what_matters(config.lift)
        self._inputs = (gaussians_digest(gaussians), features_digest([features for _, features in views]))
        self._lifted = cache(self._lift_vectors)

    def codec(self) -> Codec:
        """Fitted to the masks' vectors and, unless latents are averaged themselves, to lifted ones."""
        fitted_to = "masks" if self._lift.mode in LATENT_LIFTS else self._lift.mode
        key = stage_key("codec", 1, *self._inputs, fitted_to, self._config.codec)
        return kept(self._work / f"{key}.npz", self._fit, _pack_codec, _unpack_codec)

    def latents(self, codec: Codec) -> Latents:
        """Of every Gaussian at every level, and the confidence in them."""
        key = stage_key("latents", 1, *self._inputs, self._lift, self._config.codec)
        return kept(
            self._work / f"{key}.npz",
            lambda: self._lift_latents(codec),
            lambda made: {"latents": made[0], "confidence": made[1]},
            lambda arrays: (arrays["latents"], arrays["confidence"]),
        )

    def _fit(self) -> Codec:
        config = self._config.codec
        if self._lift.mode in LATENT_LIFTS:
            return fit_codec(self._mask_vectors, config, self._progress)
        return fit_codec(_codec_data(self._mask_vectors, self._lifted(), config.seed), config, self._progress)

    def _lift_latents(self, codec: Codec) -> Latents:
        if self._lift.mode in LATENT_LIFTS:
            lift = LATENT_LIFTS[self._lift.mode]
            scene = (self._rasterizer(), self._gaussians, self._views, codec)
            return lift(*scene, config=self._config.lift, progress=self._progress)
        lifted = self._lifted()
        latents = np.stack([_encode(codec, vectors, weight) for vectors, weight in lifted])
        return latents, np.stack([weight for _, weight in lifted])

    def _lift_vectors(self) -> Lifted:
        """Half precision because three levels of 512 numbers for a million Gaussians are 3 GB even so; its
        error, 5e-4, is far below a mask's."""
        key = stage_key("memberships", 1, *self._inputs)
        memberships = kept(
            self._work / f"{key}.npz", self._find_memberships, _pack_memberships, _unpack_memberships
        )
        levels = []
        for vectors, confidence in lift_vectors(memberships, robust=self._lift.mode == "median"):
            levels.append((vectors.astype(np.float16), confidence))
            self._progress("averaging mask vectors", len(levels) / 3)
        return levels

    def _find_memberships(self) -> Memberships:
        chunk = self._config.lift.chunk
        return find_memberships(
            self._rasterizer(), self._gaussians, self._views, chunk, progress=self._progress
        )

    def _rasterizer(self) -> LiftingRasterizer:
        return load_lifting_rasterizer(self._config.lift.backend)


def _what_matters(config: LiftConfig) -> LiftConfig:
    """The settings that change the result: not the backend and the batches, which change who computes."""
    if config.mode != "gradient":
        return LiftConfig(mode=config.mode)
    return replace(config, backend="auto", chunk=LiftConfig.chunk)


def _one_pass(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Views,
    codec: Codec,
    config: LiftConfig,
    progress: Progress,
) -> Latents:
    return lift_latents(rasterizer, gaussians, views, codec, progress=progress)


# Modes that lift latents of a codec that is fitted to the masks' vectors alone.
LATENT_LIFTS: Mapping[str, Callable[..., Latents]] = MappingProxyType(
    {"one-pass": _one_pass, "gradient": lift_by_gradient}
)


def _pack_codec(codec: Codec) -> Arrays:
    return {"kind": np.array(codec.kind), **codec.tensors()}


def _unpack_codec(arrays: Arrays) -> Codec:
    return codec_from_tensors(str(arrays["kind"]), {k: v for k, v in arrays.items() if k != "kind"})


def _pack_memberships(members: Memberships) -> Arrays:
    weights = members.weights
    pairs = {"data": weights.data, "indices": weights.indices, "indptr": weights.indptr}
    return {**pairs, "levels": members.levels, "vectors": members.vectors}


def _unpack_memberships(arrays: Arrays) -> Memberships:
    shape = (len(arrays["indptr"]) - 1, len(arrays["levels"]))
    weights = sparse.csr_matrix((arrays["data"], arrays["indices"], arrays["indptr"]), shape=shape)
    return Memberships(weights, arrays["levels"], arrays["vectors"])


def _phrasebook(encoder: ClipEncoder, phrases: tuple[str, ...]) -> dict[str, Array]:
    names = [phrase_key(phrase) for phrase in phrases]
    return dict(zip(names, encoder.encode_texts(names), strict=True))


def _codec_data(mask_vectors: Array, lifted: Lifted, seed: int) -> Array:
    """Mask vectors, and as many lifted ones again as `CODEC_SAMPLE` allows: those are what it encodes."""
    generator = np.random.default_rng(seed)
    samples = [mask_vectors]
    for vectors, confidence in lifted:
        seen = np.flatnonzero(confidence > 0)
        rows = generator.permutation(seen)[: CODEC_SAMPLE // len(lifted)]
        samples.append(vectors[rows].astype(np.float32))
    return np.concatenate(samples)


def _encode(codec: Codec, vectors: Array, confidence: Array, chunk: int = 65_536) -> Array:
    """(N, D) -> (N, d) latents, zero where unobserved."""
    latents = np.zeros((len(vectors), codec.latent_dim), np.float32)
    for start in range(0, len(vectors), chunk):
        part = slice(start, start + chunk)
        latents[part] = codec.encode(vectors[part].astype(np.float32))
    return np.where(confidence[:, None] > 0, latents, 0).astype(np.float32)
