"""From photographs to a searchable scene: the whole method, one line a stage.

Every stage keeps its result in the work folder under a key of its settings, so that an interrupted run
continues where it stopped and a changed setting recomputes only what depends on it.
"""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.config import RadianceConfig, TrainConfig, check_settings
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.holdout import split
from langsplat_core.datasets.matches import NotLocatedError
from langsplat_core.errors import InputError
from langsplat_core.io.files import check_output_folder, shown
from langsplat_core.io.ply import read_ply, write_ply
from langsplat_core.io.scenes import check_writable, load_scene, save_scene
from langsplat_core.pipeline.agreement import agreed_features
from langsplat_core.pipeline.language import check_lift, check_masks, language_field
from langsplat_core.pipeline.report import (
    TrainReport,
    quality_warnings,
    read_report,
    work_folder,
)
from langsplat_core.pipeline.report_page import write_refusal, write_reports
from langsplat_core.pipeline.stages import ProcessGroup, sole_use, stage_key
from langsplat_core.progress import Progress, silent
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_core.semantics.encoders import DEMO, DEMO_ELSEWHERE, load_encoder
from langsplat_core.semantics.masks import MaskSource
from langsplat_core.semantics.sam import load_mask_source
from langsplat_core.semantics.store import FeatureStore, ImageFeatures, StoredFeatures, describe_capture
from langsplat_core.training.radiance.train import evaluate_views, train_radiance

FEWEST_VIEWS = 3

log = logging.getLogger("langsplat")


def train_scene(
    dataset: Path,
    out: Path,
    config: TrainConfig,
    work: Path | None = None,
    progress: Progress = silent,
    masks_of: Callable[[Capture], MaskSource] | None = None,
    processes: ProcessGroup | None = None,
    gaussians_from: Path | None = None,
) -> TrainReport:
    """Train `out` (a .ply; sidecar and cameras beside it) from the photographs in `dataset`.

    `masks_of` makes another mask source than ``config.masks`` names, once the photographs are read.
    `processes`: the processes that share the work; all call this with the same arguments, and one writes the
    scene. `gaussians_from`: a scene in the photographs' world whose Gaussians are taken instead of training
    some.
    """
    check_settings(config)
    check_lift(config)
    if out.suffix.lower() != ".ply":
        raise InputError(f"{out}: the scene must be named *.ply, for example --out {out.with_suffix('.ply')}")
    work = work or work_folder(out)
    check_writable(out)
    check_output_folder(work)
    # First: a scene that cannot be read should not cost an hour.
    given = None if gaussians_from is None else load_scene(gaussians_from)
    processes = processes or ProcessGroup()
    with sole_use(work) if processes.is_main else nullcontext():
        return _train(dataset, out, config, work, progress, masks_of, processes, given)


