"""A twin of `gsplat.rasterization` in plain PyTorch, as of gsplat 1.5.3, for the CPU.

Arithmetic and its order are those of gsplat's CUDA code, in float32, without tiles: every pixel is asked of
every Gaussian. One camera, no packing, no depth modes: what `raster.gsplat` asks for.
It cannot show gsplat's Python code, compiling, `-use_fast_math`, the order of atomic sums, time and memory.
"""

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from langsplat_core.raster import gsplat

ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4
WIDEST = 3.33  # standard deviations
BLOCK = 1 << 20  # pixels times Gaussians that are blended at once


@contextmanager
def gsplat_on_cpu() -> Iterator[None]:
    """Within, `raster.gsplat` works, by this module on the CPU."""
    installed = import_module("gsplat")
    signature = inspect.signature(installed.rasterization)

    def checked(**given: Any) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        signature.bind(**given)
        return rasterization(**given)

    with (
        patch.object(gsplat, "DEVICE", "cpu"),
        patch.object(gsplat, "has_device", lambda: True),
        patch.object(installed, "rasterization", checked),
    ):
        yield


def _plain(name: str) -> Any:
    """One of gsplat's own plain functions, which are under no other name."""
    return getattr(import_module("gsplat.cuda._torch_impl"), f"_{name}")


def rasterization(  # noqa: PLR0913  gsplat's signature
    means: Tensor, quats: Tensor | None, scales: Tensor | None, opacities: Tensor, colors: Tensor,
    viewmats: Tensor, Ks: Tensor, width: int, height: int, eps2d: float, packed: bool, camera_model: str,
    near_plane: float = 0.01, far_plane: float = 1e10, sh_degree: int | None = None,
    rasterize_mode: str = "classic", covars: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:  # fmt: skip
    """Return (1, H, W, C) images, (1, H, W, 1) alphas, and of the Gaussians means2d (1, N, 2) and radii."""
    assert (viewmats.shape, Ks.shape, packed) == ((1, 4, 4), (1, 3, 3), False)
    if covars is None:
        covars, _ = _plain("quat_scale_to_covar_preci")(quats, scales, compute_preci=False)
    points, turned = _plain("world_to_cam")(means, covars, viewmats)
    project = _plain("persp_proj" if camera_model == "pinhole" else "ortho_proj")
    means2d, sharp = project(points, turned, Ks, width, height)
    blurred = sharp[0] + eps2d * torch.eye(2)
    if rasterize_mode == "antialiased":
        opacities = opacities * (_det(sharp[0]) / _det(blurred)).clamp(min=0).sqrt()
    with torch.no_grad():
        radii = _radii(means2d[0], blurred, opacities, (width, height))
        radii[(points[0, :, 2] < near_plane) | (points[0, :, 2] > far_plane)] = 0
    rows = (radii > 0).all(1).nonzero()[:, 0]
    rows = rows[points[0, rows, 2].argsort(stable=True)]  # front to back
    seen = colors[rows]
    if sh_degree is not None:
        directions = means[rows] - torch.inverse(viewmats)[0, :3, 3]
        seen = (_plain("spherical_harmonics")(sh_degree, directions, seen) + 0.5).clamp(min=0)
    assert seen.shape[1] > 0
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    blocks = torch.stack([x, y], -1).reshape(-1, 2).split(max(BLOCK // max(len(rows), 1), 1))
    parts = (means2d[0, rows], blurred[rows], seen, opacities[rows])
    images, alphas = zip(*(_blend(pixels, *parts) for pixels in blocks), strict=True)
    shape = (1, height, width, -1)
    extra = {"means2d": means2d, "radii": radii[None]}
    return torch.cat(images).reshape(shape), torch.cat(alphas).reshape(shape), extra


def _det(m: Tensor) -> Tensor:
    return m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]


def _radii(means2d: Tensor, covariances: Tensor, opacities: Tensor, size: tuple[int, int]) -> Tensor:
    """Return (N, 2) int32: how many pixels a Gaussian reaches to both sides; 0 where it is not drawn."""
    drawn = (_det(covariances) > 0) & (opacities >= ALPHA_MIN)
    reach = (2 * (opacities / ALPHA_MIN).log()).sqrt().clamp(max=WIDEST)
    extents = (reach[:, None] * covariances.diagonal(dim1=1, dim2=2).sqrt()).ceil()
    drawn &= ~(extents <= 0).all(1)
    drawn &= ~((means2d + extents <= 0) | (means2d - extents >= torch.tensor(size))).any(1)
    # As the device converts: out of range saturates, NaN becomes 0.
    whole = extents.nan_to_num(0).clamp(max=2.0**31 - 1).double().to(torch.int32)
    return torch.where(drawn[:, None], whole, 0)


def _blend(
    pixels: Tensor, means2d: Tensor, covariances: Tensor, colors: Tensor, opacities: Tensor
) -> tuple[Tensor, Tensor]:
    """Map (P, 2) pixels, G Gaussians front to back to (P, C) colours, (P,) alphas."""
    x, y = (means2d[None] - pixels[:, None]).unbind(2)
    (xx, xy), (_, yy) = (row.unbind(1) for row in covariances.unbind(1))
    conics = torch.stack([yy, -xy, xx]) / _det(covariances)
    sigma = 0.5 * (conics[0] * x * x + conics[2] * y * y) + conics[1] * x * y
    alphas = (opacities * (-sigma).exp()).clamp(max=ALPHA_MAX)
    alphas = torch.where((sigma < 0) | (alphas < ALPHA_MIN), 0.0, alphas)
    after = (1 - alphas).cumprod(1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    stopped = after.detach() <= TRANSMITTANCE_MIN
    weights = torch.where(stopped, 0.0, alphas * before)
    return weights @ colors, 1 - torch.where(stopped, 1.0, 1 - alphas).prod(1)
