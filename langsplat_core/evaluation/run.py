"""A benchmark's labels, and whoever answers them, brought together by names."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from langsplat_core.datasets.colmap import find_model, load_colmap
from langsplat_core.datasets.nerfstudio import load_nerfstudio
from langsplat_core.errors import InputError, shortened
from langsplat_core.evaluation.labels import Benchmark, LabelledScene, without_suffix
from langsplat_core.evaluation.profiles import MapRule, OwnRule, Profile
from langsplat_core.evaluation.report import BenchmarkReport
from langsplat_core.evaluation.scoring import score_scene
from langsplat_core.evaluation.sources import MapSource, SceneSource
from langsplat_core.io.scenes import load_scene
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import AnswerRule
from langsplat_core.query.engine import LoadEncoder, QueryEngine, no_field
from langsplat_core.scene import Camera

log = logging.getLogger("langsplat")
FULL_SIZE = 100_000  # px: photographs are read for their cameras alone and not shrunk


@dataclass(frozen=True)
class Subject:
    """Subject of a measurement: exactly one of `scene` and `maps` is set."""

    scene: Path | None = None  # a scene file, or a folder of <benchmark's scene>.ply
    maps: Path | None = None  # <view>/<phrase>..., or <benchmark's scene>/<view>/<phrase>...
    encoder: str = ""  # in place of the one that the scene names
    paper_order: bool = False


def run_benchmark(
    benchmark: Benchmark,
    profile: Profile,
    subject: Subject,
    load_encoder: LoadEncoder,
    only: Sequence[str] = (),
    pictures: Path | None = None,
    progress: Progress = silent,
) -> BenchmarkReport:
    """Score `subject` on the scenes of `benchmark`, or those named by `only`.

    Raises InputError for a scene or maps that do not belong to the labels, EncoderError where the text
    encoder cannot be loaded.
    """
    if subject.paper_order and (subject.maps is not None or not isinstance(profile.rule, MapRule)):
        raise InputError(
            "--paper-order is for a scene under a protocol that reads relevancy maps; leave it out"
        )
    names = chosen_scenes(list(benchmark.scenes), only, subject)
    scores = {}
    for name in names:
        labelled = benchmark.scenes[name]
        source = (
            _map_source(labelled, len(names), profile, subject.maps)
            if subject.maps is not None
            else _scene_source(labelled, profile, subject, load_encoder, progress)
        )
        scores[name] = score_scene(labelled, source, profile, pictures, progress)
    order = ", latents blended and every pixel decoded (the paper's order)" if subject.paper_order else ""
    return BenchmarkReport(benchmark.name, profile, f"{subject.scene or subject.maps}{order}", scores)


def chosen_scenes(labelled: Sequence[str], only: Sequence[str], subject: Subject) -> list[str]:
    """Names of the `labelled` scenes to score: `only` these, else the one that a scene file is named after
    where several could be meant. Raises InputError for a name that is not labelled."""
    wrong = [name for name in only if name not in labelled]
    if wrong:
        raise InputError(f"--only {wrong[0]}: no such labelled scene; there are {', '.join(labelled)}")
    if only or subject.scene is None or subject.scene.is_dir() or len(labelled) == 1:
        return list(only or labelled)
    if subject.scene.stem not in labelled:
        raise InputError(
            f"{subject.scene} could be any labelled scene of {', '.join(labelled)}; say which with --only"
        )
    return [subject.scene.stem]


def open_scene(
    subject: Subject, name: str, load_encoder: LoadEncoder, rule: AnswerRule = "regions"
) -> QueryEngine:
    """The scene of `subject` that belongs to the labelled scene `name`, to be asked."""
    assert subject.scene is not None
    path = subject.scene / f"{name}.ply" if subject.scene.is_dir() else subject.scene
    if not path.exists():
        raise InputError(f"{path}: no such scene; leave {name} out with --only, or name the right folder")
    scene = load_scene(path)
    if scene.language is None:
        raise InputError(f"{path}: {no_field(scene)}")
    return QueryEngine(scene, load_encoder, encoder_id=subject.encoder, rule=rule)


def _scene_source(
    labelled: LabelledScene, profile: Profile, subject: Subject, load_encoder: LoadEncoder, progress: Progress
) -> SceneSource:
    # Published maps are read as published.
    rule: AnswerRule = "peak" if isinstance(profile.rule, MapRule) else "regions"
    engine = open_scene(subject, labelled.name, load_encoder, rule)
    own = {without_suffix(camera.name): camera for camera in engine.scene.cameras}
    others = _other_cameras(own, labelled, progress)
    # With no name in common the scene's views are named by another rule: nothing is known of training.
    related = not own.keys().isdisjoint([*others, *(frame.name for frame in labelled.frames)])
    trained = frozenset(own) if related else None
    return SceneSource(engine, {**others, **own}, trained, profile, subject.paper_order)


def _map_source(labelled: LabelledScene, count: int, profile: Profile, maps: Path) -> MapSource:
    if isinstance(profile.rule, OwnRule):
        raise InputError("--protocol ours reads a scene's own answer; score maps by another protocol")
    candidates = (maps / labelled.name, maps) if count == 1 else (maps / labelled.name,)
    names = [frame.name for frame in labelled.frames]
    for folder in candidates:
        if any((folder / name).is_dir() for name in names):
            return MapSource(folder, profile.rule)
    raise InputError(
        f"{candidates[0]}: no folder is named after a labelled frame ({shortened(names, 3)}); "
        "expected <view>/<phrase>.npy or .png in it"
    )


def _other_cameras(
    own: Mapping[str, Camera], labelled: LabelledScene, progress: Progress
) -> Mapping[str, Camera]:
    """The dataset's views by name, read where the scene lacks a labelled one; they share its world.
    InputError where no labelled frame is among either."""
    wanted = [frame.name for frame in labelled.frames]
    if all(name in own for name in wanted):
        return {}
    others = {camera.name: camera for camera in _dataset_cameras(labelled.dataset, progress)}
    missing = [name for name in wanted if name not in own and name not in others]
    if len(missing) == len(wanted):
        raise InputError(
            f"{labelled.name}: none of the scene's views ({shortened(own, 3) or 'it has none'}) is a "
            f"labelled frame ({shortened(wanted, 3)}); views are matched by name, never by number; put the "
            f"photographs with their cameras into {labelled.dataset}"
        )
    if missing:
        log.warning("%d labelled frames have no camera: %s", len(missing), shortened(missing))
    return others


def _dataset_cameras(folder: Path, progress: Progress) -> tuple[Camera, ...]:
    """Return the cameras that came with a dataset; none where it has none."""
    if (folder / "transforms.json").is_file():
        return load_nerfstudio(folder / "transforms.json", FULL_SIZE, progress).cameras
    model = find_model(folder)
    return () if model is None else load_colmap(folder, model, FULL_SIZE, progress).cameras
