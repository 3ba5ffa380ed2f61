"""Rasterizers that load here, comparisons with the reference, OpenGL contexts, and measured figures.

Image formation has steps: an alpha of just 1/255 counts or does not, a transmittance of just 1e-4 stops a
pixel or does not. Pixels where rounding may decide are the *band*: a counted allowance of them may differ.
"""

import ctypes
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import chain
from typing import Any

import moderngl
import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.config import RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.rasterizer import create_egl_context
from langsplat_core.raster.reference import Footprints, ReferenceView, project
from langsplat_core.scene import Camera, Gaussians
from tests.support.gsplat_twin import gsplat_on_cpu

# "cuda-twin": the CUDA backend over gsplat in plain PyTorch, see `gsplat_twin`.
NAMES = (
    "reference",
    "cpu",
    pytest.param("opengl-half", marks=pytest.mark.long),
    "opengl-single",
    "cuda",
    pytest.param("cuda-twin", marks=pytest.mark.slow),
)


def drawn_settings(settings: RasterSettings) -> RasterSettings:
    """Return the settings that the installed gsplat draws with: its cap of alpha is its own."""
    release = tuple(int(part) for part in version("gsplat").split(".")[:2])
    return replace(settings, alpha_max=0.999 if release < (1, 6) else 0.99)


@dataclass(frozen=True)
class Backend:
    """A loaded rasterizer and what it promises."""

    name: str
    raster: Any
    tolerance: float  # of a value in [0, 1], away from cut-offs
    band: float  # relative width of what counts as "at a cut-off"

    @property
    def stops_early(self) -> bool:
        """False where blending cannot end at T <= transmittance_min; a pixel may then hold that much more."""
        return not self.name.startswith("opengl")

    @property
    def gsplat(self) -> bool:
        """Return whether gsplat draws, or its twin."""
        return self.name.startswith("cuda")

    @property
    def adjoint_tolerance(self) -> float:
        """Of `gather`, relative to the largest entry.

        gsplat's backward pass begins with 1 - alpha, of which 6e-8 / 1e-4 may be lost where a pixel is full.
        """
        return {"reference": 1e-12, "cuda": 6e-4}.get(self.name, 1e-5)

    def promises(self, footprints: Footprints) -> bool:
        """Return whether `tolerance` holds: with gsplat only where float32 keeps enough of all covariances.

        With k = xx yy / det >= 1, terms of an exponent s add up to 4 k s, and the determinant is a difference
        of k and k - 1 times itself: 40 roundings move an alpha by 40 k s exp(-s) 2^-24, 2e-5 for k = 23.
        """
        xx, xy, yy = footprints.conics[footprints.opacities > 0].T
        return not self.gsplat or bool((xx * yy <= 23 * (xx * yy - xy * xy)).all())

    def expected_settings(self, settings: RasterSettings) -> RasterSettings:
        """With these the reference forms the image that this backend means to form."""
        if self.gsplat:
            return drawn_settings(settings)
        return settings if self.stops_early else replace(settings, transmittance_min=0.0)


# Half floats keep 11 bits and every layer rounds once. Mesa's software driver rounds towards zero, so that
# errors add up: at most 7e-3 and on average 1e-3 for the 150 layers of a random scene.
_PROMISES = {
    "reference": (1e-12, 1e-9),
    "cpu": (2e-5, 1e-4),
    "opengl-half": (8e-3, 1e-3),
    "opengl-single": (2e-5, 1e-3),
    "cuda": (2e-5, 1e-3),
    "cuda-twin": (2e-5, 1e-3),
}


@pytest.fixture
def gsplat_twin() -> Iterator[None]:
    """During the test gsplat is its twin, on the CPU."""
    pytest.importorskip("gsplat")
    with gsplat_on_cpu():
        yield


def _load(name: str, request: pytest.FixtureRequest) -> Any:
    if name == "cuda-twin":
        request.getfixturevalue("gsplat_twin")
        return load_rasterizer("cuda")
    if not name.startswith("opengl"):
        return load_rasterizer(name)
    loaded = request.getfixturevalue("gl_rasterizers")
    request.getfixturevalue("gl")  # after the rasterizers: making them leaves no context current
    return loaded[name.removeprefix("opengl-")]


