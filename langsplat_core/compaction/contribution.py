"""What each Gaussian contributes to the pictures of a scene, and what pictures lose without some of them.

**Contribution.** In a view with blending weights w (a row of W per pixel p), taking Gaussian i of colour
c_i away changes pixel p by about w_pi (c_i - C_p): its weight times its distance from the picture C. The
adjoint sums this over pixels without ever listing them: with one gather of [1, C, |C|^2],

    W_i = sum_p w_pi,    E_i = sum_p w_pi |c_i - C_p|^2 = |c_i|^2 W_i - 2 c_i . (W^T C)_i + (W^T |C|^2)_i,

and by Cauchy-Schwarz sum_p w_pi |c_i - C_p| <= sqrt(W_i E_i), an upper bound of the total change in display
values times pixels. That is of one Gaussian taken away alone. Many of one colour hold a white wall up
together, though each has nothing but its like behind it; so every Gaussian counts as at least `ALONE` away
from the picture: its contribution is sqrt(W_i (E_i + ALONE^2 W_i)). Over views the largest counts, so that
what only one view shows is not averaged away. On the bundled scene, at 77 % of the Gaussians, the mean loss
(the worst view's) is 0.21 (1.3) dB; ranked by W_i it is 0.42 (1.3), by sqrt(W_i E_i) 0.30 (3.4).

**Loss.** With photographs, the loss in PSNR is measured on them. Without, it is derived from how far the
compact picture lies from the original one: removing something from a trained scene is, to first order,
uncorrelated with what the scene already gets wrong (at a minimum of the training loss no direction helps),
so squared errors add. A view that the original shows with mean squared error e and that changes by d loses

    10 log10(1 + d / e) dB.

e is not known without photographs; it is what a scene of an assumed PSNR has. A scene that is worse than
assumed loses less than stated, so the assumption should be on the high side. On the bundled scene, with its
photographs and true e, this agreed with the measured loss within 0.03 dB at losses up to 1 dB.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array, mean_squared_error, psnr
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LiftingRasterizer, Rasterizer, View
from langsplat_core.raster.render import colours_seen, splat_colours
from langsplat_core.scene import SH_COUNTS, Camera, Scene

ALONE = 0.055  # display values, RGB distance; see above


@dataclass(frozen=True, eq=False)
class MeasuringView:
    """One view on which the loss is measured."""

    camera: Camera
    original: Array  # (H, W, 3) float32 in [0, 1], the picture of the original scene
    photograph: Array | None = None  # (H, W, 3) float32 in [0, 1]


def draw(rasterizer: Rasterizer, scene: Scene, camera: Camera) -> tuple[View, Array]:
    """The projected view and its (H, W, 3) float32 picture, unclipped, without background."""
    view = rasterizer.view(scene.gaussians, camera, scene.raster_settings())
    return view, splat_colours(view, scene.gaussians, camera).colours


def measuring_views(
    rasterizer: Rasterizer, scene: Scene, cameras: Sequence[Camera], photographs: Sequence[Array | None]
) -> list[MeasuringView]:
    """Pictures of the original `scene`, with the (H, W, 3) uint8 photographs of the same cameras or None."""
    views = []
    for camera, photograph in zip(cameras, photographs, strict=True):
        truth = None if photograph is None else photograph.astype(np.float32) / 255
        picture = np.clip(draw(rasterizer, scene, camera)[1], 0, 1)
        views.append(MeasuringView(camera, picture, truth))
    return views


def contributions(
    rasterizer: LiftingRasterizer, scene: Scene, cameras: Sequence[Camera], progress: Progress = silent
) -> Array:
    """(N,) float64 >= 0: the largest contribution of each Gaussian to any of `cameras` (see above)."""
    largest = np.zeros(len(scene.gaussians))
    for index, camera in enumerate(cameras):
        view = rasterizer.view(scene.gaussians, camera, scene.raster_settings())
        own = colours_seen(scene.gaussians, camera)
        picture = view.splat(own)[0]
        stacked = [np.ones_like(picture[..., :1]), picture, (picture**2).sum(-1, keepdims=True)]
        sums = view.gather(np.concatenate(stacked, -1)).astype(np.float64)
        weight, own = sums[:, 0], own.astype(np.float64)
        error = (own**2).sum(1) * weight - 2 * (own * sums[:, 1:4]).sum(1) + sums[:, 4]
        score = np.sqrt(weight * (np.maximum(error, 0) + ALONE**2 * weight))
        np.maximum(largest, score, out=largest)
        progress("ranking Gaussians", (index + 1) / len(cameras))
    return largest


def psnr_losses(
    rasterizer: Rasterizer, scene: Scene, views: Sequence[MeasuringView], assumed_psnr: float
) -> Array:
    """(V,) dB lost by `scene` in each view; negative where it comes nearer to a photograph.

    `assumed_psnr` (dB) is the original's, used for views without a photograph.
    """
    losses = []
    for view_ in views:
        picture = np.clip(draw(rasterizer, scene, view_.camera)[1], 0, 1)
        if view_.photograph is None:
            change = mean_squared_error(picture, view_.original)
            losses.append(estimated_loss(change, assumed_psnr))
        else:
            before, after = (psnr(image, view_.photograph) for image in (view_.original, picture))
            losses.append(before - after)
    return np.array(losses)


def estimated_loss(change: float, assumed_psnr: float) -> float:
    """dB lost when a view of `assumed_psnr` dB changes by the mean squared error `change`."""
    return float(10 * np.log10(1 + change * 10 ** (assumed_psnr / 10)))


def reduced(scene: Scene, rows: Array, sh_degree: int) -> Scene:
    """The Gaussians at `rows` with spherical harmonics up to `sh_degree` at most."""
    kept = scene.take(rows)
    count = min(SH_COUNTS[sh_degree], kept.gaussians.sh.shape[1])
    return replace(kept, gaussians=replace(kept.gaussians, sh=kept.gaussians.sh[:, :count]))
