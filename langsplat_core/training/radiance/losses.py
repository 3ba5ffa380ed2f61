"""Comparison of images with photographs: losses (torch and compiled kernels), exposures, transients.

The losses are L1 and structural similarity (Wang et al. 2004). Images are (H, W, C) float32 with values about
[0, 1]. The SSIM window is the usual Gaussian of 11x11 pixels with sigma 1.5; outside the image it sees zeros,
as in the INRIA code.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.ndimage import binary_dilation, label
from torch import Tensor

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel, shared_workers
from langsplat_core.raster.cpu.lanes import LANES, lanes, load, store
from langsplat_core.scene import Camera

RADIUS, SIGMA = 5, 1.5  # of the window, pixels
C1, C2 = 0.01**2, 0.03**2  # of SSIM, for a data range of 1
_TWO = np.float32(2)  # a plain 2 would turn every product into float64 and halve the speed
_ONE, _ZERO = np.float32(1), np.float32(0)
_WINDOW = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)  # its 11 taps along one axis
_WINDOW /= _WINDOW.sum()
_TAPS = _WINDOW.astype(np.float32)


# The loss and its gradient in three passes over the rows: pass 1 blurs the raw moments along rows; pass 2
# blurs them across rows, forms SSIM and its derivatives by the moments, and blurs those along rows; pass 3
# blurs the derivatives across rows and adds everything up. Rows are independent within a pass, so results do
# not depend on the number of threads. Rows of moments and derivatives are filled up to whole `LANES`.
#
# With S = a1 a2 / (b1 b2) and mx, xx, xy the blurred x, x^2, x y: dS/dmx = 2 my (a2 - a1) / (b1 b2)
# - 2 mx S (1/b1 - 1/b2), dS/dxx = -S / b2, dS/dxy = 2 a1 / (b1 b2), and dS/dx = blur(dS/dmx)
# + 2 x blur(dS/dxx) + y blur(dS/dxy), because the blur is symmetric.


@helper
def _along(padded: Array, out: Array, channels: int) -> None:
    """Blur one row; `padded` has RADIUS pixels of zeros at both ends."""
    for i in range(0, out.shape[0], LANES):
        total = _TAPS[0] * load(padded, i)
        for k in range(1, 2 * RADIUS + 1):
            total = total + _TAPS[k] * load(padded, i + k * channels)
        store(out, i, total)


@helper
def _across(rows: Array, y: int, out: Array) -> None:
    """Blur `rows` (H, n) at row y over the rows around it; zeros beyond the image."""
    for i in range(0, out.shape[0], LANES):
        total = lanes(_ZERO)
        for k in range(max(RADIUS - y, 0), min(2 * RADIUS + 1, rows.shape[0] + RADIUS - y)):
            total = total + _TAPS[k] * load(rows, (y + k - RADIUS) * out.shape[0] + i)
        store(out, i, total)


@kernel
def _blur_moments(first: int, last: int, image: Array, target: Array, channels: int, moments: Array) -> None:
    """Pass 1: (H, n) images -> `moments` (4, H, m), x, y, x^2 + y^2, x y blurred along rows."""
    n, edge = image.shape[1], RADIUS * channels
    padded = np.zeros((4, moments.shape[2] + 2 * edge), np.float32)
    squares, products = padded[2, edge : edge + n], padded[3, edge : edge + n]
    for row in range(first, last):
        x, y = image[row], target[row]
        padded[0, edge : edge + n] = x
        padded[1, edge : edge + n] = y
        for i in range(n):
            squares[i] = x[i] * x[i] + y[i] * y[i]
            products[i] = x[i] * y[i]
        for m in range(4):
            _along(padded[m], moments[m, row], channels)


@kernel
def _compare(
    first: int, last: int, moments: Array, n: int, channels: int, derivatives: Array, row_ssim: Array
) -> None:
    """Pass 2: `derivatives` (3, H, m) by the blurred x, x^2, xy, blurred along rows; SSIM sums per row."""
    edge = RADIUS * channels
    c1, c2 = np.float32(C1), np.float32(C2)
    m = np.empty((4, moments.shape[2]), np.float32)
    padded = np.zeros((3, moments.shape[2] + 2 * edge), np.float32)
    by_mx, by_xx, by_xy = padded[0, edge : edge + n], padded[1, edge : edge + n], padded[2, edge : edge + n]
    similarity = np.empty(n, np.float32)
    for row in range(first, last):
        for k in range(4):
            _across(moments[k], row, m[k])
        for i in range(n):
            mx, my = m[0, i], m[1, i]
            product, squares = mx * my, mx * mx + my * my
            a1, a2 = _TWO * product + c1, _TWO * (m[3, i] - product) + c2
            b1, b2 = squares + c1, m[2, i] - squares + c2
            inverse_b1, inverse_b2 = _ONE / b1, _ONE / b2
            inverse = inverse_b1 * inverse_b2
            s = a1 * a2 * inverse
            similarity[i] = s
            by_mx[i] = _TWO * (my * (a2 - a1) * inverse - mx * s * (inverse_b1 - inverse_b2))
            by_xx[i] = -s * inverse_b2
            by_xy[i] = _TWO * a1 * inverse
        row_ssim[row] = similarity.sum()
        for k in range(3):
            _along(padded[k], derivatives[k, row], channels)


@kernel
def _gather_gradient(
    first: int,
    last: int,
    image: Array,
    target: Array,
    derivatives: Array,
    weights: Array,
    gradient: Array,
    row_l1: Array,
) -> None:
    """Pass 3: the gradient by the image, weights[0] sign(x - y) - weights[1] dSSIM/dx; L1 sums per row."""
    n = image.shape[1]
    d = np.empty((3, derivatives.shape[2]), np.float32)
    difference = np.empty(n, np.float32)
    l1, dssim, zero = weights[0], weights[1], np.float32(0)
    for row in range(first, last):
        for k in range(3):
            _across(derivatives[k], row, d[k])
        x, y, out = image[row], target[row], gradient[row]
        for i in range(n):
            difference[i] = abs(x[i] - y[i])
            sign = l1 if x[i] > y[i] else (-l1 if x[i] < y[i] else zero)
            out[i] = sign - dssim * (d[0, i] + _TWO * x[i] * d[1, i] + y[i] * d[2, i])
        row_l1[row] = difference.sum()


def _loss_and_gradient(image: Array, target: Array, lambda_dssim: float) -> tuple[float, Array]:
    """Return the loss of (H, W, C) contiguous float32 images, and its (H, W, C) gradient by `image`."""
    height, width, channels = image.shape
    n = width * channels
    x, y = image.reshape(height, n), target.reshape(height, n)
    blurred = np.empty((7, height, -(-n // LANES) * LANES), np.float32)
    moments, derivatives = blurred[:4], blurred[4:]
    row_ssim, row_l1 = np.empty(height), np.empty(height)
    gradient = np.empty((height, n), np.float32)
    weights = np.array([1 - lambda_dssim, lambda_dssim], np.float32) / np.float32(x.size)
    run = shared_workers().run
    run(_blur_moments, height, x, y, channels, moments)
    run(_compare, height, moments, n, channels, derivatives, row_ssim)
    run(_gather_gradient, height, x, y, derivatives, weights, gradient, row_l1)
    loss = (1 - lambda_dssim) * row_l1.sum() / x.size + lambda_dssim * (1 - row_ssim.sum() / x.size)
    return float(loss), gradient.reshape(image.shape)


# The same by torch, on any device, and the loss of training.


class _Blur(torch.autograd.Function):
    """Blur of each channel of (..., H, W, C) under the SSIM window; zeros outside.

    Eleven shifted additions per axis: on a CPU about 25 times as fast as a grouped `conv2d`. The operator is
    symmetric, so that it is its own gradient.
    """

    @staticmethod
    def forward(ctx: Any, images: Tensor) -> Tensor:
        for axis, size in ((-2, images.shape[-2]), (-3, images.shape[-3])):
            padded = torch.nn.functional.pad(images, [0, 0] * (-axis - 1) + [RADIUS, RADIUS])
            images = padded.narrow(axis, 0, size) * float(_WINDOW[0])
            for offset, tap in enumerate(_WINDOW[1:].tolist(), start=1):
                images.add_(padded.narrow(axis, offset, size), alpha=tap)
        return images

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return blur(grads[0])


def blur(images: Tensor) -> Tensor:
    """Blur each channel of (..., H, W, C) under the SSIM window; zeros outside."""
    blurred: Tensor = _Blur.apply(images)
    return blurred


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return the (H, W, C) structural similarity of two images, in [-1, 1].

    SSIM needs the squares only as their sum.
    """
    squares = torch.addcmul(image * image, target, target)
    mx, my, xx_yy, xy = blur(torch.stack([image, target, squares, image * target]))
    product, squares = mx * my, torch.addcmul(mx * mx, my, my)
    a1, a2 = 2 * product + C1, 2 * (xy - product) + C2
    b1, b2 = squares + C1, xx_yy - squares + C2
    return (a1 * a2) / (b1 * b2)


