"""Rehearsal of a training: how many steps a few photographs support.

Few photographs can be learnt by heart, and from some step on they are: views that were held out get worse.
Which step that is depends on the capture (docs/photographs.md). So some of the training views are held out,
and the others trained on at a small size: shortly, three times as long, and so on, as long as that pays. The
training itself then takes all views.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from langsplat_core.config import RadianceConfig
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.holdout import chosen
from langsplat_core.progress import Progress, Report, silent
from langsplat_core.training.radiance.train import STAGE as STEPS
from langsplat_core.training.radiance.train import evaluate_views, train_radiance

log = logging.getLogger("langsplat")

STAGE = "rehearsing"
LONGER_SIDE = 320  # px at most
HELD_OUT = 8  # one view in so many: the more are left, the more it is like the training itself
LEAST_GAIN = 0.25  # dB, for which more steps are trained: less may be chance


def rehearse(
    capture: Capture,
    config: RadianceConfig,
    train_indices: Sequence[int],
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> dict[int, float]:
    """Steps -> mean PSNR (dB, exposures fitted) of views held out of those at `train_indices`. Empty where
    there is nothing to decide: many views, so few that none can be held out, or few steps.

    With a `checkpoint` path an interrupted rehearsal goes on where it stopped; the files are those of
    `checkpoints_of` it, and stay.
    """
    every = config.rehearsals(len(train_indices))
    held_out = chosen([capture.cameras[i] for i in train_indices], HELD_OUT)
    if len(every) < 2 or not held_out:
        return {}
    small = capture.shrunk(train_indices, LONGER_SIDE)
    train = [index for index in range(len(small)) if index not in held_out]
    found: dict[int, float] = {}
    for index, steps in enumerate(every):
        at = checkpoint and checkpoint.with_name(f"{steps}-{checkpoint.name}")
        reports = _of_steps(progress.part(index, len(every), STAGE, f"{steps} steps"))
        gaussians = train_radiance(small, replace(config, steps=steps), train, at, reports)
        scores = evaluate_views(gaussians, small, held_out, config.backend)
        found[steps] = float(np.mean([score.psnr_exposed or score.psnr for score in scores]))
        log.debug("rehearsal of %d steps: %.2f dB held out", steps, found[steps])
        if index and found[steps] < found[every[index - 1]] + LEAST_GAIN:
            break
    return found


def _of_steps(progress: Progress) -> Progress:
    """Progress of the steps alone: depths, found in seconds, would count as the whole."""

    def show(report: Report) -> None:
        if report.stage == STEPS:
            progress.show(report)

    return Progress(show)


def checkpoints_of(checkpoint: Path) -> list[Path]:
    """The files that `rehearse` wrote."""
    return list(checkpoint.parent.glob(f"*-{checkpoint.name}"))


def supported(found: dict[int, float], config: RadianceConfig, views: int) -> RadianceConfig:
    """Return `config` with the steps that the rehearsals `found` best, more only where they gain; with the
    fewest where no view could be held out."""
    steps = config.rehearsals(views)[0]
    for more, psnr in found.items():
        if psnr >= found[steps] + LEAST_GAIN:
            steps = more
    return replace(config, steps=steps)
