"""The `DifferentiableRenderer` on CUDA: gsplat's rasterizer and its gradients."""

import subprocess

import numpy as np
import torch
from torch import Tensor

from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.scene import Camera, look_at
from langsplat_core.training.radiance.differentiable import Rendered, sh_coefficients


class CudaRenderer:
    """Draws with `gsplat.rasterization`. The first use on a machine may compile for some minutes.

    Differences from the CPU kernels, all gsplat's: alpha is capped at 0.999 in 1.5.x, and view directions
    do not contribute to the gradient by the means.
    """

    def __init__(self, settings: RasterSettings = INRIA) -> None:
        self.device = torch.device("cuda")
        self._settings = settings
        if not torch.cuda.is_available():
            raise BackendError("backend cuda: torch finds no CUDA device; use --backend cpu")
        try:
            from gsplat import rasterization

            self._rasterization = rasterization
            self._draw_one()
        except (ImportError, RuntimeError, OSError, AttributeError, subprocess.SubprocessError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise BackendError(
                f"backend cuda: gsplat does not work here ({reason}); "
                "install langsplat-viewer[cuda] with a matching CUDA toolkit, or use --backend cpu"
            ) from None

    def render(self, parameters: dict[str, Tensor], camera: Camera, sh_degree: int) -> Rendered:
        """See `DifferentiableRenderer.render`."""
        intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        images, alphas, extra = self._rasterization(
            means=parameters["means"],
            quats=parameters["quats_wxyz"],
            scales=parameters["log_scales"].exp(),
            opacities=parameters["opacity_logits"].sigmoid(),
            colors=sh_coefficients(parameters, sh_degree),
            viewmats=torch.tensor(camera.world_to_camera[None], dtype=torch.float32, device=self.device),
            Ks=torch.tensor([intrinsics], dtype=torch.float32, device=self.device),
            width=camera.width,
            height=camera.height,
            near_plane=self._settings.near,
            eps2d=self._settings.dilation,
            sh_degree=sh_degree,
            packed=False,
            rasterize_mode="antialiased" if self._settings.antialiased else "classic",
        )
        means_px = extra["means2d"]
        if means_px.requires_grad:
            means_px.retain_grad()
        count = len(parameters["means"])
        visible = extra["radii"].reshape(count, -1).amin(1) > 0  # (N,) or (N, 2), by gsplat's version
        return Rendered(images[0], alphas[0, ..., 0], visible, means_px)

    def _draw_one(self) -> None:
        """One Gaussian, forwards and backwards: an import alone does not prove that kernels exist."""
        shapes = {"means": 3, "log_scales": 3, "quats_wxyz": 4}
        parameters = {name: torch.ones(1, size, device=self.device) for name, size in shapes.items()}
        parameters["opacity_logits"] = torch.ones(1, device=self.device)
        parameters["sh_dc"] = torch.ones(1, 1, 3, device=self.device)
        parameters = {name: value.requires_grad_() for name, value in parameters.items()}
        camera = look_at(np.array([5.0, 5.0, 5.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), (16, 16))
        self.render(parameters, camera, 0).image.sum().backward()
