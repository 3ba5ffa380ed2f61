"""The rasterizer benchmark (`langsplat bench raster`): time, error and memory of every operation, in one run.

* Time: median of the calls that fit into 0.3 seconds (3 to 15), after a first call that is not counted. If
  the first call takes more than two seconds, its time is reported.
* Error: against the float64 reference (`ReferenceWindow`), from a separate call.
* Memory: peak rise of the process's resident set during the first call, after free pages of the heap were
  returned to the system. It includes arrays of NumPy, PyTorch and kernels, and memory of a software OpenGL
  driver. Linux only; elsewhere unknown.
"""

import ctypes
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy.sparse
import tyro

from langsplat_core.arrays import Array
from langsplat_core.cli.arguments import OutFolder
from langsplat_core.config import INRIA, Count, Range, RasterSettings
from langsplat_core.errors import BackendError, InputError
from langsplat_core.extensions.benchmarks.report import markdown, write_report
from langsplat_core.io.scenes import load_scene
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.rasterizer import create_egl_context
from langsplat_core.raster.protocol import Rasterizer
from langsplat_core.raster.reference import Footprints, ReferenceView, project, rim
from langsplat_core.scene import Camera, Gaussians, look_at

Pixels = Annotated[int, Range(1, 65_536)]
Size = tuple[Pixels, Pixels]  # width and height of an image
Channels = Annotated[int, Range(1, 4_096)]  # values per Gaussian
WINDOW = 112  # px, side of the central window in which errors are measured
_BAND = 1e-3  # relative distance to a cut-off; footprints in float32 on a GPU differ by about 3e-4
_FLIP = 2e-5  # an error in the band is a flip if larger than this and than twice all others
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_NOTES = """- ms: median of the calls after the first.
- frame: project + splat with a camera that has moved since the last frame.
- MiB: rise of the process's resident set at its highest during the first call.
- Errors: against the float64 reference in a window of 112x112 pixels, values in [0, 1); of `backward`,
  that of the derivatives by the values.
- Cut-offs are an alpha of 1/255 and a transmittance of 1e-4. A pixel within 0.1 % of one may come out on its
  other side: a flip, counted where its error exceeds all others. gather is compared without such
  pixels.
"""


@dataclass(frozen=True)
class BenchRaster:
    """Time, error and memory of every rasterizer that loads here, in one run; takes a minute or two."""

    counts: tuple[Count, ...] = (10_000, 31_000, 100_000, 200_000, 1_000_000)
    """Gaussians of the random scenes."""
    size: Size = (640, 480)
    """Width and height of the image, pixels."""
    channels: Channels = 12
    """Values per Gaussian."""
    scenes: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="SCENE ...")] = ()
    """Real scenes to measure beside the random ones, from their first camera, else one that frames them."""
    out: OutFolder = Path("bench_out")
    """Folder for raster.md and raster.json."""

    def run(self) -> None:
        for path in self.scenes:  # before minutes of measuring
            if not os.path.exists(path):
                raise InputError(f"{path}: no such file; check the spelling and the folder")
        with TerminalProgress() as progress:
            machine, rows = run_plan(self, progress)
        told = "".join(f"- {name}: {value}\n" for name, value in machine.items())
        text = f"# Rasterizers: time against error\n\n{told}\n{table(rows)}\n{_NOTES}"
        figures = {"machine": machine, "measurements": [asdict(row) for row in rows]}
        write_report(self.out, "raster", text, figures)
        print(text)


# Memory of this process, from /proc of Linux; the maximum of getrusage is inherited from the parent process.


def resident_memory() -> int | None:
    """Return the present resident set of this process, bytes; None if unknown."""
    return _status("VmRSS")


def peak_memory() -> int | None:
    """Return the peak resident set since the process began or `restart_peak`, bytes; None if unknown."""
    return _status("VmHWM")


