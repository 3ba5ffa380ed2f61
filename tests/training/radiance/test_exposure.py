"""Exposures of photographs."""

import numpy as np
import torch

from langsplat_core.training.radiance.exposure import fit_exposure, with_exposure


def test_exposure_is_a_ridge_regression() -> None:
    rng = np.random.default_rng(4)
    image = torch.tensor(rng.random((30, 40, 3)), dtype=torch.float32)
    change = torch.tensor([[1.2, 0.0, 0.1], [0.0, 0.8, 0.0], [0.0, 0.1, 1.0], [0.05, -0.02, 0.0]])
    target = with_exposure(image, change)
    found = fit_exposure([(image[:10], target[:10]), (image[10:], target[10:])], ridge=0.0)
    torch.testing.assert_close(found, change, rtol=1e-4, atol=1e-5)
    x = np.pad(image.reshape(-1, 3).numpy().astype(np.float64), ((0, 0), (0, 1)), constant_values=1.0)
    y, none = target.reshape(-1, 3).numpy().astype(np.float64), np.eye(4, 3)
    hold = 0.5 * (x[:, :3] ** 2).mean() * np.eye(4)
    held = none + np.linalg.solve(x.T @ x / len(x) + hold, x.T @ (y - x @ none) / len(x))
    np.testing.assert_allclose(fit_exposure([(image, target)], ridge=0.5), held, atol=1e-5)
    nothing = torch.zeros((0, 3))
    torch.testing.assert_close(fit_exposure([(nothing, nothing)]), torch.eye(4, 3))
