"""Scenes made as small as an error budget allows: fewer Gaussians, a lower SH degree, no training.

Gaussians are ranked by their contribution to one group of views (`views`). A second group, which had no say
in that order, measures what the images lose. For every SH degree that the budget allows by itself, from the
scene's own downward, the smallest number of Gaussians within the budget is found by bisection; the degree
with the fewest numbers wins. The contribution of the last Gaussian kept becomes a threshold, and only now the
second group has a say too: whatever contributes more than that to any of its views is kept after all.
Everything is measured as the target format stores it, and the file's own content is read back and measured
before it takes its name.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compaction.views import (
    MeasuringView,
    Views,
    choose_views,
    contributions,
    draw,
    mean_psnr,
    psnr_losses,
)
from langsplat_core.config import CompactConfig, check_settings
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import check_keeps, check_writable, load_scene, save_scene
from langsplat_core.io.summary import disk_bytes, memory_bytes
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import SH_COUNTS, Scene
from langsplat_core.scene.language import phrase_key
from langsplat_core.semantics.encoders import load_text_encoder


@dataclass(frozen=True)
class Weight:
    """Size of a scene in bytes, and its quality in decibels."""

    gaussians: int
    sh_degree: int
    disk_bytes: int  # in the target format, with language field and cameras
    memory_bytes: int  # arrays of the Gaussians, extra properties and language field
    psnr: float | None  # mean against the photographs, dB; None without


@dataclass(frozen=True)
class AnswerChange:
    """How the answer to one phrase changed."""

    phrase: str
    same: bool  # found or not, and the level, as before
    moved: float | None  # distance between the two places, world units; None where either has none


@dataclass(frozen=True)
class CompactReport:
    """A compact scene beside its original; losses are over the measuring views, dB."""

    before: Weight
    after: Weight
    budget: float
    loss: float  # mean, of the file
    worst_loss: float  # of any one view, ranking ones included, of the file
    assumed_psnr: float | None  # None: measured against photographs
    ranking_views: int
    measuring_views: int
    views_from: str
    answers: tuple[AnswerChange, ...]


def compact_scene(
    source: Path, out: Path, config: CompactConfig, photos: Path | None = None, progress: Progress = silent
) -> CompactReport:
    """Write the scene `source` to `out` as small as ``config.max_psnr_loss`` allows.

    `photos` is the dataset it was trained on; without, the loss is derived from the change of the images.
    Raises InputError, and leaves `out` as it was, where the budget cannot be kept or nothing can be dropped.
    """
    check_writable(out)
    check_settings(config)
    check_keeps(out, source)
    scene = load_scene(source)
    views = choose_views(scene, photos, config, progress)
    measured = views.measured(scene)
    before, before_bytes = stored(scene, out)
    reduction = find_reduction(before, views, measured, config, progress)
    candidate = reduced(before, reduction.keep, reduction.sh_degree)
    after, after_bytes = stored(candidate, out)
    losses = psnr_losses(after, measured, config.assumed_psnr)
    if not losses.mean() <= config.max_psnr_loss:
        raise InputError(f"{out}: as stored it would lose {losses.mean():.3f} dB; not written, allow more")
    truth = mean_psnr(scene, measured) or config.assumed_psnr
    worst = losses.max()
    for camera in views.ranking:  # one at a time, for their images may be many
        worst = max(worst, *psnr_losses(after, [MeasuringView(camera, draw(scene, camera))], truth))
    report = CompactReport(
        before=weigh(scene, before_bytes, measured),
        after=weigh(after, after_bytes, measured),
        budget=config.max_psnr_loss,
        loss=float(losses.mean()),
        worst_loss=float(worst),
        assumed_psnr=config.assumed_psnr if photos is None else None,
        ranking_views=len(views.ranking),
        measuring_views=len(views.measuring),
        views_from=views.origin,
        answers=answer_changes(scene, after, config.phrases),
    )
    save_scene(out, replace(candidate, path=out))
    return report


def stored(scene: Scene, out: Path) -> tuple[Scene, int]:
    """Return the scene after a journey through a file named like `out`, and the bytes that it took."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / out.name
        save_scene(path, replace(scene, path=path))
        return load_scene(path), disk_bytes(path)


