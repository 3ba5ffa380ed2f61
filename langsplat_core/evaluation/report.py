"""Scores of labelled queries as means, as a table for people and as JSON for programs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from langsplat_core.errors import shortened
from langsplat_core.evaluation.profiles import Profile
from langsplat_core.evaluation.scoring import QueryScore, SceneScores
from langsplat_core.io.files import write_json

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


# Published figures on the benchmarks, beside the own: mIoU and localisation, percent.
#
# LERF and LangSplat: from the paper of LangSplat (CVPR 2024), 3D-OVS's own figures too; N2F2 (ECCV 2024),
# LangSplatV2 (NeurIPS 2025) and Occam's LGS (BMVC 2025) as later papers repeat them. Figures of other
# machines, masks and trainings: to see where one stands, not to rank by a point.

Row = Mapping[str, tuple[float, float | None]]  # scene -> mIoU and localisation


_LERF_OVS = """
              figurines  teatime    ramen      waldo_kitchen
LERF          38.6/75.0  45.0/84.8  28.2/62.0  37.9/72.7
LangSplat     44.7/80.4  65.1/88.1  51.2/73.2  44.5/95.5
LangSplatV2   56.4/82.1  72.2/93.2  51.8/74.7  59.1/95.5
Occam's_LGS   58.6/80.4  70.2/93.2  51.0/74.7  65.3/81.8
"""
_OVS_3D = """
              bed   bench  room  sofa  lawn
LERF          73.5  53.2   46.6  27.0  73.7
3D-OVS        89.5  89.3   92.8  74.0  88.2
LangSplat     92.5  94.2   94.1  90.0  96.1
N2F2          93.8  92.6   93.5  92.1  96.3
"""


def _rows(table: str) -> Mapping[str, Row]:
    """Parse a table as above: method -> column -> pair of figures."""
    head, *lines = table.strip().splitlines()
    return {
        name.replace("_", " "): dict(zip(head.split(), map(_pair, cells), strict=True))
        for name, *cells in (line.split() for line in lines)
    }


def _pair(cell: str) -> tuple[float, float | None]:
    iou, _, place = cell.partition("/")
    return float(iou), float(place) if place else None


PUBLISHED: Mapping[str, Mapping[str, Row]] = MappingProxyType(
    {"lerf-ovs": _rows(_LERF_OVS), "3d-ovs": _rows(_OVS_3D)}
)


def beside_published(report: BenchmarkReport) -> str:
    """Markdown: a column per scene of the report that others published too, and their mean; a row for the
    report, and one for each of them. "" where there is no such scene."""
    others = PUBLISHED.get(report.benchmark, {})
    scenes = [name for name in report.scenes if any(name in row for row in others.values())]
    if not scenes:
        return ""
    means = summary(report)
    ours = {
        name: (
            100 * means[name].iou,
            None if means[name].localisation is None else 100 * (means[name].localisation or 0),
        )
        for name in scenes
    }
    lines = [
        f"| mIoU % / localisation % | {' | '.join(scenes)} | mean |",
        "|---|" + "---|" * (len(scenes) + 1),
    ]
    for method, row in {"this scene": ours, **others}.items():
        shared = [row[name] for name in scenes if name in row]
        mean = _mean([pair[0] for pair in shared]), _mean([pair[1] for pair in shared])
        cells = [_cell(row.get(name)) for name in scenes]
        lines.append(
            f"| {method} | {' | '.join(cells)} | {_cell(mean if len(shared) == len(scenes) else None)} |"
        )
    return "\n".join(lines)


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if values and len(known) == len(values) else None


def _cell(pair: tuple[float | None, float | None] | None) -> str:
    if pair is None or pair[0] is None:
        return "-"
    return f"{pair[0]:.1f}" if pair[1] is None else f"{pair[0]:.1f} / {pair[1]:.1f}"
