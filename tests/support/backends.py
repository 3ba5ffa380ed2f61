"""Every rasterizer that loads here, as one fixture, and how far each may be from the reference."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from langsplat_core.config import RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.gsplat import drawn_settings
from langsplat_core.scene import Gaussians
from tests.support.gsplat_twin import gsplat_on_cpu

# "cuda-twin": the CUDA backend over gsplat's kernels in plain PyTorch, see `gsplat_twin`.
NAMES = (
    "reference",
    "cpu",
    pytest.param("opengl-half", marks=pytest.mark.long),
    "opengl-single",
    "cuda",
    pytest.param("cuda-twin", marks=pytest.mark.slow),
)


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
        """Whether gsplat's own Python code draws, over its kernels or over their twin."""
        return self.name.startswith("cuda")

    def promises(self, gaussians: Gaussians, settings: RasterSettings) -> bool:
        """Whether `tolerance` holds. Not for gsplat's needles, whose covariances are formed in 3D in float32,
        nor for its antialiasing of whatever is far smaller than a pixel, which has no floor."""
        spread = np.ptp(gaussians.log_scales, axis=1).max(initial=0)
        return not self.gsplat or bool(spread < np.log(100) and not settings.antialiased)

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
    """During the test gsplat's kernels are their twin's, on the CPU."""
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


@pytest.fixture(params=NAMES)
def backend(request: pytest.FixtureRequest) -> Backend:
    """Each rasterizer in turn; one that cannot load here is skipped with its reason."""
    return _backend(request)


@pytest.fixture(params=NAMES[1:])
def fast_backend(request: pytest.FixtureRequest) -> Backend:
    """The same without the reference."""
    return _backend(request)


def _backend(request: pytest.FixtureRequest) -> Backend:
    try:
        return Backend(request.param, _load(request.param, request), *_PROMISES[request.param])
    except BackendError as error:
        pytest.skip(str(error))
