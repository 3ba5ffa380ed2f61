"""Compaction of scenes within an error budget: fewer Gaussians, a lower SH degree, no training.

Some views of a scene rank its Gaussians, others measure the loss of images without some of them. For every SH
degree that the budget allows by itself, the smallest number of Gaussians within the budget is found by
bisection; the degree with the fewest numbers wins. Gaussians that contribute more to any measuring view than
the last one that is kept are kept, too. All is measured as the target format stores it, and the written
file is read back and measured before it is renamed.

**Contribution.** In a view with blending weights w (a row of W per pixel p), taking Gaussian i of colour c_i
away changes pixel p by about w_pi (c_i - C_p): its weight times its distance from the image C. The adjoint
sums this over pixels without ever listing them: with one gather of [1, C, |C|^2],

    W_i = sum_p w_pi,    E_i = sum_p w_pi |c_i - C_p|^2 = |c_i|^2 W_i - 2 c_i . (W^T C)_i + (W^T |C|^2)_i,

and by Cauchy-Schwarz sum_p w_pi |c_i - C_p| <= sqrt(W_i E_i), an upper bound of the total change in display
values times pixels, if one Gaussian is removed alone. As those of a white wall have only similar ones behind
them, distances to the image are increased by `ALONE`: the contribution is sqrt(W_i (E_i + ALONE^2 W_i)), the
largest over views. On the bundled scene, at 77 % of the Gaussians, the mean loss (the worst view's) is 0.21
(1.3) dB; ranked by W_i it is 0.42 (1.3), by sqrt(W_i E_i) 0.30 (3.4).

**Loss.** With photographs, the loss in PSNR is measured on them. Without, it is derived from the change of
images, which is, to first order, uncorrelated with the errors of a trained scene, so that squared errors add:
a view of mean squared error e that changes by d loses 10 log10(1 + d / e) dB. e is that of an assumed PSNR,
which should be high: a worse scene loses less than stated. On the bundled scene, with its photographs and
true e, this agreed with the measured loss within 0.03 dB at losses up to 1 dB.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import numpy as np
import tyro

from langsplat_core.arrays import Array, mean_squared_error, psnr
from langsplat_core.cli.arguments import AnyScene, JsonOption, OutFile, Photographs
from langsplat_core.cli.run import print_json
from langsplat_core.config import DatasetConfig, Decibels, Range, SeveralCount, Side, check_settings
from langsplat_core.datasets import load_capture
from langsplat_core.errors import InputError
from langsplat_core.io import scenes
from langsplat_core.io.files import shown
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_core.raster.render import colours_seen, render, view_of
from langsplat_core.scene import SH_COUNTS, Camera, Scene
from langsplat_core.scene.transform import place_scene

T = TypeVar("T")

ALONE = 0.055  # display values, RGB distance; see above
HOLD_OUT = 6  # every n-th view is a measuring view


@dataclass(frozen=True)
class BudgetConfig:
    """The error that is allowed, and the views it is measured on."""

    max_psnr_loss: Decibels = 0.1  # dB, mean over the measuring views; nothing that loses more is written
    views: SeveralCount = 96
    """At most, of the scene's cameras or photographs; a sixth of them measures the loss."""
    max_side: Side = 800  # images are drawn with at most this many pixels on their longer side
    # dB that the scene is assumed to have where no photographs are given: higher is more cautious
    assumed_psnr: Annotated[float, Range(0.0, 200.0, above=True)] = 35.0


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
        """Return the measuring views with the scene's images; InputError if photographs do not fit."""
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
    """Return views with the cameras of the photographs, else of the scene, else some around it.

    There are at most ``config.views``. If some photographs were not used in training, only these measure;
    otherwise every `HOLD_OUT`-th view does. Raises InputError if ranking or measuring views are missing.
    """
    check_settings(config)
    if photos is not None:
        return _photographed(scene, photos, config, progress)
    if len(scene.cameras) >= 2:
        cameras, origin = _thinned(scene.cameras, config.views), "the scene's cameras"
    else:
        # At two distances: the whole scene, and nearer for small Gaussians.
        cameras = [*scene.spiral_cameras(min(config.views, 48), (640, 480), distances=(2.6, 1.6))]
        origin = "a ring around the scene (it has no cameras): what lies inside may be judged invisible"
    ranking, measuring = _divided([camera.within(config.max_side) for camera in cameras])
    return Views(tuple(ranking), tuple(measuring), (None,) * len(measuring), origin)


def _photographed(scene: Scene, photos: Path, config: BudgetConfig, progress: Progress) -> Views:
    if config.assumed_psnr != BudgetConfig().assumed_psnr:
        raise InputError("--assumed-psnr: the loss is measured on photographs; leave it out, or --photos")
    with tempfile.TemporaryDirectory() as work:  # for structure from motion, if it is needed
        settings = DatasetConfig(max_side=config.max_side, allow_few_cameras=True)  # nothing is trained
        capture = load_capture(photos, settings, Path(work), progress)
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
    cameras = [camera.moved(capture.origin - scene.origin) for camera in capture.cameras]
    return Views(
        tuple(cameras[i] for i in ranking),
        tuple(cameras[i] for i in measuring),
        tuple(capture.images[i] for i in measuring),
        origin,
    )


