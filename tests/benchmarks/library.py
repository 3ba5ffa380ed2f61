"""The report `library`: the first pass of a search over many scenes against the engine's own answers, in
rooms with known truth, and its time over many synthetic codebooks."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.bench.measure import markdown
from langsplat_core.config import CountOrZero
from langsplat_core.io.scenes import save_scene
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.finding import judged, rank
from langsplat_core.query.grammar import named
from langsplat_core.query.library import (
    COLUMNS,
    THUMBNAIL,
    Digest,
    Group,
    Listed,
    digest,
    fits_in,
    read_library,
    write_library,
)
from langsplat_core.scene import Scene
from tests.benchmarks.room import InRooms, MaskOrigin, Room, Variant, publish

CODEWORDS, DIM, REGIONS, MIXED = 256, 512, (120, 80, 40), 4  # of a synthetic scene; codewords of a region
PHRASES = 12  # that are timed


@dataclass(frozen=True)
class Found(InRooms):
    """Every phrase in every room by the index alone, against the engine; and the index's time at scale."""

    masks: tuple[MaskOrigin, ...] = ("truth", "graph")  # where outlines come from
    scenes: CountOrZero = 10_000  # synthetic ones, 220 KB each in the temporary folder; 0: none

    def run(self) -> None:
        with TerminalProgress() as progress:
            rows = [
                row for room in self.rooms(progress) for mask in self.masks for row in compare(room, mask)
            ]
        text = agreement_table(rows)
        if self.scenes:
            text += "\n" + timing_line(self.scenes)
        publish(self, "library", "Search over many scenes", text, [row for row in rows if row.far])


@dataclass(frozen=True)
class Compared:
    """One phrase in one scene, by the index and by the engine."""

    seed: int
    masks: str
    text: str
    index: str  # verdict
    engine: str
    error: float  # largest difference of a fit, spreads

    @property
    def far(self) -> bool:
        """Whether the verdicts differ."""
        return self.index != self.engine


def compare(room: Room, masks: MaskOrigin) -> list[Compared]:
    """All phrases that are there and that are not."""
    scene = Scene(room.gaussians, room.field(Variant("the method", masks))[0])
    engine = QueryEngine(scene, lambda _: room.encoder)
    with TemporaryDirectory() as folder:
        path = Path(folder, "scene.ply")
        save_scene(path, replace(scene, cameras=tuple(room.held_out)))
        write_library(Path(folder, "index"), [digest(path, path.name, lambda _: room.encoder)])
        group = read_library(Path(folder, "index"), Path(folder)).groups[0]
        rows = []
        for answer in engine.run_many([text for text in room.texts if not engine.unknown_words(text)]):
            fits = fits_in(group, engine.text_vector(answer.phrase))[0]
            verdict = judged(group.scenes[0], fits, named(answer.phrase))[2]
            error = float(np.abs(fits - answer.fits).max())
            rows.append(Compared(room.seed, masks, answer.phrase, verdict, answer.verdict, error))
        return rows


def agreement_table(rows: Sequence[Compared]) -> str:
    """A row for each kind of masks."""
    lines = []
    for masks in dict.fromkeys(row.masks for row in rows):
        own = [row for row in rows if row.masks == masks]
        there = [row for row in own if row.engine != "not here"]
        missed = sum(row.index == "not here" for row in there)
        lines.append([
            *(masks, str(len(own)), str(len(there)), str(missed), str(sum(row.far for row in own))),
            *(f"{median(row.error for row in own):.4f}", f"{max(row.error for row in own):.4f}"),
        ])  # fmt: skip
    names = ["masks", "asked", "found or weak", "missed", "other verdict", "median error", "largest error"]
    return markdown(names, lines)


def timing_line(count: int) -> str:
    """Time of a phrase over so many synthetic scenes, median and longest, with a warm file."""
    rng = np.random.default_rng(0)
    vectors = unit(rng.normal(size=(PHRASES, DIM))).astype(np.float32)
    with TemporaryDirectory() as folder:
        index = Path(folder, "index")
        write_library(index, [synthetic(k) for k in range(count)])
        start = time.perf_counter()
        group = read_library(index, Path(folder)).groups[0]
        opened, size = time.perf_counter() - start, index.stat().st_size
        seconds = [_seconds(group, vector) for vector in vectors][2:]
    return (
        f"{count} codebooks of {CODEWORDS} x {DIM} in 8 bits, {size / 1e9:.2f} GB: opened in {opened:.2f} s, "
        f"a phrase in {median(seconds):.2f} s (longest {max(seconds):.2f} s)\n"
    )


def _seconds(group: Group, vector: Array) -> float:
    start = time.perf_counter()
    rank(group, {"mug": vector})
    return time.perf_counter() - start


def synthetic(seed: int) -> Digest:
    """A scene of random codewords and regions, as the index keeps it."""
    rng, regions = np.random.default_rng(seed), sum(REGIONS)
    one, two, three = REGIONS
    parents = np.concatenate([
        one + rng.integers(two, size=one), one + two + rng.integers(three, size=two), np.full(three, -1)
    ])  # fmt: skip
    columns = {
        "steps": np.full(CODEWORDS, DIM**-0.5 / 30),
        "zeros": np.full(CODEWORDS, 0.1),
        "rates": np.full(CODEWORDS, 25.0),
        "shares": np.full(regions * MIXED, 1 / MIXED),
        "words": rng.integers(CODEWORDS, size=regions * MIXED),
        "regions": np.repeat(np.arange(regions), MIXED),
        "parents": parents,
        "solid": np.ones(regions),
        "codewords": rng.integers(-60, 61, (CODEWORDS, DIM)),
    }
    counts = (CODEWORDS, *REGIONS, regions * MIXED)
    listed = Listed(f"{seed}.ply", (seed,), counts, (0.0, 1.0) * 4 + (float("nan"),) * 12)
    made = {name: columns[name].astype(kind) for name, kind, _ in COLUMNS}
    width, height = THUMBNAIL
    picture = np.zeros((height, width, 3), np.uint8)
    return Digest(listed, "synthetic", np.eye(4, DIM, dtype=np.float32), made, picture)
