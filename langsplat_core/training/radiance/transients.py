"""Transients: parts of a photograph that others contradict, such as people who walk by.

After RobustNeRF (Sabour et al. 2023), WildGaussians (Kulhanek et al. 2024) and SpotLessSplats (Sabour et al.
2024), without a network. A photograph is compared with the render by the mean colours of patches, under the
exposure that fits best: details, thin things and small highlights average out. A patch differs where that is
several times the median over all views. It is transient where other views see the very surface that is
rendered there, and find it as it is rendered. What stands still and is not learnt yet, or shines, differs in
other views too, and what only one photograph shows is in no other.

Nothing is masked for good: patches are judged anew whenever their view is rendered.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import binary_dilation, label
from torch import Tensor

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera
from langsplat_core.scene.transform import C0
from langsplat_core.training.radiance.differentiable import DifferentiableRenderer
from langsplat_core.training.radiance.losses import fit_exposure, with_exposure

GRID = 32  # patches along both sides of a view
MOST = 0.4  # of a photograph's patches that may be transient
SAME_SURFACE = 0.1  # of the depth, within which two views see the same surface


@dataclass
class Transients:
    """Observations of V training views when they were last rendered. The first rows of arrays are views."""

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
        """Judge the patches of view `index` anew.

        By its (GRID, GRID, 3) mean colours, NaN where masked, and its rendered (GRID, GRID) depths.
        """
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
    for _ in range(3):  # the 70 % of the patches that fit best tell the exposure
        exposed = with_exposure(image, fit_exposure([(image[fits], target[fits])], ridge=0.01))
        apart = (exposed - target).abs().mean(1)
        fits = apart <= apart.nanquantile(0.7)
    return (exposed - target).numpy().reshape(rendered.shape)


def count_agreeing(index: int, cameras: Sequence[Camera], depths: Array, alike: Array) -> Array:
    """Return (2, GRID, GRID) numbers of other views for each patch of view `index`.

    Of those that see the surface where view `index` renders it, and find it `alike` (V, GRID, GRID), and of
    all that see it.
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
    """Return the (GRID, GRID) bool patches that `contradicts` in connected pieces, and those around them.

    Pieces have four patches at least, one of them of a size above `sure`. Of more than `MOST` of all patches
    those remain that differ most.
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


def rendered_depths(renderer: DifferentiableRenderer, values: dict[str, Tensor], camera: Camera) -> Array:
    """Return the (GRID, GRID) mean depths of what a camera sees of the `values`, NaN where little is."""
    small = camera.resized(64, max(1, round(64 * camera.height / camera.width)))
    z = camera.project(values["means"].detach().cpu().numpy())[1].clip(0).astype(np.float32)
    grey = torch.from_numpy(np.repeat((z[:, None, None] - 0.5) / C0, 3, axis=2)).to(values["means"].device)
    with torch.no_grad():
        rendered = renderer.render({**values, "sh_dc": grey}, small, 0)
    depth, alpha = patch_means(rendered.image)[..., 0], patch_means(rendered.alpha[..., None])[..., 0]
    return np.where(alpha > 0.5, depth / np.maximum(alpha, 1e-6), np.nan)