def _train(
    dataset: Path,
    out: Path,
    config: TrainConfig,
    work: Path,
    progress: Progress,
    masks_of: Callable[[Capture], MaskSource] | None,
    processes: ProcessGroup,
    given: Scene | None,
) -> TrainReport:
    """`train_scene` in a folder that is its own; `given`: the scene whose Gaussians are taken."""
    clock = _Clock()
    # First: absent weights should not cost an hour.
    encoder = load_encoder(config.clip.model, config.clip.device, config.clip.batch)
    named = None if masks_of else load_mask_source(config.masks, config.clip.device)
    # One process solves for cameras, the others find them in the work folder.
    capture = processes.once(lambda: _photographs(dataset, config, work, progress))
    if len(capture) < FEWEST_VIEWS and not config.dataset.allow_few_cameras:
        raise InputError(
            f"{shown(dataset)}: only {len(capture)} photographs have cameras, and a scene needs "
            f"{FEWEST_VIEWS}; take more, or go on with --dataset.allow-few-cameras"
        )
    mask_source = named or masks_of(capture)  # type: ignore[misc]  # one of them is there
    log.info("masks: %s, encoder: %s", mask_source.name, encoder.id)
    if encoder.id == DEMO and not capture.drawn:
        log.warning("%s", DEMO_ELSEWHERE)
    train, held_out = split(capture, config.dataset)
    clock.lap("photographs")

    # Keyed by mask settings, encoder and image. Masks that do not agree yet are described when they do.
    store = FeatureStore(work / ("features" if mask_source.agrees else "masks"))
    mine = processes.share(train)
    names = [capture.cameras[i].name for i in mine]
    seen_by = encoder if mask_source.agrees else None
    images, counted = [capture.images[i] for i in mine], [capture.mask(i) for i in mine]
    describe_capture(images, names, mask_source, seen_by, store, progress, counted)
    processes.barrier()
    cameras = tuple(capture.cameras[i] for i in train)
    features = StoredFeatures(store, [camera.name for camera in cameras])
    check_masks(features)  # before the Gaussians, which may cost hours
    clock.lap("masks and vectors")

    if given is None:
        gaussians = processes.once(lambda: trained_gaussians(capture, train, config, work, progress))
    else:
        gaussians = given.gaussians
    said = None if given is None else given.metres_per_unit  # the dataset's may be an estimate
    metres = config.dataset.metres_per_unit or said or capture.metres_per_unit
    clock.lap("radiance")

    views = StoredViews(cameras, features)
    if not mask_source.agrees:
        shared = load_lifting_rasterizer(config.lift.backend), work, progress, processes
        photographs = [(capture.images[i], capture.mask(i)) for i in train]
        features = agreed_features(gaussians, views, photographs, encoder, *shared)
        views = StoredViews(cameras, features)
        clock.lap("masks that agree")
    language, loss = language_field(gaussians, views, encoder, config, work, progress, processes)
    if not capture.drawn:
        language = replace(language, reading=language.reading.elsewhere)
    clock.lap("language field")

    if processes.is_main:
        save_scene(out, Scene(gaussians, language, cameras, metres_per_unit=metres))
        scores = evaluate_views(gaussians, capture, held_out) if held_out else []
        clock.lap("saving and held-out views")
        report = TrainReport(
            views=len(train),
            held_out=len(held_out),
            gaussians=len(gaussians),
            psnr=float(np.mean([score.psnr for score in scores])) if scores else None,
            masks=mask_source.name,
            encoder=encoder.id,
            mask_count=sum(len(item.vectors) for item in features),
            codec=language.codec.kind,
            codec_size=language.codec.size,
            codec_cosine=loss.cosine,
            relevancy_error=loss.error_mean,
            relevancy_error_p99=loss.error_p99,
            observed=float((language.confidence[2] > 0).mean()) if len(gaussians) else 0.0,
            warnings=quality_warnings(scores, cameras),
            seconds=clock.laps,
            dataset=str(dataset.resolve()),
            held_out_views=tuple(scores),
        )
        write_reports(work, report, capture, gaussians)
    processes.barrier()
    return read_report(work)


def _photographs(dataset: Path, config: TrainConfig, work: Path, progress: Progress) -> Capture:
    try:
        return load_capture(dataset, config.dataset, work, progress)
    except NotLocatedError as error:
        page = write_refusal(work, error)
        raise InputError(f"{error}; see {shown(page)}") from None


def trained_gaussians(
    capture: Capture, train: list[int], config: TrainConfig, work: Path, progress: Progress
) -> Gaussians:
    """The Gaussians of the photographs at `train`, from `work` where they were trained before."""
    # The backend changes who computes, not what, so that a run may move between machines; nor do checkpoints.
    every = RadianceConfig.checkpoint_every
    settings = replace(config.radiance, backend="auto", checkpoint_every=every)
    done = work / f"{stage_key('radiance', 3, settings, capture.digest(train))}.ply"
    if done.exists():
        log.debug("%s: kept from an earlier run", done.name)
        return read_ply(done)
    gaussians = train_radiance(
        capture, config.radiance, train, done.with_suffix(".checkpoint.safetensors"), progress
    )
    write_ply(done, gaussians)
    done.with_suffix(".checkpoint.safetensors").unlink(missing_ok=True)
    return gaussians


class StoredViews(Sequence[tuple[Camera, ImageFeatures]]):
    """Cameras with the features of what each saw, read when a view is looked at: hundreds of label maps are
    more than memory holds."""

    def __init__(self, cameras: Sequence[Camera], features: Sequence[ImageFeatures]) -> None:
        self._cameras, self._features = cameras, features

    def __len__(self) -> int:
        return len(self._cameras)

    def __getitem__(self, index: Any) -> Any:
        """Return view `index`, a number; slices are not supported."""
        return self._cameras[index], self._features[index]


class _Clock:
    """Clock of the seconds that each stage takes."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = round(now - self._last, 1)
        log.debug("%s: %.1f s", name, self.laps[name])
        self._last = now
