"""From photographs to a searchable scene: the whole method, one step a stage.

Every stage keeps its result in the work folder under a key of its settings, so that an interrupted run
continues where it stopped and a changed setting recomputes only what depends on it.
"""

import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from langsplat_core.config import QUICK, RadianceBudget, RadianceConfig, TrainConfig, check_settings
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.capture import Capture, split_views
from langsplat_core.errors import STRICTNESS, FormatError, InputError
from langsplat_core.io.cameras import SUFFIX as CAMERAS
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.files import atomic_path, check_output_folder, patiently, shown, write_json
from langsplat_core.io.ply import read_ply, write_ply
from langsplat_core.io.scenes import check_writable, load_scene, save_scene
from langsplat_core.pipeline import language_field
from langsplat_core.pipeline import report as reports
from langsplat_core.pipeline.stages import LOCK, ProcessGroup, digest_of, sole_use, stage_key
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import Gaussians, LanguageField, Scene
from langsplat_core.scene.transform import place_scene
from langsplat_core.semantics.encoders import DEMO, DEMO_ELSEWHERE, Encoder, load_encoder
from langsplat_core.semantics.features import FeatureStore, ImageFeatures, OnDemand, describe_capture
from langsplat_core.semantics.masks import MaskSource
from langsplat_core.semantics.sam import load_mask_source
from langsplat_core.training.radiance import trainer
from langsplat_core.training.radiance.differentiable import evaluate_views

FEWEST_VIEWS = 3
VERSION = 9  # of what training and rehearsals make

Until = Literal["gaussians", "language field"]  # what a training ends with

log = logging.getLogger("langsplat")


def train_scene(  # noqa: PLR0913  what the command has as options
    dataset: Path,
    out: Path,
    config: TrainConfig,
    work: Path | None = None,
    progress: Progress = silent,
    masks_of: Callable[[Capture], MaskSource] | None = None,
    processes: ProcessGroup | None = None,
    gaussians_from: Path | None = None,
    until: Until = "language field",
) -> reports.TrainReport:
    """Train `out` (a .ply; sidecar and cameras beside it) from the photographs in `dataset`.

    `masks_of` makes another mask source than ``config.masks`` names, once the photographs are read.
    `processes`: the processes that share the work; all call this with the same arguments, and one writes the
    scene. `gaussians_from`: a scene in the photographs' world whose Gaussians are taken instead of training
    some. `until` "gaussians": a scene without a language field, which a later call adds to it.
    """
    check_settings(config)
    language_field.check_lift(config)
    if out.suffix.lower() != ".ply":
        raise InputError(f"{out}: the scene must be named *.ply, for example --out {out.with_suffix('.ply')}")
    work = work or reports.work_folder(out)
    check_writable(out)
    check_output_folder(work)
    # First: a scene that cannot be read should not cost an hour.
    given = None if gaussians_from is None else load_scene(gaussians_from)
    processes = processes or ProcessGroup()
    with sole_use(work) if processes.is_main else nullcontext():
        return _train(_Run(dataset, out, config, work, progress, processes, until), masks_of, given)


