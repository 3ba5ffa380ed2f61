"""The CUDA backend: gsplat's rasterizer behind the same small interface.

gsplat (1.5 or newer) is an optional dependency and compiles its kernels at first use. What differs from the
reference, all of it gsplat's own: float32 throughout, alpha capped at 0.999 in 1.5, at 0.99 from 1.6 on, and
`gather` sums with atomics, so its last digits vary between runs.
"""

import subprocess
from typing import Any

import numpy as np
import torch
from gsplat import rasterization
from torch import Tensor

from langsplat_core.arrays import Array, check_array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster.protocol import DepthKind
from langsplat_core.scene import Camera, Gaussians, look_at


class GsplatView:
    """Valid Gaussians on the device; gsplat projects them anew in every call."""

    def __init__(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> None:
        valid = gaussians.valid()
        self.camera = camera
        self.dropped = int((~valid).sum())
        self._count, self._rows = len(gaussians), np.flatnonzero(valid)
        kept = gaussians.take(self._rows)
        # Relative to the camera in float64 first: float32 has no digits left far from the origin.
        means = kept.means.astype(np.float64) - camera.position
        self._depths = (means @ camera.rotation[2]).astype(np.float32)
        view = np.eye(4)
        view[:3, :3] = camera.rotation
        intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        self._arguments: dict[str, Any] = {
            "means": _to_device(means),
            "quats": _to_device(kept.quats_wxyz),
            "scales": _to_device(kept.log_scales).exp(),
            "opacities": _to_device(kept.opacity_logits).sigmoid(),
            "viewmats": _to_device(view[None]),
            "Ks": _to_device(intrinsics[None]),
            "width": camera.width,
            "height": camera.height,
            "near_plane": settings.near,
            "eps2d": settings.dilation,
            "rasterize_mode": "antialiased" if settings.antialiased else "classic",
        }

    def _draw(self, values: Tensor) -> tuple[Tensor, Tensor]:
        image, alpha, _ = rasterization(colors=values, sh_degree=None, **self._arguments)
        return image[0], alpha[0, ..., 0]

    def splat(self, values: Array) -> tuple[Array, Array]:
        """See `View.splat`; float32."""
        channels = check_array("values", values, (self._count, "C"))["C"]
        if len(self._rows) == 0:
            shape = (self.camera.height, self.camera.width)
            return np.zeros((*shape, channels), np.float32), np.zeros(shape, np.float32)
        with torch.no_grad():
            image, alpha = self._draw(_to_device(values[self._rows]))
        return image.cpu().numpy(), alpha.cpu().numpy()

    def gather(self, image: Array) -> Array:
        """See `LiftingView.gather`: the derivative of <splat(values), image> by values; float32."""
        channels = check_array("image", image, (self.camera.height, self.camera.width, "C"))["C"]
        gathered = np.zeros((self._count, channels), np.float32)
        if len(self._rows) > 0:
            values = torch.zeros(len(self._rows), channels, device="cuda", requires_grad=True)
            (grad,) = torch.autograd.grad(self._draw(values)[0], values, _to_device(image))
            gathered[self._rows] = grad.cpu().numpy()
        return gathered

    def contributions(self) -> Array:
        """See `LiftingView.contributions`; float32."""
        return self.gather(np.ones((self.camera.height, self.camera.width, 1), np.float32))[:, 0]

    def depth(self, kind: DepthKind = "expected") -> Array:
        """See `View.depth`; float32, `expected` only."""
        if kind != "expected":
            raise BackendError("rasterizer 'cuda' has no median depth; use --backend cpu for that")
        both = np.ones((self._count, 2), np.float32)
        both[self._rows, 0] = self._depths
        sums, weights = np.moveaxis(self.splat(both)[0], -1, 0)
        return np.where(weights > 0, sums / np.where(weights > 0, weights, 1), 0)


def _to_device(array: Array) -> Tensor:
    return torch.tensor(np.asarray(array), dtype=torch.float32, device="cuda")


class GsplatRasterizer:
    """Stateless; BackendError where there is no CUDA device or gsplat's kernels do not work."""

    name = "cuda"

    def __init__(self) -> None:
        if not torch.cuda.is_available():
            raise BackendError("torch finds no CUDA device")
        one = Gaussians(np.zeros((1, 3)), np.zeros((1, 3)), np.ones((1, 4)), np.ones(1), np.zeros((1, 1, 3)))
        camera = look_at(np.array([0.0, 0.0, 5.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), (16, 16))
        try:  # an import alone does not prove that there are kernels
            self.view(one, camera).gather(np.ones((16, 16, 1), np.float32))
        except (ImportError, RuntimeError, OSError, AttributeError, subprocess.SubprocessError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise BackendError(f"gsplat does not work here: {reason}") from error

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> GsplatView:
        """See `Rasterizer.view`. Of the settings near, dilation and antialiased apply; gsplat fixes the rest.

        Raises BackendError for other settings that are not the profiles'.
        """
        for name in ("fov_clamp", "alpha_min", "transmittance_min"):
            if getattr(settings, name) != getattr(INRIA, name):
                raise BackendError(f"rasterizer 'cuda' cannot change {name}; use --backend cpu")
        return GsplatView(gaussians, camera, settings)