class _CpuLoss(torch.autograd.Function):
    """`radiance_loss` by the compiled kernels, which find value and gradient together."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, lambda_dssim: float) -> Tensor:
        pair = image.detach().contiguous().numpy(), target.contiguous().numpy()
        value, gradient = _loss_and_gradient(*pair, lambda_dssim)
        ctx.save_for_backward(torch.from_numpy(gradient))
        return torch.tensor(value)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * grads[0], None, None


def radiance_loss(image: Tensor, target: Tensor, lambda_dssim: float) -> Tensor:
    """Return (1 - lambda) L1 + lambda (1 - SSIM), equation 7 of Kerbl et al. 2023; a scalar >= 0.

    Differentiable by `image` only. Single precision on the CPU takes the compiled kernels: four times as
    fast, equal to 1e-6.
    """
    if image.device.type == "cpu" and image.dtype == torch.float32:
        loss: Tensor = _CpuLoss.apply(image, target, lambda_dssim)
        return loss
    l1 = (image - target).abs().mean()
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim_map(image, target).mean())


# Exposure and white balance of a photograph, as an affine change of the scene's colours.


def fit_exposure(pairs: Sequence[tuple[Tensor, Tensor]], ridge: float = 0.1) -> Tensor:
    """Return the (4, 3) affine change of colours that best takes images to their targets (least squares).

    (r, g, b, 1) @ change are the new colours. pairs: (..., 3) images and targets, at least one pair. ridge:
    weight, over the mean square of colours, that pulls the change towards the identity.
    """
    device = pairs[0][0].device
    moments = torch.zeros((4, 4), dtype=torch.float64, device=device)
    wanted, count = moments[:, :3], 0
    for image, target in pairs:
        padded = torch.nn.functional.pad(image.detach().reshape(-1, 3).double(), (0, 1), value=1.0)
        moments = moments + padded.T @ padded
        wanted = wanted + padded.T @ target.detach().reshape(-1, 3).double()
        count += len(padded)
    # The second term keeps the system solvable for black images.
    hold = max(ridge * float(moments.diagonal()[:3].mean()), 1e-9 * max(count, 1))
    none = torch.eye(4, dtype=torch.float64, device=device)
    return torch.linalg.solve(moments + hold * none, wanted + hold * none[:, :3]).float()


def with_exposure(image: Tensor, change: Tensor) -> Tensor:
    """Return the (..., 3) image under the (4, 3) affine change of its colours."""
    return image @ change[:3] + change[3]


def fit_exposures(pairs: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, float]:
    """Return (V, 4, 3) exposures beyond the common one, and their gain, dB; pairs: image, target (..., 3)."""
    common = fit_exposure(pairs)
    pairs = [(with_exposure(image, common), target) for image, target in pairs]
    exposures = torch.stack([fit_exposure([pair]) for pair in pairs])
    before = after = 0.0
    for (image, target), exposure in zip(pairs, exposures, strict=True):
        before += float((image - target).square().sum())
        after += float((with_exposure(image, exposure) - target).square().sum())
    return exposures, 10 * math.log10(max(before, 1e-12) / max(after, 1e-12))


# Transients: parts of a photograph that others contradict, such as people who walk by.
#
# After RobustNeRF (Sabour et al. 2023), WildGaussians (Kulhanek et al. 2024) and SpotLessSplats (Sabour et
# al. 2024), without a network. A photograph is compared with the render by the mean colours of patches, under
# the exposure that fits best: details, thin things and small highlights average out. A patch differs where
# that is several times the median over all views. It is transient where other views see the very surface that
# is rendered there, and find it as it is rendered. Static surfaces that are not learnt yet, or specular ones,
# differ in other views too; surfaces in only one photograph are in no other. No mask is permanent:
# patches are judged anew whenever their view is rendered.

GRID = 32  # patches along both sides of a view
MOST = 0.4  # of a photograph's patches that may be transient
SAME_SURFACE = 0.1  # of the depth, within which two views see the same surface


@dataclass
class Transients:
    """Observations of V training views when they were last rendered; the first axis of arrays is the view."""

    differences: Array  # (V, GRID, GRID, 3) float32 mean colours, render less photograph; NaN: not known
    depths: Array  # (V, GRID, GRID) float32 world units along the camera's z; NaN where nothing is rendered
    moving: Array  # (V, GRID, GRID) bool: transient

    def explained(self) -> float:
        """Return the share of all squared differences that lies in transient patches."""
        squares = np.nan_to_num(self.differences.astype(np.float64) ** 2).sum(-1)
        return float(squares[self.moving].sum() / max(squares.sum(), 1e-12))

    def observe(
        self, index: int, cameras: Sequence[Camera], rendered: Array, photographed: Array, depths: Array
    ) -> None:
        """Judge a view's patches by (GRID, GRID, 3) colours, NaN if masked, and (GRID, GRID) depths."""
        found, before = colour_difference(rendered, photographed), self.differences[index]
        self.differences[index] = np.where(np.isnan(before), found, (before + found) / 2)
        self.depths[index] = depths
        sizes = np.sqrt((self.differences**2).mean(-1))  # NaN where a view was not rendered yet
        bar = max(0.03, 5 * float(np.nanmedian(sizes)))
        contradicts = sizes[index] > bar
        agreeing, seeing = count_agreeing(index, cameras, self.depths, sizes < 2 / 3 * bar)
        contradicts &= (agreeing > 0) & (agreeing >= 3 * (seeing - agreeing))
        self.moving[index] = connected_patches(contradicts, sizes[index], 1.5 * bar)

    def still_pixels(self, index: int, size: tuple[int, int], device: torch.device) -> Tensor:
        """Return the (H, W) bool pixels of view `index`, of that size, that are not transient."""
        moving = torch.tensor(self.moving[index], dtype=torch.float32, device=device)
        return torch.nn.functional.interpolate(moving[None, None], size)[0, 0] == 0


