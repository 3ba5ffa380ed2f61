"""A scene made as small as an error budget allows: fewer Gaussians, a lower SH degree, no training.

Gaussians are ranked by their contribution to one group of views (`evaluation.contribution`). A second group,
which had no say in that order, measures what the pictures lose. For every SH degree that the budget allows
by itself, from the scene's own downward, the smallest number of Gaussians within the budget is found by
bisection; the degree with the fewest bytes wins. Everything is measured as the target format stores it, and
the file's own content is read back and measured once more before it takes its name.
"""

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import CompactConfig
from langsplat_core.errors import InputError
from langsplat_core.evaluation.contribution import (
    Exposure,
    contributions,
    draw,
    expose,
    psnr,
    psnr_losses,
    reduced,
)
from langsplat_core.evaluation.language_change import LanguageChange, language_change
from langsplat_core.formats import cameras_json, companion_path, language, load_scene, save_scene
from langsplat_core.formats.sog import META_NAME
from langsplat_core.pipeline.compact_views import Views, choose_views
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.numba_cpu import CpuRasterizer
from langsplat_core.raster.protocol import Rasterizer
from langsplat_core.scene import SH_COUNTS, Scene

RESOLUTION = 256  # the number of Gaussians is found to this fraction of the whole
ROUNDS = 3  # timed pictures of every measuring view
STRANGERS = 10.0  # dB: a scene that is this far from the photographs does not show what they show


@dataclass(frozen=True)
class Weight:
    """What a scene costs, and what it is worth."""

    gaussians: int
    sh_degree: int
    disk_bytes: int  # in the target format, with language field and cameras
    memory_bytes: int  # arrays of the Gaussians, extra properties and language field
    render_ms: float  # median over the measuring views, CPU backend; before and after drawn in turn
    psnr: float | None  # mean against the photographs, dB; None without


@dataclass(frozen=True)
class CompactReport:
    """A compact scene beside its original; losses are over the measuring views, dB."""

    before: Weight
    after: Weight
    budget: float
    assumed_psnr: float | None  # None: measured against photographs
    likeness: float  # PSNR of the compact pictures against the original ones, mean, at most 100
    ranking_views: int
    measuring_views: int
    views_from: str
    language: LanguageChange | None
    loss: float = math.nan  # mean over views
    worst_loss: float = math.nan  # of any one view
    source_bytes: int = 0  # the scene as given, in its own format


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
    order = _ranking(rasterizer, before.scene, views, progress)

    def losses(candidate: Scene) -> Array:
        return psnr_losses(rasterizer, candidate, exposures, config.assumed_psnr)

    whole = Choice(len(order), before.scene.gaussians.sh_degree)
    choice = smallest(
        whole,
        lambda choice: float(losses(_chosen(before.scene, order, choice)).mean()),
        config.max_psnr_loss,
        progress,
    )
    if choice is None or choice == whole:
        what = "nothing can be dropped" if choice else "its format alone loses more than that: nothing fits"
        raise InputError(f"{out}: within {config.max_psnr_loss} dB {what}; allow more with --max-psnr-loss")
    candidate = _chosen(before.scene, order, choice)
    after = _stored(candidate, out)
    lost = losses(after.scene)
    if not lost.mean() <= config.max_psnr_loss:
        raise InputError(f"{out}: as stored it would lose {lost.mean():.3f} dB; not written, allow more")
    report = _report(rasterizer, (replace(before, scene=scene), after), exposures, views, config)
    save_scene(out, replace(candidate, path=out))
    return replace(
        report, source_bytes=disk_bytes(source), loss=float(lost.mean()), worst_loss=float(lost.max())
    )


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


def disk_bytes(scene: Path) -> int:
    """Size of a scene file, or of a folder's files, with the companions beside it."""
    path = scene.parent if scene.name == META_NAME else scene
    own = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    companions = [companion_path(scene, suffix) for suffix in (language.SUFFIX, cameras_json.SUFFIX)]
    return sum(file.stat().st_size for file in [*own, *companions] if file.is_file())


