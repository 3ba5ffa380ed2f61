"""A twin of gsplat's compiled kernels (`gsplat.cuda._backend._C` as of 1.5.3) in plain PyTorch, for the CPU.

gsplat's own Python code runs unchanged above them: its signatures, checks of shapes, padding of channels and
chunks are the real ones. Arguments and results below are those of its `Ops.h`, arithmetic and its order
those of its CUDA code, in float32. Where a kernel leaves its result unwritten (`at::empty`), NaN stands here,
so that whoever reads it is found out. One camera, no batches, no packing: what `raster.gsplat` asks for.

What this cannot show: whether the real kernels compile, the digits that `-use_fast_math` costs, the order of
their atomic sums, and everything about time and memory.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from itertools import pairwise
from types import ModuleType
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from langsplat_core.raster import gsplat

PINHOLE, ORTHO = 0, 1  # pybind exports the values of this enumeration beside it
CameraModelType = ModuleType("CameraModelType")
ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4
WIDEST = 3.33  # standard deviations
KERNEL_CHANNELS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33, 64, 65, 128, 129, 256, 257, 512, 513)


@contextmanager
def gsplat_on_cpu() -> Iterator[None]:
    """Within, `raster.gsplat` works, with these kernels on the CPU."""
    backend = ModuleType("gsplat.cuda._backend")
    backend._C = sys.modules[__name__]  # type: ignore[attr-defined]  # noqa: SLF001  gsplat's name
    name = backend.__name__
    before = sys.modules.get(name)
    sys.modules[name] = backend  # not patch.dict, which would forget what else is imported meanwhile
    try:
        with patch.object(gsplat, "DEVICE", "cpu"), patch.object(gsplat, "has_device", lambda: True):
            yield
    finally:
        del sys.modules[name]
        if before is not None:
            sys.modules[name] = before


def _check(*tensors: Tensor | None, kind: torch.dtype = torch.float32) -> None:
    """Assert what CHECK_INPUT and `data_ptr<T>` ask for."""
    for tensor in tensors:
        if tensor is not None and not (tensor.is_contiguous() and tensor.dtype == kind):
            raise RuntimeError(f"a kernel was given {tensor.dtype}, contiguous: {tensor.is_contiguous()}")


def _unwritten(*shape: int) -> Tensor:
    return torch.full(shape, torch.nan)


def _plain(name: str) -> Any:
    """One of gsplat's own plain functions, which are under no other name."""
    return getattr(import_module("gsplat.cuda._torch_impl"), f"_{name}")


def _project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    size: tuple[int, int],
    eps2d: float,
    camera_model: int,
) -> tuple[Tensor, ...]:
    """Centres in camera space, pixels, blurred 2D covariances (N, 2, 2), det before / after the blur."""
    covariances, _ = _plain("quat_scale_to_covar_preci")(quats, scales, compute_preci=False)
    points, turned = _plain("world_to_cam")(means, covariances, viewmats)
    project = _plain("persp_proj" if camera_model == PINHOLE else "ortho_proj")
    pixels, sharp = (part[0] for part in project(points, turned, Ks, *size))
    blurred = sharp + eps2d * torch.eye(2)
    return points[0], pixels, blurred, _det(sharp) / _det(blurred)


def _det(m: Tensor) -> Tensor:
    return m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]


def _conics(covariances: Tensor) -> Tensor:
    (xx, xy), (_, yy) = covariances.unbind(1)[0].unbind(1), covariances.unbind(1)[1].unbind(1)
    return torch.stack([yy, -xy, xx], 1) / _det(covariances)[:, None]


