"""From photographs to a searchable scene: the whole method, one step a stage.

Every stage keeps its result in the work folder under a key of its settings, so that an interrupted run
continues where it stopped and a changed setting recomputes only what depends on it.
"""

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args
from uuid import uuid4

import numpy as np

from langsplat_core.config import QUICK_SIDE, RadianceConfig, TrainConfig, Until, check_settings
from langsplat_core.datasets import check_dataset, load_capture
from langsplat_core.datasets.capture import Capture, split_views
from langsplat_core.datasets.photos import count_photographs
from langsplat_core.errors import STRICTNESS, InputError, LangSplatError, optional_imports
from langsplat_core.interrupts import raised
from langsplat_core.io import apart
from langsplat_core.io.cameras import SUFFIX as CAMERAS
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.files import check_output_folder, patiently, shown, write_json, write_whole
from langsplat_core.io.ply import read_ply, write_ply
from langsplat_core.io.scenes import check_writable, load_scene, save_scene
from langsplat_core.pipeline import language_field
from langsplat_core.pipeline import report as reports
from langsplat_core.pipeline.stages import LOCK, ProcessGroup, changed, digest_of, sole_use, stage_key
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import Gaussians, LanguageField, Scene
from langsplat_core.scene.transform import place_scene
from langsplat_core.semantics.encoders import DEMO, DEMO_ELSEWHERE, Encoder, load_encoder
from langsplat_core.semantics.features import FeatureStore, ImageFeatures, OnDemand, describe_capture
from langsplat_core.semantics.masks import MaskSource
from langsplat_core.semantics.sam import load_mask_source
from langsplat_core.training.radiance import trainer
from langsplat_core.training.radiance.differentiable import evaluate_views

FEWEST_CAMERAS = 3
VERSION = 9  # of the results of training

log = logging.getLogger("langsplat")


