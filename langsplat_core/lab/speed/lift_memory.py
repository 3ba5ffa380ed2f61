"""How much memory and time the way from masks to codes takes, and how both grow (`langsplat bench memory`).

Random Gaussians, random outlines in a grid, random vectors of some hundred meanings: what they mean is of no
interest, their number is. Every size runs in a fresh interpreter, whose peak memory is that of everything in
it, files that are mapped into memory included.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import overload

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.config import CodebookConfig, TrainConfig
from langsplat_core.errors import InputError
from langsplat_core.lab.speed.cases import random_scene
from langsplat_core.lab.speed.resident import peak_memory
from langsplat_core.pipeline.language import language_field
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import Camera, Reading, look_at
from langsplat_core.semantics.store import ImageFeatures

GRIDS = ((15, 10), (10, 7), (6, 5))  # columns and rows of outlines: 150 subparts, 70 parts, 30 wholes
MEANINGS, DIM = 400, 512


@dataclass(frozen=True)
class LiftCost:
    """One size."""

    gaussians: int
    views: int
    width: int
    height: int
    seconds: float
    peak_bytes: int | None  # of the process; None where the system does not tell
    kept_bytes: int  # in the work folder
    relevancy_error: float  # mean, of the codebook


def measure_lift_memory(
    sizes: Sequence[tuple[int, int]], picture: tuple[int, int], progress: Progress = silent
) -> list[LiftCost]:
    """sizes: numbers of Gaussians and of views; picture: width and height, pixels."""
    costs = []
    for count, views in sizes:
        command = [sys.executable, "-m", __name__, *map(str, (count, views, *picture))]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"bench memory: {count} Gaussians, {views} views: {done.stderr.strip()[-300:]}")
        costs.append(LiftCost(**json.loads(done.stdout.splitlines()[-1])))
        progress("lifting", len(costs) / len(sizes))
    return costs


def cost_table(costs: Sequence[LiftCost]) -> str:
    """Markdown."""
    head = "| Gaussians | views | picture | seconds | peak memory | kept on disk | relevancy error |"
    lines = [head, "|---|---|---|---|---|---|---|"]
    for cost in costs:
        peak = "?" if cost.peak_bytes is None else f"{cost.peak_bytes / 1e9:.2f} GB"
        lines.append(
            f"| {cost.gaussians} | {cost.views} | {cost.width}x{cost.height} | {cost.seconds:.0f} | {peak} | "
            f"{cost.kept_bytes / 1e9:.2f} GB | {cost.relevancy_error:.4f} |"
        )
    return "\n".join(lines) + "\n"


class RandomViews(Sequence[tuple[Camera, ImageFeatures]]):
    """Cameras around the ball of `random_scene`; outlines and vectors are drawn when they are looked at."""

    def __init__(self, count: int, picture: tuple[int, int]) -> None:
        self._count, self._picture = count, picture
        meanings = np.random.default_rng(0).normal(size=(MEANINGS, DIM))
        self._meanings = unit(meanings + 2 * meanings[0]).astype(np.float32)

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> tuple[Camera, ImageFeatures]: ...

    @overload
    def __getitem__(self, index: slice) -> "RandomViews": ...

    def __getitem__(self, index: int | slice) -> "tuple[Camera, ImageFeatures] | RandomViews":
        if isinstance(index, slice):
            raise TypeError("views are looked at one by one")
        if not 0 <= index < self._count:
            raise IndexError(index)
        angle = 2 * np.pi * index / self._count
        eye = 2.6 * np.array([np.sin(angle), 0.3 * np.cos(3 * angle), -np.cos(angle)])
        camera = look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0]), self._picture)
        generator = np.random.default_rng(index)
        labels = _outlines(self._picture)
        chosen = self._meanings[generator.integers(MEANINGS, size=int(labels.max()) + 1)]
        vectors = unit(chosen + 0.01 * generator.normal(size=chosen.shape)).astype(np.float32)
        return camera, ImageFeatures(labels, vectors)


def _outlines(picture: tuple[int, int]) -> Array:
    width, height = picture
    labels, first = [], 0
    for columns, rows in GRIDS:
        x, y = np.arange(width) * columns // width, np.arange(height) * rows // height
        labels.append(first + y[:, None] * columns + x)
        first += columns * rows
    return np.stack(labels).astype(np.int32)


class RandomEncoder:
    """Phrases as random vectors, each always the same."""

    id = "random"
    temperature = 10.0
    reading = Reading()

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """None."""
        return ()

    def encode_texts(self, texts: Sequence[str]) -> Array:
        """(M, DIM) float32 unit vectors."""
        made = [np.random.default_rng(list(text.encode())).normal(size=DIM) for text in texts]
        return unit(np.stack(made or [np.zeros((0, DIM))])).astype(np.float32).reshape(-1, DIM)


def _measure(count: int, views: int, picture: tuple[int, int]) -> LiftCost:
    config = TrainConfig(codec=CodebookConfig(size=1_024))
    gaussians = random_scene(count)
    with tempfile.TemporaryDirectory(prefix="langsplat_lift_") as folder:
        start = time.perf_counter()
        _, loss = language_field(
            gaussians,
            RandomViews(views, picture),
            RandomEncoder(),  # type: ignore[arg-type]  # all that is asked of an encoder here
            config,
            Path(folder),
            silent,
        )
        seconds = time.perf_counter() - start
        kept = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    return LiftCost(count, views, *picture, round(seconds, 1), peak_memory(), kept, loss.error_mean)


if __name__ == "__main__":
    count, views, width, height = map(int, sys.argv[1:])
    print(json.dumps(asdict(_measure(count, views, (width, height)))))