def restart_peak() -> int | None:
    """Return free pages to the system and reset the peak; return the present bytes, None if impossible."""
    if not _CLEAR.exists():
        return None
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc has it
    try:
        if trim is not None:
            trim(0)
        _CLEAR.write_text("5", encoding="ascii")
    except OSError:
        return None
    return resident_memory()


def _status(key: str) -> int | None:
    try:
        found = re.search(rf"{key}:\s*(\d+) kB", _STATUS.read_text(encoding="utf-8"))
    except OSError:
        return None
    return int(found[1]) * 1024 if found else None


# One run.


@dataclass(frozen=True, eq=False)
class Case:
    """A scene and a camera."""

    scene: str  # "random", or the name of a file
    gaussians: Gaussians
    camera: Camera


@dataclass(frozen=True)
class Error:
    """Differences from the reference."""

    largest: float  # over all compared pixels
    off_cuts: float  # over pixels that are not near a cut-off
    flips: int  # pixels near a cut-off on its other side


@dataclass(frozen=True)
class Measurement:
    """Time, memory and error of an operation of a backend."""

    scene: str
    gaussians: int
    width: int
    height: int
    channels: int
    operation: str
    backend: str
    milliseconds: float = 0.0  # median
    peak_mib: float | None = None  # rise of the resident set; None: unknown
    error: Error | None = None  # None: not compared


def run_plan(plan: BenchRaster, progress: Progress = silent) -> tuple[dict[str, object], list[Measurement]]:
    """Return the description of the machine, and all measurements, which take minutes."""
    machine = describe_machine()
    backends = _backends(machine)
    progress("bench: compiling", 0.0)
    warm_up(backends, (plan.channels,))
    rows, total = list[Measurement](), len(plan.scenes) + len(plan.counts)
    for n, case in enumerate(_cases(plan)):
        name = f"bench: {case.scene} {len(case.gaussians)}"
        progress(f"{name}, reference", n / total)
        exact = reference_window(case.gaussians, case.camera)
        for step, backend in enumerate(backends):
            progress(f"{name}, {backend.name}", (n + step / len(backends)) / total)
            rows += measure(backend, case, plan.channels, exact)
    progress("bench: done", 1.0)
    return machine, rows


def _cases(plan: BenchRaster) -> Iterator[Case]:
    for count in sorted(plan.counts):
        yield Case("random", random_scene(count), default_camera(*plan.size))
    for path in plan.scenes:
        scene = load_scene(path)
        camera = scene.cameras[0] if scene.cameras else scene.framing_camera(plan.size)
        yield Case(path.name, scene.gaussians, camera.resized(*plan.size))


def random_scene(count: int) -> Gaussians:
    """Return `count` small Gaussians in a unit ball, of a size such that the image's coverage is constant."""
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = generator.uniform(0, 1, (count, 1)) ** (1 / 3)
    size = 0.6 * count ** (-1 / 3)
    return Gaussians(
        means=directions * radius,
        log_scales=np.log(size * np.exp(generator.normal(-1.0, 0.5, (count, 3)))),
        quats_wxyz=generator.normal(size=(count, 4)),
        opacity_logits=generator.normal(0.0, 1.5, count),
        sh=generator.normal(0, 0.5, (count, 1, 3)),
    )


def default_camera(width: int, height: int) -> Camera:
    """Return a camera that sees the whole ball of `random_scene`."""
    return look_at(np.array([0.0, 0.0, -2.6]), np.zeros(3), np.array([0.0, -1.0, 0.0]), (width, height))


