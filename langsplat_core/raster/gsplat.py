"""The CUDA backend: gsplat's rasterizer behind our interfaces. This is the only file that knows gsplat.

gsplat (1.5 or newer) is an optional dependency and compiles its kernels at first use. What differs from the
reference, all of it gsplat's own: alpha is capped at 0.999 in 1.5, at 0.99 from 1.6 on; `gather` sums with
atomics, so its last digits vary between runs; numbers are float32. A view's footprints, sorted and in
float64 by the CPU's kernels, are shown to gsplat as flat Gaussians in pixels: it rounds a mean to 6e-8 of the
image's size, and a covariance, whose inverse loses 6e-8 times the ratio of its variances and overflows beyond
4e9 pixels. In training (`draw`) gsplat projects: equal float32 depths stay in the order of rows, covariances
are formed in 3D, antialiasing lacks INRIA's floor of 0.005, smaller images the pixels' box of `dilation`.
"""

import subprocess
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from langsplat_core.arrays import Array, check_array
from langsplat_core.compiled import shared_workers
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster.cpu import projection
from langsplat_core.raster.cpu.tiles import depth_order
from langsplat_core.raster.protocol import LiftingView, dilation, far_plane
from langsplat_core.scene import Camera, Gaussians, look_at

DEVICE = "cuda"
RAW = ("means", "log_scales", "quats_wxyz", "opacity_logits")  # of what is drawn
has_device = torch.cuda.is_available
FAR = 1e10  # world units: gsplat's default far plane


# N Gaussians: the raw fields of `Gaussians` without sh, by name, as float32 tensors on the CUDA device.
DeviceGaussians = Mapping[str, Tensor]


@dataclass(frozen=True, eq=False)
class DifferentiableImage:
    """One image that can be differentiated by the Gaussians and values that it came from."""

    image: Tensor  # (H, W, C) blended values on black, not clamped above
    alpha: Tensor  # (H, W) in [0, 1]
    visible: Tensor  # (N,) bool: the Gaussian's extent meets the image
    means_px: Tensor  # its `grad`, after `backward`, is the loss gradient by the projected means, 1/px

    def means_px_grad(self) -> Tensor:
        """Return the (N, 2) gradient; zeros when nothing was differentiated."""
        grad = torch.zeros_like(self.means_px) if self.means_px.grad is None else self.means_px.grad
        return grad.reshape(-1, 2)


