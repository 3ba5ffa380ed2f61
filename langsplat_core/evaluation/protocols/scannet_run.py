"""ScanNet's scenes, whoever answers them, and the report."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from langsplat_core.errors import InputError
from langsplat_core.evaluation.protocols.report import FIXED, write_json
from langsplat_core.evaluation.protocols.run import Subject
from langsplat_core.evaluation.protocols.scannet import (
    PointProfile,
    PointScore,
    map_classes,
    read_points,
    scene_classes,
    score_points,
)
from langsplat_core.formats import load_scene
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import LoadEncoder, QueryEngine, no_field


@dataclass(frozen=True)
class PointReport:
    """One system on ScanNet."""

    profile: PointProfile
    subject: str
    scores: tuple[PointScore, ...]


def run_scannet(
    files: Mapping[str, Path],
    subject: Subject,
    load_encoder: LoadEncoder,
    only: Sequence[str] = (),
    progress: Progress = silent,
) -> PointReport:
    """Score `subject` on the scenes whose label files are given, or those named by `only`. Raises InputError
    for a scene or maps that do not belong to them."""
    profile = PointProfile()
    wrong = [name for name in only if name not in files]
    if wrong:
        raise InputError(f"--only {wrong[0]}: no such labelled scene; there are {', '.join(files)}")
    names = list(only or files)
    if subject.scene is not None and not subject.scene.is_dir() and len(names) > 1:
        names = [name for name in names if name == subject.scene.stem]
        if not names:
            raise InputError(f"{subject.scene} could be any labelled scene; say which with --only")
    scores: list[PointScore] = []
    for done, name in enumerate(names):
        points = read_points(files[name], name)
        if subject.maps is not None:
            scores += score_points(points, map_classes(subject.maps, points, profile), profile)
        else:
            assert subject.scene is not None
            path = subject.scene / f"{name}.ply" if subject.scene.is_dir() else subject.scene
            scene = load_scene(path)
            if scene.language is None:
                raise InputError(f"{path}: {no_field(scene)}")
            engine = QueryEngine(scene, load_encoder, encoder_id=subject.encoder)
            found, unknown = scene_classes(engine, points, profile)
            scores += score_points(points, found, profile, unknown)
        progress("asking classes", (done + 1) / len(names))
    return PointReport(profile, str(subject.scene or subject.maps), tuple(scores))


def point_table(report: PointReport) -> str:
    """Markdown, and below it what a reader has to know."""
    lines = ["| | classes | of them present | vertices | mIoU % | mAcc % |", "|---|---|---|---|---|---|"]
    for s in report.scores:
        shares = f"{100 * s.iou:.1f} | {100 * s.accuracy:.1f}"
        lines.append(f"| {s.scene} | {s.classes} | {s.present} | {s.points} | {shares} |")
    for classes in dict.fromkeys(score.classes for score in report.scores):
        rows = [score for score in report.scores if score.classes == classes]
        shares = (
            f"{100 * np.mean([s.iou for s in rows]):.1f} | {100 * np.mean([s.accuracy for s in rows]):.1f}"
        )
        total = sum(score.points for score in rows)
        lines.append(f"| macro, mean of scenes | {classes} | | {total} | {shares} |")
    lines += ["", f"scannet, protocol {report.profile.name}: {report.profile.source}"]
    lines += [f"scored: {report.subject}", FIXED]
    unknown = dict.fromkeys(name for score in report.scores for name in score.unknown)
    if unknown:
        lines.append(
            f"the encoder does not know {', '.join(unknown)}: counted as wrong at each of their vertices"
        )
    return "\n".join(lines)


def save_point_json(path: Path, report: PointReport) -> None:
    """All of it."""
    write_json(path, asdict(report))
