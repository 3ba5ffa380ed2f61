"""Reading a large file in a fresh interpreter, whose peak memory is measured.

`python -m tests.benchmarks.fresh langsplat|plyfile FILE` prints its figures as JSON. Nothing else is
imported, since the peak memory is that of the whole process.
"""

import hashlib
import json
import re
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError


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
    seconds, status = time.perf_counter() - start, Path("/proc/self/status")
    highest = re.search(r"VmHWM:\s*(\d+) kB", status.read_text(encoding="utf-8")) if status.exists() else None
    peak = 1024 * int(highest[1]) if highest else None
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


if __name__ == "__main__":
    print(json.dumps(read(sys.argv[1], Path(sys.argv[2]))))
