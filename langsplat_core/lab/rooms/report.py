"""The benchmark's figures as tables for people and as JSON for programs."""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.files import atomic_path
from langsplat_core.lab.rooms.scoring import KINDS, Asked, DirectScore, Score, Truth, found_rate


@dataclass(frozen=True)
class Measured:
    """One variant of the method in one room."""

    scores: tuple[Score, ...]
    direct: tuple[DirectScore, ...]
    accepted: float  # share of the room's objects that are answered with a place
    objects: int  # that were asked
    rejected: float  # share of absent objects that are answered with "not here"
    absent: int  # that were asked
    separation: (
        float  # chance that a present object's peak exceeds an absent one's: 1 where a threshold exists
    )
    peaks: dict[str, float]  # smoothed peak relevancy of every object that was asked, absent ones included
    unknown: tuple[str, ...]  # phrases left out, because the encoder was never taught their words
    query_ms: float  # median, from text to place
    name: str = ""
    masks: str = ""
    vectors: str = ""
    codec: str = ""
    query: str = ""
    codec_cosine: float = 1.0  # mean, of mask vectors with what the codec makes of them
    frame_ms: float = 0.0  # median, one phrase into one view


@dataclass(frozen=True)
class RoomReport:
    """One room."""

    tier: str
    seed: int
    views: int  # trained on
    held_out: int
    gaussians: int
    psnr: float  # mean over held-out views, dB
    encoder: str
    cut: str
    measured: tuple[Measured, ...]  # the method first
    seconds: dict[str, float]  # per stage, of this run: a stage that was already done takes almost none


def measured(
    asked: Asked, truth: Truth, absent: Sequence[str], scores: Sequence[Score], direct: Sequence[DirectScore]
) -> Measured:
    """Collect what was asked of a scene."""
    present = [phrase.text for phrase in truth.phrases if phrase.kind == "object"]
    accepted, objects = found_rate(asked, present)
    found, count = found_rate(asked, absent)
    peaks = {
        text: round(asked.answers[text].peak, 4) for text in [*present, *absent] if text in asked.answers
    }
    inside = np.array([peaks[text] for text in present if text in peaks])
    outside = np.array([peaks[text] for text in absent if text in peaks])
    return Measured(
        scores=tuple(scores),
        direct=tuple(direct),
        accepted=accepted,
        objects=objects,
        rejected=1 - found,
        absent=count,
        separation=separation(inside, outside),
        peaks=peaks,
        unknown=asked.unknown,
        query_ms=1000 * asked.seconds,
    )


def separation(present: Array, absent: Array) -> float:
    """Chance that one of `present` (P,) exceeds one of `absent` (A,), ties half; 1 without either."""
    if len(present) == 0 or len(absent) == 0:
        return 1.0
    above = (present[:, None] > absent).mean() + 0.5 * (present[:, None] == absent).mean()
    return float(above)


def pooled(scores: Iterable[Score]) -> tuple[int, float, float]:
    """Number of queries, mean IoU and localisation over all of them; 0 where nothing was asked."""
    rows = list(scores)
    count = sum(score.queries for score in rows)
    weights = [score.queries / max(count, 1) for score in rows]
    iou = float(np.dot(weights, [score.mean_iou for score in rows])) if rows else 0.0
    localisation = float(np.dot(weights, [score.localisation for score in rows])) if rows else 0.0
    return count, iou, localisation


def score_table(reports: Sequence[RoomReport]) -> str:
    """Markdown: the method, per tier and kind of phrase, pooled over the seeds."""
    lines = ["| tier | phrases | queries | mIoU % | localisation % | 3D IoU % |", "|---|---|---|---|---|---|"]
    for tier, rooms in _by_tier(reports):
        for kind in (*KINDS, "all"):
            scores = [s for room in rooms for s in room.measured[0].scores if kind in (s.kind, "all")]
            direct = [d for room in rooms for d in room.measured[0].direct if kind in (d.kind, "all")]
            count, iou, localisation = pooled(scores)
            if count:
                line = (tier, kind, count, _percent(iou), _percent(localisation), _percent(_direct(direct)))
                lines.append(_row(line))
    return "\n".join(lines)


def room_table(reports: Sequence[RoomReport]) -> str:
    """Markdown: the method, per tier, what is not per kind of phrase."""
    head = (
        "tier",
        "Gaussians",
        "PSNR dB",
        "objects found",
        "absent rejected",
        "separation %",
        "ms/query",
        "ms/picture",
    )
    lines = [_row(head), "|" + "---|" * len(head)]
    for tier, rooms in _by_tier(reports):
        ours = [room.measured[0] for room in rooms]
        objects, absent = sum(m.objects for m in ours), sum(m.absent for m in ours)
        accepted = sum(m.accepted * m.objects for m in ours) / max(objects, 1)
        rejected = sum(m.rejected * m.absent for m in ours) / max(absent, 1)
        lines.append(_row((
            tier,
            round(np.mean([room.gaussians for room in rooms])),
            f"{np.mean([room.psnr for room in rooms]):.1f}",
            f"{_percent(accepted)} % of {objects}",
            f"{_percent(rejected)} % of {absent}",
            _percent(float(np.mean([m.separation for m in ours]))),
            f"{np.median([m.query_ms for m in ours]):.1f}",
            f"{np.median([m.frame_ms for m in ours]):.1f}",
        )))  # fmt: skip
    return "\n".join(lines)


def budget_table(reports: Sequence[RoomReport]) -> str:
    """Markdown: per tier and swapped stage, and the difference that it makes, in percentage points."""
    head = ("tier", "swapped", "mIoU %", "+/-", "localisation %", "+/-", "rejected %", "codec cosine")
    lines = [_row(head), "|" + "---|" * len(head)]
    for tier, rooms in _by_tier(reports):
        _, base_iou, base_localisation = pooled(s for room in rooms for s in room.measured[0].scores)
        for row in range(min(len(room.measured) for room in rooms)):
            ours = [room.measured[row] for room in rooms]
            _, iou, localisation = pooled(s for m in ours for s in m.scores)
            rejected = sum(m.rejected * m.absent for m in ours) / max(sum(m.absent for m in ours), 1)
            lines.append(_row((
                tier,
                f"nothing ({ours[0].masks} masks)" if row == 0 else ours[0].name,
                _percent(iou),
                f"{100 * (iou - base_iou):+.1f}" if row else "",
                _percent(localisation),
                f"{100 * (localisation - base_localisation):+.1f}" if row else "",
                _percent(rejected),
                f"{np.mean([m.codec_cosine for m in ours]):.4f}",
            )))  # fmt: skip
    return "\n".join(lines)


def save_json(path: Path, settings: dict[str, object], reports: Sequence[RoomReport]) -> None:
    """All figures, with the settings that they belong to."""
    content = {"settings": settings, "rooms": [asdict(report) for report in reports]}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, default=str) + "\n", encoding="utf-8")


def _by_tier(reports: Sequence[RoomReport]) -> Iterator[tuple[str, list[RoomReport]]]:
    for tier in dict.fromkeys(report.tier for report in reports):
        yield tier, [report for report in reports if report.tier == tier]


def _direct(scores: Sequence[DirectScore]) -> float:
    count = sum(score.phrases for score in scores)
    return sum(score.mean_iou * score.phrases for score in scores) / max(count, 1)


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _row(cells: Iterable[object]) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"
