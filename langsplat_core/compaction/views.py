"""Views of a scene: some rank its Gaussians, others measure what images lose without some of them.

**Contribution.** In a view with blending weights w (a row of W per pixel p), taking Gaussian i of colour c_i
away changes pixel p by about w_pi (c_i - C_p): its weight times its distance from the image C. The adjoint
sums this over pixels without ever listing them: with one gather of [1, C, |C|^2],

    W_i = sum_p w_pi,    E_i = sum_p w_pi |c_i - C_p|^2 = |c_i|^2 W_i - 2 c_i . (W^T C)_i + (W^T |C|^2)_i,

and by Cauchy-Schwarz sum_p w_pi |c_i - C_p| <= sqrt(W_i E_i), an upper bound of the total change in display
values times pixels. That is of one Gaussian taken away alone. Many of one colour hold a white wall up
together, though each has nothing but its like behind it; so every Gaussian counts as at least `ALONE` away
from the image: its contribution is sqrt(W_i (E_i + ALONE^2 W_i)). Over views the largest counts, so that what
only one view shows is not averaged away. On the bundled scene, at 77 % of the Gaussians, the mean loss (the
worst view's) is 0.21 (1.3) dB; ranked by W_i it is 0.42 (1.3), by sqrt(W_i E_i) 0.30 (3.4).

**Loss.** With photographs, the loss in PSNR is measured on them. Without, it is derived from how far the new
image lies from the original one: removing something from a trained scene is, to first order, uncorrelated
with what the scene already gets wrong (at a minimum of the training loss no direction helps), so squared
errors add. A view that the original shows with mean squared error e and that changes by d loses

    10 log10(1 + d / e) dB.

e is not known without photographs; it is what a scene of an assumed PSNR has. A scene that is worse than
assumed loses less than stated, so the assumption should be on the high side. On the bundled scene, with its
photographs and true e, this agreed with the measured loss within 0.03 dB at losses up to 1 dB.
"""

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from langsplat_core.arrays import Array, mean_squared_error, psnr
from langsplat_core.config import BudgetConfig, DatasetConfig, check_settings
from langsplat_core.datasets import load_capture
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.render import colours_seen, render, view_of
from langsplat_core.scene import Camera, Scene

log = logging.getLogger("langsplat")

T = TypeVar("T")

ALONE = 0.055  # display values, RGB distance; see above
HOLD_OUT = 6  # every n-th view measures


@dataclass(frozen=True, eq=False)
class MeasuringView:
    """A view on which the loss is measured, with its images."""

    camera: Camera
    original: Array  # (H, W, 3) float32 in [0, 1], the image of the original scene
    photograph: Array | None = None  # (H, W, 3) float32 in [0, 1]


@dataclass(frozen=True, eq=False)
class Views:
    """Two groups of views with no camera in common."""

    ranking: tuple[Camera, ...]
    measuring: tuple[Camera, ...]
    photographs: tuple[Array | None, ...]  # of the measuring views, (H, W, 3) uint8
    origin: str  # where they come from, for the report

    def measured(self, scene: Scene) -> list[MeasuringView]:
        """Return the measuring views with the images of the original `scene`.

        Raises InputError where the photographs show something else than the scene.
        """
        found = []
        for camera, photograph in zip(self.measuring, self.photographs, strict=True):
            truth = None if photograph is None else photograph.astype(np.float32) / 255
            found.append(MeasuringView(camera, draw(scene, camera), truth))
        scores = [psnr(view.original, view.photograph) for view in found if view.photograph is not None]
        if scores and np.mean(scores) < 10:
            raise InputError(
                f"the photographs show something else than the scene (PSNR {np.mean(scores):.1f} dB); "
                "give the dataset that it was trained on, or leave --photos out"
            )
        return found


def choose_views(scene: Scene, photos: Path | None, config: BudgetConfig, progress: Progress) -> Views:
    """Choose the cameras of the photographs, else of the scene, else some around it.

    At most ``config.views``. Photographs that the scene was not trained on, if there are any, all measure;
    otherwise every `HOLD_OUT`-th view does. Raises InputError where fewer than two views are left or the
    photographs belong to another world than the scene.
    """
    check_settings(config)
    if photos is not None:
        return _photographed(scene, photos, config, progress)
    if len(scene.cameras) >= 2:
        cameras, origin = _thinned(scene.cameras, config.views), "the scene's cameras"
    else:
        # The whole scene, and nearer, where small Gaussians show.
        around = scene.spiral_cameras(min(config.views, 48), (640, 480), distances=(2.6, 1.6))
        cameras = list(around)
        origin = "a ring around the scene (it has no cameras): what lies inside may be judged invisible"
    ranking, measuring = _divided([camera.within(config.max_side) for camera in cameras])
    return Views(tuple(ranking), tuple(measuring), (None,) * len(measuring), origin)


