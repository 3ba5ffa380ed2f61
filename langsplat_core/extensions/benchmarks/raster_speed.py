"""The rasterizer benchmark (`langsplat bench raster`): every backend that loads here, tables and plot."""

import os
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.errors import BackendError
from langsplat_core.extensions.benchmarks.config import RasterBenchConfig
from langsplat_core.extensions.benchmarks.measure import (
    Case,
    Foresight,
    Measurement,
    default_camera,
    markdown,
    measure,
    random_scene,
    reference_windows,
    warm_up,
)
from langsplat_core.io.scenes import load_scene
from langsplat_core.progress import Progress, silent
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.scene_textures import create_egl_context
from langsplat_core.raster.protocol import Rasterizer

SceneSize = tuple[int, tuple[int, int]]  # Gaussians, (width, height)
_NOTES = """- The size with most scenes and the most channels; every other measurement is in raster.json.
- ms: median of the calls after the first.
- frame: project + splat with a camera that has moved since the last frame.
- labels: W^T onehot of label maps with 252 regions at three levels; `channels` plays no part.
- MiB: rise of the process's resident set at its highest during the first call.
- Errors: against the float64 reference on three windows of 64x64 pixels, values in [0, 1).
- Cut-offs are an alpha of 1/255 and a transmittance of 1e-4. A pixel within 0.1 % of one may come out on its
  other side: a flip, counted where its error exceeds all others. gather is compared without such
  pixels.
"""


def quick_plan(plan: RasterBenchConfig) -> RasterBenchConfig:
    """Return a smaller plan, which takes about a minute on two cores."""
    counts, sizes = (3_000, 10_000, 31_000), ((160, 120), (320, 240), (640, 480))
    return replace(plan, counts=counts, sizes=sizes, pivot=10_000, limit=min(plan.limit, 3.0))


