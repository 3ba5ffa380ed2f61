"""How far two versions of a scene differ in what they mean: latents, relevancy, answers."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.compose import gated_mean
from langsplat_core.display.latent_colours import latent_colours
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import LoadEncoder, QueryEngine
from langsplat_core.raster.protocol import Rasterizer
from langsplat_core.scene import Camera, LanguageField, Scene

GATE = PictureConfig().alpha_gate


@dataclass(frozen=True)
class AnswerChange:
    """One phrase, asked before and after."""

    phrase: str
    relevancy: float  # mean absolute change of the rendered relevancy, over covered pixels and levels
    same: bool  # found or not, and the level, as before
    moved: float | None  # distance between the two places, world units; None where either has none


@dataclass(frozen=True)
class LanguageChange:
    """Over the pixels that the original scene covers."""

    latents: float  # mean absolute change of a rendered latent's numbers
    answers: tuple[AnswerChange, ...]


def language_change(
    rasterizer: Rasterizer,
    scenes: tuple[Scene, Scene],
    cameras: Sequence[Camera],
    phrases: Sequence[str],
    load_encoder: LoadEncoder | None = None,
) -> LanguageChange | None:
    """Compare `scenes` (before, after) in the views of `cameras`; None where either has no language field.

    load_encoder: of a phrase outside the phrasebook, see `QueryEngine`; EncoderError where one needs it.
    """
    before, after = scenes
    if before.language is None or after.language is None:
        return None
    load = None if load_encoder is None else cache(load_encoder)  # once for both
    engines = [QueryEngine(scene, load) for scene in scenes]
    results = [tuple(engine.run_many(phrases)) for engine in engines]
    channels = [
        _channels(scene.language, found)
        for scene, found in zip((before, after), results, strict=True)
        if scene.language is not None
    ]
    latent_count = channels[0].shape[1] - 3 * len(phrases)
    totals, covered = np.zeros(channels[0].shape[1]), 0
    for camera in cameras:
        images = []
        for scene, values in zip(scenes, channels, strict=True):
            view = rasterizer.view(scene.gaussians, camera, scene.raster_settings())
            total, alpha = view.splat(values)
            images.append((gated_mean(total, alpha, GATE), alpha))
        visible = images[0][1] > GATE
        totals += np.abs(images[0][0] - images[1][0])[visible].sum(0, dtype=np.float64)
        covered += int(visible.sum())
    means = totals / max(covered, 1)
    answers = tuple(
        _answer(old, new, float(means[latent_count + 3 * j :][:3].mean()))
        for j, (old, new) in enumerate(zip(*results, strict=True))
    )
    return LanguageChange(float(means[:latent_count].mean()), answers)


def _channels(field: LanguageField, results: Sequence[QueryResult]) -> Array:
    """(N, 3 c + 3 Q) float32: the latents of every level (the colours of codewords, whose numbers cannot be
    blended), then the relevancies of every phrase."""
    latents = latent_colours(field) if field.codec.space == "index" else field.latents
    parts = [*latents, *(result.relevancy.T for result in results)]
    return np.concatenate(parts, axis=1).astype(np.float32)


def _answer(old: QueryResult, new: QueryResult, relevancy: float) -> AnswerChange:
    moved = None
    if old.place is not None and new.place is not None:
        moved = float(np.linalg.norm(old.place - new.place))
    return AnswerChange(old.phrase, relevancy, (old.found, old.level) == (new.found, new.level), moved)