def _backends(machine: dict[str, object]) -> list[Rasterizer]:
    """Return the fast backends of this machine; those that cannot load are named in `machine`."""
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
    """Return processor, cores, load and library versions."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = f"{os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else "unknown"
    libraries = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "torch"))
    told: dict[str, object] = {"processor": _processor(), "cores": cores, "load when the run began": load}
    return told | {"libraries": libraries}


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())


# One backend on one case.


def warm_up(backends: Sequence[Rasterizer], channels: Sequence[int]) -> None:
    """Compile and load everything with a tiny scene, so that measurements do not include it."""
    case = Case("random", random_scene(200), default_camera(40, 30))
    for backend in backends:
        for count in channels:
            for _, call, _ in _operations(backend, case, count):
                call()


def measure(
    backend: Rasterizer, case: Case, channels: int, exact: "ReferenceWindow"
) -> Iterator[Measurement]:
    """Yield measurements of every operation of `backend` on one case."""
    shape = case.scene, len(case.gaussians), case.camera.width, case.camera.height, channels
    name = f"{backend.name} {getattr(backend, 'precision', '')}".strip()
    for operation, call, error_of in _operations(backend, case, channels):
        seconds, peak = _timed(call)
        error = None if error_of is None else error_of(exact)
        yield Measurement(*shape, operation, name, 1e3 * seconds, peak, error)


# Name, function that is timed, and its error, if one is measured.
_Operation = tuple[str, Callable[[], Any], "Callable[[ReferenceWindow], Error] | None"]


def _operations(backend: Rasterizer, case: Case, channels: int) -> Iterator[_Operation]:
    """Yield the operations that `backend` has, on values in [0, 1) and an image in [-1, 1)."""
    generator, camera = np.random.default_rng(1), case.camera
    values = generator.random((len(case.gaussians), channels), np.float32)
    image = 2 * generator.random((camera.height, camera.width, channels), np.float32) - 1
    ahead = camera.world_to_camera.copy()
    ahead[2, 3] -= 1e-3
    cameras, turn = (camera, replace(camera, world_to_camera=ahead)), iter(range(sys.maxsize))

    def frame() -> Array:
        # The camera moves, so that a backend that caches the order must sort again.
        return backend.view(case.gaussians, cameras[next(turn) % 2]).splat(values)[0]

    if backend.name != "opengl":  # which projects in its first draw
        yield "project", lambda: backend.view(case.gaussians, camera), None
    yield "frame", frame, None
    view: Any = backend.view(case.gaussians, camera)
    yield "splat", lambda: view.splat(values), lambda exact: exact.splat_error(view.splat(values)[0], values)
    if hasattr(view, "gather"):
        yield "gather", lambda: view.gather(image), lambda exact: exact.gather_error(view.gather, image)
    if hasattr(view, "backward"):
        backward = partial(view.backward, values)
        yield (
            "backward",
            lambda: backward(image),
            lambda exact: exact.gather_error(lambda y: backward(y).values, image),
        )


def _timed(call: Callable[[], Any]) -> tuple[float, float | None]:
    """Return the median seconds of a call, and the first one's rise of the resident set in MiB."""
    times: list[float] = []
    before, peak = restart_peak(), None
    while len(times) < 4 or (len(times) < 16 and sum(times[1:]) < 0.3):
        start = time.perf_counter()
        kept = call()
        times.append(time.perf_counter() - start)
        if len(times) == 1:
            highest = peak_memory()
            peak = None if before is None or highest is None else max(highest - before, 0) / 2**20
        del kept
        if times[0] > 2.0:
            return times[0], peak
    return float(np.median(times[1:])), peak


# The reference.


