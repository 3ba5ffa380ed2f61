"""Gradients of the CPU rasterizer against autograd of a dense float64 twin, and against differences."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from langsplat_core.arrays import logit
from langsplat_core.config import GSPLAT, INRIA
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Gaussians
from tests.support import torch_reference
from tests.support.close import BAND, assert_gradient
from tests.support.scenes import random_camera, random_gaussians, random_values, without_perspective

PARAMETERS = ("means", "log_scales", "quats_wxyz", "opacity_logits")


@pytest.fixture(autouse=True)
def one_thread():
    """torch's threads only wait for each other on tensors this small."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def compare_with_autograd(gaussians, camera, settings=INRIA, channels=3):
    """1e-3 relative for every entry of every gradient; pixels at a cut-off carry no loss."""
    x = random_values(len(gaussians), channels, 1)
    rng = np.random.default_rng(2)
    image_grad = rng.normal(size=(camera.height, camera.width, channels))
    alpha_grad = rng.normal(size=(camera.height, camera.width))
    band = ReferenceRasterizer().view(gaussians, camera, settings).cut_off_band(BAND)
    assert band.mean() < 0.02
    image_grad[band], alpha_grad[band] = 0, 0
    got = CpuRasterizer().view(gaussians, camera, settings).backward(x, image_grad, alpha_grad)

    leaves = torch_reference.parameters(gaussians)
    values = torch.tensor(x, dtype=torch.float64, requires_grad=True)
    image, alpha, means_px = torch_reference.render(leaves, values, camera, settings)
    loss = (image * torch.tensor(image_grad)).sum() + (alpha * torch.tensor(alpha_grad)).sum()
    loss.backward()
    for name in PARAMETERS:
        assert_gradient(name, getattr(got, name), leaves[name].grad.numpy())
    assert_gradient("values", got.values, values.grad.numpy())
    assert_gradient("means_px", got.means_px, means_px.grad.numpy())
    return got


@pytest.mark.parametrize("seed", range(20))
def test_autograd(seed):
    """Every other scene antialiased, every third in the gsplat profile, every fifth mostly opaque."""
    gaussians = random_gaussians(40, seed, scale_range=(0.003, 0.1) if seed % 2 else (0.02, 0.25))
    if seed % 5 == 0:
        gaussians = replace(gaussians, opacity_logits=gaussians.opacity_logits + np.float32(3))
    settings = replace(GSPLAT if seed % 3 == 0 else INRIA, antialiased=bool(seed % 2))
    got = compare_with_autograd(gaussians, random_camera(seed, 32, 22), settings)
    assert (got.opacity_logits != 0).sum() > 15


@pytest.mark.parametrize("antialiased", [False, True])
def test_autograd_without_perspective(antialiased):
    """A Gaussian's depth changes nothing but the order; beside the picture no Jacobian is clamped."""
    gaussians, camera = random_gaussians(50, 3, radius=2.0), random_camera(3, 40, 27, distance=1.5)
    camera = without_perspective(camera, 1.5)
    got = compare_with_autograd(gaussians, camera, replace(INRIA, antialiased=antialiased))
    np.testing.assert_allclose(got.means @ camera.rotation[2], 0, atol=1e-5 * np.abs(got.means).max())


