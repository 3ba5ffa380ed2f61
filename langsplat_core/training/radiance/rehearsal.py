"""Rehearsal of a training: how large a budget a few photographs support.

Few photographs can be overfitted, and from some budget on they are: views that were held out get worse. Which
one that is depends on the capture (docs/photographs.md). So some of the training views are held out, and the
others trained on with the smallest budget, then with larger ones, unless one clearly loses. The training
itself then takes all views.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from langsplat_core.config import GOOD, INRIA, QUICK, RadianceBudget, RadianceConfig
from langsplat_core.datasets.capture import Capture, surrounded_views
from langsplat_core.progress import Progress, Report, silent
from langsplat_core.scene import Camera, Gaussians
from langsplat_core.training.radiance.differentiable import evaluate_views
from langsplat_core.training.radiance.trainer import STAGE as STEPS
from langsplat_core.training.radiance.trainer import train_radiance

log = logging.getLogger("langsplat")

STAGE = "rehearsing"
LEAST_GAIN = 0.25  # dB, for which more is spent: less may be chance


def budgets_for(capture: Capture, config: RadianceConfig, views: int) -> list[RadianceBudget]:
    """Return the ascending budgets that are tried with so many training views.

    The last is all that is asked for, and the only one with many views or few steps. Steps grow threefold. A
    larger preset's budgets begin with the smaller one's, so that it cannot choose worse.
    """
    longer_side = max(max(camera.width, camera.height) for camera in capture.cameras)
    whole = RadianceBudget(longer_side, config.steps, config.max_gaussians, config.sh_degree)
    if views > config.rehearsed_views or config.steps < 3 * QUICK.steps:
        return [whole]
    steps = [QUICK.steps]
    while 9 * steps[-1] <= config.steps:
        steps.append(3 * steps[-1])
    larger = [(GOOD if count <= GOOD.steps else whole)._replace(steps=count) for count in steps]
    return list(dict.fromkeys(budget.at_most(whole) for budget in (QUICK, *larger, whole)))


def budget_text(budget: RadianceBudget) -> str:
    """Return the budget as messages and reports name it."""
    return f"{budget.steps} steps at {budget.longer_side} px"


def rehearse(
    capture: Capture,
    config: RadianceConfig,
    budgets: Sequence[RadianceBudget],
    train_indices: Sequence[int],
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> list[list[float]]:
    """Train with ascending budgets without some of the views at `train_indices`, and score these.

    Returns for each budget, from the smallest on up to one that clearly loses, the mean PSNR (dB, exposures
    fitted) of the held-out views, in one rehearsal after the other, see `climb`. Empty where there is nothing
    to decide: one budget, or so few views that none can be held out.

    With a `checkpoint` path an interrupted rehearsal goes on where it stopped; the files are those of
    `checkpoints_of` it, and stay.
    """
    held_out = _held_out([capture.cameras[i] for i in train_indices])
    if len(budgets) < 2 or not held_out:
        return []
    done: list[float] = []

    def score(index: int, number: int) -> float:
        budget, without = budgets[index], held_out[number]
        part = progress.part(len(done), len(budgets) * len(held_out), STAGE, budget_text(budget))
        at = checkpoint and checkpoint.with_name(f"{index}-{number}-{checkpoint.name}")
        small = capture.read_at(train_indices, budget.longer_side)
        train = [row for row in range(len(small)) if row not in without]
        gaussians = train_radiance(small, config.spending(budget), train, at, _steps_alone(part))
        scores = evaluate_views(gaussians, small, without, config.backend, near=config.near)
        done.append(float(np.mean([score.psnr_exposed or score.psnr for score in scores])))
        log.debug("%s without %s: %.2f dB", budget_text(budget), without, done[-1])
        return done[-1]

    return climb(len(budgets), len(held_out), score)


def climb(budgets: int, rehearsals: int, score: Callable[[int, int], float]) -> list[list[float]]:
    """Return the scores (dB) of ascending budgets, from the smallest on up to one that clearly loses.

    score(i, n): what budget i reaches in rehearsal n. One in which a budget does not gain over the best so
    far is its last: others could not make it pay.
    """
    found: list[list[float]] = [[] for _ in range(budgets)]

    def reached(index: int, number: int) -> float:
        if len(found[index]) == number:
            found[index].append(score(index, number))
        return found[index][number]

    best = 0
    for index in range(1, budgets):
        gains: list[float] = []
        while len(gains) < rehearsals and all(gain > 0 for gain in gains):
            before = reached(best, len(gains))
            gains.append(reached(index, len(gains)) - before)
        if _pays(gains):
            best = index
        elif np.mean(gains) < -LEAST_GAIN:
            break
    return [scores for scores in found if scores]


def _held_out(cameras: Sequence[Camera]) -> list[list[int]]:
    """Return the views that the rehearsals leave out, one rehearsal after the other.

    An eighth in each, so that it is like the training itself, and three in all at least, since single ones
    differ by a decibel or two.
    """
    views: list[list[int]] = []
    taken: list[int] = []
    while len(taken) < 3 and (more := surrounded_views(cameras, 8, taken)):
        taken = [*taken, *more]
        views.append(more)
    return views


def _steps_alone(progress: Progress) -> Progress:
    """Progress of the steps alone: depths, found in seconds, would count as the whole."""

    def show(report: Report) -> None:
        if report.stage == STEPS:
            progress.show(report)

    return Progress(show)


def checkpoints_of(checkpoint: Path) -> list[Path]:
    """Return the files that `rehearse` wrote."""
    return list(checkpoint.parent.glob(f"*-{checkpoint.name}"))


def supported(found: Sequence[Sequence[float]], budgets: Sequence[RadianceBudget]) -> RadianceBudget:
    """Return the budget that rehearsals `found` best.

    A larger one only where it gains in every one of them; the smallest where no view could be held out.
    """
    best = 0
    for index in range(1, len(found)):
        if _pays([more - less for more, less in zip(found[index], found[best], strict=False)]):
            best = index
    return budgets[best]


def _pays(gains: Sequence[float]) -> bool:
    """Return True where a larger budget pays that gained so much (dB): one view alone tells little."""
    return min(gains) > 0 and float(np.mean(gains)) >= LEAST_GAIN


def train_within(
    capture: Capture,
    budget: RadianceBudget,
    config: RadianceConfig,
    train_indices: Sequence[int],
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> Gaussians:
    """Call `train_radiance` with the budget's share of `config`, for images as large as the photographs."""
    spent, cameras = config.spending(budget), capture.cameras
    if all(max(camera.width, camera.height) <= budget.longer_side for camera in cameras):
        return train_radiance(capture, spent, train_indices, checkpoint, progress)
    small = capture.read_at(range(len(capture)), budget.longer_side)
    gaussians = train_radiance(small, spent, train_indices, checkpoint, progress)
    return widened(gaussians, [(small.cameras[index], cameras[index]) for index in train_indices])


def widened(gaussians: Gaussians, views: Sequence[tuple[Camera, Camera]]) -> Gaussians:
    """Return Gaussians fitted to the first camera of each view, as large as the second has to see them.

    The second has the same place and more pixels: what the dilation (`raster.protocol.dilation`) adds there
    is less.
    """
    added = np.full(len(gaussians), np.inf)
    for camera, finer in views:
        pixels, depth = camera.project(gaussians.means)
        seen = camera.in_image(pixels, depth)
        less = 1 / (camera.fx * camera.fy) - 1 / (finer.fx * finer.fy)
        added[seen] = np.minimum(added, INRIA.dilation * depth**2 * less)[seen]
    added = np.where(np.isfinite(added), added, 0)[:, None]
    variances = np.exp(2 * gaussians.log_scales.astype(np.float64)) + added
    return replace(gaussians, log_scales=(np.log(variances) / 2).astype(np.float32))
