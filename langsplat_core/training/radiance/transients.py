"""What moves: parts of a photograph that others contradict, such as people who walk by.

After RobustNeRF (Sabour et al. 2023), WildGaussians (Kulhanek et al. 2024) and SpotLessSplats (Sabour et al.
2024), without a network. A photograph is compared with what is drawn by the mean colours of patches, under
the exposure that fits best: details, thin things and small highlights average out. A patch differs where
that is several times the median over all views. It is of something that moves where other views see the very
surface that is drawn there, and find it as it is drawn. What stands still and is not learnt yet, or shines,
differs in other views too, and what only one photograph shows is in no other.

Nothing is masked for good: patches are judged anew whenever their view is drawn, and what other views teach
comes back. Where all that moves explains little of the error (`EXPLAINS`) after the first steps, nothing is
masked and nothing more is looked for.
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
FROM = 0.2  # of the steps: what moves counts until then
FACTOR = 5.0  # times the median difference of all patches: from here on a patch differs ...
LEAST = 0.03  # ... and at least so much, colours in [0, 1]
SURE = 1.5  # times that: one patch at least of what moves
ALIKE = 2 / 3  # of that: up to here a patch is as it is drawn
FEWEST = 4  # patches that touch, of what moves
MOST = 0.4  # of a photograph that may move
AT = 0.1  # of the depth, within which two views see the same surface
KEPT = 0.5  # of the difference that was found before, in the mean
FITTING = 0.7  # of the patches, those that fit best, tell the exposure
RIDGE = 0.01  # of that exposure, as `losses.RIDGE`
AGAINST = 3  # times as many other views agree with what is drawn as do not
EXPLAINS = 0.24  # of the squared differences, that must lie in what moves
DEPTH_SIDE = 64  # px, width of the drawn depths


@dataclass
class Watched:
    """What was found when the V training views were last drawn. The first rows of arrays are views."""

    differences: Array  # (V, GRID, GRID, 3) float32 mean colours, drawn less photographed; NaN: not known
    depths: Array  # (V, GRID, GRID) float32 world units along the camera's z; NaN where nothing is drawn
    moving: Array  # (V, GRID, GRID) bool

    def explained(self) -> float:
        """The share of all squared differences that lies in what moves."""
        squares = np.nan_to_num(self.differences.astype(np.float64) ** 2).sum(-1)
        return float(squares[self.moving].sum() / max(squares.sum(), 1e-12))


def nothing_watched(views: int) -> Watched:
    """Before the first step."""
    shape = views, GRID, GRID
    return Watched(
        np.full((*shape, 3), np.nan, np.float32), np.full(shape, np.nan, np.float32), np.zeros(shape, bool)
    )


def look(
    watched: Watched, index: int, cameras: Sequence[Camera], drawn: Array, seen: Array, depths: Array
) -> None:
    """Take up what view `index` shows now, all (GRID, GRID, ...): mean colours drawn, NaN where masked, and
    photographed, and the depths drawn."""
    found = difference(drawn, seen)
    before = watched.differences[index]
    watched.differences[index] = np.where(np.isnan(before), found, KEPT * before + (1 - KEPT) * found)
    watched.depths[index] = depths
    sizes = np.sqrt((watched.differences**2).mean(-1))  # NaN where a view was not drawn yet
    bar = max(LEAST, FACTOR * float(np.nanmedian(sizes)))
    differs = sizes[index] > bar
    agree, all_views = agreeing(index, cameras, watched.depths, sizes < ALIKE * bar)
    differs &= (agree > 0) & (agree >= AGAINST * (all_views - agree))
    watched.moving[index] = grown(differs, sizes[index], SURE * bar)


def difference(drawn: Array, seen: Array) -> Array:
    """(GRID, GRID, 3) colours under the exposure that takes most of them to those `seen`, less these."""
    image, target = (torch.from_numpy(colours.reshape(-1, 3)) for colours in (drawn, seen))
    fits = torch.isfinite(image).all(1)
    for _ in range(3):
        exposed = with_exposure(image, fit_exposure([(image[fits], target[fits])], RIDGE))
        apart = (exposed - target).abs().mean(1)
        fits = apart <= apart.nanquantile(FITTING)
    return (exposed - target).numpy().reshape(drawn.shape)


def agreeing(index: int, cameras: Sequence[Camera], depths: Array, alike: Array) -> Array:
    """(2, GRID, GRID) int: how many other views see the surface that view `index` draws in a patch and find
    it `alike` (V, GRID, GRID), and how many see it."""
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
        at = other, row, column
        same = np.abs(z[inside] / depths[at] - 1) < AT  # NaN is not
        counts[:, known[inside]] += np.stack([same & alike[at], same])
    return counts.reshape(2, GRID, GRID)


def grown(differs: Array, sizes: Array, sure: float) -> Array:
    """(GRID, GRID) bool: patches that touch, `FEWEST` at least and one of them of a size above `sure`, and
    those around them; of more than `MOST` of all patches those that differ most."""
    pieces, _ = label(differs)
    numbers, counts = np.unique(pieces[differs], return_counts=True)
    good = np.intersect1d(numbers[counts >= FEWEST], pieces[differs & (sizes > sure)])
    moving = binary_dilation(np.isin(pieces, good), np.ones((3, 3)))
    if moving.mean() > MOST:
        moving &= sizes > np.quantile(sizes, 1 - MOST)
    return np.asarray(moving)


def patches(picture: Tensor) -> Array:
    """Means of the patches of a (H, W, C) picture, (GRID, GRID, C) float32."""
    means = torch.nn.functional.adaptive_avg_pool2d(picture.detach().permute(2, 0, 1), GRID)
    return means.permute(1, 2, 0).cpu().numpy()


def pixels_of(moving: Array, size: tuple[int, int], device: torch.device) -> Tensor:
    """(H, W) bool pixels of the (GRID, GRID) patches; size: (H, W)."""
    grid = torch.tensor(moving, dtype=torch.float32, device=device)[None, None]
    return torch.nn.functional.interpolate(grid, size)[0, 0] > 0


def drawn_depths(renderer: DifferentiableRenderer, values: dict[str, Tensor], camera: Camera) -> Array:
    """(GRID, GRID) mean depths of what is drawn, NaN where little is."""
    shape = DEPTH_SIDE, max(1, round(DEPTH_SIDE * camera.height / camera.width))
    z = camera.project(values["means"].detach().cpu().numpy())[1].clip(0).astype(np.float32)
    grey = torch.from_numpy(np.repeat((z[:, None, None] - 0.5) / C0, 3, axis=2)).to(values["means"].device)
    with torch.no_grad():
        drawn = renderer.render({**values, "sh_dc": grey}, camera.resized(*shape), 0)
    depth, alpha = patches(drawn.image)[..., 0], patches(drawn.alpha[..., None])[..., 0]
    return np.where(alpha > 0.5, depth / np.maximum(alpha, 1e-6), np.nan)