@dataclass(frozen=True, eq=False)
class ReferenceWindow:
    """The float64 reference in the central window of a view of N Gaussians, which may be millions.

    The reference draws Gaussians one by one, so a whole image of a million takes minutes. The window's pixels
    depend only on the Gaussians that reach into it; projected by the whole image's camera (as the Jacobian's
    clamp depends on the image's size) and shifted, they give exactly the pixels of the whole image.

    Pixels where rounding may decide a cut-off (an alpha of about 1/255, a transmittance of about 1e-4) are
    the *band*: a flip there exceeds all other errors, so flips are counted, and errors are stated without the
    band.
    """

    at: tuple[slice, slice]  # rows and columns of the image
    rows: Array  # (K,) ascending: the Gaussians that reach into it
    weights: scipy.sparse.csr_array  # (h * w, K) their exact blending weights alpha_i T_i
    band: Array  # (h, w) bool: pixels near a cut-off

    def splat(self, values: Array) -> Array:
        """Return the (h, w, C) float64 image of the window from (N, C) values."""
        return np.reshape(self.weights @ values[self.rows].astype(np.float64), (*self.band.shape, -1))

    def splat_error(self, image: Array, values: Array) -> Error:
        """Return the error of a backend's (H, W, C) `image` of `values`."""
        errors = np.abs(image[self.at] - self.splat(values)).max(-1, initial=0)
        off = float(errors[~self.band].max(initial=0))
        flips = int((errors[self.band] > max(_FLIP, 2 * off)).sum())
        return Error(float(errors.max()), off, flips)

    def gather_error(self, gather: Callable[[Array], Array], image: Array) -> Error:
        """Return the error of a backend's (H, W, C) -> (N, C), of `image` with 0 in the band and outside."""
        masked = np.zeros_like(image)
        masked[self.at] = image[self.at] * ~self.band[..., None]
        values = gather(masked)
        want = np.zeros(values.shape)
        want[self.rows] = self.weights.T @ masked[self.at].reshape(-1, image.shape[2]).astype(np.float64)
        off = float(np.abs(values - want).max(initial=0))
        return Error(off, off, 0)


def reference_window(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA
) -> ReferenceWindow:
    """Return the window of the reference; takes about 0.1 ms for each Gaussian that reaches into it."""
    footprints = project(gaussians, camera, settings)
    reach = rim(footprints, settings, _BAND)
    width, height = size = np.minimum(WINDOW, (camera.width, camera.height))
    start = (np.array([camera.width, camera.height]) - size) // 2
    low, high = footprints.means_px - reach, footprints.means_px + reach
    inside = (high > start).all(1) & (low < start + size).all(1) & (footprints.opacities > 0)
    rows = np.flatnonzero(inside)
    own = {column.name: getattr(footprints, column.name)[rows] for column in fields(Footprints)}
    moved = Footprints(**own | {"means_px": own["means_px"] - start})
    view = ReferenceView(moved, replace(camera, width=int(width), height=int(height)), settings)
    pixels = np.arange(width * height).reshape(height, width)
    indices, where, weights = [np.empty(0, int)], [np.empty(0, int)], [np.empty(0)]
    for step in view.steps():
        hit = step.weights > 0
        where.append(pixels[step.window][hit])
        weights.append(step.weights[hit])
        indices.append(np.full(len(where[-1]), step.index))
    entries = (np.concatenate(weights), (np.concatenate(where), np.concatenate(indices)))
    matrix = scipy.sparse.csr_array(entries, shape=(width * height, len(rows)))
    (left, top), (right, bottom) = start, start + size
    return ReferenceWindow((slice(top, bottom), slice(left, right)), rows, matrix, view.cut_off_band(_BAND))


# The report.


def table(rows: Sequence[Measurement]) -> str:
    """Return the measurements as a Markdown table."""
    head = ["scene", "Gaussians", "size", "channels", "operation", "backend", "ms", "MiB"]
    lines: list[list[object]] = []
    for r in rows:
        case = [r.scene, r.gaussians, f"{r.width}x{r.height}", r.channels, r.operation, r.backend]
        cost = [f"{r.milliseconds:.4g}", "-" if r.peak_mib is None else f"{r.peak_mib:.1f}"]
        error: list[object] = ["-", "-", "-"]
        if r.error is not None:
            error = [f"{r.error.off_cuts:.1e}", f"{r.error.largest:.1e}", r.error.flips]
        lines.append([*case, *cost, *error])
    return markdown([*head, "error off cut-offs", "largest error", "flips"], lines)
