"""Time, error and memory of one operation after another, for every rasterizer, in one run.

* Time: median of the calls that fit into 0.3 seconds (at least three), after a first call that is not
  counted. A call of more than two seconds is measured once.
* Error: against the float64 reference (`bench_truth`), from a call of its own.
* Memory: how far the process's resident set rises at its highest during the first call, with the heap's
  free pages given back before. It counts everything: arrays of NumPy, PyTorch's, kernels' own, and what a
  software OpenGL driver holds. Linux only; elsewhere unknown.
"""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from langsplat_core.arrays import Array
from langsplat_core.lab.speed.cases import Case, default_camera, random_scene
from langsplat_core.lab.speed.resident import peak_memory, restart_peak
from langsplat_core.lab.speed.torch_baseline import TorchRasterizer
from langsplat_core.lab.speed.truth import Error, Truth
from langsplat_core.raster.protocol import LiftingView, Rasterizer
from langsplat_core.scene import Camera

GRIDS = ((16, 12), (8, 6), (4, 3))  # cells of subparts, parts and wholes: 252 labels in all
_CALLS, _BUDGET_S = 15, 0.3  # at most this many calls, begun within this time
_ONCE_S = 2.0  # a call that takes longer is its own measurement
MIB = 2**20


@dataclass(frozen=True)
class Measurement:
    """One backend doing one operation."""

    scene: str
    gaussians: int
    width: int
    height: int
    channels: int
    operation: str
    backend: str
    milliseconds: float | None  # median; None: not run, see `note`
    fastest: float | None  # milliseconds
    calls: int
    peak_mib: float | None  # rise of the resident set; None: unknown
    largest_error: (
        float | None
    )  # None: not compared. Of "backward": relative to each gradient's largest entry
    error_off_cuts: float | None  # away from cut-offs
    flips: int | None  # pixels near a cut-off that came out on its other side
    note: str = ""


@dataclass(frozen=True)
class Operation:
    """Something a backend can do with a view."""

    name: str
    call: Callable[[], Any]
    error: Callable[[], Error] | None = None


class Foresight:
    """What is likely to take too long is not begun: time grows with the overlaps of footprints and tiles."""

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._rates: dict[tuple[str, str, int], float] = {}  # seconds per overlap

    def expected(self, key: tuple[str, str, int], overlaps: int) -> float:
        """Seconds; 0 where nothing like it ran before."""
        return self._rates.get(key, 0.0) * overlaps

    def learn(self, key: tuple[str, str, int], overlaps: int, seconds: float) -> None:
        self._rates[key] = seconds / max(overlaps, 1)


def label(backend: Rasterizer) -> str:
    """Its name, with the precision where it offers several."""
    return f"{backend.name} {getattr(backend, 'precision', '')}".strip()


def warm_up(backends: Sequence[Rasterizer], channels: Sequence[int]) -> None:
    """Compile and load everything on a tiny scene, so that no measurement contains it."""
    case = Case("random", random_scene(200), default_camera(40, 30))
    for backend in backends:
        for count in channels:
            for operation in operations(backend, case, count, None):
                operation.call()


def measure(
    backend: Rasterizer, case: Case, channels: int, truth: Truth, foresight: Foresight
) -> Iterator[Measurement]:
    """Every operation of `backend` on one case."""
    overlaps = int(
        np.prod(2 * truth.footprints.extents_px / 16 + 1, axis=1)[truth.footprints.opacities > 0].sum()
    )
    for operation in operations(backend, case, channels, truth):
        key = (label(backend), operation.name, channels)
        expected = foresight.expected(key, overlaps)
        row = Measurement(
            case.scene, len(case.gaussians), case.camera.width, case.camera.height, channels, operation.name,
            label(backend), None, None, 0, None, None, None, None,
        )  # fmt: skip
        if expected > foresight.limit_s:
            yield replace(row, note=f"not run: about {expected:.0f} s expected")
            continue
        times, peak = _timed(operation.call)
        foresight.learn(key, overlaps, float(np.median(times)))
        error = operation.error() if operation.error is not None else None
        yield replace(
            row,
            milliseconds=1e3 * float(np.median(times)),
            fastest=1e3 * min(times),
            calls=len(times),
            peak_mib=peak,
            largest_error=None if error is None else error.largest,
            error_off_cuts=None if error is None else error.off_cuts,
            flips=None if error is None else error.flips,
        )