@pytest.mark.long
@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("antialiased", [False, True])
def test_autograd_itself_against_differences(antialiased, orthographic):
    """The twin's gradients by torch's own check in float64; cut-offs are moved to where nothing is left."""
    settings = replace(INRIA, alpha_min=1e-12, transmittance_min=1e-14, antialiased=antialiased)
    gaussians, camera = random_gaussians(4, 10), random_camera(10, 6, 5)
    camera = without_perspective(camera) if orthographic else camera
    gaussians = replace(gaussians, opacity_logits=logit(np.linspace(0.2, 0.8, 4)))
    leaves = torch_reference.parameters(gaussians)
    values = torch.tensor(random_values(4, 2), dtype=torch.float64, requires_grad=True)

    def drawn(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        named = dict(zip(leaves, inputs[:-1], strict=True))
        return torch_reference.render(named, inputs[-1], camera, settings)[:2]

    assert torch.autograd.gradcheck(drawn, (*leaves.values(), values), eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_twin_draws_what_the_reference_draws(antialiased, orthographic):
    """So that its gradients are those of the image formation that is documented."""
    settings = replace(INRIA, antialiased=antialiased)
    gaussians, camera, x = random_gaussians(40, 11), random_camera(11, 40, 27), random_values(40, 3)
    camera = without_perspective(camera) if orthographic else camera
    want, want_alpha = ReferenceRasterizer().view(gaussians, camera, settings).splat(x)
    image, alpha, _ = torch_reference.render(
        torch_reference.parameters(gaussians), torch.tensor(x, dtype=torch.float64), camera, settings
    )
    np.testing.assert_allclose(image.detach(), want, atol=1e-12)
    np.testing.assert_allclose(alpha.detach(), want_alpha, atol=1e-12)


def test_autograd_with_clamped_jacobians():
    """Large Gaussians beside the field of view: the clamped coordinate has no gradient there."""
    gaussians, camera = random_gaussians(50, 3, radius=2.0), random_camera(3, 40, 27, distance=1.5)
    in_camera = gaussians.means @ camera.rotation.T + camera.world_to_camera[:3, 3]
    aside = (np.abs(in_camera[:, 0] / in_camera[:, 2]) > 1.0) & (in_camera[:, 2] > 0.2)
    got = compare_with_autograd(gaussians, camera)
    assert (aside & (got.means != 0).any(1)).sum() >= 3


def test_autograd_of_opaque_needles_and_discs():
    gaussians = random_gaussians(50, 5)
    log_scales, logits = gaussians.log_scales.copy(), gaussians.opacity_logits.copy()
    log_scales[:20] = np.log([0.6, 1e-5, 1e-5])
    log_scales[20:30, 0] = -np.inf
    logits[::3] = 9.0  # alpha is capped in the middle: no gradient there
    got = compare_with_autograd(
        replace(gaussians, log_scales=log_scales, opacity_logits=logits), random_camera(5, 40, 27)
    )
    assert not got.log_scales[20:30, 0].any()


@pytest.mark.parametrize("channels", [1, 5])
def test_autograd_with_other_channels(channels):
    compare_with_autograd(random_gaussians(30, 6), random_camera(6, 33, 20), channels=channels)


def test_differences_of_the_reference():
    """Directional derivatives of the reference itself; its cut-offs are moved to where nothing is left."""
    settings = replace(INRIA, alpha_min=1e-10, transmittance_min=1e-12)
    gaussians, camera = random_gaussians(12, 7), random_camera(7, 24, 18)
    gaussians = replace(gaussians, opacity_logits=logit(np.linspace(0.1, 0.9, 12)))  # none at the cap
    x = random_values(12, 2)
    target = np.random.default_rng(0).normal(size=(18, 24, 2))

    def loss(changed: Gaussians) -> float:
        return float((ReferenceRasterizer().view(changed, camera, settings).splat(x)[0] * target).sum())

    gradients = CpuRasterizer().view(gaussians, camera, settings).backward(x, target)
    rng = np.random.default_rng(8)
    for name in PARAMETERS:
        value = getattr(gaussians, name)
        direction = rng.normal(size=value.shape) * 2e-3
        ahead, back = (replace(gaussians, **{name: value + sign * direction}) for sign in (1, -1))
        step = getattr(ahead, name).astype(np.float64) - getattr(back, name)  # as float32 rounds it
        want = loss(ahead) - loss(back)
        # The third derivative times 2e-3 squared is left over.
        assert np.vdot(getattr(gradients, name), step) == pytest.approx(want, rel=2e-3, abs=1e-5), name


def test_a_descent_step_lowers_the_loss():
    gaussians, camera = random_gaussians(60, 9), random_camera(9, 40, 30)
    x = random_values(60, 3)
    target = np.full((30, 40, 3), 0.5, np.float32)
    before = after = 0.0
    for _ in range(20):
        view = CpuRasterizer().view(gaussians, camera)
        error = view.splat(x)[0] - target
        after = float((error**2).mean())
        before = before or after
        by = view.backward(x, 2 * error / error.size)
        moved = [
            getattr(gaussians, f.name) - 3.0 * getattr(by, f.name)
            for f in fields(gaussians)
            if f.name in PARAMETERS
        ]
        gaussians = Gaussians(*moved, gaussians.sh)
    assert after < 0.9 * before
