"""Scores of labelled queries as means, as a table for people and as JSON for programs."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from langsplat_core.datasets.capture import shortened
from langsplat_core.evaluation.profiles import Profile
from langsplat_core.evaluation.scoring import QueryScore, SceneScores
from langsplat_core.io.files import atomic_path

ACCURACY_AT = (0.25, 0.5)  # IoU strictly above
FIXED = (
    "every constant of the protocol was fixed before a label was read; none was chosen or tuned by the labels"
)
COUNTED = "a query without an answer counts as wrong: IoU 0, no place"


@dataclass(frozen=True)
class Means:
    """Mean scores of a set of queries, or means of such means."""

    queries: int
    iou: float
    localisation: float | None  # None: no place is scored
    accuracy_25: float
    accuracy_50: float


@dataclass(frozen=True)
class BenchmarkReport:
    """One system on one benchmark under one protocol."""

    benchmark: str
    profile: Profile
    subject: str  # the scene or maps that were scored, and how
    scenes: dict[str, SceneScores]

    @property
    def queries(self) -> list[QueryScore]:
        """Queries of all scenes."""
        return [query for scores in self.scenes.values() for query in scores.queries]


def means(queries: Sequence[QueryScore]) -> Means:
    """Mean scores over queries; zeros where there are none."""
    ious = np.array([query.iou for query in queries])
    hits = [query.hit for query in queries if query.hit is not None]
    if not len(ious):
        return Means(0, 0.0, None, 0.0, 0.0)
    above = [float((ious > least).mean()) for least in ACCURACY_AT]
    return Means(len(ious), float(ious.mean()), float(np.mean(hits)) if hits else None, above[0], above[1])


def macro(queries: Sequence[QueryScore], group: Callable[[QueryScore], object]) -> Means:
    """The mean of the groups' means, each group with the same weight."""
    groups: dict[object, list[QueryScore]] = {}
    for query in queries:
        groups.setdefault(group(query), []).append(query)
    rows = [means(members) for members in groups.values()]
    if not rows:
        return means(())
    places = [row.localisation for row in rows if row.localisation is not None]
    return Means(
        len(queries),
        float(np.mean([row.iou for row in rows])),
        float(np.mean(places)) if places else None,
        float(np.mean([row.accuracy_25 for row in rows])),
        float(np.mean([row.accuracy_50 for row in rows])),
    )


def summary(report: BenchmarkReport) -> dict[str, Means]:
    """The rows of the table: every scene, then macro means over scenes and over frames, then the micro mean
    over all queries; the last also of what was answered, and of views not trained on, where they differ."""
    queries = report.queries
    rows = {name: means(scores.queries) for name, scores in report.scenes.items()}
    rows["macro, mean of scenes"] = macro(queries, lambda query: query.scene)
    rows["macro, mean of frames"] = macro(queries, lambda query: (query.scene, query.frame))
    rows["micro, mean of queries"] = means(queries)
    answered = [query for query in queries if not query.unanswered]
    if len(answered) < len(queries):
        rows["micro, answered ones alone"] = means(answered)
    held_out = [query for query in queries if query.trained_on is False]
    if 0 < len(held_out) < len(queries):
        rows["micro, held-out views alone"] = means(held_out)
    return rows


def table(report: BenchmarkReport) -> str:
    """The means as a Markdown table, with notes below it."""
    lines = [
        "| | queries | mIoU % | localisation % | mAcc@0.25 % | mAcc@0.5 % |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in summary(report).items():
        shares = (row.iou, row.localisation, row.accuracy_25, row.accuracy_50)
        cells = ["-" if share is None else f"{100 * share:.1f}" for share in shares]
        lines.append(f"| {name} | {row.queries} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", *notes(report)])


def notes(report: BenchmarkReport) -> list[str]:
    """Return lines of plain text on the protocol, the subject and the frames behind the figures."""
    queries = report.queries
    lines = [
        f"{report.benchmark}, protocol {report.profile.name}: {report.profile.source}",
        f"scored: {report.subject}",
        f"{FIXED}; a frame's answers are cut before its masks are drawn",
    ]
    reasons = dict.fromkeys(query.unanswered for query in queries if query.unanswered)
    for reason in reasons:
        names = [f"{query.frame}: {query.phrase}" for query in queries if query.unanswered == reason]
        lines.append(f"not answered ({reason}), {len(names)} queries: {shortened(names)}")
    if reasons:
        lines.append(COUNTED)
    frames = {(query.scene, query.frame): query.trained_on for query in queries}
    trained = [frame for (_, frame), was in frames.items() if was]
    if trained:
        lines.append(
            f"{len(trained)} of {len(frames)} labelled frames are training views: {shortened(trained)}"
        )
    left_out = [name for scores in report.scenes.values() for name in scores.left_out]
    if left_out:
        lines.append(f"{len(left_out)} labels left out: {shortened(left_out)}")
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
        "left_out": {name: list(scores.left_out) for name, scores in report.scenes.items()},
    }
    write_json(path, content)


def write_json(path: Path, content: object) -> None:
    """Write a value as a JSON file, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
