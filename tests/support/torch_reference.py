"""Image formation once more, dense and differentiable: float64 torch, every Gaussian at every pixel.

It exists to check gradients. Cut-offs are decided by detached comparisons, so autograd gives the gradient
of what is drawn; keep scenes to a few dozen Gaussians and a few thousand pixels.
"""

import numpy as np
import torch

from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.raster.protocol import dilation, farthest
from langsplat_core.scene import Camera, Gaussians


def parameters(gaussians: Gaussians) -> dict[str, torch.Tensor]:
    """Leaves in float64 that `render` takes."""
    names = ("means", "log_scales", "quats_wxyz", "opacity_logits")
    return {
        name: torch.tensor(getattr(gaussians, name), dtype=torch.float64, requires_grad=True)
        for name in names
    }


def project(
    leaves: dict[str, torch.Tensor], camera: Camera, settings: RasterSettings = INRIA
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pixel means (N, 2), 2D covariances (N, 2, 2), opacities (N,), depths (N,)."""
    rotation = torch.tensor(camera.rotation)
    points = leaves["means"] @ rotation.T + torch.tensor(camera.world_to_camera[:3, 3])
    x, y, z = points.T
    grow_x, grow_y = (
        (settings.fov_clamp - 1) * 0.5 * size / focal
        for size, focal in ((camera.width, camera.fx), (camera.height, camera.fy))
    )
    tx = torch.clamp(x / z, -camera.cx / camera.fx - grow_x, (camera.width - camera.cx) / camera.fx + grow_x)
    ty = torch.clamp(y / z, -camera.cy / camera.fy - grow_y, (camera.height - camera.cy) / camera.fy + grow_y)
    over = torch.ones_like(z) if camera.orthographic else z
    if camera.orthographic:
        tx, ty = torch.zeros_like(z), torch.zeros_like(z)
    nought = torch.zeros_like(z)
    jacobian = torch.stack(
        [camera.fx / over, nought, -camera.fx * tx / z, nought, camera.fy / over, -camera.fy * ty / z], -1
    ).reshape(-1, 2, 3)
    w, i, j, k = torch.nn.functional.normalize(leaves["quats_wxyz"], dim=1).T
    turn = torch.stack(
        [
            1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j),
            2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i),
            2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j),
        ],
        -1,
    ).reshape(-1, 3, 3)  # fmt: skip
    a = jacobian @ rotation @ (turn * torch.exp(leaves["log_scales"])[:, None, :])
    sharp = a @ a.mT
    covariance = sharp + dilation(camera, settings) * torch.eye(2, dtype=torch.float64)
    opacity = torch.sigmoid(leaves["opacity_logits"])
    if settings.antialiased:
        ratio = torch.linalg.det(sharp) / torch.linalg.det(covariance)
        opacity = opacity * torch.sqrt(torch.clamp(ratio, min=0.005**2))
    means_px = torch.stack([camera.fx * x / over + camera.cx, camera.fy * y / over + camera.cy], -1)
    return means_px, covariance, opacity, z


def render(
    leaves: dict[str, torch.Tensor], values: torch.Tensor, camera: Camera, settings: RasterSettings = INRIA
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(N, C) values -> image (H, W, C), alpha (H, W), and the pixel means for their gradient."""
    means_px, covariance, opacity, depth = project(leaves, camera, settings)
    means_px.retain_grad()
    ys, xs = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = torch.tensor(np.stack([xs.ravel(), ys.ravel()], -1))
    image = torch.zeros(len(pixels), values.shape[1], dtype=torch.float64)
    transmittance = torch.ones(len(pixels), dtype=torch.float64)
    running = torch.ones(len(pixels), dtype=torch.bool)
    for n in torch.argsort(depth.detach(), stable=True).tolist():
        if not settings.near < depth[n] <= farthest(settings):
            continue
        offset = pixels - means_px[n]
        power = -0.5 * (offset @ torch.linalg.inv(covariance[n]) * offset).sum(1)
        alpha = torch.clamp(opacity[n] * torch.exp(power), max=float(np.float32(settings.alpha_max)))
        hit = running & (alpha.detach() >= settings.alpha_min)
        stop = hit & ((transmittance * (1 - alpha)).detach() <= settings.transmittance_min)
        running = running & ~stop
        alpha = torch.where(hit & ~stop, alpha, 0.0)
        image = image + (alpha * transmittance)[:, None] * values[n]
        transmittance = transmittance * (1 - alpha)
    shape = (camera.height, camera.width)
    return image.reshape(*shape, -1), (1 - transmittance).reshape(shape), means_px
