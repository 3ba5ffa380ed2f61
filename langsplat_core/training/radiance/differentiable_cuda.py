"""The `DifferentiableRenderer` on CUDA: gsplat's rasterizer and its gradients."""

import torch
from torch import Tensor

from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster import gsplat
from langsplat_core.scene import Camera
from langsplat_core.training.radiance.differentiable import Rendered, sh_coefficients


class CudaRenderer:
    """Draws with gsplat; how it differs from the CPU kernels says `raster.gsplat`."""

    def __init__(self, settings: RasterSettings = INRIA) -> None:
        self.device = torch.device(gsplat.DEVICE)
        self._settings = settings
        try:
            gsplat.require_device()
        except BackendError as error:
            raise BackendError(f"backend cuda: {error}; use --backend cpu") from error

    def render(self, parameters: dict[str, Tensor], camera: Camera, sh_degree: int) -> Rendered:
        """See `DifferentiableRenderer.render`."""
        names = ("means", "log_scales", "quats_wxyz", "opacity_logits")
        gaussians = gsplat.DeviceGaussians(**{name: parameters[name] for name in names})
        colours = sh_coefficients(parameters, sh_degree)
        drawn = gsplat.draw(gaussians, colours, camera, self._settings, sh_degree)
        return Rendered(drawn.image, drawn.alpha, drawn.visible, drawn.means_px)
