"""Rendering with gradients by every parameter of the Gaussians, on two backends, and scores of views.

* CPU: the project's own kernels behind a `torch.autograd.Function`; arrays are shared, not copied.
* CUDA: gsplat and its gradients.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from langsplat_core.arrays import Array, ViewScore, near_power, psnr
from langsplat_core.config import INRIA, Device, RasterSettings
from langsplat_core.datasets.capture import Capture, shrunk_view
from langsplat_core.errors import BackendError
from langsplat_core.progress import Progress, silent
from langsplat_core.raster import gsplat, load_rasterizer
from langsplat_core.raster.cpu.projection import colours, colours_backward
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer, CpuView
from langsplat_core.scene import Camera, Gaussians, near_plane
from langsplat_core.scene.transform import C0
from langsplat_core.training.radiance.losses import fit_exposure, patch_means, radiance_loss, with_exposure

PARAMETERS = (*gsplat.RAW, "sh_dc", "sh_rest")


def parameters_of(gaussians: Gaussians, device: torch.device) -> dict[str, Tensor]:
    """Return the raw `PARAMETERS` of Gaussians as tensors; sh is split in degree 0 and the rest."""
    arrays = [*(getattr(gaussians, name) for name in gsplat.RAW), gaussians.sh[:, :1], gaussians.sh[:, 1:]]
    return {name: torch.tensor(array, device=device) for name, array in zip(PARAMETERS, arrays, strict=True)}


def _coefficients(parameters: dict[str, Tensor], sh_degree: int) -> Tensor:
    """Return (N, (degree + 1)^2, 3) coefficients in use, without a copy when degree 0 is all there is."""
    if sh_degree == 0:
        return parameters["sh_dc"]
    return torch.cat([parameters["sh_dc"], parameters["sh_rest"][:, : (sh_degree + 1) ** 2 - 1]], dim=1)


class _CpuImage(torch.autograd.Function):
    """(means, log scales, quaternions, opacity logits, sh, means_px probe) -> (image, alpha, visible).

    The probe, which is not read, gets the gradient by the projected means, which densification needs.
    """

    @staticmethod
    def forward(
        ctx: Any, project: Callable[[Gaussians], CpuView], eye: Any, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        gaussians = Gaussians(*(tensor.detach().numpy() for tensor in parameters[:5]))
        view = project(gaussians)
        values = colours(gaussians.sh, gaussians.means, eye)
        image, alpha = view.splat(values)
        ctx.kept = (gaussians, eye, view, values)
        visible = torch.from_numpy(view.drawn)
        ctx.mark_non_differentiable(visible)
        return torch.from_numpy(image), torch.from_numpy(alpha), visible

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        gaussians, eye, view, values = ctx.kept
        image_grad, alpha_grad, _ = grads
        assert image_grad is not None  # the image always enters the loss
        by = view.backward(values, image_grad.numpy(), None if alpha_grad is None else alpha_grad.numpy())
        sh_grad, means_grad = colours_backward(gaussians.sh, gaussians.means, eye, by.values)
        by_means = by.means + means_grad
        arrays = (by_means, by.log_scales, by.quats_wxyz, by.opacity_logits, sh_grad, by.means_px)
        return (None, None, *(torch.from_numpy(np.asarray(array, np.float32)) for array in arrays))


class CpuRenderer:
    """The backend on the compiled CPU kernels; deterministic."""

    def __init__(self, settings: RasterSettings = INRIA) -> None:
        self.device = torch.device("cpu")
        self._settings, self._rasterizer = settings, CpuRasterizer()

    def render(
        self, parameters: dict[str, Tensor], camera: Camera, sh_degree: int, focal: float | None = None
    ) -> gsplat.DifferentiableImage:
        means, settings = parameters["means"], replace(self._settings, focal=focal)
        probe = torch.zeros(len(means), 2, requires_grad=means.requires_grad)
        image, alpha, visible = _CpuImage.apply(
            lambda gaussians: self._rasterizer.view(gaussians, camera, settings),
            camera.position,
            *(parameters[name] for name in gsplat.RAW),
            _coefficients(parameters, sh_degree),
            probe,
        )
        return gsplat.DifferentiableImage(image, alpha, visible, probe)


class CudaRenderer:
    """The backend on gsplat; `raster.gsplat` says how it differs from the CPU kernels."""

    def __init__(self, settings: RasterSettings = INRIA) -> None:
        self.device, self._settings = torch.device(gsplat.DEVICE), settings
        load_rasterizer("cuda")  # raises BackendError if gsplat does not work

    def render(
        self, parameters: dict[str, Tensor], camera: Camera, sh_degree: int, focal: float | None = None
    ) -> gsplat.DifferentiableImage:
        values = _coefficients(parameters, sh_degree)
        return gsplat.draw(parameters, values, camera, replace(self._settings, focal=focal), sh_degree)


# A backend of radiance training. Parameters and images are on its `device`; `render` draws raw `PARAMETERS`
# with harmonics up to a degree; focal: as of `RasterSettings`.
DifferentiableRenderer = CpuRenderer | CudaRenderer


def rendered_depths(renderer: DifferentiableRenderer, values: dict[str, Tensor], camera: Camera) -> Array:
    """Return (GRID, GRID) mean depths of Gaussians `values` in a view, world units; NaN if alpha <= 0.5."""
    small = camera.resized(64, max(1, round(64 * camera.height / camera.width)))
    means = values["means"].detach().double()
    *forward, offset = camera.world_to_camera[2].tolist()
    z = (means @ means.new_tensor(forward) + offset).clamp(min=0).float()
    length = near_power(max(float(z.median()), 1e-30))  # unit of depth in which colours keep its digits
    grey = ((z / length - 0.5) / C0)[:, None, None].repeat(1, 1, 3)
    with torch.no_grad():
        rendered = renderer.render({**values, "sh_dc": grey}, small, 0)
    depth, alpha = patch_means(rendered.image)[..., 0], patch_means(rendered.alpha[..., None])[..., 0]
    return np.where(alpha > 0.5, length * depth / np.maximum(alpha, 1e-6), np.nan)


def renderer_for(backend: Device, settings: RasterSettings = INRIA) -> DifferentiableRenderer:
    """Return the renderer of a backend; `auto` is CUDA if gsplat draws there, else the CPU.

    Raises BackendError if `cuda` is chosen and cannot work.
    """
    if backend != "auto":
        return CudaRenderer(settings) if backend == "cuda" else CpuRenderer(settings)
    try:
        return CudaRenderer(settings)
    except BackendError:
        return CpuRenderer(settings)


# Scores of trained Gaussians: images of views against their photographs.


def evaluate_views(
    gaussians: Gaussians,
    capture: Capture,
    indices: Sequence[int],
    backend: Device = "auto",
    small: Capture | None = None,
    near: float | None = None,
    progress: Progress = silent,
    antialiased: bool = False,
) -> list[ViewScore]:
    """Return the scores of the views at `indices` against the photographs; colours are clamped to [0, 1].

    small: the same views read at 320 px, with which shrunk images are compared, too, as photographs shrunk
    twice differ. near: the near plane, world units; None: from what cameras see. antialiased: as of `Scene`.
    """
    near = near or near_plane(gaussians, capture.cameras)
    renderer = renderer_for(backend, replace(INRIA, near=near, antialiased=antialiased))
    parameters = parameters_of(gaussians, renderer.device)
    scores = []
    for number, index in enumerate(indices):
        progress("measuring views", number / len(indices))
        camera, mask = capture.cameras[index], capture.mask(index)
        target = torch.tensor(capture.images[index], device=renderer.device).float().div_(255)
        with torch.no_grad():
            rendered = renderer.render(parameters, camera, gaussians.sh_degree)
        image = rendered.image.clamp(0, 1)
        counted = torch.tensor(True if mask is None else mask, device=renderer.device)
        counted = counted.expand(target.shape[:2])
        target = torch.where(counted[..., None], target, image)
        unlike = float(radiance_loss(image, target, 1.0))  # 1 - SSIM
        scores.append(
            ViewScore(
                camera.name,
                psnr(image[counted].cpu().numpy(), target[counted].cpu().numpy()),
                1 - unlike / max(float(counted.float().mean()), 1e-9),
                float((rendered.alpha >= 0.5)[counted].float().mean()),
                _psnr_exposed(image, target, counted),
                None if small is None else _psnr_small(camera, image, small, number),
            )
        )
    return scores


def _psnr_exposed(image: Tensor, target: Tensor, counted: Tensor) -> float | None:
    """Return the PSNR with each half's exposure fitted on the other half; None if a half is masked."""
    left = counted & (torch.arange(image.shape[1], device=counted.device) < image.shape[1] // 2)
    right = counted & ~left
    if not (left.any() and right.any()):
        return None
    exposed = [
        with_exposure(image[one], fit_exposure([(image[other], target[other])])).clamp(0, 1)
        for one, other in ((left, right), (right, left))
    ]
    return psnr(torch.cat(exposed).cpu().numpy(), torch.cat([target[left], target[right]]).cpu().numpy())


def _psnr_small(camera: Camera, image: Tensor, small: Capture, number: int) -> float | None:
    """Return the PSNR of an image shrunk to a small photograph's size; None if no pixel of that counts."""
    photograph, mask = small.images[number], small.mask(number)
    shown = (255 * image).round().byte().cpu().numpy()
    _, shrunk, _ = shrunk_view(camera, shown, None, (photograph.shape[1], photograph.shape[0]))
    counted = np.ones(shrunk.shape[:2], bool) if mask is None else mask
    return psnr(shrunk[counted] / 255, photograph[counted] / 255) if counted.any() else None