def no_transients(views: int) -> Transients:
    """Return the state before the first step."""
    shape = views, GRID, GRID
    unknown = np.full((*shape, 3), np.nan, np.float32)
    return Transients(unknown, unknown[..., 0].copy(), np.zeros(shape, bool))


def colour_difference(rendered: Array, photographed: Array) -> Array:
    """Return the (GRID, GRID, 3) colours rendered less those photographed, under the best exposure."""
    image, target = (torch.from_numpy(colours.reshape(-1, 3)) for colours in (rendered, photographed))
    fits = torch.isfinite(image).all(1)
    for _ in range(3):  # the exposure is fitted to the 70 % of the patches that fit best
        exposed = with_exposure(image, fit_exposure([(image[fits], target[fits])], ridge=0.01))
        apart = (exposed - target).abs().mean(1)
        fits = apart <= apart.nanquantile(0.7)
    return (exposed - target).numpy().reshape(rendered.shape)


def count_agreeing(index: int, cameras: Sequence[Camera], depths: Array, alike: Array) -> Array:
    """Return (2, GRID, GRID) numbers of other views for each patch of view `index`.

    First of those that see the surface where view `index` renders it and find it `alike` (V, GRID, GRID),
    then of all that see it.
    """
    grids = [camera.resized(GRID, GRID) for camera in cameras]  # a pixel for each patch
    points = grids[index].unproject(grids[index].pixel_centres(), depths[index]).reshape(-1, 3)
    known = np.flatnonzero(np.isfinite(points[:, 0]))
    counts = np.zeros((2, GRID * GRID), int)
    for other, camera in enumerate(grids):
        if other == index:
            continue
        pixels, z = camera.project(points[known])
        inside = camera.in_image(pixels, z)
        column, row = pixels[inside].astype(int).T
        same = np.abs(z[inside] / depths[other, row, column] - 1) < SAME_SURFACE  # NaN is not
        counts[:, known[inside]] += np.stack([same & alike[other, row, column], same])
    return counts.reshape(2, GRID, GRID)


def connected_patches(contradicts: Array, sizes: Array, sure: float) -> Array:
    """Return (GRID, GRID) bool: connected pieces of the patches `contradicts`, and the patches around.

    Pieces have four patches at least, one of them with a size above `sure`. If they are more than `MOST` of
    all patches, those that differ most remain.
    """
    pieces, _ = label(contradicts)
    numbers, counts = np.unique(pieces[contradicts], return_counts=True)
    good = np.intersect1d(numbers[counts >= 4], pieces[contradicts & (sizes > sure)])
    moving = binary_dilation(np.isin(pieces, good), np.ones((3, 3)))
    if moving.mean() > MOST:
        moving &= sizes > np.quantile(sizes, 1 - MOST)
    return np.asarray(moving)


def patch_means(image: Tensor) -> Array:
    """Return the (GRID, GRID, C) float32 means of the patches of a (H, W, C) image."""
    means = torch.nn.functional.adaptive_avg_pool2d(image.detach().permute(2, 0, 1), GRID)
    return means.permute(1, 2, 0).cpu().numpy()
