"""A tile rasterizer in nothing but PyTorch tensors: the baseline of the rasterizer benchmark.

It is what one would write without compiled kernels, made as fast as tensors allow: projection of all
Gaussians at once, a radix sort into tiles of 16x16 pixels, tiles of like length blended together in steps
that stay in cache, tiles that are opaque dropped after every step, one group of tiles per thread (PyTorch's
own threads meet after every operation, which here takes less time than the meeting), and gradients group by
group through autograd, so that no image's worth of weights is ever held. Image formation is that of
`raster/reference.py`. In float64 its gradients, which autograd derives, serve the benchmark as the truth.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.raster.cpu.rasterizer import GaussianGradients
from langsplat_core.scene import Camera, Gaussians

TILE = 16
PIXELS = TILE * TILE
_STEP = 32  # Gaussians of a tile that are blended at once
_TILES = 16  # tiles that are blended together: 16 * 32 * 256 float32 numbers fill half a MiB
_ROWS = 16384  # Gaussians that are projected together
_NEVER = -1e4  # logarithm of the opacity that fills a short tile up
_T = TypeVar("_T")
_Used = list[tuple[Tensor, list[Tensor]]]  # rows of the tables that a step read, and its leaves


class Footprints(NamedTuple):
    """Footprints of M projected Gaussians on the image plane."""

    means_px: Tensor  # (M, 2) float64
    shapes: Tensor  # (M, 4) xx, xy, yy of the inverse covariance, 1/px^2, and log(opacity)
    depths: Tensor  # (M,) float64
    extents_px: Tensor  # (M, 2) half width and half height of the alpha = alpha_min contour


class _Bins(NamedTuple):
    """Intersections of Gaussians with tiles, sorted by tile, then by depth."""

    starts: Tensor  # (T + 1,) int64
    ranks: Tensor  # (I,) int64
    columns: int


def project(leaves: list[Tensor], camera: Camera, settings: RasterSettings) -> Footprints:
    """Means, log scales, quaternions and opacity logits -> footprints; differentiable.

    Positions are float64 (a pixel's thousandth matters at 1000 pixels), shapes have the leaves' type.
    """
    means, log_scales, quats, logits = leaves
    rotation = torch.from_numpy(camera.rotation.copy())
    points = means.double() @ rotation.T + torch.from_numpy(camera.world_to_camera[:3, 3].copy())
    x, y, depth = points.unbind(1)
    margin_x = (settings.fov_clamp - 1) * 0.5 * camera.width / camera.fx
    margin_y = (settings.fov_clamp - 1) * 0.5 * camera.height / camera.fy
    tx = (x / depth).clamp(
        -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x
    )
    ty = (y / depth).clamp(
        -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y
    )
    kind = means.dtype
    z = depth.to(kind)[:, None]
    turned = _rotations(quats) * log_scales.exp()[:, None, :]
    right, down, ahead = (rotation.to(kind)[row] @ turned for row in range(3))
    row0 = (right - tx.to(kind)[:, None] * ahead) * (camera.fx / z)
    row1 = (down - ty.to(kind)[:, None] * ahead) * (camera.fy / z)
    xx, xy, yy = (row0 * row0).sum(1), (row0 * row1).sum(1), (row1 * row1).sum(1)
    sharp = torch.linalg.cross(row0, row1).square().sum(1)
    det = sharp + settings.dilation * (xx + yy) + settings.dilation**2
    xx, yy = xx + settings.dilation, yy + settings.dilation
    log_opacity = torch.nn.functional.logsigmoid(logits)
    if settings.antialiased:
        log_opacity = log_opacity + 0.5 * (sharp / det).clamp(min=0.005**2).log()
    reach = (2 * (log_opacity.detach() - np.log(settings.alpha_min))).clamp(min=0).sqrt()
    extents = torch.stack([reach * xx.detach().sqrt(), reach * yy.detach().sqrt()], 1)
    pixels = torch.stack([camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy], 1)
    return Footprints(pixels, torch.stack([yy / det, -xy / det, xx / det, log_opacity], 1), depth, extents)


def _rotations(quats: Tensor) -> Tensor:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(entries, 1).reshape(-1, 3, 3)


def _bin_tiles(footprints: Footprints, camera: Camera) -> _Bins:
    """Every tile that a footprint's bounding box meets; footprints are in depth order."""
    columns, lines = -(-camera.width // TILE), -(-camera.height // TILE)
    low, high = footprints.means_px - footprints.extents_px, footprints.means_px + footprints.extents_px
    limit = torch.tensor([columns, lines])
    first = (low / TILE).floor().long().clamp(min=0).minimum(limit)
    last = ((high / TILE).floor().long() + 1).clamp(min=0).minimum(limit)
    spans = (last - first).clamp(min=0)
    counts = spans.prod(1)
    ranks = torch.repeat_interleave(counts)
    nth = torch.arange(len(ranks)) - (counts.cumsum(0) - counts)[ranks]
    across = spans[ranks, 0]
    tiles = (first[ranks, 1] + nth // across) * columns + first[ranks, 0] + nth % across
    # NumPy sorts 16-bit keys by radix, several times as fast as torch.sort.
    keys = tiles.numpy().astype(np.uint16 if columns * lines < 2**16 else np.uint32)
    order = torch.from_numpy(np.argsort(keys, kind="stable"))
    starts = torch.zeros(columns * lines + 1, dtype=torch.long)
    starts[1:] = torch.bincount(tiles, minlength=columns * lines).cumsum(0)
    return _Bins(starts, ranks[order], columns)


def _in_threads(pieces: Sequence[Tensor], work: Callable[[Tensor], _T]) -> list[_T]:
    """`work` of every piece, one piece per thread at a time; PyTorch itself uses one thread meanwhile."""
    threads, graded = torch.get_num_threads(), torch.is_grad_enabled()

    def alone(piece: Tensor) -> _T:
        with torch.set_grad_enabled(graded):  # is a setting of each thread
            return work(piece)

    try:
        torch.set_num_threads(1)
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(alone, pieces))
    finally:
        torch.set_num_threads(threads)


class TorchView:
    """M drawn of N Gaussians in depth order, with their tiles."""

    def __init__(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, kind: torch.dtype
    ) -> None:
        self.camera, self.settings, self._kind = camera, settings, kind
        valid = gaussians.valid()
        self.dropped = int((~valid).sum())
        arrays = (gaussians.means, gaussians.log_scales, gaussians.quats_wxyz, gaussians.opacity_logits)
        self._all = [torch.from_numpy(array).to(kind) for array in arrays]
        with torch.no_grad():
            pieces = _in_threads(torch.arange(len(valid)).split(_ROWS), self._project)
            found = Footprints(*(torch.cat(parts) for parts in zip(*pieces, strict=True)))
            (low, high) = found.means_px - found.extents_px, found.means_px + found.extents_px
            size = torch.tensor([camera.width, camera.height])
            drawn = torch.from_numpy(valid) & (found.depths > settings.near)
            drawn &= (found.shapes[:, 3] >= np.log(settings.alpha_min)) & ((high > 0) & (low < size)).all(1)
            rows = drawn.nonzero()[:, 0]
            self._rows = rows[found.depths[rows].sort(stable=True).indices]
            self._footprints = Footprints(*(part[self._rows] for part in found))
            self._bins = _bin_tiles(self._footprints, camera)

    def splat(self, values: Array) -> tuple[Array, Array]:
        channels = values.shape[1]
        lines = (len(self._bins.starts) - 1) // self._bins.columns
        picture = torch.zeros(lines * self._bins.columns, PIXELS, channels + 1, dtype=self._kind)
        tables = self._tables(values)
        with torch.no_grad():
            for tiles, blended in self._over_groups(
                torch.arange(len(picture)), lambda tiles: self._blend(tiles, tables, None)
            ):
                picture[tiles] = blended
        picture = picture.reshape(lines, self._bins.columns, TILE, TILE, channels + 1)
        whole = picture.transpose(1, 2).reshape(lines * TILE, self._bins.columns * TILE, channels + 1).numpy()
        whole = whole[: self.camera.height, : self.camera.width]
        return whole[..., :-1], whole[..., -1]

    def backward(self, values: Array, image_grad: Array) -> GaussianGradients:
        """As `CpuView.backward`, by autograd; tiles in which `image_grad` is 0 are left out."""
        grads = self._grad_tiles(image_grad)
        tables = self._tables(values)
        sums = [torch.zeros_like(table) for table in tables]

        def group(tiles: Tensor) -> _Used:
            used: _Used = []
            (self._blend(tiles, tables, used)[..., :-1] * grads[tiles]).sum().backward()
            return used

        for _, used in self._over_groups(grads.abs().amax((1, 2)).nonzero()[:, 0], group):
            for index, leaves in used:
                for total, leaf in zip(sums, leaves, strict=True):
                    assert leaf.grad is not None  # every leaf enters the picture
                    total.index_add_(0, index.reshape(-1), leaf.grad.flatten(0, 1).to(total.dtype))
        by_means_px, by_shapes, by_values = (total[:-1] for total in sums)

        def pull_back(piece: Tensor) -> list[Tensor | None]:
            leaves = [part[self._rows[piece]].requires_grad_() for part in self._all]
            again = project(leaves, self.camera, self.settings)
            torch.autograd.backward([again.means_px, again.shapes], [by_means_px[piece], by_shapes[piece]])
            return [leaf.grad for leaf in leaves]

        pieces = _in_threads(torch.arange(len(self._rows)).split(_ROWS), pull_back)
        found = [torch.cat(parts) for parts in zip(*pieces, strict=True)]
        found += [by_values[:, :-1], by_means_px.to(self._kind)]
        full = []
        for part in found:
            whole = torch.zeros(len(self._all[0]), *part.shape[1:], dtype=self._kind)
            whole[self._rows] = part
            full.append(whole.numpy())
        return GaussianGradients(*full)

    def _project(self, rows: Tensor) -> Footprints:
        return project([part[rows] for part in self._all], self.camera, self.settings)

    def _tables(self, values: Array) -> list[Tensor]:
        """Positions, shapes and values with a one behind them, each with a last row that draws nothing."""
        given = torch.from_numpy(values).to(self._kind)[self._rows]
        ones = torch.ones(len(given), 1, dtype=self._kind)
        tables = [self._footprints.means_px, self._footprints.shapes, torch.cat([given, ones], 1)]
        padded = [torch.cat([table, table.new_zeros(1, table.shape[1])]) for table in tables]
        padded[1][-1, 3] = _NEVER
        return padded

    def _grad_tiles(self, image_grad: Array) -> Tensor:
        height, width, channels = image_grad.shape
        columns, lines = self._bins.columns, (len(self._bins.starts) - 1) // self._bins.columns
        whole = torch.zeros(lines * TILE, columns * TILE, channels, dtype=self._kind)
        whole[:height, :width] = torch.from_numpy(image_grad)
        tiles = whole.reshape(lines, TILE, columns, TILE, channels).transpose(1, 2)
        return tiles.reshape(-1, PIXELS, channels)

    def _over_groups(self, tiles: Tensor, work: Callable[[Tensor], _T]) -> Iterator[tuple[Tensor, _T]]:
        """Groups of tiles of like length, the longest first, without those that are empty; and what `work`
        makes of each, one group per thread at a time."""
        lengths = self._bins.starts.diff()[tiles]
        order = lengths.sort(descending=True).indices
        groups = [group for group in tiles[order[lengths[order] > 0]].split(_TILES) if len(group)]
        return zip(groups, _in_threads(groups, work), strict=True)

    def _blend(self, tiles: Tensor, tables: list[Tensor], used: _Used | None) -> Tensor:
        """(B,) tiles -> (B, 256, C + 1) blended values and alpha; `used` collects leaves for gradients."""
        bins, settings = self._bins, self.settings
        starts, ends = bins.starts[tiles], bins.starts[tiles + 1]
        corners = TILE * torch.stack([tiles % bins.columns, tiles // bins.columns], 1)[:, None].double()
        centres = torch.arange(TILE, dtype=self._kind) + 0.5
        total = torch.zeros(len(tiles), PIXELS, tables[2].shape[1], dtype=self._kind)
        clear = torch.ones(len(tiles), 1, PIXELS, dtype=self._kind)
        alive = torch.arange(len(tiles))
        done: list[tuple[Tensor, Tensor]] = []
        for start in range(0, int((ends - starts).max()), _STEP):
            places = starts[alive, None] + start + torch.arange(_STEP)
            inside = places < ends[alive, None]
            index = torch.where(inside, bins.ranks[places.clamp(max=len(bins.ranks) - 1)], len(tables[0]) - 1)
            leaves = [(tables[0][index] - corners[alive]).to(self._kind), tables[1][index], tables[2][index]]
            if used is not None:
                leaves = [leaf.requires_grad_() for leaf in leaves]
                used.append((index, leaves))
            alphas = _alphas(leaves[0], leaves[1], centres, settings)
            behind = (1 - alphas).cumprod(1) * clear
            weights = alphas * (behind / (1 - alphas)) * (behind > settings.transmittance_min)
            total = torch.baddbmm(total, weights.transpose(1, 2), leaves[2])
            clear = behind[:, -1:]
            running = clear.detach().amax((1, 2)) > settings.transmittance_min
            running &= ends[alive] - starts[alive] > start + _STEP
            if not bool(running.all()):
                done.append((alive[~running], total[~running]))
                alive, clear, total = alive[running], clear[running], total[running]
            if len(alive) == 0:
                break
        return torch.cat([part for _, part in done])[torch.cat([which for which, _ in done]).argsort()]


def _alphas(means: Tensor, shapes: Tensor, centres: Tensor, settings: RasterSettings) -> Tensor:
    """(B, L, 2) means within their tile, (B, L, 4) shapes -> (B, L, 256) alphas, 0 below alpha_min."""
    dx, dy = centres - means[..., :1], centres - means[..., 1:]
    xx, xy, yy, log_opacity = (shapes[..., n : n + 1] for n in range(4))
    columns, rows = log_opacity - 0.5 * xx * dx * dx, -0.5 * yy * dy * dy
    power = torch.addcmul(columns[..., None, :] + rows[..., None], dy[..., None], (-xy * dx)[..., None, :])
    alphas = power.flatten(2).exp().clamp(max=float(np.float32(settings.alpha_max)))
    return alphas * (alphas >= settings.alpha_min)


class TorchRasterizer:
    """The baseline as a backend: `splat` and `backward`, no adjoint, no depth."""

    name = "pytorch"

    def __init__(self, kind: torch.dtype = torch.float32) -> None:
        self._kind = kind

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> TorchView:
        return TorchView(gaussians, camera, settings, self._kind)
