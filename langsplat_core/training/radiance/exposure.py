"""Exposure and white balance of a photograph, as an affine change of the scene's colours."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

RIDGE = 0.1  # of the mean square of colours: pulls an exposure towards no change


def fit_exposure(pairs: Sequence[tuple[Tensor, Tensor]], ridge: float = RIDGE) -> Tensor:
    """Return the (4, 3) affine change of colours that best takes images to their targets.

    With the least squared error; (r, g, b, 1) @ change are the new colours. pairs: (..., 3) images and
    targets, at least one pair. ridge: a share of the mean square of colours, by which the change is pulled to
    none.
    """
    device = pairs[0][0].device
    moments = torch.zeros((4, 4), dtype=torch.float64, device=device)
    wanted, count = moments[:, :3], 0
    for image, target in pairs:
        padded = torch.nn.functional.pad(image.detach().reshape(-1, 3).double(), (0, 1), value=1.0)
        moments = moments + padded.T @ padded
        wanted = wanted + padded.T @ target.detach().reshape(-1, 3).double()
        count += len(padded)
    # Black images tell nothing: the second term keeps the system solvable.
    hold = max(ridge * float(moments.diagonal()[:3].mean()), 1e-9 * max(count, 1))
    none = torch.eye(4, dtype=torch.float64, device=device)
    return torch.linalg.solve(moments + hold * none, wanted + hold * none[:, :3]).float()


def with_exposure(image: Tensor, change: Tensor) -> Tensor:
    """Return the (..., 3) image under the (4, 3) affine change of its colours."""
    return image @ change[:3] + change[3]


def no_exposures(views: int, device: torch.device) -> Tensor:
    """Return the (V, 4, 3) changes of colours that change nothing."""
    return torch.eye(4, 3, device=device).repeat(views, 1, 1)


def fit_exposures(pairs: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, float]:
    """Return the (V, 4, 3) exposure of each view beyond what all views have in common, and the gain.

    The gain is by how much the exposures bring images nearer to their targets over all views, dB. pairs:
    (..., 3) image and target of each view.
    """
    common = fit_exposure(pairs)
    pairs = [(with_exposure(image, common), target) for image, target in pairs]
    exposures = torch.stack([fit_exposure([pair]) for pair in pairs])
    before = after = 0.0
    for (image, target), exposure in zip(pairs, exposures, strict=True):
        before += float((image - target).square().sum())
        after += float((with_exposure(image, exposure) - target).square().sum())
    return exposures, 10 * math.log10(max(before, 1e-12) / max(after, 1e-12))