def memory_bytes(scene: Scene) -> int:
    """Of the arrays that grow with the number of Gaussians."""
    arrays = [getattr(scene.gaussians, field.name) for field in fields(scene.gaussians)]
    arrays += list(scene.extras.values())
    if scene.language is not None:
        arrays += [scene.language.latents, scene.language.confidence]
    return sum(array.nbytes for array in arrays)


def _check(source: Path, out: Path, config: CompactConfig) -> None:
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


def _ranking(rasterizer: CpuRasterizer, scene: Scene, views: Views, progress: Progress) -> Array:
    """(N,) indices of the Gaussians by falling contribution, ties by index."""
    score = contributions(rasterizer, scene, views.ranking, progress)
    if not score.any():
        raise InputError(f"no Gaussian of the scene is visible from {views.origin}")
    return np.argsort(-score, kind="stable")


def _chosen(scene: Scene, order: Array, choice: Choice) -> Scene:
    """The first ``choice.count`` of `order`, in the scene's own order."""
    return reduced(scene, np.sort(order[: choice.count]), choice.sh_degree)


def _numbers(sh_degree: int) -> int:
    """Numbers of a Gaussian that any format must hold: position, scale, rotation, opacity, colour."""
    return 11 + 3 * SH_COUNTS[sh_degree]


def _report(
    rasterizer: Rasterizer,
    pair: tuple[_Stored, _Stored],
    exposures: Sequence[Exposure],
    views: Views,
    config: CompactConfig,
) -> CompactReport:
    """Everything but the loss itself and the size of the source."""
    scenes = (pair[0].scene, pair[1].scene)
    weights = []
    for stored, milliseconds in zip(pair, _render_times(rasterizer, scenes, exposures), strict=True):
        own = stored.scene
        weights.append(
            Weight(
                gaussians=len(own.gaussians),
                sh_degree=own.gaussians.sh_degree,
                disk_bytes=stored.disk_bytes,
                memory_bytes=memory_bytes(own),
                render_ms=milliseconds,
                psnr=_truth(rasterizer, own, exposures),
            )
        )
    pictures = [(np.clip(draw(rasterizer, scenes[1], e.camera)[1], 0, 1), e.original) for e in exposures]
    photographed = any(exposure.photograph is not None for exposure in exposures)
    return CompactReport(
        before=weights[0],
        after=weights[1],
        budget=config.max_psnr_loss,
        assumed_psnr=None if photographed else config.assumed_psnr,
        likeness=float(np.mean([psnr(*pair) for pair in pictures])),
        ranking_views=len(views.ranking),
        measuring_views=len(views.measuring),
        views_from=views.origin,
        language=_language(rasterizer, scenes, exposures, config.phrases),
    )


def _truth(rasterizer: Rasterizer, scene: Scene, exposures: Sequence[Exposure]) -> float | None:
    scores = [
        psnr(np.clip(draw(rasterizer, scene, e.camera)[1], 0, 1), e.photograph)
        for e in exposures
        if e.photograph is not None
    ]
    return float(np.mean(scores)) if scores else None


def _language(
    rasterizer: Rasterizer, scenes: tuple[Scene, Scene], exposures: Sequence[Exposure], more: Sequence[str]
) -> LanguageChange | None:
    field = scenes[0].language
    if field is None:
        return None
    phrases = list(dict.fromkeys([*field.phrasebook, *(" ".join(text.lower().split()) for text in more)]))
    encoder = None
    if any(phrase not in field.phrasebook for phrase in phrases):
        from langsplat_core.semantics.clip import load_text_encoder  # imports torch

        encoder = load_text_encoder(field.encoder_id)
    return language_change(rasterizer, scenes, [e.camera for e in exposures], phrases, encoder)


def _render_times(
    rasterizer: Rasterizer, scenes: tuple[Scene, Scene], exposures: Sequence[Exposure]
) -> tuple[float, float]:
    """Median milliseconds of a picture of each scene: projection, colours and blending. Drawn in turn, so
    that another program's load falls on both."""
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(ROUNDS):
        for exposure in exposures:
            for scene, spent in zip(scenes, times, strict=True):
                start = time.perf_counter()
                draw(rasterizer, scene, exposure.camera)
                spent.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times[0])), float(np.median(times[1]))