@dataclass(frozen=True)
class _Run:
    """State that all stages of a training share."""

    dataset: Path
    out: Path
    config: TrainConfig
    work: Path
    progress: Progress
    processes: ProcessGroup
    until: Until

    @property
    def seconds_file(self) -> Path:
        """The file of `seconds`, one for each dataset and settings."""
        return self.work / f"{stage_key('seconds', 1, str(self.dataset.resolve()), self.config)}.json"

    @cached_property
    def seconds(self) -> dict[str, float]:
        """Seconds that each stage took, in this process and in earlier ones that were interrupted."""
        return reports.stated_figures(self.seconds_file)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the seconds of a stage, also of one that is interrupted, to those of earlier runs."""
        began = time.perf_counter()
        try:
            yield
        finally:
            took = time.perf_counter() - began
            self.seconds[stage] = round(self.seconds.get(stage, 0.0) + took, 1)
            log.debug("%s: %.1f s", stage, took)
            with suppress(OSError):
                if set(os.listdir(self.work)) - {LOCK}:  # else the folder goes with what was refused
                    write_json(self.seconds_file, self.seconds)


def _train(
    run: _Run, masks_of: Callable[[Capture], MaskSource] | None, given: Scene | None
) -> reports.TrainReport:
    """Train in a work folder that is this run's own; `given`: the scene whose Gaussians are taken."""
    config, processes = run.config, run.processes
    encoder, named_source = None, None
    with run.timed("photographs"):
        if run.until != "gaussians":  # first: absent weights should not cost an hour
            encoder = load_encoder(config.clip.model, config.clip.device, config.clip.batch)
            named_source = None if masks_of else load_mask_source(config.masks, config.clip.device)
        # One process solves for cameras, the others find them in the work folder.
        capture = processes.once(lambda: _photographs(run))
        train, held_out = split_views(capture, config.dataset)
        cameras = tuple(capture.cameras[i] for i in train)
        if processes.is_main:  # for whoever looks at the Gaussians before their scene is written
            with atomic_path((run.work / reports.PREVIEW).with_suffix(CAMERAS)) as file:
                write_cameras(file, cameras)

    if encoder is not None:
        mask_source = named_source or masks_of(capture)  # type: ignore[misc]  # one of them is there
        with run.timed("masks and vectors"):
            features = _described(run, capture, train, mask_source, encoder)
            language_field.check_masks(features)  # before the Gaussians, which may cost hours

    with run.timed("radiance"):
        if given is None:
            gaussians, rehearsed = _gaussians(run, capture, train)
        else:
            gaussians, rehearsed = place_scene(given, origin=capture.origin).gaussians, {}

    language, figures = None, dict[str, Any]()
    if encoder is not None:
        language, figures = _language(run, capture, train, gaussians, features, mask_source, encoder)

    if processes.is_main:
        with run.timed("saving and held-out views"):
            said = None if given is None else given.metres_per_unit  # the dataset's may be an estimate
            metres = config.dataset.metres_per_unit or said or capture.metres_per_unit
            scene = Scene(gaussians, language, cameras, metres_per_unit=metres, origin=capture.origin)
            save_scene(run.out, scene)
            small = capture.read_at(held_out, QUICK.longer_side) if held_out else None
            near = config.radiance.near or scene.near  # as whoever opens the scene has it
            told: dict[str, Any] = {"near": near, "progress": run.progress}
            scores = evaluate_views(gaussians, capture, held_out, small=small, **told) if held_out else []
            trained = evaluate_views(gaussians, capture, reports.shown_views(train), **told)
        rule = f"one in {config.dataset.test_every}, "
        rule += "by name" if config.dataset.hold_out == "every" else "amid others"
        report = reports.TrainReport(
            views=len(cameras),
            held_out=len(scores),
            gaussians=len(gaussians),
            psnr=_mean(score.psnr for score in scores),
            psnr_small=_mean(score.psnr_small for score in scores),
            warnings=reports.quality_warnings(capture, train, scores, trained),
            seconds=run.seconds,
            dataset=str(run.dataset.resolve()),
            taken=capture.taken,
            held_out_views=tuple(scores),
            rehearsed=rehearsed,
            psnr_trained=_mean(score.psnr for score in trained),
            held_out_rule="as the dataset says" if any(photo.held_out for photo in capture.photos) else rule,
            **figures,
        )
        reports.write_reports(run.work, report, capture, gaussians, trained)
    processes.barrier()
    return reports.read_report(run.work)


def _language(
    run: _Run,
    capture: Capture,
    train: list[int],
    gaussians: Gaussians,
    features: Sequence[ImageFeatures],
    source: MaskSource,
    encoder: Encoder,
) -> tuple[LanguageField, dict[str, Any]]:
    """Return the language field of the Gaussians, and the report's figures of it."""
    config, shared = run.config, (run.work, run.progress, run.processes)
    cameras = tuple(capture.cameras[i] for i in train)
    if not source.agrees:
        with run.timed("masks that agree"):
            photographs = [(capture.images[i], capture.mask(i)) for i in train]
            views = language_field.views_of(cameras, features)
            features = language_field.agreed_features(gaussians, views, photographs, encoder, config, *shared)
    with run.timed("language field"):
        views = language_field.views_of(cameras, features)
        language, codec = language_field.language_field(gaussians, views, encoder, config, *shared)
        if not capture.drawn:
            language = replace(language, calibration=None)  # which holds in drawn rooms alone
    return language, {
        "masks": source.name,
        "encoder": encoder.id,
        "mask_count": sum(len(item.vectors) for item in features),
        "codec": language.codec.kind,
        "codec_size": language.codec.size,
        "codec_cosine": codec.cosine,
        "relevancy_error": codec.error_mean,
        "relevancy_error_p99": codec.error_p99,
        "observed": float((language.confidence[2] > 0).mean()) if len(gaussians) else 0.0,
    }


def _mean(scores: Iterable[float | None]) -> float | None:
    """Mean of the scores that could be measured; None where none could."""
    measured = [score for score in scores if score is not None]
    return float(np.mean(measured)) if measured else None


