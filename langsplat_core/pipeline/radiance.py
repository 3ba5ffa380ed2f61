"""Gaussians of photographs, trained within the budget that rehearsals support, kept in the work folder."""

import json
import logging
from dataclasses import replace
from pathlib import Path

from langsplat_core.config import RadianceBudget, RadianceConfig
from langsplat_core.datasets.capture import Capture
from langsplat_core.io.files import atomic_path
from langsplat_core.io.ply import read_ply, write_ply
from langsplat_core.pipeline.report import rehearsals_in_words
from langsplat_core.pipeline.stages import ProcessGroup, stage_key
from langsplat_core.progress import Progress
from langsplat_core.scene import Gaussians
from langsplat_core.training.radiance.rehearsal import (
    budget_text,
    budgets_for,
    checkpoints_of,
    rehearse,
    supported,
    train_within,
)

VERSION = 7  # of what training and rehearsals make

log = logging.getLogger("langsplat")


def gaussians_of(
    capture: Capture,
    train: list[int],
    config: RadianceConfig,
    work: Path,
    progress: Progress,
    processes: ProcessGroup,
) -> tuple[Gaussians, dict[str, list[float]]]:
    """Return the trained Gaussians, and the held-out PSNRs (dB) that rehearsals found for each budget.

    One process trains; the others read what it keeps.
    """
    budgets = budgets_for(capture, config, len(train))
    found = processes.once(lambda: _rehearsals(capture, train, config, work, progress))
    budget = supported(found, budgets)
    scores = [[round(decibels, 2) for decibels in each] for each in found]
    rehearsed = dict(zip(map(budget_text, budgets), scores, strict=False))
    if budget != budgets[-1]:
        log.info(
            "training takes %s, not %s: with so few photographs more does not pay (held out: %s); "
            "--radiance.rehearsed-views 0 spends all",
            *(
                budget_text(budget),
                budget_text(budgets[-1]),
                rehearsals_in_words(rehearsed) or "none could be",
            ),
        )
    made = processes.once(lambda: trained_gaussians(capture, train, config, budget, work, progress))
    return made, rehearsed


def _rehearsals(
    capture: Capture, train: list[int], config: RadianceConfig, work: Path, progress: Progress
) -> list[list[float]]:
    """`rehearse` for the photographs at `train`, from `work` where that was done before."""
    done = work / f"{_key('rehearsal', capture, train, config)}.json"
    if not done.exists():
        checkpoint = done.with_suffix(".checkpoint.safetensors")
        found = rehearse(capture, config, train, checkpoint, progress)
        with atomic_path(done) as temporary:
            temporary.write_text(json.dumps(found))
        for left in checkpoints_of(checkpoint):
            left.unlink(missing_ok=True)
    return [[float(decibels) for decibels in each] for each in json.loads(done.read_text())]


def trained_gaussians(
    capture: Capture,
    train: list[int],
    config: RadianceConfig,
    budget: RadianceBudget,
    work: Path,
    progress: Progress,
) -> Gaussians:
    """Return the Gaussians of the photographs at `train`, from `work` where they were trained before."""
    done = work / f"{_key('radiance', capture, train, config, budget)}.ply"
    if done.exists():
        log.debug("%s: kept from an earlier run", done.name)
        return read_ply(done)
    checkpoint = done.with_suffix(".checkpoint.safetensors")
    gaussians = train_within(capture, budget, config, train, checkpoint, progress)
    write_ply(done, gaussians)
    checkpoint.unlink(missing_ok=True)
    return gaussians


def _key(name: str, capture: Capture, train: list[int], config: RadianceConfig, *more: RadianceBudget) -> str:
    # The backend changes who computes, not what, so that a run may move between machines; nor do checkpoints.
    every = RadianceConfig.checkpoint_every
    settings = replace(config, backend="auto", checkpoint_every=every)
    return stage_key(name, VERSION, settings, capture.digest(train), *more)
