"""A scene made as small as an error budget allows: fewer Gaussians, a lower SH degree, no training.

Gaussians are ranked by their contribution to one group of views (`evaluation.contribution`). A second group,
which had no say in that order, measures what the pictures lose. For every SH degree that the budget allows
by itself, from the scene's own downward, the smallest number of Gaussians within the budget is found by
bisection; the degree with the fewest numbers wins. The contribution of the last Gaussian kept becomes a
threshold, and only now the second group has a say too: whatever contributes more than that to any of its
views is kept after all. Everything is measured as the target format stores it, and the file's own content is
read back and measured before it takes its name.
"""

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compaction.contribution import (
    Exposure,
    contributions,
    draw,
    expose,
    psnr,
    psnr_losses,
    reduced,
)
from langsplat_core.compaction.language_change import LanguageChange, language_change
from langsplat_core.compaction.views import Views, choose_views
from langsplat_core.config import CompactConfig
from langsplat_core.errors import InputError
from langsplat_core.formats import check_writable, load_scene, save_scene
from langsplat_core.formats.summary import disk_bytes, memory_bytes
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.protocol import LiftingRasterizer, Rasterizer
from langsplat_core.scene import SH_COUNTS, Scene

RESOLUTION = 256  # the number of Gaussians is found to this fraction of the whole
ROUNDS = 3  # timed pictures of every measuring view
PHRASES = 8  # at most, of the phrasebook, asked before and after
STRANGERS = 10.0  # dB: a scene that is this far from the photographs does not show what they show


@dataclass(frozen=True)
class Weight:
    """What a scene costs, and what it is worth."""

    gaussians: int
    sh_degree: int
    disk_bytes: int  # in the target format, with language field and cameras
    memory_bytes: int  # arrays of the Gaussians, extra properties and language field
    render_ms: float  # mean over the measuring views, CPU backend; before and after drawn in turn
    psnr: float | None  # mean against the photographs, dB; None without


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


@dataclass(frozen=True, eq=False)
class _Stored:
    """A scene as the target format gives it back, and the size of its files."""

    scene: Scene
    disk_bytes: int


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


def compact_scene(
    source: Path, out: Path, config: CompactConfig, photos: Path | None = None, progress: Progress = silent
) -> CompactReport:
    """Write the scene `source` to `out` as small as ``config.max_psnr_loss`` allows.

    `photos` is the dataset it was trained on; without, the loss is derived from the change of the pictures.
    Raises InputError, and leaves `out` as it was, where the budget cannot be kept or nothing can be dropped.
    """
    _check(source, out, config)
    scene = load_scene(source)
    rasterizer = CpuRasterizer()
    views = choose_views(scene, photos, config, progress)
    exposures = expose(rasterizer, scene, views.measuring, views.photographs)
    _check_likeness(exposures)
    before = _stored(scene, out)
    selection = select(rasterizer, before.scene, views, exposures, config, progress)
    candidate = reduced(before.scene, selection.keep, selection.sh_degree)
    after = _stored(candidate, out)
    losses = psnr_losses(rasterizer, after.scene, exposures, config.assumed_psnr)
    if not losses.mean() <= config.max_psnr_loss:
        raise InputError(f"{out}: as stored it would lose {losses.mean():.3f} dB; not written, allow more")
    truth = _truth(rasterizer, scene, exposures) or config.assumed_psnr
    weighed = _weights(rasterizer, (replace(before, scene=scene), after), exposures)
    report = CompactReport(
        before=weighed[0],
        after=weighed[1],
        source_bytes=disk_bytes(source),
        budget=config.max_psnr_loss,
        unseen_loss=selection.unseen_loss,
        loss=float(losses.mean()),
        worst_loss=max(float(losses.max()), _worst(rasterizer, scene, after.scene, views, truth)),
        assumed_psnr=config.assumed_psnr if photos is None else None,
        likeness=_likeness(rasterizer, after.scene, exposures),
        threshold=selection.threshold,
        ranking_views=len(views.ranking),
        measuring_views=len(views.measuring),
        views_from=views.origin,
        language=_language(rasterizer, (scene, after.scene), views, config.phrases),
    )
    save_scene(out, replace(candidate, path=out))
    return report


def select(
    rasterizer: LiftingRasterizer,
    scene: Scene,
    views: Views,
    exposures: Sequence[Exposure],
    config: CompactConfig,
    progress: Progress = silent,
) -> Selection:
    """What of `scene` to keep; `exposures` are those of ``views.measuring``. Raises InputError where nothing
    is visible, nothing fits the budget or nothing can be dropped."""
    score = contributions(rasterizer, scene, views.ranking, progress)
    if not score.any():
        raise InputError(f"no Gaussian of the scene is visible from {views.origin}")
    order = np.argsort(-score, kind="stable")  # ties by index

    def loss_of(choice: Choice) -> float:
        candidate = reduced(scene, np.sort(order[: choice.count]), choice.sh_degree)
        return float(psnr_losses(rasterizer, candidate, exposures, config.assumed_psnr).mean())

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


