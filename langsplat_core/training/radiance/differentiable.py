"""Rendering with gradients by every parameter of the Gaussians, one small interface, two backends.

* CPU: the project's own kernels behind a `torch.autograd.Function`; arrays are shared, not copied.
* CUDA: gsplat and its gradients.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster import gsplat
from langsplat_core.raster.cpu.projection import colours, colours_backward
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer, CpuView
from langsplat_core.scene import Camera, Gaussians


@dataclass(frozen=True, eq=False)
class Rendered:
    """One image, still attached to the parameters it came from."""

    image: Tensor  # (H, W, 3) blended colours on black, >= 0, not clamped above
    alpha: Tensor  # (H, W) in [0, 1]
    visible: Tensor  # (N,) bool: the Gaussian's extent meets the image
    means_px: Tensor  # its `grad`, after `backward`, is the loss gradient by the projected means, 1/px

    def means_px_grad(self) -> Tensor:
        """Return the (N, 2) gradient; zeros when nothing was differentiated."""
        if self.means_px.grad is None:
            return torch.zeros_like(self.means_px).reshape(-1, 2)
        return self.means_px.grad.reshape(-1, 2)


class DifferentiableRenderer(Protocol):
    """A backend of radiance training."""

    device: torch.device  # where parameters and images live

    def render(self, parameters: dict[str, Tensor], camera: Camera, sh_degree: int) -> Rendered:
        """Draw the raw `parameters` (see `state`) with harmonics up to `sh_degree`."""


def sh_coefficients(parameters: dict[str, Tensor], sh_degree: int) -> Tensor:
    """Return the (N, (degree + 1)^2, 3) coefficients in use, without a copy when degree 0 is all there is."""
    if sh_degree == 0:
        return parameters["sh_dc"]
    rest = parameters["sh_rest"][:, : (sh_degree + 1) ** 2 - 1]
    return torch.cat([parameters["sh_dc"], rest], dim=1)


class _CpuImage(torch.autograd.Function):
    """(means, log scales, quaternions, opacity logits, sh, means_px probe) -> (image, alpha).

    The probe is not read: it is an input only so that autograd hands out the gradient by the projected
    means, which densification needs.
    """

    @staticmethod
    def forward(
        ctx: Any,
        setup: tuple[Callable[[Gaussians], CpuView], Camera, list[Tensor]],
        means: Tensor,
        log_scales: Tensor,
        quats_wxyz: Tensor,
        opacity_logits: Tensor,
        sh: Tensor,
        probe: Tensor,
    ) -> tuple[Tensor, Tensor]:
        project, camera, visible = setup
        gaussians = Gaussians(
            *(t.detach().numpy() for t in (means, log_scales, quats_wxyz, opacity_logits, sh))
        )
        view = project(gaussians)
        values = colours(gaussians.sh, gaussians.means, camera.position)
        image, alpha = view.splat(values)
        visible.append(torch.from_numpy(view.radii > 0))
        ctx.kept = (gaussians, camera, view, values)
        return torch.from_numpy(image), torch.from_numpy(alpha)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        gaussians, camera, view, values = ctx.kept
        image_grad, alpha_grad = grads
        assert image_grad is not None  # the image always enters the loss
        by = view.backward(
            values,
            np.ascontiguousarray(image_grad.numpy()),
            None if alpha_grad is None else np.ascontiguousarray(alpha_grad.numpy()),
        )
        sh_grad, means_grad = colours_backward(gaussians.sh, gaussians.means, camera.position, by.values)
        by_means = by.means + means_grad
        arrays = (by_means, by.log_scales, by.quats_wxyz, by.opacity_logits, sh_grad, by.means_px)
        return (None, *(torch.from_numpy(np.asarray(array, np.float32)) for array in arrays))


class CpuRenderer:
    """`DifferentiableRenderer` on the compiled CPU kernels; deterministic."""

    def __init__(self, settings: RasterSettings = INRIA) -> None:
        self.device = torch.device("cpu")
        self._settings = settings
        self._rasterizer = CpuRasterizer()

    def render(self, parameters: dict[str, Tensor], camera: Camera, sh_degree: int) -> Rendered:
        p = parameters
        probe = torch.zeros(len(p["means"]), 2, requires_grad=p["means"].requires_grad)
        visible: list[Tensor] = []
        image, alpha = _CpuImage.apply(
            (lambda gaussians: self._rasterizer.view(gaussians, camera, self._settings), camera, visible),
            p["means"],
            p["log_scales"],
            p["quats_wxyz"],
            p["opacity_logits"],
            sh_coefficients(p, sh_degree),
            probe,
        )
        return Rendered(image, alpha, visible[0], probe)


class CudaRenderer:
    """`DifferentiableRenderer` on gsplat; `raster.gsplat` says how it differs from the CPU kernels."""

    def __init__(self, settings: RasterSettings = INRIA) -> None:
        self.device = torch.device(gsplat.DEVICE)
        self._settings = settings
        try:
            gsplat.require_device()
        except BackendError as error:
            raise BackendError(f"backend cuda: {error}; use --backend cpu") from error

    def render(self, parameters: dict[str, Tensor], camera: Camera, sh_degree: int) -> Rendered:
        names = ("means", "log_scales", "quats_wxyz", "opacity_logits")
        gaussians = gsplat.DeviceGaussians(**{name: parameters[name] for name in names})
        colours = sh_coefficients(parameters, sh_degree)
        drawn = gsplat.draw(gaussians, colours, camera, self._settings, sh_degree)
        return Rendered(drawn.image, drawn.alpha, drawn.visible, drawn.means_px)


Backend = Literal["auto", "cpu", "cuda"]


def renderer_for(backend: Backend) -> DifferentiableRenderer:
    """Return the renderer a user asked for; `auto` takes CUDA where gsplat really draws there, else the CPU.

    Raises BackendError when `cuda` is asked for and cannot work.
    """
    if backend == "cpu" or (backend == "auto" and not torch.cuda.is_available()):
        return CpuRenderer()
    try:
        return CudaRenderer()
    except BackendError:
        if backend == "cuda":
            raise
        return CpuRenderer()