def reduced(scene: Scene, rows: Array, sh_degree: int) -> Scene:
    """Return the Gaussians at `rows` with spherical harmonics up to `sh_degree` at most."""
    kept = scene.take(rows)
    count = min(SH_COUNTS[sh_degree], kept.gaussians.sh.shape[1])
    return replace(kept, gaussians=replace(kept.gaussians, sh=kept.gaussians.sh[:, :count]))


def weigh(scene: Scene, stored_bytes: int, measured: Sequence[MeasuringView]) -> Weight:
    """Return size and quality of a scene that takes `stored_bytes` in a file."""
    degree, memory = scene.gaussians.sh_degree, memory_bytes(scene)
    return Weight(len(scene.gaussians), degree, stored_bytes, memory, mean_psnr(scene, measured))


@dataclass(frozen=True)
class Choice:
    """Number of the ranked Gaussians that stay, and their SH degree."""

    count: int
    sh_degree: int


@dataclass(frozen=True, eq=False)
class Reduction:
    """The part of a scene of N Gaussians that stays."""

    keep: Array  # (N,) bool
    sh_degree: int
    threshold: float  # no other Gaussian contributes more to any view


def find_reduction(
    scene: Scene,
    views: Views,
    measured: Sequence[MeasuringView],
    config: CompactConfig,
    progress: Progress = silent,
) -> Reduction:
    """Find what of `scene` to keep; `measured` are those of ``views.measuring``.

    Raises InputError where nothing is visible, nothing fits the budget or nothing can be dropped.
    """
    score = contributions(scene, views.ranking, progress)
    if not score.any():
        raise InputError(f"no Gaussian of the scene is visible from {views.origin}")
    order = np.argsort(-score, kind="stable")  # ties by index

    def loss_of(choice: Choice) -> float:
        candidate = reduced(scene, np.sort(order[: choice.count]), choice.sh_degree)
        return float(psnr_losses(candidate, measured, config.assumed_psnr).mean())

    degree = scene.gaussians.sh_degree
    choice = smallest(Choice(len(order), degree), loss_of, config.max_psnr_loss, progress)
    if choice is None:
        raise InputError(f"the new file's format alone loses more than {config.max_psnr_loss} dB; allow more")
    threshold = float(score[order[choice.count - 1]])
    keep = contributions(scene, views.measuring) > threshold
    keep[order[: choice.count]] = True
    if keep.all() and choice.sh_degree == degree:
        raise InputError(f"nothing can be dropped within {config.max_psnr_loss} dB; allow more")
    return Reduction(keep, choice.sh_degree, threshold)


def smallest(
    whole: Choice, loss_of: Callable[[Choice], float], budget: float, progress: Progress = silent
) -> Choice | None:
    """Return the choice with the fewest numbers whose loss is within `budget` dB.

    None if even `whole` exceeds it. `loss_of` should not rise with the count; where it does, the answer is
    within the budget all the same, only perhaps not the smallest.
    """
    best: Choice | None = None
    for degree in range(whole.sh_degree, -1, -1):
        progress("finding the smallest scene", (whole.sh_degree - degree) / (whole.sh_degree + 1))
        high, low = whole.count, 0
        if not loss_of(Choice(high, degree)) <= budget:
            break  # a lower degree can only lose more
        while high - low > max(whole.count // 256, 1):
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


def answer_changes(before: Scene, after: Scene, more: Sequence[str]) -> tuple[AnswerChange, ...]:
    """Compare the answers to some phrases of the phrasebook and to `more`; none without a language field.

    Raises EncoderError where a phrase needs the text encoder and that cannot be loaded.
    """
    if before.language is None or after.language is None:
        return ()
    phrases = list(dict.fromkeys([*map(phrase_key, more), *list(before.language.phrasebook)[:8]]))
    load = cache(load_text_encoder)  # once for both
    pairs = zip(*(QueryEngine(scene, load).run_many(phrases) for scene in (before, after)), strict=True)
    changes = []
    for old, new in pairs:
        known = old.place is not None and new.place is not None
        moved = float(np.linalg.norm(old.place - new.place)) if known else None
        changes.append(AnswerChange(old.phrase, (old.found, old.level) == (new.found, new.level), moved))
    return tuple(changes)
