"""Which Gaussians stay: those that contribute most, and as few as the error budget allows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compaction.views import (
    MeasuringView,
    Views,
    Weight,
    check_likeness,
    choose_views,
    contributions,
    likeness,
    mean_psnr,
    measuring_views,
    psnr_losses,
    reduced,
    stored,
    weigh,
    worst_loss,
)
from langsplat_core.config import CompactConfig, PictureConfig, check_settings
from langsplat_core.display.displays import gated_mean
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import check_writable, load_scene, save_scene
from langsplat_core.io.summary import disk_bytes
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import LoadEncoder, QueryEngine
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.protocol import LiftingRasterizer, Rasterizer
from langsplat_core.scene import SH_COUNTS, Camera, LanguageField, Scene
from langsplat_core.scene.language import phrase_key
from langsplat_core.semantics.encoders import load_text_encoder

RESOLUTION = 256  # the number of Gaussians is found to this fraction of the whole


@dataclass(frozen=True)
class Choice:
    """How many of the ranked Gaussians stay, and with which SH degree."""

    count: int
    sh_degree: int


@dataclass(frozen=True, eq=False)
class Selection:
    """What stays of a scene of N Gaussians."""

    keep: Array  # (N,) bool
    sh_degree: int
    threshold: float  # no other Gaussian contributes more to any view
    unseen_loss: float  # dB, mean over the measuring views, before these had a say


def select(
    rasterizer: LiftingRasterizer,
    scene: Scene,
    views: Views,
    measured: Sequence[MeasuringView],
    config: CompactConfig,
    progress: Progress = silent,
) -> Selection:
    """What of `scene` to keep; `measured` are those of ``views.measuring``. Raises InputError where nothing
    is visible, nothing fits the budget or nothing can be dropped."""
    score = contributions(rasterizer, scene, views.ranking, progress)
    if not score.any():
        raise InputError(f"no Gaussian of the scene is visible from {views.origin}")
    order = np.argsort(-score, kind="stable")  # ties by index

    def loss_of(choice: Choice) -> float:
        candidate = reduced(scene, np.sort(order[: choice.count]), choice.sh_degree)
        return float(psnr_losses(rasterizer, candidate, measured, config.assumed_psnr).mean())

    degree = scene.gaussians.sh_degree
    choice = smallest(Choice(len(order), degree), loss_of, config.max_psnr_loss, progress)
    if choice is None:
        raise InputError(f"the new file's format alone loses more than {config.max_psnr_loss} dB; allow more")
    threshold = float(score[order[choice.count - 1]])
    keep = contributions(rasterizer, scene, views.measuring) > threshold
    keep[order[: choice.count]] = True
    if keep.all() and choice.sh_degree == degree:
        raise InputError(f"nothing can be dropped within {config.max_psnr_loss} dB; allow more")
    return Selection(keep, choice.sh_degree, threshold, loss_of(choice))


def smallest(
    whole: Choice, loss_of: Callable[[Choice], float], budget: float, progress: Progress = silent
) -> Choice | None:
    """The choice with the fewest numbers whose loss was measured to be within `budget` dB; None if even
    `whole` exceeds it.

    `loss_of` should not rise with the count; where it does, the answer is within the budget all the same,
    only perhaps not the smallest.
    """
    best: Choice | None = None
    for degree in range(whole.sh_degree, -1, -1):
        progress("finding the smallest scene", (whole.sh_degree - degree) / (whole.sh_degree + 1))
        high, low = whole.count, 0
        if not loss_of(Choice(high, degree)) <= budget:
            break  # a lower degree can only lose more
        while high - low > max(whole.count // RESOLUTION, 1):
            middle = (low + high) // 2
            if loss_of(Choice(middle, degree)) <= budget:
                high = middle
            else:
                low = middle
        if best is None or high * _numbers(degree) < best.count * _numbers(best.sh_degree):
            best = Choice(high, degree)
    progress("finding the smallest scene", 1.0)
    return best


def _numbers(sh_degree: int) -> int:
    """Numbers of a Gaussian that any format must hold: position, scale, rotation, opacity, colour."""
    return 11 + 3 * SH_COUNTS[sh_degree]


# How far two versions of a scene differ in what they mean: latents, relevancy, answers.

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
    """(N, 3 c + 3 Q) float32: the latents of every level as what can be blended, then all relevancies."""
    latents = [field.codec.blendable(level) for level in field.latents]
    parts = [*latents, *(result.relevancy.T for result in results)]
    return np.concatenate(parts, axis=1).astype(np.float32)


def _answer(old: QueryResult, new: QueryResult, relevancy: float) -> AnswerChange:
    moved = None
    if old.place is not None and new.place is not None:
        moved = float(np.linalg.norm(old.place - new.place))
    return AnswerChange(old.phrase, relevancy, (old.found, old.level) == (new.found, new.level), moved)


# A scene made as small as an error budget allows: fewer Gaussians, a lower SH degree, no training.
#
# Gaussians are ranked by their contribution to one group of views (`contribution`). A second group, which
# had no say in that order, measures what the pictures lose. For every SH degree that the budget allows by
# itself, from the scene's own downward, the smallest number of Gaussians within the budget is found by
# bisection; the degree with the fewest numbers wins. The contribution of the last Gaussian kept becomes a
# threshold, and only now the second group has a say too: whatever contributes more than that to any of its
# views is kept after all. Everything is measured as the target format stores it, and the file's own content
# is read back and measured before it takes its name.

PHRASES = 8  # at most, of the phrasebook, asked before and after


@dataclass(frozen=True)
class CompactReport:
    """A compact scene beside its original; losses are over the measuring views, dB."""

    before: Weight
    after: Weight
    source_bytes: int  # the scene as given, in its own format
    budget: float
    unseen_loss: float  # mean, of what the ranking views alone chose: a guess for any other view
    loss: float  # mean, of the file
    worst_loss: float  # of any one view, ranking ones included, of the file
    assumed_psnr: float | None  # None: measured against photographs
    likeness: float  # PSNR of the compact pictures against the original ones, mean, at most 100
    threshold: float  # no dropped Gaussian contributes more to any view, display values times pixels
    ranking_views: int
    measuring_views: int
    views_from: str
    language: LanguageChange | None


def compact_scene(
    source: Path, out: Path, config: CompactConfig, photos: Path | None = None, progress: Progress = silent
) -> CompactReport:
    """Write the scene `source` to `out` as small as ``config.max_psnr_loss`` allows.

    `photos` is the dataset it was trained on; without, the loss is derived from the change of the pictures.
    Raises InputError, and leaves `out` as it was, where the budget cannot be kept or nothing can be dropped.
    """
    _check(source, out, config)
    scene = load_scene(source)
    rasterizer = load_lifting_rasterizer("cpu")
    views = choose_views(scene, photos, config, progress)
    measured = measuring_views(rasterizer, scene, views.measuring, views.photographs)
    check_likeness(measured)
    before = stored(scene, out)
    selection = select(rasterizer, before.scene, views, measured, config, progress)
    candidate = reduced(before.scene, selection.keep, selection.sh_degree)
    after = stored(candidate, out)
    losses = psnr_losses(rasterizer, after.scene, measured, config.assumed_psnr)
    if not losses.mean() <= config.max_psnr_loss:
        raise InputError(f"{out}: as stored it would lose {losses.mean():.3f} dB; not written, allow more")
    truth = mean_psnr(rasterizer, scene, measured) or config.assumed_psnr
    weighed = weigh(rasterizer, (replace(before, scene=scene), after), measured)
    report = CompactReport(
        before=weighed[0],
        after=weighed[1],
        source_bytes=disk_bytes(source),
        budget=config.max_psnr_loss,
        unseen_loss=selection.unseen_loss,
        loss=float(losses.mean()),
        worst_loss=max(float(losses.max()), worst_loss(rasterizer, scene, after.scene, views, truth)),
        assumed_psnr=config.assumed_psnr if photos is None else None,
        likeness=likeness(rasterizer, after.scene, measured),
        threshold=selection.threshold,
        ranking_views=len(views.ranking),
        measuring_views=len(views.measuring),
        views_from=views.origin,
        language=_language(rasterizer, (scene, after.scene), views, config.phrases),
    )
    save_scene(out, replace(candidate, path=out))
    return report


def _check(source: Path, out: Path, config: CompactConfig) -> None:
    check_writable(out)
    check_settings(config)
    if out.resolve() == source.resolve():
        raise InputError(f"{out}: would replace the original scene; choose another --out")


def _language(
    rasterizer: Rasterizer, scenes: tuple[Scene, Scene], views: Views, more: Sequence[str]
) -> LanguageChange | None:
    field = scenes[0].language
    if field is None:
        return None
    stored = list(field.phrasebook)[:PHRASES]
    phrases = list(dict.fromkeys([*map(phrase_key, more), *stored]))
    return language_change(rasterizer, scenes, views.measuring, phrases, load_text_encoder)
