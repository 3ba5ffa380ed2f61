"""Scenes of other methods as scenes of this one: a codec for their vectors, and what a query needs.

Latents of LangSplat's autoencoder are kept with it. Vectors of CLIP's own space go into a codec fitted to a
sample of them, a codebook unless asked otherwise; clusters that have a vector each are a codebook already.
Vectors are read a block of Gaussians at a time: all of them may be more than memory holds.
"""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.config import CodebookConfig, CodecConfig, check_settings
from langsplat_core.errors import InputError
from langsplat_core.extensions.checkpoints.features import Leaves
from langsplat_core.extensions.checkpoints.methods import ForeignScene
from langsplat_core.pipeline.language_field import field_of
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS, Codec, Scene
from langsplat_core.scene.codec import LARGEST, SHORTEST
from langsplat_core.semantics.encoder import OPEN_MODEL
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.training.language.codec_fit import (
    CodecReport,
    Vocabulary,
    codec_report,
    everyday_vocabulary,
    exact_codec,
    fit_codec,
)

FITTED, JUDGED = 12_000, 2_000  # Gaussians of each level that a codec is fitted to, and judged on
BLOCK = 16_384  # Gaussians read at a time: 32 MB at 512 float32 numbers


@dataclass(frozen=True)
class ImportReport:
    """Report on the import of a scene of another method."""

    method: str
    codec: str  # its kind; empty without a language field
    codec_size: int  # codewords of a codebook, numbers per latent of other kinds
    meaningful: tuple[float, float, float]  # share of the Gaussians with a meaning, per level
    loss: CodecReport | None  # of the codec, on vectors it was not fitted to; None where it is the method's
    notes: tuple[str, ...]


def import_scene(
    foreign: ForeignScene,
    encoder_id: str | None = None,
    phrases: tuple[str, ...] = (),
    config: CodecConfig | None = None,
    progress: Progress = silent,
) -> tuple[Scene, ImportReport]:
    """Return the scene with its language field; without one where `foreign` has no features.

    `encoder_id` is the text encoder of the space that the method's vectors are in, by default that of
    LangSplat; `phrases` are stored encoded. A Gaussian's confidence is 1 where it has a feature, else 0.
    Raises EncoderError where the encoder cannot be loaded, InputError where its vectors have another length
    or no Gaussian has a feature, FormatError for features that are not finite.
    """
    config = config or CodebookConfig()
    check_settings(config, "--codec.")
    if foreign.dim == 0:
        return foreign.scene, ImportReport(foreign.method, "", 0, (0.0, 0.0, 0.0), None, foreign.notes)
    encoder = load_text_encoder(encoder_id or OPEN_MODEL)
    if encoder.dim != foreign.dim:
        raise InputError(
            f"{_first_path(foreign)}: vectors of {foreign.dim} numbers, those of the encoder {encoder.id} "
            f"have {encoder.dim}; name the encoder they were made with by --encoder"
        )
    vocabulary = everyday_vocabulary(encoder, phrases)
    codec, loss = _codec(foreign, config, vocabulary, progress)
    latents, confidence = _latents(foreign, codec, progress)
    field = field_of((latents, confidence), codec, encoder, phrases)
    subpart, part, whole = confidence.mean(1).tolist() if confidence.size else (0.0, 0.0, 0.0)
    shares = (subpart, part, whole)
    report = ImportReport(foreign.method, codec.kind, codec.size, shares, loss, foreign.notes)
    return replace(foreign.scene, language=replace(field, calibration=None)), report


def _first_path(foreign: ForeignScene) -> object:
    return next(path for path in foreign.paths if path is not None)


def _codec(
    foreign: ForeignScene, config: CodecConfig, vocabulary: Vocabulary, progress: Progress
) -> tuple[Codec, CodecReport | None]:
    """Return the codec of the scene, and what it loses where it is not the method's own."""
    if foreign.codec is not None:
        return foreign.codec, None
    clusters = foreign.levels[-1]
    if isinstance(clusters, Leaves) and len(clusters.vectors) <= LARGEST:
        exact = _cluster_codec(clusters, config)
        if exact is not None:
            return exact, None
    fitted, judged = _samples(foreign, config.seed)
    codec = fit_codec(fitted, config, vocabulary, progress)
    return codec, codec_report(codec, judged if len(judged) else fitted, vocabulary)


def _cluster_codec(clusters: Leaves, config: CodecConfig) -> Codec | None:
    """Return a codec that keeps the vectors of all clusters in use exactly, in their order.

    None for a kind of codec that keeps no vectors as they are.
    """
    named = (clusters.index >= 0) & (clusters.index < len(clusters.vectors))
    counts = np.bincount(clusters.index[named], minlength=len(clusters.vectors))
    used = np.flatnonzero((counts > 0) & _has_meaning(clusters.vectors))
    if len(used) == 0:
        raise InputError("no cluster that Gaussians belong to has a meaning; there is nothing to search")
    return exact_codec(unit(clusters.vectors[used]), counts[used].astype(np.float64), config)


def _samples(foreign: ForeignScene, seed: int) -> tuple[Array, Array]:
    """(M, D) float32 unit vectors of Gaussians of all levels to fit a codec to, and others to judge it."""
    order = np.random.default_rng(seed).permutation(len(foreign.scene.gaussians))
    judges = min(JUDGED, len(order) // 6)
    samples = []
    for rows in (order[judges : judges + FITTED], order[:judges]):
        parts = [_unit_rows(foreign, level, np.sort(rows)) for level in _told(foreign)]
        samples.append(np.concatenate([vectors[known] for vectors, known in parts]))
    if len(samples[0]) == 0:
        raise InputError(f"{_first_path(foreign)}: no Gaussian has a meaning, all features are zero")
    return samples[0], samples[1]


def _told(foreign: ForeignScene) -> list[int]:
    return [level for level in range(len(LEVELS)) if foreign.levels[level] is not None]


def _has_meaning(vectors: Array) -> Array:
    known: Array = np.linalg.norm(vectors, axis=1) > SHORTEST
    return known


def _unit_rows(foreign: ForeignScene, level: int, rows: Array) -> tuple[Array, Array]:
    """(n, D or d) float32 vectors or latents of length 1, and (n,) whether there is a meaning."""
    values = foreign.rows(level, rows)
    known = _has_meaning(values)
    return unit(values, SHORTEST).astype(np.float32), known


def _latents(foreign: ForeignScene, codec: Codec, progress: Progress) -> tuple[Array, Array]:
    """(3, N, d) of the codec's type, and (3, N) float32: 1 where a Gaussian has a meaning."""
    count = len(foreign.scene.gaussians)
    latents = np.zeros((len(LEVELS), count, codec.latent_dim), codec.dtype)
    confidence = np.zeros((len(LEVELS), count), np.float32)
    told = _told(foreign)
    for done, level in enumerate(told):
        for start in range(0, count, BLOCK):
            rows = np.arange(start, min(start + BLOCK, count))
            values, known = _unit_rows(foreign, level, rows)
            made = values if foreign.codec is not None else codec.encode(values)
            latents[level, rows[known]] = made[known]
            confidence[level, rows] = known
            progress("reading features", (done + (start + len(rows)) / count) / len(told))
    return latents, confidence
