"""Scores of trained Gaussians: images of views against their photographs."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from langsplat_core.arrays import ViewScore, psnr
from langsplat_core.datasets.capture import Capture, shrunk_view
from langsplat_core.scene import Camera, Gaussians
from langsplat_core.training.radiance.differentiable import Backend, renderer_for
from langsplat_core.training.radiance.exposure import fit_exposure, with_exposure
from langsplat_core.training.radiance.losses import ssim
from langsplat_core.training.radiance.state import start


def evaluate_views(
    gaussians: Gaussians,
    capture: Capture,
    indices: Sequence[int],
    backend: Backend = "auto",
    small: Capture | None = None,
) -> list[ViewScore]:
    """Draw the views at `indices` and score them against the photographs; colours are clamped to [0, 1].

    small: the same views read at 320 px, which images are compared with too, shrunk. A photograph that is
    shrunk twice differs from one that was read at that size, by as much as good images do.
    """
    renderer = renderer_for(backend)
    parameters = start(gaussians, 0, renderer.device).values
    scores = []
    for number, index in enumerate(indices):
        camera, photograph, mask = capture.cameras[index], capture.images[index], capture.mask(index)
        target = torch.tensor(photograph, device=renderer.device).float().div_(255)
        with torch.no_grad():
            rendered = renderer.render(parameters, camera, gaussians.sh_degree)
        image = rendered.image.clamp(0, 1)
        counted = torch.tensor(
            np.ones(photograph.shape[:2], bool) if mask is None else mask, device=renderer.device
        )
        target = torch.where(counted[..., None], target, image)
        similarity = 1 - (1 - float(ssim(image, target))) / max(float(counted.float().mean()), 1e-9)
        scores.append(
            ViewScore(
                camera.name,
                psnr(image[counted].cpu().numpy(), target[counted].cpu().numpy()),
                similarity,
                float((rendered.alpha >= 0.5)[counted].float().mean()),
                _psnr_exposed(image, target, counted),
                None if small is None else _psnr_small(camera, image, small, number),
            )
        )
    return scores


def _psnr_exposed(image: Tensor, target: Tensor, counted: Tensor) -> float | None:
    """PSNR of an image whose halves, left and right, each have the exposure that fits the other best.

    None where a half has no pixel that counts.
    """
    left, right = counted.clone(), counted.clone()
    left[:, image.shape[1] // 2 :] = False
    right[:, : image.shape[1] // 2] = False
    if not (left.any() and right.any()):
        return None
    exposed = [
        with_exposure(image[one], fit_exposure([(image[other], target[other])])).clamp(0, 1)
        for one, other in ((left, right), (right, left))
    ]
    return psnr(torch.cat(exposed).cpu().numpy(), torch.cat([target[left], target[right]]).cpu().numpy())


def _psnr_small(camera: Camera, image: Tensor, small: Capture, number: int) -> float | None:
    """PSNR of an image shrunk to the size of a photograph; None where nothing of that counts."""
    photograph, mask = small.images[number], small.mask(number)
    colours = (255 * image).round().byte().cpu().numpy()
    _, shrunk, _ = shrunk_view(camera, colours, None, (photograph.shape[1], photograph.shape[0]))
    counted = np.ones(shrunk.shape[:2], bool) if mask is None else mask
    return psnr(shrunk[counted] / 255, photograph[counted] / 255) if counted.any() else None
