"""What each step of the CPU kernels gains: the same kernels with one step taken out, timed in turn.

`python packaging/kernel_steps.py [--scene SCENE] [--count N] [--size WxH]` copies the package to a temporary
folder, takes one step out of the source there, and times that copy in a process of its own. Beside each time
stands the greatest difference of its picture from that of the whole kernels. One thread, the median of nine.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

ROOT = Path(__file__).resolve().parents[3]


@dataclass(frozen=True)
class Variant:
    """One step taken out: texts of source files replaced, or the compiler told of another processor."""

    name: str
    edits: tuple[tuple[str, str, str], ...] = ()  # file in raster/, text, what stands there instead
    environment: dict[str, str] = field(default_factory=dict)


VARIANTS = (
    Variant("whole"),
    Variant(
        "rows of the tile that the footprint misses are blended too",
        (("blend.py", "return max(packed & 255, top), min(packed >> 8, bottom)", "return top, bottom"),),
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
                "reach = np.sqrt(2 * np.log(max(opacity / lens.alpha_min, 1.0)))",
                "reach = 3.33",
            ),
        ),
    ),
    Variant("no early stop", (("blend.py", "CHECK_EVERY = 16", "CHECK_EVERY = 2**40"),)),
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

_MEASURE = """
import json, sys, time
import numpy as np
from langsplat_core.lab.speed.cases import default_camera, random_scene
from langsplat_core.formats import load_scene
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
scene, count, width, height, channels, picture = json.loads(sys.argv[1])
if scene:
    opened = load_scene(scene)
    gaussians = opened.gaussians
    camera = opened.cameras[0] if opened.cameras else opened.framing_camera((width, height))
    camera = camera.resized(width, height)
else:
    gaussians, camera = random_scene(count), default_camera(width, height)
rng = np.random.default_rng(0)
x = rng.uniform(size=(len(gaussians), channels)).astype(np.float32)
y = rng.uniform(size=(camera.height, camera.width, channels)).astype(np.float32)
raster = CpuRasterizer(1)
view = raster.view(gaussians, camera)
calls = {"view": lambda: raster.view(gaussians, camera), "splat": lambda: view.splat(x),
         "gather": lambda: view.gather(y), "backward": lambda: view.backward(x, y)}
times = {}
for name, call in calls.items():
    call()
    spent = []
    for _ in range(9):
        start = time.thread_time()
        call()
        spent.append(1e3 * (time.thread_time() - start))
    times[name] = float(np.median(spent))
np.save(picture, view.splat(x)[0])
print(json.dumps(times))
"""


@dataclass(frozen=True)
class Steps:
    """What each step of the CPU kernels gains."""

    scene: Path | None = None
    """A scene to measure on; without one a random one."""
    count: int = 200_000
    """Gaussians of the random scene."""
    size: tuple[int, int] = (640, 480)
    """Width and height of the picture, pixels."""
    channels: int = 12
    """Values per Gaussian."""


def main(steps: Steps) -> None:
    import numpy as np

    console, rows = Console(), []
    with tempfile.TemporaryDirectory() as folder:
        for number, variant in enumerate(track(VARIANTS, "measuring", console=console)):
            place = Path(folder) / str(number)
            shutil.copytree(ROOT / "langsplat_core", place / "langsplat_core", ignore=_compiled)
            _take_out(variant, place / "langsplat_core" / "raster" / "cpu")
            rows.append((variant.name, _measure(variant, steps, place), np.load(place / "picture.npy")))
    whole_times, whole_picture = rows[0][1:]
    table = Table("taken out", *whole_times, "picture differs by", title=f"milliseconds, {steps}")
    for name, times, picture in rows:
        cells = [f"{times[k]:.1f} ({times[k] / whole_times[k]:.2f}x)" for k in times]
        table.add_row(name, *cells, f"{np.abs(picture - whole_picture).max():.1e}")
    console.print(table)


def _take_out(variant: Variant, raster: Path) -> None:
    for name, old, new in variant.edits:
        text = (raster / name).read_text()
        if old not in text:
            raise SystemExit(f"{variant.name}: {name} no longer holds {old!r}")
        (raster / name).write_text(text.replace(old, new))


def _measure(variant: Variant, steps: Steps, place: Path) -> dict[str, float]:
    scene = str(steps.scene.resolve()) if steps.scene else None
    arguments = json.dumps([scene, steps.count, *steps.size, steps.channels, str(place / "picture.npy")])
    environment = os.environ | variant.environment | {"PYTHONPATH": str(place)}
    done = subprocess.run(
        [sys.executable, "-c", _MEASURE, arguments],
        cwd=place, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{variant.name}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def _compiled(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if name == "__pycache__"]


if __name__ == "__main__":
    main(tyro.cli(Steps))
