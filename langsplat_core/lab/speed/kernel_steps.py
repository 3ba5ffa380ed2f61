"""What each step of the CPU kernels gains: the same kernels with one step taken out, timed in turn.

The package is copied to a temporary folder, one step is taken out of the source there, and that copy is
timed in a process of its own (`kernel_times`). Beside each time stands the greatest difference of its
picture from that of the whole kernels. One thread, the median of nine.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import BackendError
from langsplat_core.lab.config import KernelStepsConfig
from langsplat_core.progress import Progress, silent

PACKAGE = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Variant:
    """One step taken out: texts of source files replaced, or the compiler told of another processor."""

    name: str
    edits: tuple[tuple[str, str, str], ...] = ()  # file in raster/cpu/, text, what stands there instead
    environment: dict[str, str] = field(default_factory=dict)


VARIANTS = (
    Variant("whole"),
    Variant(
        "rows of the tile that the footprint misses are blended too",
        (("walk.py", "return max(low, top), min(high, bottom)", "return top, bottom"),),
    ),
    Variant(
        "tiles of the bounding box, not of the ellipse",
        (
            (
                "tiles.py",
                "    return _span(g[cp.MEAN_Y], low, high, height)",
                "    return _span(g[cp.MEAN_Y], -g[cp.HALF_HEIGHT], g[cp.HALF_HEIGHT], height)",
            ),
        ),
    ),
    Variant(
        "3.33 standard deviations, whatever the opacity",
        (
            (
                "projection.py",
                "reach = np.sqrt(2 * np.log(max(opacity / camera.alpha_min, 1.0)))",
                "reach = 3.33",
            ),
        ),
    ),
    Variant("no early stop", (("walk.py", "CHECK_EVERY = 16", "CHECK_EVERY = 2**40"),)),
    Variant(
        "the C library's exp2, not a polynomial",
        (
            (
                "lanes.py",
                "        low = constant(-100)\n",
                "        from numba.core.cgutils import get_or_insert_function as declare\n"
                "        kind = ir.FunctionType(FLOATS, [FLOATS])\n"
                "        call = declare(builder.module, kind, 'llvm.exp2.v16f32')\n"
                "        return builder.call(call, arguments)\n"
                "        low = constant(-100)\n",
            ),
        ),
    ),
    Variant(
        "channels one by one, not in fours",
        (
            ("planes.py", "channels & ~3", "channels & 0"),
            ("planes.py", "lines & ~3", "lines & 0"),
            ("planes.py", "channels == 3 and", "False and"),
        ),
    ),
    Variant(
        "no prefetching",
        (
            (
                "lanes_memory.py",
                "        byte = ir.IntType(8).as_pointer()\n",
                "        return context.get_dummy_value()\n        byte = ir.IntType(8).as_pointer()\n",
            ),
        ),
    ),
    Variant("AVX2 only", environment={"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma,+bmi2"}),
    Variant("SSE2 only", environment={"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": "+sse2"}),
)


@dataclass(frozen=True)
class StepTimes:
    """The kernels without one step."""

    name: str
    milliseconds: dict[str, float]  # by operation
    changes_by: float  # largest difference of its picture from that of the whole kernels


def measure_steps(config: KernelStepsConfig, progress: Progress = silent) -> list[StepTimes]:
    """Every variant in turn, the whole kernels first; some minutes.

    Raises BackendError where a variant cannot be measured.
    """
    rows: list[StepTimes] = []
    whole: Array | None = None
    with tempfile.TemporaryDirectory() as folder:
        for number, variant in enumerate(VARIANTS):
            progress("measuring", number / len(VARIANTS))
            place = Path(folder) / str(number)
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(PACKAGE, place / PACKAGE.name, ignore=ignored)
            take_out(variant, place / PACKAGE.name / "raster" / "cpu")
            times = _times(variant, config, place)
            picture: Array = np.load(place / "picture.npy")
            whole = picture if whole is None else whole
            rows.append(StepTimes(variant.name, times, float(np.abs(picture - whole).max())))
    progress("measuring", 1.0)
    return rows


def steps_table(rows: list[StepTimes]) -> str:
    """Markdown; milliseconds, and how many times those of the whole kernels."""
    whole = rows[0].milliseconds
    lines = [
        "| taken out | " + " | ".join(whole) + " | picture differs by |",
        "|---" * (len(whole) + 2) + "|",
    ]
    for row in rows:
        cells = [f"{ms:.1f} ({ms / whole[name]:.2f}x)" for name, ms in row.milliseconds.items()]
        lines.append(f"| {row.name} | " + " | ".join(cells) + f" | {row.changes_by:.1e} |")
    return "\n".join(lines) + "\n"


def take_out(variant: Variant, sources: Path) -> None:
    """Edit the files in `sources`, a copy of raster/cpu; BackendError for a text that is not there."""
    for name, old, new in variant.edits:
        text = (sources / name).read_text()
        if old not in text:
            raise BackendError(f"{variant.name}: {name} no longer holds {old!r}")
        (sources / name).write_text(text.replace(old, new))


def _times(variant: Variant, config: KernelStepsConfig, place: Path) -> dict[str, float]:
    settings = asdict(config) | {"scene": str(config.scene.resolve()) if config.scene else None}
    command = [sys.executable, "-m", "langsplat_core.lab.speed.kernel_times", json.dumps(settings)]
    environment = os.environ | variant.environment | {"PYTHONPATH": str(place)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BackendError(f"{variant.name}: {done.stderr.strip().splitlines()[-1:]}")
    times: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return times