def _thinned(items: Sequence[T], most: int) -> list[T]:
    """Return at most `most` of `items`, evenly spaced, in order."""
    count = min(len(items), most)
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))]


def _divided(items: list[T]) -> tuple[list[T], list[T]]:
    """Return ranking and measuring items: every `HOLD_OUT`-th measures, or half of fewer than twelve."""
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
    """Return the (V,) dB lost in each view, < 0 for gains; assumed_psnr: dB without a photograph."""
    losses = []
    for view in views:
        image = draw(scene, view.camera)
        if view.photograph is None:
            losses.append(estimated_loss(mean_squared_error(image, view.original), assumed_psnr))
        else:
            losses.append(psnr(view.original, view.photograph) - psnr(image, view.photograph))
    return np.array(losses)


def estimated_loss(change: float, assumed_psnr: float) -> float:
    """Return the dB lost if a view of `assumed_psnr` dB changes by the mean squared error `change`."""
    return float(10 * np.log10(1 + change * 10 ** (assumed_psnr / 10)))


def mean_psnr(scene: Scene, measured: Sequence[MeasuringView]) -> float | None:
    """Return the mean PSNR against the photographs, dB; None without."""
    pairs = [(view.camera, view.photograph) for view in measured if view.photograph is not None]
    scores = [psnr(draw(scene, camera), photograph) for camera, photograph in pairs]
    return float(np.mean(scores)) if scores else None


# ---- the smallest scene ----


@dataclass(frozen=True)
class Weight:
    """Size of a scene in bytes, and its quality in decibels."""

    gaussians: int
    sh_degree: int
    disk_bytes: int  # in the target format, with language field and cameras
    memory_bytes: int  # arrays of the Gaussians, extra properties and language field
    psnr: float | None  # mean against the photographs, dB; None without


@dataclass(frozen=True)
class Loss:
    """Losses of a smaller scene over the measuring views, dB; negative for a gain."""

    budget: float
    loss: float  # mean
    worst_loss: float  # of any one view
    assumed_psnr: float | None  # None: measured against photographs
    measuring_views: int
    views_from: str

    @classmethod
    def of(cls, losses: Array, config: BudgetConfig, views: Views, **more: Any) -> Self:
        """Return the report of (V,) losses; more: fields of a subclass."""
        assumed = config.assumed_psnr if views.photographs[0] is None else None
        mean, worst, count = float(losses.mean()), float(losses.max()), len(losses)
        return cls(config.max_psnr_loss, mean, worst, assumed, count, views.origin, **more)

    @property
    def lines(self) -> list[str]:
        """The losses as lines of text."""
        how = "measured on photographs"
        if self.assumed_psnr is not None:
            how = f"derived from the change, if the scene has {self.assumed_psnr:g} dB"
        loss = f"{self.loss:.3f} dB of {self.budget:g} allowed, worst view {self.worst_loss:.2f} dB"
        return [f"loss: {loss} ({how})", f"views: {self.measuring_views} measured; {self.views_from}"]


@dataclass(frozen=True, kw_only=True)
class CompactReport(Loss):
    """A compact scene beside its original; losses are those of the file."""

    before: Weight
    after: Weight
    ranking_views: int


def compact_scene(
    source: Path, out: Path, config: BudgetConfig, photos: Path | None = None, progress: Progress = silent
) -> CompactReport:
    """Write the scene `source` to `out` as small as ``config.max_psnr_loss`` allows.

    photos: the dataset it was trained on; without, the loss is derived from the change of the images. Raises
    InputError, and leaves `out` as it was, if the budget cannot be kept or nothing can be dropped.
    """
    scene = scene_for(out, source)
    views = choose_views(scene, photos, config, progress)
    measured = views.measured(scene)
    before, before_bytes = _stored(scene, out)
    keep, sh_degree = find_reduction(replace(before, path=source), views, measured, config, progress)
    candidate = _reduced(before, keep, sh_degree)
    after, after_bytes = _stored(candidate, out)
    losses = psnr_losses(after, measured, config.assumed_psnr)
    if not losses.mean() <= config.max_psnr_loss:
        raise InputError(f"{out}: as stored it would lose {losses.mean():.3f} dB; not written, allow more")

    def weigh(one: Scene, stored_bytes: int) -> Weight:
        degree, memory = one.gaussians.sh_degree, scenes.memory_bytes(one)
        return Weight(len(one.gaussians), degree, stored_bytes, memory, mean_psnr(one, measured))

    sizes = {"before": weigh(scene, before_bytes), "after": weigh(after, after_bytes)}
    report = CompactReport.of(losses, config, views, **sizes, ranking_views=len(views.ranking))
    scenes.save_scene(out, replace(candidate, path=out), tell=False)
    return report


def scene_for(out: Path, source: Path) -> Scene:
    """Return the scene `source` after checks of `out`, and report what `out` cannot hold; InputError."""
    row = scenes.check_writable(out, source)
    scene = scenes.load_scene(source)
    companion = f"its companion *{scenes.ORIGIN_SUFFIX}"
    scenes.report_left_out(out, scene, f"{row.suffix} files", row.loses, companion)
    return scene


