"""Scores of labelled queries, their means, tables and JSON."""

import json
import logging
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets.colmap import find_model, load_colmap
from langsplat_core.datasets.nerfstudio import load_nerfstudio
from langsplat_core.errors import InputError, shortened
from langsplat_core.extensions.benchmarks import labels, profiles
from langsplat_core.io.files import write_json, write_whole
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import AnswerRule
from langsplat_core.query.engine import LoadEncoder, QueryEngine, searchable
from langsplat_core.scene import LEVELS, Camera


def write_report(out: Path, name: str, text: str, figures: Any) -> None:
    """Write `name`.md and .json into the folder `out`, atomically."""
    write_whole(out / f"{name}.md", text)
    write_whole(out / f"{name}.json", json.dumps(figures, indent=1, default=str))


def markdown(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a Markdown table that ends with a newline."""
    lines = ["| " + " | ".join(map(str, line)) + " |\n" for line in (head, *rows)]
    return "".join([lines[0], "|" + "---|" * len(head) + "\n", *lines[1:]])


def intersection_over_union(found: Array, truth: Array) -> float:
    """Return the intersection over union of two (H, W) boolean masks; 1 if both are empty."""
    union = np.logical_or(found, truth).sum()
    return float(np.logical_and(found, truth).sum() / union) if union else 1.0


# Scores of single queries.


@dataclass(frozen=True)
class QueryScore:
    """Score of a phrase in a labelled view. Queries without an answer count as wrong in means."""

    scene: str
    frame: str
    phrase: str
    iou: float
    hit: bool | None  # True if the position is in a box of the label; None: not scored
    level: str  # of the map that was cut; "": none was
    unanswered: str  # why there is no answer; "" with one
    trained_on: bool | None  # True for a training view; None: unknown
    grid: labels.Size  # width and height that were scored
    targets: int | None  # number of the phrase's instances in the frame, if that may be 0
    is_empty: bool  # True for an empty mask


def score_scene(
    labelled: labels.LabelledScene,
    source: profiles.Source,
    profile: profiles.Profile,
    progress: Progress = silent,
) -> tuple[list[QueryScore], list[str]]:
    """Return the scores of all queries of a scene, and the labels that cannot be scored, with the reason.

    A frame's answers are final before any of its masks is drawn. Raises InputError if a map has another
    aspect ratio than the labelled image.
    """
    scores: list[QueryScore] = []
    left_out = list(labelled.left_out)
    for done, frame in enumerate(labelled.frames):
        phrases = [label.phrase for label in frame.labels]
        answers = source.answers(frame.name, scored_size(frame.size, profile.max_rows), phrases)
        for label in frame.labels:
            answer, unanswered = answers[label.phrase], ""
            if isinstance(answer, str):  # counts as an empty answer that is wrong
                unanswered, answer = answer, profiles.Prediction(np.zeros(frame.size[::-1], bool))
            size = answer.mask.shape[1], answer.mask.shape[0]
            labels.check_same_image(frame.name, size, frame.size)
            truth = label.truth(size)
            if label.targets != 0 and not truth.any():
                left_out.append(f"{frame.name}: {label.phrase} (empty mask)")
                continue
            placed = label.boxes is not None and not isinstance(profile.rule, profiles.SilhouetteRule)
            score = QueryScore(
                scene=labelled.name,
                frame=frame.name,
                phrase=label.phrase,
                iou=0.0 if unanswered else intersection_over_union(answer.mask, truth),
                hit=inside_any_box(answer.peaks, label.boxes, frame.size, size) if placed else None,
                level="" if answer.level is None else LEVELS[answer.level],
                unanswered=unanswered,
                trained_on=None if source.trained is None else frame.name in source.trained,
                grid=size,
                targets=label.targets,
                is_empty=not answer.mask.any(),
            )
            scores.append(score)
        progress("asking phrases", (done + 1) / len(labelled.frames), labelled.name)
    return scores, left_out


def scored_size(size: labels.Size, max_rows: int) -> labels.Size:
    """Return `size`, shrunk to `max_rows` rows if it has more."""
    width, height = size
    return size if height <= max_rows else (max(1, int(width * max_rows / height)), max_rows)


def inside_any_box(peaks: Array, boxes: Array | None, size: labels.Size, grid: labels.Size) -> bool:
    """Return True if a peak (P, 2) on `grid` is in a box (B, 4) of the label's `size`, borders included."""
    if boxes is None:
        return False
    scaled = boxes * np.tile(np.divide(grid, size), 2)
    low, high = np.minimum(scaled[:, :2], scaled[:, 2:]), np.maximum(scaled[:, :2], scaled[:, 2:])
    inside = (peaks[:, None] >= low) & (peaks[:, None] <= high)
    return bool(inside.all(-1).any())


# Means of scores, and their report.


@dataclass(frozen=True)
class Means:
    """Mean scores of a set of queries, or means of such means."""

    queries: int
    iou: float
    localisation: float | None  # None: no position is scored
    accuracy_25: float
    accuracy_50: float


@dataclass(frozen=True)
class BenchmarkReport:
    """One system on one benchmark under one protocol."""

    benchmark: str
    profile: profiles.Profile
    subject: str  # the scene or maps that were scored
    queries: tuple[QueryScore, ...]
    left_out: tuple[str, ...]  # labels that cannot be scored, each "frame: phrase (why)"


def means(queries: Sequence[QueryScore], group: Callable[[QueryScore], Hashable] = id) -> Means:
    """Return the mean of the means of groups of queries, by default of queries; zeros without any."""
    groups: dict[Hashable, list[tuple[float, ...]]] = {}
    for one in queries:
        shares = one.iou, np.nan if one.hit is None else one.hit, one.iou > 0.25, one.iou > 0.5
        groups.setdefault(group(one), []).append(shares)
    if not groups:
        return Means(0, 0.0, None, 0.0, 0.0)
    iou, place, above, high = np.mean([np.mean(rows, axis=0) for rows in groups.values()], axis=0).tolist()
    return Means(len(queries), iou, None if np.isnan(place) else place, above, high)


def summary(report: BenchmarkReport) -> dict[str, Means]:
    """Return the table's rows: scenes, then means of scenes, frames, queries, answered and held-out ones."""
    queries = report.queries
    scenes = dict.fromkeys(query.scene for query in queries)
    rows = {name: means([one for one in queries if one.scene == name]) for name in scenes}
    rows["macro, mean of scenes"] = means(queries, lambda query: query.scene)
    rows["macro, mean of frames"] = means(queries, lambda query: (query.scene, query.frame))
    rows["micro, mean of queries"] = means(queries)
    answered = [query for query in queries if not query.unanswered]
    if len(answered) < len(queries):
        rows["micro, answered ones alone"] = means(answered)
    held_out = [query for query in queries if query.trained_on is False]
    if 0 < len(held_out) < len(queries):
        rows["micro, held-out views alone"] = means(held_out)
    return rows


def table(report: BenchmarkReport) -> str:
    """Return the means as a Markdown table, with notes below it."""
    rows = (
        (name, row.queries, *map(_percent, (row.iou, row.localisation, row.accuracy_25, row.accuracy_50)))
        for name, row in summary(report).items()
    )
    head = ("", "queries", "mIoU %", "localisation %", "mAcc@0.25 %", "mAcc@0.5 %")
    return "\n".join([markdown(head, rows), *target_table(report.queries), *notes(report)])


def target_table(queries: Sequence[QueryScore]) -> list[str]:
    """Return the scores by number of targets, as Markdown; nothing if the labels do not have it.

    Measures of GRES (CVPR 2023): gIoU is the mean IoU of queries, 1 for an empty answer without targets;
    no-target accuracy is the share of queries without targets that got an empty answer, target accuracy the
    share of the others that got an answer.
    """
    rows = []
    for name, low, high in (("none", 0, 0), ("one", 1, 1), ("several", 2, np.inf), ("all", 0, np.inf)):
        own = [one for one in queries if one.targets is not None and low <= one.targets <= high]
        if own:
            right = np.mean([one.is_empty == (one.targets == 0) and not one.unanswered for one in own])
            rows.append((name, len(own), _percent(means(own).iou), _percent(float(right))))
    head = ("things named", "queries", "gIoU %", "nothing or something, rightly %")
    return [markdown(head, rows)] if rows else []


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"


def notes(report: BenchmarkReport) -> list[str]:
    """Return lines of text about the protocol, the subject and the frames of the figures."""
    queries = report.queries
    lines = [
        f"{report.benchmark}, protocol {report.profile.name}: {report.profile.source}",
        f"scored: {report.subject}",
        "every constant of the protocol was fixed before a label was read; none was chosen or tuned by the "
        "labels; a frame's answers are cut before its masks are drawn",
    ]
    reasons = dict.fromkeys(query.unanswered for query in queries if query.unanswered)
    for reason in reasons:
        names = [f"{query.frame}: {query.phrase}" for query in queries if query.unanswered == reason]
        lines.append(f"not answered ({reason}), {len(names)} queries: {shortened(names)}")
    if reasons:
        lines.append("a query without an answer counts as wrong: IoU 0, no place")
    frames = {(query.scene, query.frame): query.trained_on for query in queries}
    trained = [frame for (_, frame), was in frames.items() if was]
    if trained:
        lines.append(f"{len(trained)} of {len(frames)} labelled frames were trained on: {shortened(trained)}")
    if report.left_out:
        lines.append(f"{len(report.left_out)} labels left out: {shortened(report.left_out)}")
    return lines


def save_json(path: Path, report: BenchmarkReport) -> None:
    """Write profile, means and every query as JSON."""
    content = {
        "benchmark": report.benchmark,
        "protocol": asdict(report.profile),
        "scored": report.subject,
        "notes": notes(report),
        "means": {name: asdict(row) for name, row in summary(report).items()},
        "queries": [asdict(query) for query in report.queries],
        "left_out": report.left_out,
    }
    write_json(path, content)


# Matching of labels with scenes and maps, by names.

log = logging.getLogger("langsplat")


@dataclass(frozen=True)
class Evaluated:
    """The scenes or maps that `eval` scores; exactly one of `scene` and `maps` is set."""

    scene: Path | None = None  # a scene file, or a folder of <benchmark's scene>.ply
    maps: Path | None = None  # <view>/<phrase>..., or <benchmark's scene>/<view>/<phrase>...
    encoder: str = ""  # in place of the one that the scene names


def run_benchmark(
    benchmark: labels.Benchmark,
    profile: profiles.Profile,
    subject: Evaluated,
    load_encoder: LoadEncoder,
    progress: Progress = silent,
) -> BenchmarkReport:
    """Return the scores of `subject` on the scenes of `benchmark`.

    Raises InputError for a scene or maps that do not belong to the labels, EncoderError if the text encoder
    cannot be loaded.
    """
    names = _chosen_scenes(list(benchmark.scenes), subject)
    queries, left_out = list[QueryScore](), list[str]()
    for name in names:
        labelled = benchmark.scenes[name]
        source = (
            _map_source(labelled, len(names), profile, subject.maps)
            if subject.maps is not None
            else _scene_source(labelled, profile, subject, load_encoder, progress)
        )
        scores, without = score_scene(labelled, source, profile, progress)
        queries += scores
        left_out += without
    said = str(subject.scene or subject.maps)
    return BenchmarkReport(benchmark.name, profile, said, tuple(queries), tuple(left_out))


def _chosen_scenes(labelled: Sequence[str], subject: Evaluated) -> list[str]:
    """Return the names of scenes to score: all `labelled`, or the one that a scene file is named after."""
    if subject.scene is None or subject.scene.is_dir() or len(labelled) == 1:
        return list(labelled)
    if subject.scene.stem not in labelled:
        raise InputError(
            f"{subject.scene} could be any labelled scene of {', '.join(labelled)}; name the folder of one"
        )
    return [subject.scene.stem]


def _scene_source(
    labelled: labels.LabelledScene,
    profile: profiles.Profile,
    subject: Evaluated,
    load_encoder: LoadEncoder,
    progress: Progress,
) -> profiles.SceneSource:
    assert subject.scene is not None
    path = subject.scene / f"{labelled.name}.ply" if subject.scene.is_dir() else subject.scene
    if not path.exists():
        raise InputError(f"{path}: no such scene; name another folder, or that of one labelled scene")
    # Rules for maps need relevancies as published.
    rule: AnswerRule = "peak" if isinstance(profile.rule, profiles.MapRule) else "regions"
    engine = QueryEngine(searchable(path), load_encoder, encoder_id=subject.encoder, rule=rule)
    own = {labels.without_suffix(camera.name): camera for camera in engine.scene.cameras}
    others = _other_cameras(own, labelled, progress)
    # Without a common name the scene has other names for views, and training views are unknown.
    related = not own.keys().isdisjoint([*others, *(frame.name for frame in labelled.frames)])
    trained = frozenset(own) if related else None
    return profiles.SceneSource(engine, {**others, **own}, trained, profile)


def _map_source(
    labelled: labels.LabelledScene, count: int, profile: profiles.Profile, maps: Path
) -> profiles.MapSource:
    if isinstance(profile.rule, profiles.OwnRule):
        raise InputError("--protocol ours reads a scene's own answer; score maps by another protocol")
    candidates = (maps / labelled.name, maps) if count == 1 else (maps / labelled.name,)
    names = [frame.name for frame in labelled.frames]
    for folder in candidates:
        if any((folder / name).is_dir() for name in names):
            return profiles.MapSource(folder, profile.rule)
    raise InputError(
        f"{candidates[0]}: no folder is named after a labelled frame ({shortened(names, 3)}); "
        "expected <view>/<phrase>.npy or .png in it"
    )


def _other_cameras(
    own: Mapping[str, Camera], labelled: labels.LabelledScene, progress: Progress
) -> Mapping[str, Camera]:
    """Return the dataset's cameras by name, if the scene lacks some; InputError if neither has any."""
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
    """Return the cameras of a dataset, for photographs in full size; empty without cameras."""
    whole = DatasetConfig(max_side=65_536)
    if (folder / "transforms.json").is_file():
        return load_nerfstudio(folder / "transforms.json", whole, progress).cameras
    model = find_model(folder)
    return () if model is None else load_colmap(folder, model, whole, progress).cameras