@dataclass(frozen=True)
class RasterReport:
    """Results of one run of the benchmark."""

    machine: dict[str, object]
    rows: list[Measurement]

    @property
    def text(self) -> str:
        """The machine and a selection of the measurements, as Markdown."""
        return "\n".join([
            "# Rasterizers: time against error\n",
            "\n".join(f"- {name}: {value}" for name, value in self.machine.items()) + "\n",
            table(_selection(self.rows)),
            _NOTES,
        ])  # fmt: skip

    @property
    def figures(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return {
            "machine": self.machine,
            "measurements": [asdict(row) for row in self.rows],
        }


def run_plan(
    plan: RasterBenchConfig,
    progress: Progress = silent,
    keep: Callable[[RasterReport], None] = lambda _: None,
) -> RasterReport:
    """Measure; a few minutes for the default plan.

    `keep` is given what there is after every scene and size, so that an interrupted run leaves that.
    """
    machine = describe_machine()
    backends = _backends(machine)
    progress("bench: compiling", 0.0)
    warm_up(backends, plan.channels)
    foresight = Foresight(plan.limit)
    rows: list[Measurement] = []
    pairs = sweep(plan.counts, plan.sizes, plan.pivot)
    total = len(plan.scenes) + len(pairs)
    for n, case in enumerate(_cases(plan, pairs)):
        name = f"bench: {case.scene} {len(case.gaussians)} at {case.camera.width}x{case.camera.height}"
        progress(f"{name}, reference", n / total)
        exact = reference_windows(case.gaussians, case.camera)
        steps = [(channels, backend) for channels in plan.channels for backend in backends]
        for step, (channels, backend) in enumerate(steps):
            progress(f"{name}, {backend.name}", (n + step / len(steps)) / total)
            rows += measure(backend, case, channels, exact, foresight)
        keep(RasterReport(machine | {"unfinished": f"{n + 1} of {total} scenes and sizes"}, list(rows)))
    progress("bench: done", 1.0)
    return RasterReport(machine, rows)


def sweep(counts: tuple[int, ...], sizes: tuple[tuple[int, int], ...], pivot: int) -> list[SceneSize]:
    """Return the numbers of Gaussians and image sizes of the random scenes, small ones first.

    They are every count at the middle size, and every size at `pivot` Gaussians. The time of large ones is
    foretold from small ones.
    """
    middle = sorted(sizes)[len(sizes) // 2]
    pairs = {(count, middle) for count in counts} | {(pivot, size) for size in sizes}
    return sorted(pairs, key=lambda pair: (pair[0], pair[1][0] * pair[1][1]))


def _cases(plan: RasterBenchConfig, pairs: list[SceneSize]) -> Iterator[Case]:
    for count, size in pairs:
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
    told: dict[str, object] = {"processor": _processor(), "cores": cores, "load when the run began": load}
    return told | {"libraries": libraries}


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def table(rows: Sequence[Measurement]) -> str:
    """Return the measurements as a Markdown table."""
    head = ("scene", "Gaussians", "size", "channels", "operation", "backend", "ms", "MiB")
    return markdown(
        (*head, "error off cut-offs", "largest error", "flips"),
        (
            (r.scene, r.gaussians, f"{r.width}x{r.height}", r.channels, r.operation, r.backend)
            + (r.note or _cell(r.milliseconds, ".4g"), _cell(r.peak_mib, ".1f"))
            + (_cell(r.error_off_cuts, ".1e"), _cell(r.largest_error, ".1e"), _cell(r.flips, "d"))
            for r in rows
        ),
    )


def _selection(rows: Sequence[Measurement]) -> list[Measurement]:
    """Return the rows of the most measured image size, with the most channels."""
    size, channels = _busiest(rows), max((r.channels for r in rows), default=0)
    return [r for r in rows if (r.width, r.height) == size and r.channels == channels]


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


_COLOURS = {"cpu": "#0072b2", "opengl half": "#d55e00", "opengl single": "#e69f00"}
_COMPARED = {"splat": "splat: pixels", "gather": "gather: values", "frozen": "frozen (triangles: gathered)"}
_ORDER = ("project", "frame", "splat", "gather", "backward", "freeze", "frozen splat", "frozen gather")


def plot(rows: Sequence[Measurement], path: Path) -> None:
    """Two lines of panels: milliseconds over Gaussians, at the size with most counts.

    Solid for the fewest, dashed for the most channels. Third line: error against time of everything compared.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.lines import Line2D

    random = [r for r in rows if r.scene == "random" and r.milliseconds is not None]
    size = _busiest(random)
    here = [r for r in random if (r.width, r.height) == size]
    channels = sorted({r.channels for r in rows})
    styles = {channels[0]: "-"} | ({channels[-1]: "--"} if len(channels) > 1 else {})
    backends = list(dict.fromkeys(r.backend for r in rows))
    colours = {name: _COLOURS.get(name, f"C{n}") for n, name in enumerate(backends)}
    figure, grid = pyplot.subplots(3, 4, figsize=(13, 10), layout="constrained", squeeze=False)
    operations = [name for name in _ORDER if any(r.operation == name for r in here)]
    panels = [panel for line in grid[:2] for panel in line]
    for panel in panels[len(operations) :]:
        panel.axis("off")
    for panel, operation in zip(panels, operations, strict=False):
        _times(panel, [r for r in here if r.operation == operation], colours, styles)
        panel.set_title(operation)
    for panel, kind in zip(grid[2], _COMPARED, strict=False):
        _errors(panel, kind, rows, colours)
    grid[2][-1].axis("off")
    handles = [Line2D([], [], color=colours[name], marker="o", label=name) for name in backends]
    handles += [Line2D([], [], color="black", ls=s, label=f"{c} channels") for c, s in styles.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    where = f"at {size[0]}x{size[1]} pixels" if size else "(none)"
    figure.suptitle(f"Time of random scenes {where}; error away from cut-offs against time, all cases")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _times(panel: Any, rows: Sequence[Measurement], colours: dict[str, str], styles: dict[int, str]) -> None:
    for backend, colour in colours.items():
        for channels, style in styles.items():
            chosen = [r for r in rows if (r.backend, r.channels) == (backend, channels)]
            chosen.sort(key=lambda r: r.gaussians)
            times = [r.milliseconds for r in chosen]
            panel.plot([r.gaussians for r in chosen], times, style, color=colour, marker="o", ms=4, lw=1.4)
    panel.set(xlabel="Gaussians", ylabel="ms")
    _log_axes(panel, [r.gaussians for r in rows], [r.milliseconds or 1 for r in rows])


def _errors(panel: Any, kind: str, rows: Sequence[Measurement], colours: dict[str, str]) -> None:
    """Plot the error away from cut-offs over time; triangles are gathers."""
    chosen = [r for r in rows if r.operation.startswith(kind) and r.error_off_cuts is not None]
    errors = [max(r.error_off_cuts or 0, 1e-9) for r in chosen]
    times = [r.milliseconds or 1 for r in chosen]
    for r, x, y in zip(chosen, times, errors, strict=True):
        mark = "^" if r.operation.endswith("gather") else "o"
        panel.plot(x, y, mark, color=colours[r.backend], alpha=0.7)
    panel.set(title=_COMPARED[kind], xlabel="ms", ylabel="largest error")
    _log_axes(panel, times, errors)


def _log_axes(panel: Any, x: Sequence[float], y: Sequence[float]) -> None:
    """Make both axes logarithmic, between powers of ten that alone are labelled."""
    from matplotlib.ticker import NullFormatter

    panel.set(xscale="log", yscale="log")
    for axis, limit, values in ((panel.xaxis, panel.set_xlim, x), (panel.yaxis, panel.set_ylim, y)):
        axis.set_minor_formatter(NullFormatter())
        if values:
            low, high = np.floor(np.log10(min(values) / 1.1)), np.ceil(np.log10(max(values) * 1.1))
            limit(10.0**low, 10.0**high)
    panel.grid(True, alpha=0.3)


def _busiest(rows: Sequence[Measurement]) -> tuple[int, int] | None:
    """Return the image size that was measured with the most numbers of Gaussians."""
    counts: dict[tuple[int, int], set[int]] = {}
    for r in rows:
        counts.setdefault((r.width, r.height), set()).add(r.gaussians)
    return max(counts, key=lambda size: len(counts[size]), default=None)