def _photographed(scene: Scene, photos: Path, config: BudgetConfig, progress: Progress) -> Views:
    with tempfile.TemporaryDirectory() as work:  # for points that may have to be found, and that are not used
        settings = DatasetConfig(max_side=config.max_side, allow_few_cameras=True)  # only looked through
        capture = load_capture(photos, settings, Path(work), progress)
    check_same_world(scene.cameras, capture.cameras, photos)
    trained = {camera.name for camera in scene.cameras}
    known = [i for i, camera in enumerate(capture.cameras) if camera.name in trained]
    unknown = [i for i, camera in enumerate(capture.cameras) if camera.name not in trained]
    if known and unknown:
        share = max(config.views // HOLD_OUT, 1)
        ranking, measuring = _thinned(known, max(config.views - share, 1)), _thinned(unknown, share)
        origin = "photographs; the loss is measured on ones held out from training"
    else:
        ranking, measuring = _divided(_thinned(range(len(capture)), config.views))
        origin = "photographs, of which the scene may know all"
    if not ranking or not measuring:
        raise InputError(f"{photos}: {len(capture)} photographs; at least 2 are needed")
    return Views(
        tuple(capture.cameras[i] for i in ranking),
        tuple(capture.cameras[i] for i in measuring),
        tuple(capture.images[i] for i in measuring),
        origin,
    )


def check_same_world(own: Sequence[Camera], photographed: Sequence[Camera], photos: Path) -> None:
    """Raise InputError where cameras of one name stand elsewhere in the scene and in the photographs."""
    places = {camera.name: camera.position for camera in own}
    pairs = [(places[c.name], c.position) for c in photographed if c.name in places]
    if not pairs:
        log.warning(
            "%s: no photograph is named like a camera of the scene; the worlds are taken as equal", photos
        )
        return
    ours, theirs = np.array(pairs).transpose(1, 0, 2)
    spread = max(float(np.linalg.norm(ours - ours.mean(0), axis=1).max()), 1e-6)
    if np.median(np.linalg.norm(ours - theirs, axis=1)) > 0.01 * spread:
        raise InputError(
            f"{photos}: its cameras lie elsewhere than the scene's of the same name; "
            "give the dataset that the scene was trained on, or leave --photos out"
        )


def _thinned(items: Sequence[T], most: int) -> list[T]:
    """At most `most` of `items`, evenly spaced, in order."""
    count = min(len(items), most)
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))]


def _divided(items: list[T]) -> tuple[list[T], list[T]]:
    """Return the items that rank, and those that measure: every `HOLD_OUT`-th.

    Half of fewer than twelve measure, so that the loss is not that of one or two.
    """
    step = HOLD_OUT if len(items) >= 12 else 2
    measuring = items[step // 2 :: step]
    return [item for i, item in enumerate(items) if i % step != step // 2], measuring


def draw(scene: Scene, camera: Camera) -> Array:
    """Return the (H, W, 3) float32 image of a view in [0, 1], without background."""
    return np.clip(render(scene, camera).colours, 0, 1)


def contributions(scene: Scene, cameras: Sequence[Camera], progress: Progress = silent) -> Array:
    """Return (N,) float64 >= 0: the largest contribution of each Gaussian to any of `cameras` (see above)."""
    largest = np.zeros(len(scene.gaussians))
    for index, camera in enumerate(cameras):
        view = view_of(scene, camera)
        own = colours_seen(scene.gaussians, camera)
        image = view.splat(own)[0]
        stacked = [np.ones_like(image[..., :1]), image, (image**2).sum(-1, keepdims=True)]
        sums = view.gather(np.concatenate(stacked, -1)).astype(np.float64)
        weight, own = sums[:, 0], own.astype(np.float64)
        error = (own**2).sum(1) * weight - 2 * (own * sums[:, 1:4]).sum(1) + sums[:, 4]
        score = np.sqrt(weight * (np.maximum(error, 0) + ALONE**2 * weight))
        np.maximum(largest, score, out=largest)
        progress("ranking Gaussians", (index + 1) / len(cameras))
    return largest


def psnr_losses(scene: Scene, views: Sequence[MeasuringView], assumed_psnr: float) -> Array:
    """Return the (V,) dB lost by `scene` in each view; negative where it comes nearer to a photograph.

    `assumed_psnr` (dB) is the original's, used for views without a photograph.
    """
    losses = []
    for view in views:
        image = draw(scene, view.camera)
        if view.photograph is None:
            losses.append(estimated_loss(mean_squared_error(image, view.original), assumed_psnr))
        else:
            losses.append(psnr(view.original, view.photograph) - psnr(image, view.photograph))
    return np.array(losses)


def estimated_loss(change: float, assumed_psnr: float) -> float:
    """Return the dB lost when a view of `assumed_psnr` dB changes by the mean squared error `change`."""
    return float(10 * np.log10(1 + change * 10 ** (assumed_psnr / 10)))


def mean_psnr(scene: Scene, measured: Sequence[MeasuringView]) -> float | None:
    """Return the mean PSNR against the photographs, dB; None without."""
    pairs = [(view.camera, view.photograph) for view in measured if view.photograph is not None]
    scores = [psnr(draw(scene, camera), photograph) for camera, photograph in pairs]
    return float(np.mean(scores)) if scores else None