def train_scene(  # noqa: PLR0913  what the command has as options
    dataset: Path | str,
    out: Path | str,
    config: TrainConfig,
    work: Path | str | None = None,
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
    dataset, out = Path(dataset), Path(out)
    if until not in get_args(Until):
        raise InputError(f"until {until!r}: no stage that a training ends at; there are {get_args(Until)}")
    check_settings(config)
    language_field.check_lift(config)
    if out.suffix.lower() != ".ply":
        example = out.with_suffix(".ply") if out.name else out / "scene.ply"  # "." has no name
        raise InputError(f"{out}: the scene must be named *.ply, for example --out {example}")
    work = reports.work_folder(out) if work is None else Path(work)
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
        """The file of `kept`, one for each dataset and settings."""
        return self.work / f"{stage_key('seconds', 2, os.path.realpath(self.dataset), self.config)}.json"

    @cached_property
    def kept(self) -> dict[str, Any]:
        """The "seconds" of each stage, in interrupted runs too, and the "contents" of the photographs."""
        return {"seconds": {}, "contents": {}} | reports.stated_figures(self.seconds_file)

    def photographs_are(self, contents: Mapping[str, str]) -> None:
        """Forget the seconds of other photographs than those that are trained on now."""
        if self.kept["contents"] not in ({}, contents):
            self.kept["seconds"].clear()
        self.kept["contents"] = contents

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the seconds of a stage, also of one that is interrupted, to those of earlier runs."""
        began = time.perf_counter()
        try:
            yield
        finally:
            took = time.perf_counter() - began
            seconds = self.kept["seconds"]
            seconds[stage] = round(seconds.get(stage, 0.0) + took, 1)
            log.debug("%s: %.1f s", stage, took)
            with suppress(OSError):
                if set(os.listdir(self.work)) - {LOCK}:  # else the folder goes with what was refused
                    write_json(self.seconds_file, self.kept)


def _train(
    run: _Run, masks_of: Callable[[Capture], MaskSource] | None, given: Scene | None
) -> reports.TrainReport:
    """Train in a work folder that is this run's own; `given`: the scene whose Gaussians are taken."""
    config, processes = run.config, run.processes
    encoder, source = None, None
    with run.timed("photographs"):
        check_dataset(run.dataset)
        if run.until != "gaussians":  # first: absent weights should not cost an hour
            encoder = load_encoder(config.clip.model, config.clip.device, config.clip.batch)
            source = None if masks_of else load_mask_source(config.masks, config.clip.device)
        # One process solves for cameras, the others find them in the work folder.
        capture = processes.once(lambda: _photographs(run))
        run.photographs_are(capture.contents())
        train, held_out = split_views(capture, config.dataset)
        seen = capture.take(train)
        if processes.is_main:  # for whoever looks at the Gaussians before their scene is written
            write_cameras((run.work / reports.PREVIEW).with_suffix(CAMERAS), seen.cameras)

    if encoder is not None:
        source = source or masks_of(capture)  # type: ignore[misc]  # one of them is there
        with run.timed("masks and vectors"):
            features = _features(run, seen, source, encoder)
            language_field.check_masks(features)  # before the Gaussians, which may cost hours

    with run.timed("radiance"):
        if given is None:
            made = capture, train, config.radiance, run.work, run.progress, held_out
            gaussians = processes.once(lambda: trained_gaussians(*made))
            scene = Scene(gaussians, origin=capture.origin)
        else:
            scene = place_scene(given, origin=capture.origin)

    language, figures = None, dict[str, Any]()
    if encoder is not None and source is not None:
        language, figures = _language(run, seen, scene, features, source, encoder)

    if processes.is_main:
        # the dataset's may be an estimate
        metres = config.dataset.metres_per_unit or scene.metres_per_unit or capture.metres_per_unit
        scene = replace(scene, language=language, cameras=seen.cameras, metres_per_unit=metres, unread=())
        _finish(run, capture, scene, train, held_out, figures)
    processes.barrier()
    return reports.read_report(run.work)


def _language(
    run: _Run,
    seen: Capture,
    scene: Scene,
    features: Sequence[ImageFeatures],
    source: MaskSource,
    encoder: Encoder,
) -> tuple[LanguageField, dict[str, Any]]:
    """Return the language field of a scene's Gaussians, with its taught words, and the report's figures."""
    views, shared = language_field.views_of(seen.cameras, features), (run.work, run.progress, run.processes)
    stages = language_field.Stages(scene.gaussians, views, encoder, run.config, *shared, scene.antialiased)
    if not source.agrees:
        with run.timed("masks that agree"):
            photographs = [(image, seen.mask(row)) for row, image in enumerate(seen.images)]
            features = language_field.agreed_features(stages, photographs)
            stages = replace(stages, views=language_field.views_of(seen.cameras, features))
    with run.timed("language field"):
        language, codec = language_field.language_field(stages)
        if not seen.drawn:
            language = replace(language, calibration=None)  # which holds in drawn rooms alone
        if scene.language is not None and scene.language.encoder_id == encoder.id:
            language = replace(language, taught=scene.language.taught)
    return language, {
        "masks": source.name,
        "encoder": encoder.id,
        "mask_count": sum(len(item.vectors) for item in features),
        "codec": language.codec.kind,
        "codec_size": language.codec.size,
        "codec_cosine": codec.cosine,
        "relevancy_error": codec.error_mean,
        "relevancy_error_p99": codec.error_p99,
        "observed": float((language.confidence[2] > 0).mean()) if len(scene.gaussians) else 0.0,
    }


def _finish(
    run: _Run, capture: Capture, scene: Scene, train: list[int], held_out: list[int], figures: dict[str, Any]
) -> None:
    """Write a scene, measure its views against their photographs, and report the training."""
    with run.timed("saving and held-out views"):
        save_scene(run.out, scene)
        small = capture.read_at(held_out, QUICK_SIDE) if held_out else None
        near = run.config.radiance.near or scene.near  # as whoever opens the scene has it
        told: dict[str, Any] = {"near": near, "antialiased": scene.antialiased, "progress": run.progress}
        scores = evaluate_views(scene.gaussians, capture, held_out, small=small, **told)
        trained = evaluate_views(scene.gaussians, capture, reports.shown_views(train), **told)
    rule = f"one in {run.config.dataset.test_every}, "
    rule += "by name" if run.config.dataset.hold_out == "every" else "amid others"
    report = reports.TrainReport(
        views=len(train),
        held_out=len(scores),
        gaussians=len(scene.gaussians),
        psnr=_mean(score.psnr for score in scores),
        psnr_small=_mean(score.psnr_small for score in scores),
        warnings=reports.quality_warnings(capture, train, scores, trained),
        seconds=run.kept["seconds"],
        dataset=os.path.realpath(run.dataset),
        contents=run.kept["contents"],
        taken=capture.taken,
        held_out_views=tuple(scores),
        psnr_trained=_mean(score.psnr for score in trained),
        held_out_rule="as the dataset says" if any(photo.held_out for photo in capture.photos) else rule,
        **figures,
    )
    reports.write_reports(run.work, report, capture, scene, trained)


def _mean(scores: Iterable[float | None]) -> float | None:
    measured = [score for score in scores if score is not None]
    return float(np.mean(measured)) if measured else None


def _photographs(run: _Run) -> Capture:
    """Return the photographs that have cameras, enough for a scene."""
    capture = load_capture(run.dataset, run.config.dataset, run.work, run.progress)
    if len(capture) < FEWEST_CAMERAS and not run.config.dataset.allow_few_cameras:
        why = f" ({'; '.join(STRICTNESS.said)})" if STRICTNESS.said else ""
        raise InputError(
            f"{shown(run.dataset)}: only {len(capture)} photographs have cameras{why}, and a scene needs "
            f"{FEWEST_CAMERAS}; take more, or go on with --dataset.allow-few-cameras"
        )
    report, out = run.work / reports.REPORT, run.out  # the report is written after its scene
    stated = reports.stated_figures(report).get("dataset")  # is gone where it was moved
    other = stated is None or (stated != os.path.realpath(run.dataset) and os.path.exists(str(stated)))
    if run.processes.is_main and out.exists() and (other or report.stat().st_mtime < out.stat().st_mtime):
        said = "%s was not made by the last training in %s and will be replaced; else use another --out"
        log.warning(said, shown(out), shown(run.work))
    return capture


def _features(run: _Run, seen: Capture, source: MaskSource, encoder: Encoder) -> OnDemand[ImageFeatures]:
    """Find the masks of the photographs, and their vectors where masks agree between photographs.

    Other masks are encoded once they agree. Results are kept by mask settings, encoder and image.
    """
    log.info("masks: %s, encoder: %s", source.name, encoder.id)
    if encoder.id == DEMO and not seen.drawn:
        log.warning("%s", DEMO_ELSEWHERE)
    store = FeatureStore(run.work / ("features" if source.agrees else "masks"))
    mine = seen.take(run.processes.share(range(len(seen))))
    names = [camera.name for camera in mine.cameras]
    seen_by, counted = encoder if source.agrees else None, [mine.mask(row) for row in range(len(mine))]
    describe_capture(mine.images, names, source, seen_by, store, run.progress, counted)
    run.processes.barrier()
    return store.of([camera.name for camera in seen.cameras])


def trained_gaussians(
    capture: Capture,
    train: list[int],
    config: RadianceConfig,
    work: Path,
    progress: Progress,
    held_out: Sequence[int] = (),
) -> Gaussians:
    """Return the Gaussians of the photographs at `train`, from `work` where they were trained before.

    Few photographs are trained on by what they support, see `trainer.supported`.
    """
    config, asked = trainer.supported(config, len(train)), config.steps
    if config.steps < asked:
        log.info(
            "training takes %d times %d steps, not %d: with %d photographs more does not pay; "
            "--radiance.capped-views 0 spends all",
            *(config.ensemble, config.steps, asked, len(train)),
        )
    # Backend and checkpoints do not change the result, so that a run may move between machines.
    settings = replace(config, backend="auto", checkpoint_every=RadianceConfig.checkpoint_every)
    done = work / f"{stage_key('radiance', VERSION, settings, capture.digest(train))}.ply"
    stated = done.with_suffix(".digest")
    if done.exists() and stated.exists():
        log.debug("%s: kept from an earlier run", done.name)
        found = read_ply(done)
        if stated.read_bytes() != digest_of(found).encode():
            raise changed(done)
        return found
    checkpoint = done.with_suffix(".checkpoint.safetensors")
    stated.unlink(missing_ok=True)
    gaussians = trainer.train_radiance(capture, config, train, checkpoint, progress, held_out)
    write_ply(done, gaussians)
    write_whole(stated, digest_of(read_ply(done)))
    patiently(lambda: checkpoint.unlink(missing_ok=True))
    return gaussians


# Many captures, each in a process of its own, by an engine that runs tasks here or elsewhere: a
# `concurrent.futures.Executor`, that is threads of this process, or Dask's workers. Machines see the
# photographs and the folder of the scenes under the same paths.


@dataclass(frozen=True)
class Task:
    """A capture to train."""

    dataset: Path
    out: Path  # its scene, *.ply
    config: TrainConfig
    until: Until
    folder: Path  # that relative paths in `config` begin at
    wanted: Path  # a file that is gone once nobody waits for the result
    strict: bool


@dataclass(frozen=True)
class Trained:
    """A row of the table of captures: how the training of one ended."""

    name: str
    code: int  # as an exit code: 0; 2: refused; 130: interrupted; 1: any other failure
    seconds: float  # of all runs, or of the last one if that failed
    said: tuple[str, ...]  # why it failed, and warnings
    located: str = "-"  # "14 of 16" photographs
    psnr: str = "-"  # "26.33 dB", of held-out views


def tasks_for(datasets: Sequence[Path], out: Path, config: TrainConfig, until: Until) -> list[Task]:
    """Return a task for each capture; its scene in `out` is named as it is. InputError for two of a name."""
    check_output_folder(out)
    named: dict[str, Path] = {}
    for path in datasets:
        folder = path.resolve().parent if path.suffix.lower() == ".json" else path.resolve()
        name = folder.stem if folder.is_file() else folder.name
        if name in named:
            raise InputError(f"{named[name]} and {path} would both be {out / name}.ply; rename one of them")
        named[name] = path
    rest = config, until, Path.cwd(), out.resolve() / f".wanted-{uuid4().hex}", STRICTNESS.on
    return [Task(path.absolute(), out.absolute() / f"{name}.ply", *rest) for name, path in named.items()]


def train_captures(
    tasks: Sequence[Task], on: str, progress: Progress = silent
) -> Generator[Trained, None, None]:
    """Yield the outcome of each task as it ends; on: ``local:N``, N at a time here, or ``dask://HOST:PORT``.

    Leaving the iteration, by Ctrl-C too, ends all that runs, on other machines as well.
    """
    wanted, futures, share = tasks[0].wanted, dict[Future[Trained], str](), 0.0

    def shown(name: str) -> Progress:
        return Progress(lambda at: progress("captures", share, f"{name}: {at.stage}"))

    with _engine(on) as engine:
        wanted.parent.mkdir(parents=True, exist_ok=True)
        wanted.touch()
        try:
            for task in tasks:  # progress can be heard of in this process alone
                heard = [shown(task.out.stem)] if isinstance(engine, ThreadPoolExecutor) else []
                futures[engine.submit(_train_apart, task, *heard)] = task.out.stem
            for future in as_completed(futures):
                share += 1 / len(tasks)
                progress("captures", share)
                try:
                    yield future.result()
                except Exception as error:  # noqa: BLE001  an engine's own: its worker was lost, for example
                    yield Trained(futures[future], 1, 0.0, (f"{type(error).__name__}: {error}",))
        finally:
            wanted.unlink(missing_ok=True)
            for future in futures:
                future.cancel()


@contextmanager
def _engine(on: str) -> Iterator[Executor]:
    kind, _, where = on.partition(":")
    if kind == "local" and where.isdecimal() and int(where):
        with ThreadPoolExecutor(int(where)) as pool:
            yield pool
    elif kind == "dask" and where.startswith("//"):
        with optional_imports():
            from distributed import Client
        try:
            client = Client(where[2:])
        except (OSError, ValueError) as error:
            raise InputError(f"--on {on}: {error}; is `dask scheduler` running there?") from None
        with client:
            yield client.get_executor(pure=False)
    else:
        raise InputError(f"--on {on}: there is local:N, N captures at a time, and dask://HOST:PORT")


def _train_apart(task: Task, progress: Progress = silent) -> Trained:
    """Train in a process of its own, whose crash ends no other."""
    began = time.monotonic()
    try:
        report, losses = apart.run(_train_while_wanted, task, progress=progress)
    except (LangSplatError, OSError, MemoryError) as error:
        code, said = 2, str(error) or "too little memory"
    except apart.AbortedError as error:
        code, said = (1, f"its process {error}") if task.wanted.exists() else (130, "interrupted")
    else:
        located = report.views + report.held_out
        count = count_photographs(task.dataset) if task.dataset.is_dir() else 0
        of = f"{located} of {max(count, located)}"
        psnr = "-" if report.psnr is None else f"{report.psnr:.2f} dB"
        return Trained(task.out.stem, 0, sum(report.seconds.values()), (*losses, *report.warnings), of, psnr)
    return Trained(task.out.stem, code, time.monotonic() - began, (said,))


def _train_while_wanted(task: Task, progress: Progress) -> tuple[reports.TrainReport, tuple[str, ...]]:
    """Return the report, and what was lost; interrupt this process once nobody waits for that."""
    done = threading.Event()

    def watch() -> None:
        while task.wanted.exists():
            if done.wait(0.5):
                return
        os.kill(os.getpid(), signal.SIGTERM)  # which wakes whatever the main thread waits for

    def named(record: logging.LogRecord) -> bool:
        record.msg, record.args = f"{task.out.stem}: {record.getMessage()}", ()
        return True

    threading.Thread(target=watch, daemon=True).start()
    log.addFilter(named)
    STRICTNESS.on = task.strict
    try:
        os.chdir(task.folder)
        with raised("langsplat", ""):
            report = train_scene(task.dataset, task.out, task.config, progress=progress, until=task.until)
        return report, tuple(STRICTNESS.said)
    finally:
        done.set()
        log.removeFilter(named)
