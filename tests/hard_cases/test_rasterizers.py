"""The table of hard cases on every rasterizer that loads."""

import numpy as np
import pytest

from langsplat_core.errors import BackendError
from langsplat_core.raster.reference import ReferenceRasterizer
from tests.backends import Backend
from tests.close import assert_adjoint, cut_off_band
from tests.hard_cases.cases import CASES, HUGE_IMAGE
from tests.hard_cases.drawings import Case, Seen, draw
from tests.measured import Measure

# What rounding can decide in a pixel: two alphas of 1/255, or one last weight alpha T before T reaches 1e-4,
# which is largest for alpha = 0.99.
MOST_AT_A_CUT_OFF = 2 / 255 + 0.99 * 1e-4 / (1 - 0.99)
NAMED = [pytest.param(case, id=case.name) for case in CASES]


def run_case(case: Case, backend: Backend, measured: Measure) -> None:
    """Everything the table's docstring promises."""
    if case.only and backend.name not in case.only:
        pytest.skip("too long for this backend")
    try:
        seen = draw(backend, case.build())
    except BackendError as error:
        if backend.name != "cuda":
            raise
        pytest.skip(str(error))  # gsplat fixes some settings
    camera, channels = seen.drawing.camera, seen.drawing.features().shape[1]
    assert seen.image.shape == (camera.height, camera.width, channels)
    assert np.isfinite(seen.image).all()
    assert np.isfinite(seen.view.depth()).all()
    assert seen.alpha.shape == (camera.height, camera.width)
    assert seen.alpha.min() >= 0
    assert seen.alpha.max() <= 1
    assert seen.view.dropped == case.dropped == sum(seen.drawing.gaussians.invalid_rows().values())
    if case.compare:
        compare(seen, measured)
    if hasattr(seen.view, "gather"):
        check_adjoint(seen)
    if hasattr(seen.view, "backward"):
        check_gradients(seen)
    case.check(seen)


def compare(seen: Seen, measured: Measure) -> None:
    """The picture is the reference's but at cut-offs, where an alpha of 1/255 may flip."""
    drawing, backend = seen.drawing, seen.backend
    settings = backend.expected_settings(drawing.settings)
    reference = ReferenceRasterizer().view(drawing.gaussians, drawing.camera, settings)
    want, want_alpha = reference.splat(drawing.features())
    band = cut_off_band(reference, backend.band)
    both = np.concatenate([seen.image, seen.alpha[..., None]], -1)
    error = np.abs(both - np.concatenate([want, want_alpha[..., None]], -1)).max(-1)
    worst = float(error[~band].max(initial=0))
    measured(f"hard cases, {backend.name}", "error away from cut-offs", worst)
    measured(f"hard cases, {backend.name}", "pixels flipped", float((error[band] > backend.tolerance).sum()))
    assert worst <= backend.tolerance
    assert error[band].max(initial=0) <= MOST_AT_A_CUT_OFF


def check_adjoint(seen: Seen) -> None:
    """<W x, y> = <x, W^T y>, and nothing for rows that are not drawn."""
    y = np.random.default_rng(1).normal(size=seen.image.shape).astype(np.float32)
    gathered = seen.view.gather(y)
    assert np.isfinite(gathered).all()
    assert not gathered[~seen.drawing.gaussians.valid()].any()
    assert_adjoint(lambda x: seen.view.splat(x)[0], seen.view.gather, seen.drawing.features(), y)


def check_gradients(seen: Seen) -> None:
    """Finite everywhere, exactly zero for dropped rows."""
    rng = np.random.default_rng(2)
    by_image = rng.normal(size=seen.image.shape)
    by_alpha = rng.normal(size=seen.alpha.shape)
    gradients = seen.view.backward(seen.drawing.features(), by_image, by_alpha)
    dropped = ~seen.drawing.gaussians.valid()
    for name, gradient in vars(gradients).items():
        assert np.isfinite(gradient).all(), name
        assert not gradient[dropped].any(), name


@pytest.mark.parametrize("case", NAMED)
def test_hard_case(case: Case, backend: Backend, measured: Measure) -> None:
    run_case(case, backend, measured)


@pytest.mark.slow
def test_huge_image(backend: Backend, measured: Measure) -> None:
    run_case(HUGE_IMAGE, backend, measured)
