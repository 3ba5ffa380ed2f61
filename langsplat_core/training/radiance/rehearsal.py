"""Rehearsal of a training: how much a few photographs support.

Few photographs can be learnt by heart, and from some budget on they are: views that were held out get worse.
Which one that is depends on the capture (docs/photographs.md). So some of the training views are held out,
and the others trained on with the smallest budget, then with larger ones, unless one clearly loses. The
training itself then takes all views.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from langsplat_core.config import INRIA, RadianceBudget, RadianceConfig
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.holdout import chosen
from langsplat_core.datasets.known_poses import inside
from langsplat_core.progress import Progress, Report, silent
from langsplat_core.scene import Camera, Gaussians
from langsplat_core.training.radiance.train import STAGE as STEPS
from langsplat_core.training.radiance.train import evaluate_views, train_radiance

log = logging.getLogger("langsplat")

STAGE = "rehearsing"
HELD_OUT = 8  # one view in so many: the more are left, the more it is like the training itself
LEAST_GAIN = 0.25  # dB, for which more is spent: less may be chance


def budgets_for(capture: Capture, config: RadianceConfig, views: int) -> list[RadianceBudget]:
    """Ascending budgets that `views` of the capture's photographs may be trained with."""
    return config.budgets(views, max(max(camera.width, camera.height) for camera in capture.cameras))


def rehearse(
    capture: Capture,
    config: RadianceConfig,
    train_indices: Sequence[int],
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> list[float]:
    """Mean PSNR (dB, exposures fitted) of views held out of those at `train_indices`, for each budget from
    the smallest on, up to one that clearly loses. Empty where there is nothing to decide: many views, so few
    that none can be held out, or few steps.

    With a `checkpoint` path an interrupted rehearsal goes on where it stopped; the files are those of
    `checkpoints_of` it, and stay.
    """
    budgets = budgets_for(capture, config, len(train_indices))
    held_out = chosen([capture.cameras[i] for i in train_indices], HELD_OUT)
    if len(budgets) < 2 or not held_out:
        return []
    found: list[float] = []
    for index, budget in enumerate(budgets):
        small = capture.read_at(train_indices, budget.longer_side)
        train = [row for row in range(len(small)) if row not in held_out]
        at = checkpoint and checkpoint.with_name(f"{index}-{checkpoint.name}")
        reports = _of_steps(progress.part(index, len(budgets), STAGE, in_words(budget)))
        gaussians = train_radiance(small, config.spending(budget), train, at, reports)
        scores = evaluate_views(gaussians, small, held_out, config.backend)
        found.append(float(np.mean([score.psnr_exposed or score.psnr for score in scores])))
        log.debug("rehearsal of %s: %.2f dB held out", in_words(budget), found[-1])
        if found[-1] < max(found) - LEAST_GAIN:
            break
    return found


def in_words(budget: RadianceBudget) -> str:
    """The budget as messages and reports name it."""
    return f"{budget.steps} steps at {budget.longer_side} px"


def _of_steps(progress: Progress) -> Progress:
    """Progress of the steps alone: depths, found in seconds, would count as the whole."""

    def show(report: Report) -> None:
        if report.stage == STEPS:
            progress.show(report)

    return Progress(show)


def checkpoints_of(checkpoint: Path) -> list[Path]:
    """The files that `rehearse` wrote."""
    return list(checkpoint.parent.glob(f"*-{checkpoint.name}"))


def supported(found: Sequence[float], budgets: Sequence[RadianceBudget]) -> RadianceBudget:
    """The budget that rehearsals `found` best, a larger one only where it gains; the smallest where no view
    could be held out."""
    best = 0
    for index, decibels in enumerate(found):
        if decibels >= found[best] + LEAST_GAIN:
            best = index
    return budgets[best]


def train_within(
    capture: Capture,
    budget: RadianceBudget,
    config: RadianceConfig,
    train_indices: Sequence[int],
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> Gaussians:
    """`train_radiance` with the budget's share of `config`, for images as large as the photographs."""
    spent, cameras = config.spending(budget), capture.cameras
    if all(max(camera.width, camera.height) <= budget.longer_side for camera in cameras):
        return train_radiance(capture, spent, train_indices, checkpoint, progress)
    small = capture.read_at(range(len(capture)), budget.longer_side)
    gaussians = train_radiance(small, spent, train_indices, checkpoint, progress)
    return widened(gaussians, [(small.cameras[index], cameras[index]) for index in train_indices])


def widened(gaussians: Gaussians, views: Sequence[tuple[Camera, Camera]]) -> Gaussians:
    """Gaussians fitted to the first camera of each view, as large as the second, which has the same place and
    more pixels, has to see them: what the dilation (`raster.protocol.dilation`) adds there is less."""
    added = np.full(len(gaussians), np.inf)
    for camera, finer in views:
        seen = inside(camera, gaussians.means)
        depth = camera.project(gaussians.means)[1]
        less = 1 / (camera.fx * camera.fy) - 1 / (finer.fx * finer.fy)
        added[seen] = np.minimum(added, INRIA.dilation * depth**2 * less)[seen]
    added = np.where(np.isfinite(added), added, 0)[:, None]
    variances = np.exp(2 * gaussians.log_scales.astype(np.float64)) + added
    return replace(gaussians, log_scales=(np.log(variances) / 2).astype(np.float32))
