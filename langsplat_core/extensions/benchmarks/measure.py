"""Time, error and memory of every operation of a rasterizer on one view, in one run.

* Time: median of the calls that fit into 0.3 seconds (at least three), after a first call that is not
  counted. A call of more than two seconds is measured once.
* Error: against the float64 reference (`ReferenceWindows`), from a call of its own.
* Memory: how far the process's resident set rises at its highest during the first call, with the heap's
  free pages given back before. It counts everything: arrays of NumPy, PyTorch's, kernels' own, and what a
  software OpenGL driver holds. Linux only; elsewhere unknown.
"""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.extensions.benchmarks.config import peak_memory, restart_peak
from langsplat_core.raster.protocol import LiftingView, Rasterizer
from langsplat_core.raster.reference import Footprints, ReferenceView, project, rim
from langsplat_core.scene import Camera, Gaussians, look_at

GRIDS = ((16, 12), (8, 6), (4, 3))  # cells of subparts, parts and wholes: 252 labels in all
MIB = 2**20
_CALLS, _BUDGET_S = 15, 0.3  # at most this many calls, begun within this time
_ONCE_S = 2.0  # a call that takes longer is its own measurement
_WINDOW = 64  # pixels a side
_PLACES = ((0.5, 0.5), (0.3, 0.42), (0.64, 0.7))  # centres of the windows, as fractions of the image
_BAND = 1e-3  # relative distance to a cut-off; float32 footprints of a GPU are within about 3e-4 of it
_DIFFERENTIATED = ("means", "log_scales", "quats_wxyz", "opacity_logits")
_DIRECTIONS, _STEP = 2, 3e-6  # along which derivatives are compared, and how far each way
_FLIP = 2e-5  # an error in the band is a flip if larger than this and than twice all others