def require_device() -> None:
    """Raise BackendError unless gsplat draws and differentiates on a CUDA device; compiles at first use."""
    if not has_device():
        raise BackendError("torch finds no CUDA device")
    shapes = {"means": (1, 3), "log_scales": (1, 3), "quats_wxyz": (1, 4), "opacity_logits": (1,)}
    one = {name: torch.ones(*shape, device=DEVICE).requires_grad_() for name, shape in shapes.items()}
    camera = look_at(np.array([5.0, 5.0, 5.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), (16, 16))
    try:  # an import alone does not prove that there are kernels
        draw(one, torch.ones(1, 1, device=DEVICE), camera, INRIA).image.sum().backward()
    except (ImportError, RuntimeError, OSError, AttributeError, subprocess.SubprocessError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BackendError(
            f"gsplat does not work here ({reason}); "
            "install langsplat-viewer[cuda] with a matching CUDA toolkit"
        ) from error


def draw(
    gaussians: DeviceGaussians,
    values: Tensor,
    camera: Camera,
    settings: RasterSettings,
    sh_degree: int | None = None,
) -> DifferentiableImage:
    """Blend (N, C) `values` or, with `sh_degree`, the colours of (N, K, 3) harmonics."""
    from gsplat import rasterization

    intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    added, fitted = dilation(camera, settings)
    images, alphas, extra = rasterization(
        means=gaussians["means"],
        quats=gaussians["quats_wxyz"],
        scales=gaussians["log_scales"].exp(),
        opacities=gaussians["opacity_logits"].sigmoid(),
        colors=values,
        viewmats=to_device(camera.world_to_camera[None]),
        Ks=torch.tensor([intrinsics], dtype=torch.float32, device=DEVICE),
        width=camera.width,
        height=camera.height,
        near_plane=settings.near,
        far_plane=min(far_plane(settings), FAR),
        eps2d=added if settings.antialiased else fitted,
        sh_degree=sh_degree,
        packed=False,
        rasterize_mode="antialiased" if settings.antialiased else "classic",
        camera_model="ortho" if camera.orthographic else "pinhole",
    )
    means_px = extra["means2d"]
    if means_px.requires_grad:
        means_px.retain_grad()
    visible = extra["radii"].reshape(len(gaussians["means"]), -1).amin(1) > 0  # (N,) or (N, 2), by version
    return DifferentiableImage(images[0], alphas[0, ..., 0], visible, means_px)


def to_device(array: Array) -> Tensor:
    """Copy an array to the device as a float32 tensor."""
    return torch.tensor(np.asarray(array), dtype=torch.float32, device=DEVICE)


class GsplatView(LiftingView):
    """View of N Gaussians: the footprints of the M that are drawn, in depth order, on the device."""

    def __init__(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> None:
        self.camera, self.count, workers = camera, len(gaussians), shared_workers()
        kernel_camera = projection.kernel_camera(camera, settings)
        found = projection.project_all(projection.rows_of(gaussians), kernel_camera, workers)
        rows = depth_order(found.depths, found.drawn, workers)
        self.depths, self._rows = found.depths, torch.from_numpy(rows).to(DEVICE).long()
        # The device picks rows, of values too, many times as fast as the processor.
        geometry = torch.from_numpy(found.geometry).to(DEVICE)[self._rows]
        x, y, a, k, c, log2_opacity = geometry[:, : projection.HALF_WIDTH].unbind(1)
        xx, yy = projection.HALF_LOG2_E / a**2, projection.HALF_LOG2_E / c**2  # the factors solved for them
        # gsplat sorts by float32 depth: the rank in our order, given as the depth, keeps that order.
        place, xy, none = torch.arange(1, len(rows) + 1, device=DEVICE), k * yy, torch.zeros_like(k)
        self._means, self._opacities = torch.stack([x, y, place], 1).float(), log2_opacity.exp2().float()
        covariances = torch.stack([xx + k * xy, xy, none, xy, yy, none, none, none, none], 1)
        self._covariances = covariances.reshape(-1, 3, 3).float()

    def _draw(self, values: Tensor) -> tuple[Tensor, Tensor]:
        from gsplat import rasterization

        images, alphas, _ = rasterization(
            means=self._means,
            quats=None,
            scales=None,
            covars=self._covariances,
            opacities=self._opacities,
            colors=values,
            viewmats=torch.eye(4, device=DEVICE)[None],
            Ks=torch.eye(3, device=DEVICE)[None],
            width=self.camera.width,
            height=self.camera.height,
            eps2d=0.0,  # footprints are dilated already
            packed=False,
            camera_model="ortho",
        )
        return images[0], alphas[0, ..., 0]

    def splat(self, values: Array) -> tuple[Array, Array]:
        channels = check_array("values", values, (self.count, "C"))["C"]
        if len(self._rows) == 0:
            nothing = np.zeros((self.camera.height, self.camera.width, channels + 1), np.float32)
            return nothing[..., 1:], nothing[..., 0]
        drawn = values if channels else np.zeros((self.count, 1))  # gsplat needs one
        with torch.no_grad():
            image, alpha = self._draw(to_device(drawn)[self._rows])
        return image[..., :channels].cpu().numpy(), alpha.cpu().numpy()

    def gather(self, image: Array) -> Array:
        """Return W^T image as the derivative of <splat(values), image> by values; (N, C) float32."""
        channels = check_array("image", image, (self.camera.height, self.camera.width, "C"))["C"]
        gathered = torch.zeros(self.count, channels, device=DEVICE)
        if len(self._rows) > 0:
            values = torch.zeros(len(self._rows), channels, device=DEVICE, requires_grad=True)
            (grad,) = torch.autograd.grad(self._draw(values)[0], values, to_device(image))
            gathered[self._rows] = grad
        return gathered.cpu().numpy()


class GsplatRasterizer:
    """Stateless; BackendError where there is no CUDA device or gsplat's kernels do not work."""

    name = "cuda"

    def __init__(self) -> None:
        require_device()

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> GsplatView:
        """Project; BackendError for cut-offs other than those that gsplat fixes."""
        for name in ("alpha_min", "transmittance_min"):
            if getattr(settings, name) != getattr(INRIA, name):
                raise BackendError(f"rasterizer 'cuda' cannot change {name}; use --backend cpu")
        return GsplatView(gaussians, camera, settings)
