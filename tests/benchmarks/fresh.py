"""Work whose memory is measured in a fresh interpreter: reading a large file, lifting onto many Gaussians.

`python -m tests.benchmarks.fresh read langsplat|plyfile FILE` and `... lift COUNT VIEWS WIDTH HEIGHT` print
their figures as JSON. Nothing else is imported, since the peak memory is that of the whole process.
"""

import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks.config import peak_memory
from langsplat_core.scene import Camera, Reading, look_at
from langsplat_core.semantics.store import ImageFeatures

GRIDS = ((15, 10), (10, 7), (6, 5))  # columns and rows of outlines: 150 subparts, 70 parts, 30 wholes
MEANINGS, DIM = 400, 512


def in_fresh_interpreter(*words: object) -> dict[str, Any]:
    """Figures of one piece of work. Raises InputError with the end of its output where it fails."""
    command = [sys.executable, "-m", __name__, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"{' '.join(map(str, words))}: {done.stderr.strip()[-300:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def read(reader: str, path: Path) -> dict[str, Any]:
    """Seconds, bytes and digest of the arrays that "langsplat" or "plyfile" reads; imports are not timed."""
    if reader == "plyfile":
        import plyfile  # noqa: F401
    else:
        import langsplat_core.io.ply  # noqa: F401
    start = time.perf_counter()
    arrays = _read_by_plyfile(path) if reader == "plyfile" else _read_by_ours(path)
    seconds, peak = time.perf_counter() - start, peak_memory()
    digest = hashlib.blake2b()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    kept = sum(array.nbytes for array in arrays)
    return {"seconds": seconds, "kept_bytes": kept, "peak_bytes": peak, "digest": digest.hexdigest()}


def _read_by_ours(path: Path) -> list[Array]:
    from langsplat_core.io.ply import read_ply

    gaussians = read_ply(path)
    return [getattr(gaussians, field.name) for field in fields(gaussians)]


def _read_by_plyfile(path: Path) -> list[Array]:
    """The same arrays, filled column by column, as 3DGS programs do (the mapping alone reads nothing)."""
    import plyfile

    vertex = plyfile.PlyData.read(path)["vertex"]

    def columns(*names: str) -> Array:
        out = np.empty((vertex.count, len(names)), np.float32)
        for index, name in enumerate(names):
            out[:, index] = vertex[name]
        return out

    rest = columns(*(f"f_rest_{index}" for index in range(45))).reshape(-1, 3, 15).transpose(0, 2, 1)
    sh = np.concatenate([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest], axis=1)
    scales, quats = (columns(*(f"{name}_{n}" for n in range(k))) for name, k in (("scale", 3), ("rot", 4)))
    return [columns("x", "y", "z"), scales, quats, columns("opacity")[:, 0], sh]


def lift(count: int, views: int, picture: tuple[int, int]) -> dict[str, Any]:
    """Seconds, bytes and relevancy error of lifting random masks onto random Gaussians."""
    from langsplat_core.config import CodebookConfig, TrainConfig
    from langsplat_core.extensions.benchmarks.measure import random_scene
    from langsplat_core.pipeline.language import language_field
    from langsplat_core.progress import silent

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
    error = loss.error_mean
    return {"seconds": seconds, "peak_bytes": peak_memory(), "kept_bytes": kept, "relevancy_error": error}


class RandomViews(Sequence[tuple[Camera, ImageFeatures]]):
    """Cameras around the ball of `random_scene`; outlines and vectors are drawn when they are looked at."""

    def __init__(self, count: int, picture: tuple[int, int]) -> None:
        self._count, self._picture = count, picture
        meanings = np.random.default_rng(0).normal(size=(MEANINGS, DIM))
        self._meanings = unit(meanings + 2 * meanings[0]).astype(np.float32)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        """View `index`, a number; slices are not supported."""
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
        """Return no words."""
        return ()

    def encode_texts(self, texts: Sequence[str]) -> Array:
        """(M, DIM) float32 unit vectors."""
        made = [np.random.default_rng(list(text.encode())).normal(size=DIM) for text in texts]
        return unit(np.stack(made or [np.zeros((0, DIM))])).astype(np.float32).reshape(-1, DIM)


if __name__ == "__main__":
    work, *words = sys.argv[1:]
    if work == "read":
        print(json.dumps(read(words[0], Path(words[1]))))
    else:
        count, views, width, height = map(int, words)
        print(json.dumps(lift(count, views, (width, height))))