def operations(backend: Rasterizer, case: Case, channels: int, truth: Truth | None) -> Iterator[Operation]:
    """What `backend` can do; without `truth` nothing is compared."""
    values, image = _inputs(case, channels)
    cameras = _two_cameras(case.camera)
    turn = iter(range(sys.maxsize))

    def frame() -> Array:
        # The camera moves: a backend that keeps the last order must sort again.
        return backend.view(case.gaussians, cameras[next(turn) % 2]).splat(values)[0]

    if backend.name != "opengl":  # projects in its first draw
        yield Operation("project", lambda: backend.view(case.gaussians, case.camera))
    yield Operation("frame", frame)
    view: Any = backend.view(case.gaussians, case.camera)
    yield from _linear(view, values, image, truth, "")
    if hasattr(view, "backward"):
        wrong = (
            None if truth is None else lambda: _gradient_error(view, case, values, truth.masked(image), truth)
        )
        yield Operation("backward", lambda: view.backward(values, image), wrong)
    if type(view).gather_labels is not LiftingView.gather_labels:
        yield _labels(view, case.camera, truth)
    if type(view).frozen is not LiftingView.frozen:
        yield Operation("freeze", view.frozen)
        yield from _linear(view.frozen(), values, image, truth, "frozen ")


def _linear(view: Any, values: Array, image: Array, truth: Truth | None, prefix: str) -> Iterator[Operation]:
    """`splat` and, where there is one, `gather`."""
    splat_error = None if truth is None else lambda: truth.splat_error(view.splat(values)[0], values)
    yield Operation(f"{prefix}splat", lambda: view.splat(values), splat_error)
    if hasattr(view, "gather"):

        def gather_error() -> Error:
            assert truth is not None  # only called with one
            masked = truth.masked(image)
            return truth.gather_error(view.gather(masked), masked)

        yield Operation(
            f"{prefix}gather", lambda: view.gather(image), None if truth is None else gather_error
        )


def _labels(view: LiftingView, camera: Camera, truth: Truth | None) -> Operation:
    """Label maps of three levels (`GRIDS`), as many regions as a segmenter finds."""
    maps, count = label_maps(camera)

    def error() -> Error:
        assert truth is not None  # only called with one
        compared = truth.masked(np.ones((camera.height, camera.width, 1), np.float32))[..., 0] > 0
        kept = np.where(compared, maps, -1)
        image = np.stack([(kept == label).any(0) for label in range(count)], -1).astype(np.float32)
        return truth.gather_error(view.gather_labels(kept, count).toarray(), image)

    return Operation("labels", lambda: view.gather_labels(maps, count), None if truth is None else error)


def label_maps(camera: Camera) -> tuple[Array, int]:
    """(3, H, W) int32 labels of three grids of cells, and how many labels there are."""
    row, column = np.mgrid[: camera.height, : camera.width]
    maps, first = [], 0
    for across, down in GRIDS:
        cell = row * down // camera.height * across + column * across // camera.width
        maps.append(first + cell)
        first += across * down
    return np.stack(maps).astype(np.int32), first


def _inputs(case: Case, channels: int) -> tuple[Array, Array]:
    """(N, C) values in [0, 1) and an (H, W, C) image in [-1, 1)."""
    generator = np.random.default_rng(1)
    values = generator.random((len(case.gaussians), channels), np.float32)
    shape = (case.camera.height, case.camera.width, channels)
    return values, 2 * generator.random(shape, np.float32) - 1


def _two_cameras(camera: Camera) -> tuple[Camera, Camera]:
    """The camera, and one that has moved ahead by a thousandth of a world unit."""
    moved = camera.world_to_camera.copy()
    moved[2, 3] -= 1e-3
    return camera, replace(camera, world_to_camera=moved)


def _gradient_error(view: Any, case: Case, values: Array, masked: Array, truth: Truth) -> Error:
    """Largest error of `backward`'s gradients, each relative to its greatest entry.

    The truth is float64 autograd through the PyTorch baseline, which knows nothing of the CPU's derivatives.
    """
    got = view.backward(values, masked)
    exact = TorchRasterizer(torch.float64).view(case.gaussians.take(truth.rows), case.camera)
    want = exact.backward(values[truth.rows], masked)
    worst = 0.0
    for name in ("means", "log_scales", "quats_wxyz", "opacity_logits", "values", "means_px"):
        right = np.zeros(getattr(got, name).shape)
        right[truth.rows] = getattr(want, name)
        difference = np.abs(getattr(got, name) - right).max(initial=0)
        worst = max(worst, float(difference / max(np.abs(right).max(initial=0), 1e-30)))
    return Error(worst, worst, 0)


def _timed(call: Callable[[], Any]) -> tuple[list[float], float | None]:
    """Seconds of each call, and the first call's rise of the resident set in MiB."""
    before = restart_peak()
    start = time.perf_counter()
    kept = call()
    first = time.perf_counter() - start
    highest = peak_memory()
    peak = None if before is None or highest is None else max(highest - before, 0) / MIB
    del kept
    if first > _ONCE_S:
        return [first], peak
    times: list[float] = []
    while len(times) < 3 or (len(times) < _CALLS and sum(times) < _BUDGET_S):
        start = time.perf_counter()
        kept = call()
        times.append(time.perf_counter() - start)
        del kept
    return times, peak