def _check(source: Path, out: Path, config: CompactConfig) -> None:
    check_writable(out)
    if not 0 <= config.max_psnr_loss < math.inf:
        raise InputError(f"--max-psnr-loss {config.max_psnr_loss}: must be 0 dB or more")
    if not 0 < config.assumed_psnr < math.inf:
        raise InputError(f"--assumed-psnr {config.assumed_psnr}: must be above 0 dB, for example 35")
    if config.max_side < 16:
        raise InputError(f"--max-side {config.max_side}: pictures need at least 16 pixels")
    if out.resolve() == source.resolve():
        raise InputError(f"{out}: would replace the original scene; choose another --out")


def _check_likeness(exposures: Sequence[Exposure]) -> None:
    scores = [psnr(e.original, e.photograph) for e in exposures if e.photograph is not None]
    if scores and np.mean(scores) < STRANGERS:
        raise InputError(
            f"the photographs show something else than the scene (PSNR {np.mean(scores):.1f} dB); "
            "give the dataset that it was trained on, or leave --photos out"
        )


def _stored(scene: Scene, out: Path) -> _Stored:
    """The scene after a journey through a file named like `out`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / out.name
        save_scene(path, replace(scene, path=path))
        return _Stored(load_scene(path), disk_bytes(path))


def _numbers(sh_degree: int) -> int:
    """Numbers of a Gaussian that any format must hold: position, scale, rotation, opacity, colour."""
    return 11 + 3 * SH_COUNTS[sh_degree]


def _weights(
    rasterizer: Rasterizer, pair: tuple[_Stored, _Stored], exposures: Sequence[Exposure]
) -> list[Weight]:
    times = _render_times(rasterizer, (pair[0].scene, pair[1].scene), exposures)
    return [
        Weight(
            gaussians=len(stored.scene.gaussians),
            sh_degree=stored.scene.gaussians.sh_degree,
            disk_bytes=stored.disk_bytes,
            memory_bytes=memory_bytes(stored.scene),
            render_ms=milliseconds,
            psnr=_truth(rasterizer, stored.scene, exposures),
        )
        for stored, milliseconds in zip(pair, times, strict=True)
    ]


def _worst(rasterizer: Rasterizer, before: Scene, after: Scene, views: Views, psnr_before: float) -> float:
    """dB lost in the ranking view that loses most; one at a time, for their pictures may be many."""
    return max(
        float(psnr_losses(rasterizer, after, expose(rasterizer, before, [camera], [None]), psnr_before)[0])
        for camera in views.ranking
    )


def _likeness(rasterizer: Rasterizer, scene: Scene, exposures: Sequence[Exposure]) -> float:
    pictures = [np.clip(draw(rasterizer, scene, exposure.camera)[1], 0, 1) for exposure in exposures]
    return float(np.mean([psnr(new, e.original) for new, e in zip(pictures, exposures, strict=True)]))


def _truth(rasterizer: Rasterizer, scene: Scene, exposures: Sequence[Exposure]) -> float | None:
    scores = [
        psnr(np.clip(draw(rasterizer, scene, e.camera)[1], 0, 1), e.photograph)
        for e in exposures
        if e.photograph is not None
    ]
    return float(np.mean(scores)) if scores else None


def _language(
    rasterizer: Rasterizer, scenes: tuple[Scene, Scene], views: Views, more: Sequence[str]
) -> LanguageChange | None:
    field = scenes[0].language
    if field is None:
        return None
    stored = list(field.phrasebook)[:PHRASES]
    phrases = list(dict.fromkeys([*(" ".join(text.lower().split()) for text in more), *stored]))
    encoder = None
    if any(phrase not in field.phrasebook for phrase in phrases):
        from langsplat_core.semantics.clip import load_text_encoder  # imports torch

        encoder = load_text_encoder(field.encoder_id)
    return language_change(rasterizer, scenes, views.measuring, phrases, encoder)


def _render_times(
    rasterizer: Rasterizer, scenes: tuple[Scene, Scene], exposures: Sequence[Exposure]
) -> tuple[float, float]:
    """Milliseconds of a picture of each scene (projection, colours and blending): the best of `ROUNDS` per
    view, averaged over views. Drawn in turn, so that another program's load falls on both."""
    seconds = np.full((len(exposures), 2), np.inf)
    for _ in range(ROUNDS):
        for best, exposure in zip(seconds, exposures, strict=True):
            for which, scene in enumerate(scenes):
                start = time.perf_counter()
                draw(rasterizer, scene, exposure.camera)
                best[which] = min(best[which], time.perf_counter() - start)
    before, after = 1e3 * seconds.mean(0)
    return float(before), float(after)
