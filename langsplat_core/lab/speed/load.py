"""How fast, and in how much memory, a large scene file is read; beside it `plyfile` on the same file.

Every reading happens in a fresh interpreter, so that neither memory nor caches of one reach the other, and
ends in the same five float32 arrays, which are compared. Interpreter start and imports are not timed, but the
peak memory is that of the whole process. The file has just been written, so it is in the system's cache.
"""

import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.io.ply import BASE_COLOUR, NORMAL, POSITION, ROTATION, SCALE, read_ply
from langsplat_core.lab.speed.resident import peak_memory
from langsplat_core.progress import Progress, silent

Reader = Literal["langsplat", "plyfile"]
READERS: tuple[Reader, ...] = ("langsplat", "plyfile")
REST = tuple(f"f_rest_{index}" for index in range(45))
NAMES = (*POSITION, *NORMAL, *BASE_COLOUR, *REST, "opacity", *SCALE, *ROTATION)  # 62, as INRIA writes them
BLOCK_ROWS = 50_000


@dataclass(frozen=True)
class Loading:
    """One reader on one file."""

    reader: Reader
    rows: int
    file_bytes: int
    seconds: float  # the least of several: other programs only ever add to it
    kept_bytes: int  # of the arrays that remain
    peak_bytes: int | None  # greatest resident memory of the process; None where the system does not tell
    same: bool  # whether the arrays are those that `langsplat` read


def measure_loading(rows: int = 2_500_000, repeats: int = 3, progress: Progress = silent) -> list[Loading]:
    """Write a binary PLY of `rows` Gaussians of degree 3 (248 bytes each) to a temporary folder, read it with
    every reader `repeats` times in turn, and remove it.

    "plyfile" maps the file into memory and fills the arrays column by column, as 3DGS programs do with it
    (the mapping alone reads nothing). Raises InputError when the disk cannot take the file.
    """
    runs: dict[Reader, list[dict[str, object]]] = {reader: [] for reader in READERS}
    with tempfile.TemporaryDirectory(prefix="langsplat_load_") as folder:
        path = Path(folder) / "scene.ply"
        _write(path, rows)
        size = path.stat().st_size
        for turn in range(repeats):
            for index, reader in enumerate(READERS):
                progress(f"reading with {reader}", (turn * len(READERS) + index) / (repeats * len(READERS)))
                runs[reader].append(_in_fresh_interpreter(reader, path))
    truth = runs["langsplat"][0]["digest"]
    return [_summary(reader, rows, size, runs[reader], truth) for reader in READERS]


def as_table(loadings: list[Loading]) -> str:
    """Markdown; ratios are to `langsplat`."""
    ours = loadings[0].seconds
    lines = [
        f"{loadings[0].rows} Gaussians, {loadings[0].file_bytes / 1e6:.0f} MB",
        "",
        "| reader | seconds | times ours | kept MB | peak MB | peak / kept | same arrays |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in loadings:
        peak = "?" if row.peak_bytes is None else f"{row.peak_bytes / 1e6:.0f}"
        ratio = "?" if row.peak_bytes is None else f"{row.peak_bytes / row.kept_bytes:.2f}"
        same = "yes" if row.same else "NO"
        lines.append(
            f"| {row.reader} | {row.seconds:.3f} | {row.seconds / ours:.1f} | {row.kept_bytes / 1e6:.0f} "
            f"| {peak} | {ratio} | {same} |"
        )
    return "\n".join(lines) + "\n"


def _summary(reader: Reader, rows: int, size: int, runs: list[dict[str, object]], truth: object) -> Loading:
    peaks = [run["peak"] for run in runs if isinstance(run["peak"], int)]
    return Loading(
        reader,
        rows,
        size,
        min(float(str(run["seconds"])) for run in runs),
        int(str(runs[0]["kept"])),
        max(peaks) if peaks else None,
        all(run["digest"] == truth for run in runs),
    )


def _write(path: Path, rows: int) -> None:
    """A PLY as the INRIA code writes it, block by block."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {rows}"]
    header += [f"property float {name}" for name in NAMES]
    generator = np.random.default_rng(0)
    try:
        with path.open("wb") as file:
            file.write(("\n".join([*header, "end_header"]) + "\n").encode())
            for start in range(0, rows, BLOCK_ROWS):
                shape = (min(BLOCK_ROWS, rows - start), len(NAMES))
                file.write(generator.standard_normal(shape, np.float32).astype("<f4").tobytes())
    except OSError as error:
        raise InputError(f"{path.parent}: cannot write {rows * 248 / 1e6:.0f} MB ({error})") from None


def _in_fresh_interpreter(reader: Reader, path: Path) -> dict[str, object]:
    command = [sys.executable, "-m", "langsplat_core.lab.speed.load", reader, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    result: dict[str, object] = json.loads(done.stdout)
    return result


# ---- inside the fresh interpreter ----


def _ours(path: Path) -> list[Array]:
    gaussians = read_ply(path)
    return [getattr(gaussians, field.name) for field in fields(gaussians)]


def _plyfile(path: Path) -> list[Array]:
    import plyfile

    vertex = plyfile.PlyData.read(path)["vertex"]

    def columns(names: tuple[str, ...]) -> Array:
        out = np.empty((vertex.count, len(names)), np.float32)
        for index, name in enumerate(names):
            out[:, index] = vertex[name]
        return out

    rest = columns(REST).reshape(-1, 3, 15).transpose(0, 2, 1)
    sh = np.concatenate([columns(BASE_COLOUR)[:, None], rest], axis=1)
    return [columns(POSITION), columns(SCALE), columns(ROTATION), columns(("opacity",))[:, 0], sh]


def _report(reader: str, path: Path) -> dict[str, object]:
    read: Callable[[Path], list[Array]] = {"langsplat": _ours, "plyfile": _plyfile}[reader]
    if reader == "plyfile":
        import plyfile  # noqa: F401  imports are not timed
    start = time.perf_counter()
    arrays = read(path)
    seconds = time.perf_counter() - start
    peak = peak_memory()
    digest = hashlib.blake2b()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return {
        "seconds": seconds,
        "kept": sum(array.nbytes for array in arrays),
        "peak": peak,
        "digest": digest.hexdigest(),
    }


if __name__ == "__main__":
    print(json.dumps(_report(sys.argv[1], Path(sys.argv[2]))))
