"""Laws of rasterizers over random parameters: Hypothesis draws scene, camera and settings.

25 examples per law, 1000 with `--slow`; derandomised, so that every run sees the same ones.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from langsplat_core.config import GSPLAT, INRIA, RasterSettings
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import Camera, Gaussians
from tests.support.backends import Backend
from tests.support.close import assert_adjoint
from tests.support.scenes import random_camera, random_gaussians, random_values, without_perspective

Drawn = tuple[Gaussians, Camera, RasterSettings]


@st.composite
def cases(draw: st.DrawFn) -> Drawn:
    """1 to 30 Gaussians, sizes 1e-6 to 10 world units, opacities from 0 to 1, any camera of both kinds."""
    count, seed = draw(st.integers(1, 30)), draw(st.integers(0, 2**31))
    rng = np.random.default_rng(seed)
    base = random_gaussians(count, seed)
    size, anisotropy = draw(st.floats(-6, 1)), draw(st.floats(0, 6))
    logs = np.log(10.0) * (size - rng.uniform(0, anisotropy, (count, 3)))
    opacity = draw(st.sampled_from([-np.inf, -5.0, -2.0, 0.0, 2.0, 6.0, np.inf]))
    gaussians = replace(
        base,
        means=base.means * draw(st.sampled_from([0.01, 1.0, 3.0])),
        log_scales=logs,
        quats_wxyz=base.quats_wxyz * 10 ** draw(st.floats(-3, 3)),
        opacity_logits=opacity + rng.normal(size=count),
    )
    width, height = draw(st.integers(1, 36)), draw(st.integers(1, 36))
    camera = random_camera(seed, width, height, distance=draw(st.floats(0.05, 6)))
    if draw(st.booleans()):
        camera = without_perspective(camera, draw(st.floats(0.05, 6)))
    profile = draw(st.sampled_from([INRIA, GSPLAT]))
    return gaussians, camera, replace(profile, antialiased=draw(st.booleans()))


def over_random_cases(law: Callable[[Drawn], None], slow: bool, largest: int = 1000) -> None:
    """Run `law` on as many cases as the tier has."""
    examples = settings(
        max_examples=largest if slow else 25, derandomize=True, suppress_health_check=list(HealthCheck)
    )
    examples(given(cases())(law))()


@pytest.fixture
def slow(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("--slow"))


def view_of(backend: Backend, case: Drawn) -> Any:
    return backend.raster.view(*case)


@pytest.mark.long
def test_finite_and_between_0_and_1(backend: Backend, slow: bool) -> None:
    """Values in [0, 1] give an image in [0, alpha], and the weights of a pixel add up to alpha."""

    def law(case: Drawn) -> None:
        n, view = len(case[0]), view_of(backend, case)
        image, alpha = view.splat(np.column_stack([random_values(n, 2), np.ones(n, np.float32)]))
        assert np.isfinite(image).all()
        assert alpha.min() >= 0
        assert alpha.max() <= 1
        assert image.min() >= 0
        assert (image.max(-1) <= alpha + 1e-6).all()
        np.testing.assert_allclose(image[..., 2], alpha, atol=2e-6)
        assert np.isfinite(view.depth()).all()

    over_random_cases(law, slow)


def test_linear(backend: Backend, slow: bool) -> None:
    """W (2 x - 3 y) = 2 W x - 3 W y."""
    atol = {"reference": 1e-12, "opengl-half": 2.5e-2}.get(backend.name, 1e-5)

    def law(case: Drawn) -> None:
        n, view = len(case[0]), view_of(backend, case)
        x, y = (random_values(n, 2, seed).astype(np.float64) for seed in (1, 2))
        mixed = view.splat(2 * x - 3 * y)[0]
        np.testing.assert_allclose(mixed, 2 * view.splat(x)[0] - 3 * view.splat(y)[0], atol=atol)

    over_random_cases(law, slow)


def test_adjoint(backend: Backend, slow: bool) -> None:
    """<W x, y> = <x, W^T y>."""
    if backend.name.startswith("opengl"):
        pytest.skip("it has no adjoint")

    def law(case: Drawn) -> None:
        view, camera = view_of(backend, case), case[1]
        x = random_values(len(case[0]), 3)
        y = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
        assert_adjoint(lambda v: view.splat(v)[0], view.gather, x, y)

    over_random_cases(law, slow)


def test_equal_to_the_reference(fast_backend: Backend, slow: bool) -> None:
    """Away from cut-offs, within the backend's promise."""
    flipped = pixels = 0

    def law(case: Drawn) -> None:
        nonlocal flipped, pixels
        gaussians, camera, raster_settings = case
        if not fast_backend.promises(gaussians, raster_settings):
            return
        x = random_values(len(gaussians), 3)
        expected = fast_backend.expected_settings(raster_settings)
        reference = ReferenceRasterizer().view(gaussians, camera, expected)
        band = reference.cut_off_band(fast_backend.band)
        want, want_alpha = reference.splat(x)
        image, alpha = view_of(fast_backend, case).splat(x)
        error = np.maximum(np.abs(image - want).max(-1), np.abs(alpha - want_alpha))
        flipped += int((error[band] > fast_backend.tolerance).sum())
        pixels += error.size
        assert error[~band].max(initial=0) <= fast_backend.tolerance

    over_random_cases(law, slow)
    assert flipped <= 1e-3 * pixels


def test_gradients_are_finite(slow: bool) -> None:
    """Of the CPU backend; those that are not drawn have none."""

    def law(case: Drawn) -> None:
        gaussians, camera, raster_settings = case
        view = CpuRasterizer().view(gaussians, camera, raster_settings)
        rng = np.random.default_rng(1)
        by_image = rng.normal(size=(camera.height, camera.width, 2))
        gradients = view.backward(random_values(len(gaussians), 2), by_image, by_image[..., 0])
        undrawn = view.radii == 0
        for name, gradient in vars(gradients).items():
            assert np.isfinite(gradient).all(), name
            assert not gradient[undrawn].any(), name

    over_random_cases(law, slow)


def test_without_perspective_a_step_along_the_view_changes_nothing(backend: Backend) -> None:
    """Colours that depend on the view too; a step moves no Gaussian behind the camera."""
    gaussians, camera = random_gaussians(60, 3, sh_degree=3), without_perspective(random_camera(5, 41, 30))
    step = np.eye(4)
    step[2, 3] = 4.0  # a power of two: depths keep their last digit
    moved = replace(camera, world_to_camera=step @ camera.world_to_camera)
    images = []
    for at in (camera, moved):
        drawn = splat_colours(backend.raster.view(gaussians, at), gaussians, at)
        images.append(np.concatenate([drawn.colours, drawn.alpha[..., None]], -1))
    assert images[0].std() > 0.1
    np.testing.assert_allclose(images[1], images[0], atol=max(backend.tolerance, 1e-6))
