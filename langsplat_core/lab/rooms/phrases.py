"""Phrases with structure, composed and asked whole, in rooms with truth (`langsplat bench phrases`)."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.evaluation.scoring import intersection_over_union
from langsplat_core.lab.config import BenchmarkConfig, PhraseBenchConfig
from langsplat_core.lab.rooms.phrase_cases import CONSTRUCTIONS, Case, cases, things_in
from langsplat_core.lab.rooms.room import HOLD_OUT, Room, weights_digest
from langsplat_core.lab.rooms.scoring import MIN_GAUSSIANS, MIN_PIXELS, masks_and_peaks
from langsplat_core.lab.rooms.variants import variants
from langsplat_core.lab.world.photographs import photographed_room
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import run_phrase, upright, viewpoint
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import atoms, parse
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import Camera, Scene
from langsplat_core.semantics.encoders import load_encoder


@dataclass(frozen=True, eq=False)
class Judged:
    """An answer that is about to be compared with the truth."""

    case: Case
    values: Array  # (N,) relevancy
    members: Array  # (N,) bool
    found: bool
    seconds: float


@dataclass(frozen=True)
class PhraseScore:
    """One case in one room; means over views. NaN where nothing could be compared."""

    construction: str
    text: str
    way: str  # "whole" or "composed"
    seed: int
    present: bool
    found: bool
    ious: tuple[float, ...]  # per view in which the truth is visible
    hits: tuple[bool, ...]  # whether the peak lies on it
    direct: float  # intersection over union of Gaussians
    seconds: float


def measure_phrases(config: PhraseBenchConfig, work: Path, progress: Progress = silent) -> list[PhraseScore]:
    """Every construction in every room, whole and composed. Raises InputError for settings without a room."""
    if not config.seeds:
        raise InputError("bench phrases: name at least one of --seeds")
    encoder, weights = load_encoder("demo"), weights_digest("demo")
    rows: list[PhraseScore] = []
    for seed in config.seeds:
        room = Room(BenchmarkConfig(), config.tier, seed, work, (encoder, weights), progress)
        rows += measure_room(room, progress)
    return rows


def measure_room(room: Room, progress: Progress = silent) -> list[PhraseScore]:
    """All cases of one room that the encoder knows the words of."""
    field, _, _ = room.field(variants(room.config, room.encoder.dim)[0])
    cameras = room.capture.cameras
    engine = QueryEngine(Scene(room.gaussians, field, tuple(cameras)), lambda _: room.encoder)
    held_out = [cameras[row] for row in room.capture.split(HOLD_OUT)[1]]
    frame = upright(engine.scene.up())
    things = things_in(photographed_room(room.seed, room.tier), frame, room.seed)
    asked = [
        case
        for case in cases(room.truth, things, viewpoint(held_out[0], frame), room.seed)
        if not any(engine.unknown_words(atom.text) for atom in atoms(parse(case.text)))
    ]
    ways: dict[str, Callable[[Case], Judged]] = {
        "whole": lambda case: _whole(engine, case),
        "composed": lambda case: _composed(engine, case, held_out[0]),
    }
    rows: list[PhraseScore] = []
    for way, answer in ways.items():
        engine.run("object")  # so that no time goes into preparation
        judged = [answer(case) for case in asked]
        rows += _scores(room, judged, held_out, way)
        progress(f"room {room.seed}, {way}", 1.0)
    return rows


def _whole(engine: QueryEngine, case: Case) -> Judged:
    """Without the words that the encoder was never taught, such as "near": with them it refuses."""
    unknown = set(engine.unknown_words(case.whole))
    text = " ".join(word for word in case.whole.split() if word not in unknown)
    start = time.perf_counter()
    result = engine.run(text)
    seconds = time.perf_counter() - start
    return Judged(case, result.even, result.members, result.found, seconds)


def _composed(engine: QueryEngine, case: Case, viewpoint: Camera) -> Judged:
    start = time.perf_counter()
    result: QueryResult = run_phrase(engine, case.text, viewpoint=viewpoint).answer
    seconds = time.perf_counter() - start
    return Judged(case, result.even, result.members, result.found, seconds)


def _scores(room: Room, judged: Sequence[Judged], cameras: Sequence[Camera], way: str) -> list[PhraseScore]:
    ious: list[list[float]] = [[] for _ in judged]
    hits: list[list[bool]] = [[] for _ in judged]
    for camera in cameras:
        for row, iou, hit in _in_view(room, judged, camera):
            ious[row].append(iou)
            hits[row].append(hit)
    seen = (room.labels >= 0).any(axis=0)
    rows = []
    for number, item in enumerate(judged):
        right = item.case.mask(room.labels)[seen]
        enough = right.sum() >= MIN_GAUSSIANS
        direct = intersection_over_union(item.members[seen], right) if enough else float("nan")
        rows.append(
            PhraseScore(
                item.case.construction, item.case.text, way, room.seed, bool(item.case.ids), item.found,
                tuple(ious[number]), tuple(hits[number]), direct, item.seconds,
            )
        )  # fmt: skip
    return rows


def _in_view(room: Room, judged: Sequence[Judged], camera: Camera) -> Iterator[tuple[int, float, bool]]:
    """(number, IoU, whether the peak hits) of every answer whose truth is visible."""
    labels = room.truth.labels(camera.name)
    view = CpuRasterizer().view(room.gaussians, camera)
    masks = [item.case.mask(labels) for item in judged]
    visible = [row for row, mask in enumerate(masks) if mask.sum() >= MIN_PIXELS]
    answers = [(judged[row].values, judged[row].members) for row in visible]
    for row, (found, peak) in zip(visible, masks_and_peaks(view, answers), strict=True):
        yield row, intersection_over_union(found, masks[row]), bool(masks[row][peak])


def phrase_table(rows: Sequence[PhraseScore]) -> str:
    """Markdown: per construction, whole / composed."""
    head = (
        "construction",
        "phrases",
        "views",
        "mIoU %",
        "localisation %",
        "3D IoU %",
        "found %",
        "not there: rejected %",
    )
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name in CONSTRUCTIONS:
        ways = [
            [row for row in rows if (row.construction, row.way) == (name, way)]
            for way in ("whole", "composed")
        ]
        if ways[0]:
            here = [[row for row in way if row.present] for way in ways]
            cells = [name, str(len(here[0])), str(sum(len(row.ious) for row in here[0]))]
            cells.append(_pair([[iou for row in way for iou in row.ious] for way in here]))
            cells.append(_pair([[hit for row in way for hit in row.hits] for way in here]))
            cells.append(_pair([[row.direct for row in way if not np.isnan(row.direct)] for way in here]))
            cells.append(_pair([[row.found for row in way] for way in here]))
            cells.append(_pair([[not row.found for row in way if not row.present] for way in ways]))
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _pair(ways: Sequence[Sequence[float]]) -> str:
    """Percent; "-" for no figures."""
    return " / ".join(f"{100 * np.mean(way):.1f}" if len(way) else "-" for way in ways)


def figures(config: PhraseBenchConfig, rows: Sequence[PhraseScore]) -> dict[str, Any]:
    """All figures."""
    return {"settings": asdict(config), "rows": [asdict(row) for row in rows]}