@pytest.fixture(scope="session")
def gl_rasterizers(gl_session: Any) -> Iterator[dict[str, Any]]:
    """One OpenGL rasterizer per precision for the whole run: their shaders compile slowly."""
    with gl_session:
        loaded = {
            precision: load_rasterizer("opengl", ctx=gl_session, precision=precision)
            for precision in ("half", "single")
        }
    yield loaded
    with gl_session:
        for rasterizer in loaded.values():
            rasterizer.release()


def _backend(request: pytest.FixtureRequest) -> Backend:
    """Each rasterizer in turn; one that cannot load here is skipped with its reason."""
    try:
        return Backend(request.param, _load(request.param, request), *_PROMISES[request.param])
    except BackendError as error:
        pytest.skip(str(error))


backend = pytest.fixture(params=NAMES, name="backend")(_backend)
fast_backend = pytest.fixture(params=NAMES[1:], name="fast_backend")(_backend)  # without the reference


# OpenGL contexts, and figures that accuracy tests measured.


@pytest.fixture(scope="session")
def gl_session() -> Iterator[moderngl.Context]:
    """One offscreen context for the whole run; for what is dear to make. Tests take `gl`."""
    try:
        ctx = create_egl_context()
    except BackendError as error:
        pytest.skip(str(error))
    yield ctx
    ctx.release()


@pytest.fixture
def gl(gl_session: moderngl.Context) -> Iterator[moderngl.Context]:
    """The context, current; a GL error left behind fails the test."""
    with gl_session:
        gl_session.clear_errors()
        yield gl_session
        assert gl_session.error == "GL_NO_ERROR"


def gl_state() -> Array:
    """What a user interface drawn next would trip over, asked of the driver itself."""
    library = ctypes.CDLL("libGL.so.1")
    blend, cull, depth_test, scissor_test = 0x0BE2, 0x0B44, 0x0B71, 0x0C11
    enabled = [int(library.glIsEnabled(flag)) for flag in (blend, cull, depth_test, scissor_test)]
    blend_source, blend_target, blend_equation, viewport, framebuffer = 0x80C9, 0x80C8, 0x8009, 0x0BA2, 0x8CA6
    numbers = []
    for name in (blend_source, blend_target, blend_equation, viewport, framebuffer):
        buffer = (ctypes.c_int * 4)(-1, -1, -1, -1)
        library.glGetIntegerv(name, buffer)
        numbers += list(buffer)
    masks = (ctypes.c_ubyte * 4)()
    library.glGetBooleanv(0x0C23, masks)
    return np.array([*enabled, *numbers, *masks])


Measure = Callable[[str, str, float], None]


@pytest.fixture
def measured(record_property: Callable[[str, object], None]) -> Measure:
    """measured(group, quantity, value): remember one figure; the table shows count, largest and sum."""

    def remember(group: str, quantity: str, value: float) -> None:
        record_property(f"{group}: {quantity}", float(value))

    return remember


def print_measured(reporter: pytest.TerminalReporter) -> None:
    """Print, with `--slow` or `--measured`, everything remembered in this run, by whichever worker."""
    rows: dict[str, list[float]] = {}
    for report in chain.from_iterable(reporter.stats.values()):
        if getattr(report, "when", "") == "call":
            for label, value in report.user_properties:
                rows.setdefault(label, []).append(value)
    if not rows:
        return
    reporter.write_sep("-", "measured")
    reporter.write_line(f"{'':<58} {'count':>6} {'largest':>10} {'sum':>10}")
    for label, values in sorted(rows.items()):
        reporter.write_line(f"{label:<58} {len(values):>6} {max(values):>10.3g} {sum(values):>10.4g}")


# Comparisons with the reference.

BAND = 1e-4  # relative distance to a cut-off; float32 kernels are within about 1e-6 of it