def _stored(scene: Scene, out: Path) -> tuple[Scene, int]:
    """Return the scene as written to and read from a file in the format of `out`, and its bytes on disk."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / out.name
        scenes.save_scene(path, replace(scene, path=path), tell=False)
        return place_scene(scenes.load_scene(path), origin=scene.origin), scenes.disk_bytes(path)


def _reduced(scene: Scene, rows: Array, sh_degree: int) -> Scene:
    """Return the Gaussians at `rows` with spherical harmonics up to `sh_degree` at most."""
    kept = scene.take(rows)
    return replace(kept, gaussians=replace(kept.gaussians, sh=kept.gaussians.sh[:, : SH_COUNTS[sh_degree]]))


def find_reduction(
    scene: Scene,
    views: Views,
    measured: Sequence[MeasuringView],
    config: BudgetConfig,
    progress: Progress = silent,
) -> tuple[Array, int]:
    """Return the (N,) bool rows that stay, and the SH degree; InputError if none fits or can be dropped."""
    name = "the scene" if scene.path is None else shown(scene.path)
    score = contributions(scene, views.ranking, progress)
    if not score.any():
        raise InputError(f"{name}: no Gaussian is visible from {views.origin}; name photographs that show it")
    order = np.argsort(-score, kind="stable")  # ties by index

    def loss_of(count: int, sh_degree: int) -> float:
        candidate = _reduced(scene, np.sort(order[:count]), sh_degree)
        return float(psnr_losses(candidate, measured, config.assumed_psnr).mean())

    whole = len(order), scene.gaussians.sh_degree
    choice = smallest(*whole, loss_of, config.max_psnr_loss, progress)
    if choice is None:
        what = f"its new format alone loses more than {config.max_psnr_loss} dB; allow more, or write .ply"
        raise InputError(f"{name}: {what}")
    count, sh_degree = choice
    keep = contributions(scene, views.measuring) > score[order[count - 1]]
    keep[order[:count]] = True
    if (keep.sum(), sh_degree) == whole:
        raise InputError(f"{name}: nothing can be dropped within {config.max_psnr_loss} dB; allow more")
    return keep, sh_degree


def smallest(
    count: int,
    sh_degree: int,
    loss_of: Callable[[int, int], float],
    budget: float,
    progress: Progress = silent,
) -> tuple[int, int] | None:
    """Return the count of Gaussians and SH degree with the fewest numbers whose loss is within `budget` dB.

    None if even the whole exceeds it. `loss_of` should not rise with the count; if it does, the answer is
    within the budget but may not be the smallest.
    """
    found: list[tuple[int, int]] = []
    for degree in range(sh_degree, -1, -1):
        progress("finding the smallest scene", (sh_degree - degree) / (sh_degree + 1))
        high, low = count, 0
        if not loss_of(high, degree) <= budget:
            break  # a lower degree can only lose more
        while high - low > max(count // 256, 1):
            middle = (low + high) // 2
            if loss_of(middle, degree) <= budget:
                high = middle
            else:
                low = middle
        found.append((high, degree))
    progress("finding the smallest scene", 1.0)
    # Numbers of position, scale, rotation, opacity and colour, in any format.
    return min(found, key=lambda choice: choice[0] * (11 + 3 * SH_COUNTS[choice[1]]), default=None)


# `langsplat compact`.


@dataclass(frozen=True)
class Compact:
    """Drop the Gaussians and colour harmonics that the views do not need, within an error budget.

    Nothing is trained; language field, cameras and extra properties are kept.
    """

    scene: AnyScene
    out: OutFile | None = None
    """The scene to write (default: SCENE with the ending .compact.ply)."""
    photos: Photographs | None = None
    """Dataset the scene was trained on: the loss is then measured against its photographs."""
    json: JsonOption = False
    config: Annotated[BudgetConfig, tyro.conf.arg(name="")] = field(default_factory=BudgetConfig)

    def run(self) -> None:
        out = self.out or self.scene.with_suffix(".compact.ply")
        with TerminalProgress() as progress:
            report = compact_scene(self.scene, out, self.config, self.photos, progress)
        if self.json:
            print_json({"out": str(out), **asdict(report)})
            return
        print(*_lines(report), *report.lines, f"written: {out}", sep="\n")


def _lines(report: CompactReport) -> list[str]:
    both = report.before, report.after
    rows: list[list[object]] = [
        ["Gaussians", *(f"{one.gaussians:,}" for one in both)],
        ["SH degree", *(one.sh_degree for one in both)],
        ["MB on disk", *(f"{one.disk_bytes / 1e6:.2f}" for one in both)],
        ["MB in memory", *(f"{one.memory_bytes / 1e6:.2f}" for one in both)],
        ["PSNR, dB", *(f"{one.psnr:.2f}" for one in both if one.psnr is not None)],
    ]
    return [f"{name}: {old[0]} before, {old[1]} after" for name, *old in rows if old]
