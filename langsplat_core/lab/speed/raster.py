"""The rasterizer benchmark from plan to report."""

import json
import os
import platform
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from langsplat_core.errors import BackendError
from langsplat_core.io.files import atomic_path
from langsplat_core.io.scenes import load_scene
from langsplat_core.lab.config import RasterBenchConfig
from langsplat_core.lab.speed import report as tables
from langsplat_core.lab.speed.cases import Case, default_camera, random_scene, sweep
from langsplat_core.lab.speed.cold_start import Start, measure_starts, starts_table
from langsplat_core.lab.speed.machine_limit import Need, count_need, peak_flops
from langsplat_core.lab.speed.measure import Foresight, Measurement, measure, warm_up
from langsplat_core.lab.speed.plot import plot
from langsplat_core.lab.speed.torch_baseline import TorchRasterizer
from langsplat_core.lab.speed.truth import make_truth
from langsplat_core.progress import Progress, silent
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.scene_textures import create_egl_context
from langsplat_core.raster.protocol import Rasterizer


def quick_plan(plan: RasterBenchConfig) -> RasterBenchConfig:
    """About a minute on two cores."""
    return replace(
        plan,
        counts=(3_000, 10_000, 31_000),
        sizes=((160, 120), (320, 240), (640, 480)),
        pivot=10_000,
        limit=min(plan.limit, 3.0),
    )


@dataclass(frozen=True)
class Report:
    """Everything one run found."""

    machine: dict[str, object]
    rows: list[Measurement]
    peak: float  # flop/s
    needs: dict[tuple[str, int, int, int], Need]
    starts: list[Start]

    @property
    def text(self) -> str:
        """In Markdown."""
        reach = tables.reaches(self.rows, self.needs, self.peak)
        parts = [
            "# Rasterizers: time against error\n",
            "\n".join(f"- {name}: {value}" for name, value in self.machine.items()) + "\n",
            tables.table(self.rows),
            _NOTES,
            "## Growth: exponent of the time\n",
            tables.growth_table(tables.growth(self.rows)),
            "## Distance of the CPU's splat from the machine's limit\n",
            tables.reach_table(reach, self.peak),
        ]
        if self.starts:
            parts += ["## First calls in a fresh process, seconds\n", starts_table(self.starts)]
        parts += ["## Promised ratios\n", tables.ratio_table(tables.ratios(self.rows))]
        return "\n".join(parts)

    def save(self, folder: Path) -> None:
        """raster.md, raster.json and raster.png."""
        with atomic_path(folder / "raster.md") as path:
            path.write_text(self.text)
        with atomic_path(folder / "raster.json") as path:
            path.write_text(json.dumps(self.as_record(), indent=1))
        with atomic_path(folder / "raster.png") as path:
            plot(self.rows, path)

    def as_record(self) -> dict[str, Any]:
        """For JSON."""
        reach = tables.reaches(self.rows, self.needs, self.peak)
        return {
            "machine": self.machine,
            "measurements": tables.as_records(self.rows),
            "growth": tables.as_records(tables.growth(self.rows)),
            "peak_flops": self.peak,
            "reach": tables.as_records(reach),
            "starts": [asdict(start) for start in self.starts],
            "ratios": tables.as_records(tables.ratios(self.rows)),
        }


_NOTES = """- ms: median of the calls after the first.
- frame: project + splat with a camera that has moved since the last frame.
- labels: W^T onehot of label maps with 252 regions at three levels; `channels` plays no part.
- MiB: rise of the process's resident set at its highest during the first call.
- Errors: against the float64 reference on three windows of 64x64 pixels, values in [0, 1); those of backward
  are relative to each gradient's greatest entry, against float64 autograd.
- Cut-offs are an alpha of 1/255 and a transmittance of 1e-4. A pixel within 0.1 % of one may come out on its
  other side: a flip, counted where its error exceeds all others. gather and backward are compared without
  such pixels.
"""


def run_plan(
    plan: RasterBenchConfig, progress: Progress = silent, keep: Callable[[Report], None] = lambda _: None
) -> Report:
    """Measure; a few minutes for the default plan. `keep` is given what there is after every scene and size,
    so that an interrupted run leaves that."""
    machine = describe_machine()
    baseline: Any = TorchRasterizer()  # a `Rasterizer` whose views have no depth
    backends: list[Rasterizer] = [*_backends(machine), baseline]
    progress("bench: compiling", 0.0)
    warm_up(backends, plan.channels)
    peak = peak_flops()
    foresight = Foresight(plan.limit)
    rows: list[Measurement] = []
    needs: dict[tuple[str, int, int, int], Need] = {}
    total = len(plan.scenes) + len(_pairs(plan))
    for n, case in enumerate(_cases(plan)):
        camera = case.camera
        name = f"bench: {case.scene} {len(case.gaussians)} at {camera.width}x{camera.height}"
        progress(f"{name}, reference", n / total)
        truth = make_truth(case.gaussians, camera)
        need = count_need(truth.footprints, camera.width, camera.height)
        needs[(case.scene, len(case.gaussians), camera.width, camera.height)] = need
        steps = [(channels, backend) for channels in plan.channels for backend in backends]
        for step, (channels, backend) in enumerate(steps):
            progress(f"{name}, {backend.name}", (n + step / len(steps)) / total)
            rows += measure(backend, case, channels, truth, foresight)
        unfinished = {"unfinished": f"{n + 1} of {total} scenes and sizes"}
        keep(Report(machine | unfinished, list(rows), peak, dict(needs), []))
    progress("bench: fresh processes" if plan.cold else "bench: done", 1.0)
    return Report(machine, rows, peak, needs, measure_starts() if plan.cold else [])


def _pairs(plan: RasterBenchConfig) -> list[tuple[int, tuple[int, int]]]:
    return sweep(plan.counts, plan.sizes, plan.pivot, tables.PROMISED_CASES)


def _cases(plan: RasterBenchConfig) -> Iterator[Case]:
    for count, size in _pairs(plan):
        yield Case("random", random_scene(count), default_camera(*size))
    for path in plan.scenes:
        scene = load_scene(path)
        size = sorted(plan.sizes)[len(plan.sizes) // 2]
        camera = scene.cameras[0] if scene.cameras else scene.framing_camera(size)
        yield Case(path.name, scene.gaussians, camera.resized(*size))


def _backends(machine: dict[str, object]) -> list[Rasterizer]:
    """Every fast backend of this machine; those that cannot load are named in `machine` and left out."""
    backends = [load_rasterizer("cpu")]
    try:
        context = create_egl_context()
        machine["OpenGL"] = context.info["GL_RENDERER"]
        backends += [load_rasterizer("opengl", ctx=context, precision=p) for p in ("half", "single")]
    except BackendError as error:
        machine["OpenGL"] = f"left out: {error}"
    try:
        backends.append(load_rasterizer("cuda"))
        machine["CUDA"] = "measured"
    except BackendError as error:
        machine["CUDA"] = f"left out: {error}"
    return backends


def describe_machine() -> dict[str, object]:
    """Processor, cores, load and library versions."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = f"{os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else "unknown"
    libraries = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "torch"))
    return {
        "processor": _processor(),
        "cores": cores,
        "load when the run began": load,
        "libraries": libraries,
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