def assert_close_off_cuts(got: Array, want: Array, band: Array, atol: float = 2e-5) -> None:
    """`got` equals `want` within `atol` outside the band, under 2 % of the pixels; half of it may be off."""
    assert got.shape == want.shape
    assert np.isfinite(got).all()
    error = np.abs(got - want).reshape(*band.shape, -1).max(-1)
    assert band.mean() < 0.02, f"{band.sum()} of {band.size} pixels lie at a cut-off: change the scene"
    worst = float(error[~band].max(initial=0))
    assert worst <= atol, f"off by {worst:.2e} in {(error[~band] > atol).sum()} pixels away from cut-offs"
    flipped = error[band] > atol
    assert flipped.sum() <= max(0.5 * band.sum(), 1), f"{flipped.sum()} of {band.sum()} band pixels flipped"


def assert_adjoint(
    splat: Callable[[Array], Array], gather: Callable[[Array], Array], x: Array, y: Array, rtol: float = 1e-5
) -> None:
    """<W x, y> = <x, W^T y>, relative to |W x| |y|."""
    image = splat(x).astype(np.float64)
    left, right = np.vdot(image, y), np.vdot(x.astype(np.float64), gather(y))
    scale = np.linalg.norm(image) * np.linalg.norm(y)
    assert abs(left - right) <= rtol * scale, f"{left} against {right}, scale {scale}"


def assert_gradient(name: str, got: Array, want: Array, largest: float | None = None) -> None:
    """Equal within 1e-3 of each entry, plus 1e-5 of the largest one for float32 sums."""
    allowed = 1e-3 * np.abs(want) + 1e-5 * (np.abs(want).max() if largest is None else largest)
    off = np.abs(got - want) > allowed
    assert not off.any(), f"{name}: {off.sum()} of {off.size} off, worst {np.abs(got - want).max():.2e}"


# Gradients of the float64 reference by central differences: what backward passes are compared with.


PARAMETERS = ("means", "log_scales", "quats_wxyz", "opacity_logits")
STEP = 1e-6  # in every parameter's own unit


@dataclass(frozen=True, eq=False)
class Exact:
    """Gaussians in float64, as the reference reads them; all rows valid."""

    means: Array
    log_scales: Array
    quats_wxyz: Array
    opacity_logits: Array

    def __len__(self) -> int:
        return len(self.means)

    def valid(self) -> Array:
        return np.ones(len(self), bool)


def reference_gradients(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    values: Array,
    image_grad: Array,
    alpha_grad: Array,
    rows: Array | None = None,
) -> dict[str, Array]:
    """Gradients of <image, image_grad> + <alpha, alpha_grad> by parameters, values, pixel means at `rows`.

    Pixels at a cut-off must carry no loss: there the image jumps.
    """
    rows = np.arange(len(gaussians)) if rows is None else rows
    exact = Exact(*(getattr(gaussians, name).astype(np.float64) for name in PARAMETERS))

    def loss(footprints: Footprints) -> float:
        image, alpha = ReferenceView(footprints, camera, settings).splat(values)
        return float((image * image_grad).sum() + (alpha * alpha_grad).sum())

    def drawn(**moved: Array) -> Footprints:
        return project(replace(exact, **moved), camera, settings)  # type: ignore[arg-type]

    def slopes(whole: Array, drawn_with: Callable[[Array], Footprints]) -> Array:
        slopes = np.empty((len(rows), *whole.shape[1:]))
        for place in np.ndindex(slopes.shape):
            step = np.zeros_like(whole)
            step[(int(rows[place[0]]), *place[1:])] = STEP
            high, low = (loss(drawn_with(whole + way * step)) for way in (1, -1))
            slopes[place] = (high - low) / (2 * STEP)
        return slopes

    footprints = drawn()
    found = {
        name: slopes(getattr(exact, name), lambda moved, name=name: drawn(**{name: moved}))
        for name in PARAMETERS
    }
    found["means_px"] = slopes(footprints.means_px, lambda moved: replace(footprints, means_px=moved))
    found["values"] = ReferenceView(footprints, camera, settings).gather(image_grad)[rows]  # linear
    return found