def projection_ewa_3dgs_fused_fwd(  # noqa: PLR0913  gsplat's signature
    means: Tensor, covars: Tensor | None, quats: Tensor, scales: Tensor, opacities: Tensor | None,
    viewmats: Tensor, Ks: Tensor, image_width: int, image_height: int, eps2d: float, near_plane: float,
    far_plane: float, radius_clip: float, calc_compensations: bool, camera_model: int,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    _check(means, covars, quats, scales, opacities, viewmats, Ks)
    count = len(means)
    assert (means.shape, viewmats.shape, Ks.shape) == ((count, 3), (1, 4, 4), (1, 3, 3))
    assert covars is None
    assert camera_model in (PINHOLE, ORTHO)
    points, pixels, blurred, ratio = _project(
        means, quats, scales, viewmats, Ks, (image_width, image_height), eps2d, camera_model
    )
    compensations = ratio.clamp(min=0).sqrt()
    reach = torch.full((count,), WIDEST)
    drawn = ~((points[:, 2] < near_plane) | (points[:, 2] > far_plane)) & ~(_det(blurred) <= 0)
    if opacities is not None:
        seen = opacities * compensations if calc_compensations else opacities
        drawn &= ~(seen < ALPHA_MIN)
        reach = torch.minimum(reach, (2 * (seen / ALPHA_MIN).log()).sqrt())
    extents = (reach[:, None] * blurred.diagonal(dim1=1, dim2=2).sqrt()).ceil()
    size = torch.tensor([image_width, image_height])
    drawn &= ~(extents <= radius_clip).all(1)
    drawn &= ~((pixels + extents <= 0) | (pixels - extents >= size)).any(1)
    # As the device converts: out of range saturates, NaN becomes 0.
    whole = extents.nan_to_num(0).clamp(max=2.0**31 - 1).double().to(torch.int32)
    radii = torch.where(drawn[:, None], whole, 0)
    hidden = ~drawn[:, None]
    means2d, conics = pixels.masked_fill(hidden, torch.nan), _conics(blurred).masked_fill(hidden, torch.nan)
    depths = points[:, 2].masked_fill(~drawn, torch.nan)
    kept = torch.where(drawn, compensations, 0.0)[None] if calc_compensations else None
    return radii[None], means2d[None], depths[None], conics[None], kept


def projection_ewa_3dgs_fused_bwd(  # noqa: PLR0913  gsplat's signature
    means: Tensor, covars: Tensor | None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor,
    image_width: int, image_height: int, eps2d: float, camera_model: int, radii: Tensor, conics: Tensor,
    compensations: Tensor | None, v_means2d: Tensor, v_depths: Tensor, v_conics: Tensor,
    v_compensations: Tensor | None, viewmats_requires_grad: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    _check(means, quats, scales, viewmats, Ks, conics, compensations)
    _check(v_means2d, v_depths, v_conics, v_compensations)
    assert covars is None
    assert camera_model in (PINHOLE, ORTHO)
    assert not viewmats_requires_grad
    rows = (radii[0] > 0).all(1).nonzero()[:, 0]
    leaves = [leaf[rows].clone().requires_grad_() for leaf in (means, quats, scales)]
    with torch.enable_grad():
        points, pixels, blurred, ratio = _project(
            *leaves, viewmats, Ks, (image_width, image_height), eps2d, camera_model
        )
        outputs = [pixels, points[:, 2], _conics(blurred)]
        grads = [v_means2d[0, rows], v_depths[0, rows], v_conics[0, rows]]
        if v_compensations is not None:
            assert compensations is not None
            outputs.append(ratio)
            grads.append(v_compensations[0, rows] * 0.5 / (compensations[0, rows] + 1e-6))
        found = torch.autograd.grad(outputs, leaves, grads)
    by_means, by_quats, by_scales = (
        torch.zeros_like(leaf).index_copy(0, rows, grad)
        for leaf, grad in zip((means, quats, scales), found, strict=True)
    )
    return by_means, None, by_quats, by_scales, None


def intersect_tile(  # noqa: PLR0913  gsplat's signature
    means2d: Tensor, radii: Tensor, depths: Tensor, image_ids: Tensor | None, gaussian_ids: Tensor | None,
    I: int, tile_size: int, tile_width: int, tile_height: int, sort: bool, segmented: bool,  # noqa: E741
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    _check(means2d, depths)
    _check(radii, kind=torch.int32)
    assert (image_ids, gaussian_ids, I, segmented) == (None, None, 1, False)
    assert means2d.shape == radii.shape == (*depths.shape, 2)
    drawn = (radii[0] > 0).all(1)
    middle, reach = means2d[0].nan_to_num(0) / tile_size, radii[0].float() / tile_size
    limit = torch.tensor([tile_width, tile_height])
    first = (middle - reach).floor().clamp(min=0).long().minimum(limit)
    last = (middle + reach).ceil().clamp(min=0).long().minimum(limit)
    spans = torch.where(drawn[:, None], last - first, 0)
    counts = spans.prod(1)
    ids = torch.repeat_interleave(counts)
    nth = torch.arange(len(ids)) - (counts.cumsum(0) - counts)[ids]
    across = spans[ids, 0]
    tiles = (first[ids, 1] + nth // across) * tile_width + first[ids, 0] + nth % across
    keys = (tiles << 32) | (depths[0].view(torch.int32).long() & 0xFFFFFFFF)[ids]
    if sort:
        keys, order = keys.sort(stable=True)
        ids = ids[order]
    return counts.to(torch.int32)[None], keys, ids.to(torch.int32)


def intersect_offset(isect_ids: Tensor, I: int, tile_width: int, tile_height: int) -> Tensor:  # noqa: E741
    _check(isect_ids, kind=torch.int64)
    tiles = torch.arange(I * tile_height * tile_width)
    return torch.searchsorted(isect_ids >> 32, tiles).to(torch.int32).reshape(I, tile_height, tile_width)


def _blend(
    pixels: Tensor, means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(P, 2) pixels of a tile, G Gaussians front to back -> (P, C) colours, (P,) alphas, (P,) last."""
    x, y = (means2d[None] - pixels[:, None]).unbind(2)
    sigma = 0.5 * (conics[:, 0] * x * x + conics[:, 2] * y * y) + conics[:, 1] * x * y
    alphas = (opacities * (-sigma).exp()).clamp(max=ALPHA_MAX)
    alphas = torch.where((sigma < 0) | (alphas < ALPHA_MIN), 0.0, alphas)
    after = (1 - alphas).cumprod(1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    stopped = after.detach() <= TRANSMITTANCE_MIN
    weights = torch.where(stopped, 0.0, alphas * before)
    left = torch.where(stopped, 1.0, 1 - alphas).prod(1)
    places = torch.arange(weights.shape[1]).expand_as(weights)
    return weights @ colors, 1 - left, torch.where(weights > 0, places, 0).amax(1)


def _tiles(
    tile_offsets: Tensor, flatten_ids: Tensor, size: tuple[int, int], tile_size: int
) -> Iterator[tuple[Tensor, Tensor, tuple[slice, slice], int]]:
    """Gaussians, pixel centres (P, 2), place in the picture and first index of every tile that has any."""
    width, height = size
    starts = [*tile_offsets.flatten().tolist(), len(flatten_ids)]
    columns = tile_offsets.shape[-1]
    for tile, (start, end) in enumerate(pairwise(starts)):
        if start == end:
            continue
        top, left = tile // columns * tile_size, tile % columns * tile_size
        place = (slice(top, min(top + tile_size, height)), slice(left, min(left + tile_size, width)))
        rows, across = (
            torch.arange(place[0].start, place[0].stop),
            torch.arange(place[1].start, place[1].stop),
        )
        y, x = torch.meshgrid(rows + 0.5, across + 0.5, indexing="ij")
        yield flatten_ids[start:end].long(), torch.stack([x, y], -1).reshape(-1, 2), place, start


def rasterize_to_pixels_3dgs_fwd(  # noqa: PLR0913  gsplat's signature
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None,
    masks: Tensor | None, image_width: int, image_height: int, tile_size: int, tile_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    _check(means2d, conics, colors, opacities)
    _check(tile_offsets, flatten_ids, kind=torch.int32)
    assert backgrounds is None
    assert masks is None
    assert colors.shape[-1] in KERNEL_CHANNELS
    images = torch.zeros(1, image_height, image_width, colors.shape[-1])
    alphas, last = (
        torch.zeros(1, image_height, image_width, 1),
        torch.zeros(1, image_height, image_width).int(),
    )
    for ids, pixels, place, start in _tiles(
        tile_offsets, flatten_ids, (image_width, image_height), tile_size
    ):
        found = _blend(pixels, *(part[0, ids] for part in (means2d, conics, colors, opacities)))
        images[0][place] = found[0].reshape(images[0][place].shape)
        alphas[0][place] = found[1].reshape(alphas[0][place].shape)
        last[0][place] = (start + found[2]).int().reshape(last[0][place].shape)
    return images, alphas, last


def rasterize_to_pixels_3dgs_bwd(  # noqa: PLR0913  gsplat's signature
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None,
    masks: Tensor | None, image_width: int, image_height: int, tile_size: int, tile_offsets: Tensor,
    flatten_ids: Tensor, render_alphas: Tensor, last_ids: Tensor, v_render_colors: Tensor,
    v_render_alphas: Tensor, absgrad: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    parts = (means2d, conics, colors, opacities)
    _check(*parts, render_alphas, v_render_colors, v_render_alphas)
    _check(tile_offsets, flatten_ids, last_ids, kind=torch.int32)
    assert backgrounds is None
    assert masks is None
    assert not absgrad
    sums = [torch.zeros_like(part) for part in parts]
    for ids, pixels, place, _ in _tiles(tile_offsets, flatten_ids, (image_width, image_height), tile_size):
        leaves = [part[0, ids].clone().requires_grad_() for part in parts]
        grads = [v_render_colors[0][place].flatten(0, 1), v_render_alphas[0][place].flatten()]
        with torch.enable_grad():
            found = torch.autograd.grad(_blend(pixels, *leaves)[:2], leaves, grads)
        for total, grad in zip(sums, found, strict=True):
            total[0].index_add_(0, ids, grad)
    return None, *sums


def spherical_harmonics_fwd(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None
) -> Tensor:
    _check(dirs, coeffs)
    assert masks is not None
    colours = _unwritten(*dirs.shape)
    colours[masks] = _plain("spherical_harmonics")(degrees_to_use, dirs[masks], coeffs[masks])
    return colours


def spherical_harmonics_bwd(  # gsplat's signature
    K: int, degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None, v_colors: Tensor,
    compute_v_dirs: bool,
) -> tuple[Tensor, Tensor | None]:  # fmt: skip
    _check(dirs, coeffs, v_colors)
    assert masks is not None
    assert coeffs.shape[-2] == K
    leaves = [dirs[masks].requires_grad_(), coeffs[masks].requires_grad_()]
    with torch.enable_grad():
        colours = _plain("spherical_harmonics")(degrees_to_use, *leaves)
        found = torch.autograd.grad(
            colours, leaves, v_colors[masks], allow_unused=True, materialize_grads=True
        )
    by_dirs, by_coeffs = torch.zeros_like(dirs), torch.zeros_like(coeffs)
    by_dirs[masks], by_coeffs[masks] = found
    return by_coeffs, by_dirs if compute_v_dirs else None
