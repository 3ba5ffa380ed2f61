"""Losses: structural similarity and compiled kernels, against scikit-image and automatic differentiation."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from langsplat_core.training.radiance.losses import (
    blur,
    radiance_loss,
    raw_moments,
    ssim,
    ssim_terms,
)


def pictures(seed: int, shape: tuple[int, int, int] = (31, 40, 3)) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    target = rng.random(shape)
    return torch.tensor(np.clip(target + 0.2 * rng.standard_normal(shape), 0, 1)), torch.tensor(target)


def test_ssim_agrees_with_scikit_image_away_from_the_border() -> None:
    a, b = pictures(0)
    _, want = structural_similarity(
        a.numpy(),
        b.numpy(),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    a1, a2, b1, b2 = ssim_terms(blur(raw_moments(a, b)))
    ours = (a1 * a2 / (b1 * b2)).numpy()
    inside = np.s_[5:-5, 5:-5]  # the border differs: zeros here, reflection there
    np.testing.assert_allclose(ours[inside], want[inside], atol=1e-10)
    assert float(ssim(a, b)) == pytest.approx(ours.mean(), abs=1e-12)


def test_blur_is_its_own_adjoint_and_keeps_constants_inside() -> None:
    a, b = pictures(2)
    assert float((blur(a) * b).sum()) == pytest.approx(float((a * blur(b)).sum()), rel=1e-12)
    flat = blur(torch.ones(20, 30, 1, dtype=torch.float64))
    assert float((flat[5:-5, 5:-5] - 1).abs().max()) < 1e-12
    assert float(flat[0, 0]) < 0.5  # zeros outside


def test_hand_written_gradient_is_the_derivative() -> None:
    a, b = pictures(3, (9, 8, 2))
    assert torch.autograd.gradcheck(lambda x: ssim(x, b), a.clone().requires_grad_(), atol=1e-9)
    assert torch.autograd.gradcheck(lambda x: radiance_loss(x, b, 0.2), a.clone().requires_grad_(), atol=1e-8)


@pytest.mark.parametrize("shape", [(31, 40, 3), (1, 1, 3), (3, 2, 1), (64, 7, 3), (5, 90, 2)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_compiled_loss_equals_the_formula(shape: tuple[int, int, int], weight: float) -> None:
    a, b = pictures(5, shape)
    a[0, 0] = b[0, 0]  # equal pixels have no L1 gradient
    results = []
    for dtype in (torch.float32, torch.float64):
        # float64 copies of the float32 pictures, so that both see the same signs of a - b
        picture = a.float().to(dtype).requires_grad_()
        loss = radiance_loss(picture, b.float().to(dtype), weight)
        loss.backward()
        assert picture.grad is not None
        results.append((float(loss.detach()), picture.grad.double().numpy()))
    (ours, gradient), (want, want_gradient) = results
    assert ours == pytest.approx(want, abs=1e-6)
    # 1e-7: of equal pictures the gradient is a difference of equal numbers, not exactly 0 in float32
    np.testing.assert_allclose(gradient, want_gradient, atol=2e-6 * np.abs(want_gradient).max() + 1e-7)