def markdown(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a Markdown table that ends with a newline."""
    lines = ["| " + " | ".join(map(str, line)) + " |\n" for line in (head, *rows)]
    return "".join([lines[0], "|" + "---|" * len(head) + "\n", *lines[1:]])


@dataclass(frozen=True, eq=False)
class Case:
    """A scene and the camera that sees it."""

    scene: str  # "random", or the name of a file
    gaussians: Gaussians
    camera: Camera


def random_scene(count: int) -> Gaussians:
    """`count` small Gaussians in a unit ball, sized so that the image's coverage does not grow with it."""
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
    milliseconds: float | None = None  # median; None: not run, see `note`
    fastest: float | None = None  # milliseconds
    calls: int = 0
    peak_mib: float | None = None  # rise of the resident set; None: unknown
    # None: not compared. Of "backward": of a derivative along random directions, relative to its terms' norm.
    largest_error: float | None = None
    error_off_cuts: float | None = None  # away from cut-offs
    flips: int | None = None  # pixels near a cut-off that came out on its other side
    note: str = ""


@dataclass(frozen=True)
class Error:
    """Differences from the reference."""

    largest: float  # over all pixels compared
    off_cuts: float  # over those where no cut-off is near
    flips: int  # pixels near a cut-off that came out on its other side


@dataclass(frozen=True)
class Operation:
    """An operation of a backend on a view, to be timed."""

    name: str
    call: Callable[[], Any]
    error: Callable[[], Error] | None = None


class Foresight:
    """Expected seconds of operations: time grows with the overlaps of footprints and tiles."""

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._rates: dict[tuple[str, str, int], float] = {}  # seconds per overlap

    def expected(self, key: tuple[str, str, int], overlaps: int) -> float:
        """Return the expected seconds; 0 where nothing like it ran before."""
        return self._rates.get(key, 0.0) * overlaps

    def learn(self, key: tuple[str, str, int], overlaps: int, seconds: float) -> None:
        self._rates[key] = seconds / max(overlaps, 1)


def label(backend: Rasterizer) -> str:
    """Return the backend's name, with the precision where it offers several."""
    return f"{backend.name} {getattr(backend, 'precision', '')}".strip()


def warm_up(backends: Sequence[Rasterizer], channels: Sequence[int]) -> None:
    """Compile and load everything on a tiny scene, so that no measurement contains it."""
    case = Case("random", random_scene(200), default_camera(40, 30))
    for backend in backends:
        for count in channels:
            for operation in operations(backend, case, count, None):
                operation.call()


def measure(
    backend: Rasterizer, case: Case, channels: int, exact: "ReferenceWindows", foresight: Foresight
) -> Iterator[Measurement]:
    """Time every operation of `backend` on one case."""
    drawn = exact.footprints.opacities > 0
    overlaps = int(np.prod(2 * exact.footprints.extents_px / 16 + 1, axis=1)[drawn].sum())
    camera, backend_name = case.camera, label(backend)
    for operation in operations(backend, case, channels, exact):
        key = (backend_name, operation.name, channels)
        drawn_at = (len(case.gaussians), camera.width, camera.height)
        row = Measurement(case.scene, *drawn_at, channels, operation.name, backend_name)
        expected = foresight.expected(key, overlaps)
        if expected > foresight.limit_s:
            yield replace(row, note=f"not run: about {expected:.0f} s expected")
            continue
        times, peak = _timed(operation.call)
        foresight.learn(key, overlaps, float(np.median(times)))
        milliseconds = 1e3 * float(np.median(times))
        row = replace(
            row, milliseconds=milliseconds, fastest=1e3 * min(times), calls=len(times), peak_mib=peak
        )
        if operation.error is not None:
            error = operation.error()
            row = replace(row, largest_error=error.largest, error_off_cuts=error.off_cuts, flips=error.flips)
        yield row


def operations(
    backend: Rasterizer, case: Case, channels: int, exact: "ReferenceWindows | None"
) -> Iterator[Operation]:
    """Return the operations that `backend` has; without `exact` their errors are not measured."""
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
    yield from _linear(view, values, image, exact, "")
    if hasattr(view, "backward"):
        wrong = None if exact is None else lambda: _gradient_error(view, case, values, image, exact)
        yield Operation("backward", lambda: view.backward(values, image), wrong)
    if isinstance(view, LiftingView):
        yield _labels(view, case.camera, exact)
    if isinstance(view, LiftingView) and view.frozen() is not view:
        yield Operation("freeze", view.frozen)
        yield from _linear(view.frozen(), values, image, exact, "frozen ")


def _linear(
    view: Any, values: Array, image: Array, exact: "ReferenceWindows | None", prefix: str
) -> Iterator[Operation]:
    """Return the operation `splat` and, where the view has it, `gather`."""
    splat_error = None if exact is None else lambda: exact.splat_error(view.splat(values)[0], values)
    yield Operation(f"{prefix}splat", lambda: view.splat(values), splat_error)
    if hasattr(view, "gather"):

        def gather_error() -> Error:
            assert exact is not None  # only called with one
            masked = exact.masked(image)
            return exact.gather_error(view.gather(masked), masked)

        yield Operation(
            f"{prefix}gather", lambda: view.gather(image), None if exact is None else gather_error
        )


def _labels(view: LiftingView, camera: Camera, exact: "ReferenceWindows | None") -> Operation:
    """Gathering of label maps of three levels (`GRIDS`), with as many regions as a segmenter finds."""
    maps, count = label_maps(camera)

    def error() -> Error:
        assert exact is not None  # only called with one
        compared = exact.masked(np.ones((camera.height, camera.width, 1), np.float32))[..., 0] > 0
        kept = np.where(compared, maps, -1)
        image = np.stack([(kept == label).any(0) for label in range(count)], -1).astype(np.float32)
        return exact.gather_error(view.gather_labels(kept, count).toarray(), image)

    return Operation("labels", lambda: view.gather_labels(maps, count), None if exact is None else error)


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
    """Return the camera, and one that has moved ahead by a thousandth of a world unit."""
    moved = camera.world_to_camera.copy()
    moved[2, 3] -= 1e-3
    return camera, replace(camera, world_to_camera=moved)


def _gradient_error(view: Any, case: Case, values: Array, image: Array, exact: "ReferenceWindows") -> Error:
    """Return the error of `backward` against central differences of the float64 reference.

    Derivatives are compared along random directions of all parameters at once.
    """
    masked, scene = exact.masked(image), case.gaussians.take(exact.rows)
    got = view.backward(values, masked)
    features, generator, worst = values[exact.rows], np.random.default_rng(2), 0.0
    for _ in range(_DIRECTIONS):
        steps = {name: generator.normal(size=getattr(scene, name).shape) for name in _DIFFERENTIATED}
        steps["means"] *= np.exp(scene.log_scales).min(1, keepdims=True)
        there, back = (
            replace(
                scene, **{name: getattr(scene, name) + sign * _STEP * step for name, step in steps.items()}
            )
            for sign in (1, -1)
        )
        moved = generator.normal(size=features.shape)
        change = _pulled(there, features + _STEP * moved, case.camera, masked)
        change -= _pulled(back, features - _STEP * moved, case.camera, masked)
        terms = [2 * _STEP * moved * got.values[exact.rows]]
        for name in _DIFFERENTIATED:  # as far as they went in float32
            went = getattr(there, name).astype(np.float64) - getattr(back, name)
            terms.append(went * getattr(got, name)[exact.rows])
        joined = np.concatenate([term.ravel() for term in terms])
        worst = max(worst, abs(float(joined.sum()) - change) / max(float(np.linalg.norm(joined)), 1e-30))
    return Error(worst, worst, 0)


def _pulled(scene: Gaussians, features: Array, camera: Camera, masked: Array) -> float:
    """Return the product of `masked` (H, W, C) and the reference's image of (K, C) features, float64."""
    drawn = reference_windows(scene, camera)
    return float((drawn.gather(masked) * features[drawn.rows]).sum())


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


@dataclass(frozen=True, eq=False)
class ReferenceWindow:
    """Part of an image and its exact blending weights."""

    at: tuple[slice, slice]  # rows and columns of the image
    weights: scipy.sparse.csr_array  # (pixels, K) alpha_i T_i, K = len(ReferenceWindows.rows)
    band: Array  # (h, w) bool: pixels near a cut-off


@dataclass(frozen=True, eq=False)
class ReferenceWindows:
    """The float64 reference on three small windows of one view of N Gaussians, which may be millions.

    The reference draws Gaussians one by one, so a whole image of a million of them takes minutes. A window's
    pixels depend only on the Gaussians that reach into it; projected by the whole image's camera (as the
    Jacobian's clamp depends on the image's size) and shifted, they give exactly the pixels of the whole.

    Pixels where rounding may decide a cut-off (an alpha of just 1/255, a transmittance of just 1e-4) are the
    *band*: there one flip outweighs every other error, so flips are counted and the error is stated without
    them.
    """

    footprints: Footprints  # of all N
    rows: Array  # (K,) ascending: the Gaussians that reach into a window
    windows: tuple[ReferenceWindow, ...]

    def splat(self, values: Array) -> list[Array]:
        """(N, C) -> each window's (h, w, C) image, float64."""
        x = values[self.rows].astype(np.float64)
        return [(w.weights @ x).reshape(*w.band.shape, -1) for w in self.windows]

    def splat_error(self, image: Array, values: Array) -> Error:
        """Error of the (H, W, C) `image` that a backend made from `values`."""
        errors = [
            np.abs(image[window.at] - want).max(-1, initial=0)
            for window, want in zip(self.windows, self.splat(values), strict=True)
        ]
        pairs = list(zip(errors, self.windows, strict=True))
        off = max(float(error[~window.band].max(initial=0)) for error, window in pairs)
        flips = sum(int((error[window.band] > max(_FLIP, 2 * off)).sum()) for error, window in pairs)
        return Error(max(float(error.max()) for error in errors), off, flips)

    def masked(self, image: Array) -> Array:
        """Return `image` with 0 outside the windows and in their bands.

        This is what a backend must gather to be compared: a window knows nothing of the pixels outside.
        """
        kept = np.zeros_like(image)
        for window in self.windows:
            kept[window.at] = image[window.at] * ~window.band[..., None]
        return kept

    def gather(self, masked: Array) -> Array:
        """(H, W, C) image from `masked` -> (K, C) values of the Gaussians `rows`, float64; others get 0."""
        # Windows may overlap: every pixel counts once.
        left = masked.astype(np.float64)
        total = np.zeros((len(self.rows), masked.shape[2]))
        for window in self.windows:
            total += window.weights.T @ left[window.at].reshape(-1, masked.shape[2])
            left[window.at] = 0
        return total

    def gather_error(self, values: Array, masked: Array) -> Error:
        """Error of the (N, C) `values` that a backend gathered from `masked`; off the cut-offs alone."""
        want = np.zeros(values.shape)
        want[self.rows] = self.gather(masked)
        off = float(np.abs(values - want).max(initial=0))
        return Error(off, off, 0)


def reference_windows(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA
) -> ReferenceWindows:
    """Draw the windows with the reference; about 0.1 ms for each Gaussian that reaches into one."""
    footprints = project(gaussians, camera, settings)
    places = [_place(camera, fraction) for fraction in _PLACES]
    reaching = [np.flatnonzero(_reaches(footprints, settings, at)) for at in places]
    rows = np.unique(np.concatenate(reaching))
    windows = []
    for at, mine in zip(places, reaching, strict=True):
        columns = (len(rows), np.searchsorted(rows, mine))
        windows.append(_window(_take(footprints, mine), camera, settings, at, columns))
    return ReferenceWindows(footprints, rows, tuple(windows))


def _reaches(footprints: Footprints, settings: RasterSettings, at: tuple[slice, slice]) -> Array:
    """(N,) bool: drawn, and not wholly outside the window."""
    rows, columns = at
    reach = rim(footprints, settings, _BAND)
    low, high = footprints.means_px - reach, footprints.means_px + reach
    inside = (high > (columns.start, rows.start)) & (low < (columns.stop, rows.stop))
    return inside.all(1) & (footprints.opacities > 0)


def _take(f: Footprints, rows: Array) -> Footprints:
    return Footprints(f.means_px[rows], f.depths[rows], f.conics[rows], f.extents_px[rows], f.opacities[rows])


def _place(camera: Camera, fraction: tuple[float, float]) -> tuple[slice, slice]:
    slices = []
    for size, part in ((camera.height, fraction[1]), (camera.width, fraction[0])):
        start = min(max(round(size * part) - _WINDOW // 2, 0), max(size - _WINDOW, 0))
        slices.append(slice(start, min(start + _WINDOW, size)))
    return slices[0], slices[1]


def _window(
    footprints: Footprints,
    camera: Camera,
    settings: RasterSettings,
    at: tuple[slice, slice],
    place: tuple[int, Array],
) -> ReferenceWindow:
    """`place`: how many columns the matrix has, and the column of each footprint."""
    count, where_to = place
    rows, columns = at
    height, width = rows.stop - rows.start, columns.stop - columns.start
    moved = replace(footprints, means_px=footprints.means_px - (columns.start, rows.start))
    view = ReferenceView(moved, replace(camera, width=width, height=height), settings, dropped=0)
    pixels = np.arange(height * width).reshape(height, width)
    indices, where, weights = [np.empty(0, int)], [np.empty(0, int)], [np.empty(0)]
    for step in view.steps():
        hit = step.weights > 0
        where.append(pixels[step.window][hit])
        weights.append(step.weights[hit])
        indices.append(np.full(len(where[-1]), where_to[step.index]))
    entries = (np.concatenate(weights), (np.concatenate(where), np.concatenate(indices)))
    matrix = scipy.sparse.csr_array(entries, shape=(height * width, count))
    return ReferenceWindow(at, matrix, view.cut_off_band(_BAND))