def _photographs(run: _Run) -> Capture:
    """Return the photographs that have cameras, enough for a scene."""
    capture = load_capture(run.dataset, run.config.dataset, run.work, run.progress)
    if len(capture) < FEWEST_VIEWS and not run.config.dataset.allow_few_cameras:
        why = f" ({'; '.join(STRICTNESS.said)})" if STRICTNESS.said else ""
        raise InputError(
            f"{shown(run.dataset)}: only {len(capture)} photographs have cameras{why}, and a scene needs "
            f"{FEWEST_VIEWS}; take more, or go on with --dataset.allow-few-cameras"
        )
    return capture


def _described(
    run: _Run, capture: Capture, train: list[int], source: MaskSource, encoder: Encoder
) -> OnDemand[ImageFeatures]:
    """Find the masks of the photographs at `train`, and their vectors where masks agree between photographs.

    Others are described once they agree. Kept by mask settings, encoder and image.
    """
    log.info("masks: %s, encoder: %s", source.name, encoder.id)
    if encoder.id == DEMO and not capture.drawn:
        log.warning("%s", DEMO_ELSEWHERE)
    store = FeatureStore(run.work / ("features" if source.agrees else "masks"))
    mine = run.processes.share(train)
    names = [capture.cameras[i].name for i in mine]
    images, counted = [capture.images[i] for i in mine], [capture.mask(i) for i in mine]
    seen_by = encoder if source.agrees else None
    describe_capture(images, names, source, seen_by, store, run.progress, counted)
    run.processes.barrier()
    return store.of([capture.cameras[i].name for i in train])


def _gaussians(run: _Run, capture: Capture, train: list[int]) -> tuple[Gaussians, dict[str, list[float]]]:
    """Return Gaussians of the supported budget, and PSNRs of held-out views by budget; one process trains."""
    config = run.config.radiance
    budgets = trainer.budgets_for(capture, config, len(train))
    found = run.processes.once(lambda: _rehearsals(run, capture, train, budgets))
    budget = budgets[trainer.supported(found)]
    scores = [[round(decibels, 2) for decibels in each] for each in found]
    rehearsed = dict(zip(map(trainer.budget_text, budgets), scores, strict=False))
    if budget.steps < config.steps:
        log.info(
            "training takes %s, not %d: with %d photographs more does not pay%s; "
            "--radiance.rehearsed-views 0 spends all",
            *(trainer.budget_text(budget), config.steps, len(train)),
            f" (held out: {reports.rehearsals_in_words(rehearsed)})" if rehearsed else "",
        )
    made = run.processes.once(
        lambda: trained_gaussians(capture, train, config, budget, run.work, run.progress)
    )
    return made, rehearsed


def _rehearsals(
    run: _Run, capture: Capture, train: list[int], budgets: list[RadianceBudget]
) -> list[list[float]]:
    """`rehearse` for the photographs at `train`, from the work folder where that was done before."""
    config = run.config.radiance
    done = run.work / f"{_radiance_key('rehearsal', capture, train, config)}.json"
    if not done.exists():
        checkpoints = done.with_suffix(".checkpoints")
        checkpoints.mkdir(exist_ok=True)
        write_json(done, trainer.rehearse(capture, config, budgets, train, checkpoints, run.progress))
        shutil.rmtree(checkpoints)
    try:
        found: list[list[float]] = json.loads(done.read_bytes())
    except ValueError as error:
        raise FormatError(f"{done}: damaged ({error}); delete it and run again") from None
    return found


def trained_gaussians(
    capture: Capture,
    train: list[int],
    config: RadianceConfig,
    budget: RadianceBudget,
    work: Path,
    progress: Progress,
) -> Gaussians:
    """Return the Gaussians of the photographs at `train`, from `work` where they were trained before."""
    done = work / f"{_radiance_key('radiance', capture, train, config, budget)}.ply"
    stated = done.with_suffix(".digest")
    if done.exists():
        log.debug("%s: kept from an earlier run", done.name)
        found = read_ply(done)
        if stated.exists() and stated.read_bytes() != digest_of(found).encode():  # none in earlier versions
            raise FormatError(f"{done}: changed since it was written; delete it and run again")
        return found
    checkpoint = done.with_suffix(".checkpoint.safetensors")
    stated.unlink(missing_ok=True)
    gaussians = trainer.train_radiance(capture, config.spending(budget), train, checkpoint, progress)
    write_ply(done, gaussians)
    with atomic_path(stated) as temporary:
        temporary.write_text(digest_of(read_ply(done)), encoding="utf-8")
    patiently(lambda: checkpoint.unlink(missing_ok=True))
    return gaussians


def _radiance_key(
    name: str, capture: Capture, train: list[int], config: RadianceConfig, *more: RadianceBudget
) -> str:
    # The backend changes who computes, not what, so that a run may move between machines; nor do checkpoints.
    settings = replace(config, backend="auto", checkpoint_every=RadianceConfig.checkpoint_every)
    return stage_key(name, VERSION, settings, capture.digest(train), *more)
