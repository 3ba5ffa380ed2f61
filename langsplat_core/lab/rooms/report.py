"""The benchmark's figures as tables for people and as JSON for programs."""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.io.files import atomic_path
from langsplat_core.lab.rooms.scoring import Asked, DirectScore, Score, found_rate
from langsplat_core.lab.rooms.truth import KINDS, Truth
from langsplat_core.scene import Codec
from langsplat_core.training.language.codec_fit import CodecReport


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
    bytes_per_gaussian: float = 0.0  # of its meanings at three levels
    codec_loss: CodecReport = CodecReport(1.0, 0.0, 0.0)  # noqa: RUF009 (frozen)
    fit_seconds: float = 0.0  # from masks to latents; what an earlier run has made is not in it
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


def codec_name(codec: Codec) -> str:
    """Such as "codebook 512" or "autoencoder 3"."""
    return f"{codec.kind} {codec.size}"


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
    """Markdown: the method, per tier and kind of phrase: means over the rooms, and the standard deviation
    between them where there are several."""
    head = ("tier", "phrases", "queries", "mIoU %", "localisation %", "3D IoU %", "right regions: 3D IoU %")
    lines = [_row(head), "|" + "---|" * len(head)]
    for tier, rooms in _by_tier(reports):
        for kind in (*KINDS, "all"):
            of_rooms = [of_kind(room.measured[0], kind) for room in rooms]
            count = sum(queries for queries, *_ in of_rooms)
            if count:
                spreads = [_spread(values) for values in zip(*(row[1:] for row in of_rooms), strict=True)]
                ceilings = [_direct(room.measured[0], kind, "ceiling") for room in rooms]
                spreads.append(_spread(ceilings) if any(ceilings) else "-")
                lines.append(_row((tier, kind, count, *spreads)))
    return "\n".join(lines)


def of_kind(measured: Measured, kind: str) -> tuple[int, float, float, float]:
    """Queries, mean IoU, localisation and 3-D IoU of one kind of phrase, or of all."""
    direct = _direct(measured, kind, "mean_iou")
    return (*pooled(s for s in measured.scores if kind in (s.kind, "all")), direct)


def _spread(shares: Sequence[float]) -> str:
    """Percent, with the standard deviation of several."""
    if len(shares) == 1:
        return _percent(shares[0])
    return f"{_percent(float(np.mean(shares)))} +/- {_percent(float(np.std(shares, ddof=1)))}"


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
    """Markdown: per tier and swapped stage, means over the rooms and the difference to the method, in
    percentage points."""
    head = (
        *("tier", "swapped", "mIoU %", "+/-", "localisation %", "+/-", "3D IoU %", "+/-", "rejected %"),
        *("codec", "relevancy error mean / p99", "bytes/Gaussian"),
    )
    lines = [_row(head), "|" + "---|" * len(head)]
    for tier, rooms in _by_tier(reports):
        base = _means(room.measured[0] for room in rooms)
        for row in range(min(len(room.measured) for room in rooms)):
            ours = [room.measured[row] for room in rooms]
            cells = [tier, f"nothing ({ours[0].masks} masks)" if row == 0 else ours[0].name]
            for mean, of_method in zip(_means(ours), base, strict=True):
                cells += [_percent(mean), f"{100 * (mean - of_method):+.1f}" if row else ""]
            rejected = sum(m.rejected * m.absent for m in ours) / max(sum(m.absent for m in ours), 1)
            lines.append(_row((*cells, _percent(rejected), *loss_cells(ours))))
    return "\n".join(lines)


def loss_cells(measured: Sequence[Measured]) -> tuple[str, str, str]:
    """Codec, its relevancy error, and its bytes per Gaussian, means over the rooms."""
    mean = np.mean([m.codec_loss.error_mean for m in measured])
    p99 = np.mean([m.codec_loss.error_p99 for m in measured])
    names = dict.fromkeys(m.codec for m in measured)
    bytes_each = np.mean([m.bytes_per_gaussian for m in measured])
    return ", ".join(names), f"{mean:.4f} / {p99:.3f}", f"{bytes_each:.0f}"


def _means(measured: Iterable[Measured]) -> tuple[float, ...]:
    """Mean IoU, localisation and 3-D IoU over all phrases, mean over the rooms."""
    return tuple(float(x) for x in np.mean([of_kind(m, "all")[1:] for m in measured], axis=0))


def save_json(path: Path, settings: dict[str, object], reports: Sequence[RoomReport]) -> None:
    """All figures, with the settings that they belong to."""
    content = {"settings": settings, "rooms": [asdict(report) for report in reports]}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, default=str) + "\n", encoding="utf-8")


def _by_tier(reports: Sequence[RoomReport]) -> Iterator[tuple[str, list[RoomReport]]]:
    for tier in dict.fromkeys(report.tier for report in reports):
        yield tier, [report for report in reports if report.tier == tier]


def _direct(measured: Measured, kind: str, name: Literal["mean_iou", "ceiling"]) -> float:
    """Mean over the phrases of a kind, or of all, among the Gaussians."""
    scores = [score for score in measured.direct if kind in (score.kind, "all")]
    count = sum(score.phrases for score in scores)
    return float(sum(getattr(score, name) * score.phrases for score in scores) / max(count, 1))


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _row(cells: Iterable[object]) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"
