"""Removal of floaters: Gaussians that hang in free space.

They are found by two measures and removed within an error budget, by a third.

**Regions.** Two neighbours touch if the gap between their centres is at most `TOUCH` times the sum of their
extents (one standard deviation) along it: large sparse Gaussians of a wall touch as small dense ones do.
Gaussians that touch are one region; one of few Gaussians apart from the scene's surfaces is a floater. Over
six scenes, trained by five programs, 0.8 to 1.4 % of the Gaussians are in small regions at 1.25 extents.

**Free space.** A faint veil touches the surface behind it. A Gaussian is in free space in a view if its
centre is in front of the surface that is seen through it (the median depth). Veils are found first and are in
no region, as they would connect regions.

**Visibility.** Suspects that contribute least to any view (`compact.contributions`) are removed first, as
many as the loss, measured on other views, allows.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated

import numpy as np
import tyro
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from langsplat_core.arrays import Array, rotation_matrices
from langsplat_core.cli.arguments import AnyScene, JsonOption, Photographs, WrittenScene
from langsplat_core.cli.run import print_json
from langsplat_core.config import Count
from langsplat_core.errors import InputError
from langsplat_core.extensions.compaction import compact
from langsplat_core.io.scenes import save_scene
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_core.raster.render import view_of
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_core.scene.gaussians import along_curve
from langsplat_core.scene.surface import Surface, build_surface

# Thresholds from the least suspicious to the most; `python -m tests.benchmarks clean` measures them.
TOUCH = (1.1, 1.25, 1.5)  # largest gap of a region's Gaussians, in extents
AHEAD = (0.4, 0.55, 0.7)  # least share of views in which a Gaussian is in free space
Losses = Callable[[], Array]  # (V,) dB that the measuring views lose without the rows removed so far
USUAL = 0.45  # median gap to the nearest in trained scenes; TOUCH grows in proportion in sparser ones


@dataclass(frozen=True)
class CleanConfig(compact.BudgetConfig):
    """Settings of `langsplat clean`: the error allowed, its views, and the size of floaters."""

    region: Count = 100  # Gaussians: a larger connected region is no floater


def find_floaters(
    scene: Scene, cameras: tuple[Camera, ...], largest: int, progress: Progress = silent
) -> tuple[Array, Array]:
    """Return the (N,) int8 suspicion, 0 to 3, that a Gaussian is a floater, by `cameras`, and its kind.

    The kind is (N,) bool: True in a region of at most `largest` Gaussians that is not the largest one, False
    in free space.
    """
    gaussians = scene.gaussians
    suspicion = np.zeros(len(gaussians), np.int8)
    share = _free_space(scene, cameras, progress)
    for level, least in enumerate(AHEAD, 1):
        suspicion[share >= least] = level
    rows = np.flatnonzero(suspicion == 0)  # a veil would connect regions in front of it and behind it
    solid = gaussians.take(rows)
    surface = build_surface(solid, min_opacity=0.02)  # fainter ones are judged by free space alone
    gaps = _gaps(solid, surface)
    nearest = float(np.median(np.partition(gaps, 1, axis=1)[:, 1])) if gaps.shape[1] > 1 else USUAL
    region = np.zeros(len(gaussians), bool)
    for level, touch in enumerate(TOUCH, 1):
        near = gaps <= touch * max(1.0, nearest / USUAL)
        small = rows[_small_regions(surface, near, largest)]
        suspicion[small], region[small] = level, True
    return suspicion, region


def _gaps(gaussians: Gaussians, surface: Surface) -> Array:
    """Return (M, k) distances of the surface's Gaussians to their neighbours, over the sum of extents."""
    count, width = surface.neighbours.shape
    first, second = np.repeat(np.arange(count), width), surface.neighbours.ravel()
    apart = surface.positions[second] - surface.positions[first]
    distance = np.linalg.norm(apart, axis=1)
    along = apart / np.maximum(distance, 1e-300)[:, None]
    quats = gaussians.quats_wxyz[surface.rows].astype(np.float64)
    scales = np.exp(gaussians.log_scales[surface.rows].astype(np.float64))
    axes = rotation_matrices(quats) * scales[:, None, :]
    ends = (np.linalg.norm(np.einsum("nij,ni->nj", axes[end], along), axis=1) for end in (first, second))
    return np.reshape(distance / np.maximum(sum(ends), 1e-300), (count, width))


def _small_regions(surface: Surface, near: Array, largest: int) -> Array:
    """Return rows in regions of at most `largest`, except the largest; near: (M, k) bool: they touch."""
    count, width = near.shape
    if count == 0:
        return surface.rows
    first, second = np.repeat(np.arange(count), width)[near.ravel()], surface.neighbours[near]
    links = csr_matrix((np.ones(len(first), bool), (first, second)), (count, count))
    _, labels = connected_components(links, directed=False)
    sizes = np.bincount(labels)
    small = sizes <= largest
    small[sizes.argmax()] = False
    return surface.rows[small[labels]]


def _free_space(scene: Scene, cameras: tuple[Camera, ...], progress: Progress) -> Array:
    """Return the (N,) share of views, of those in which it is not hidden, that see through each centre.

    It is 0 if only one view does.
    """
    gaussians = scene.gaussians
    ahead, on = np.zeros(len(gaussians), int), np.zeros(len(gaussians), int)
    for index, camera in enumerate(cameras):
        depths = view_of(scene, camera).median_depth()
        pixels, z = camera.project(gaussians.means.astype(np.float64))
        rows = np.flatnonzero(camera.in_image(pixels, z))
        column, row = pixels[rows].astype(int).T
        there, z = depths[row, column], z[rows]
        ahead[rows] += (there > 0) & (z < 0.95 * there)  # nearer to the surface, it is on it
        on[rows] += (there > 0) & (np.abs(z - there) <= 0.05 * there)
        progress("finding floaters", (index + 1) / len(cameras))
    return np.where(ahead > 1, ahead / np.maximum(ahead + on, 1), 0.0)


@dataclass(frozen=True, kw_only=True)
class CleanReport(compact.Loss):
    """Numbers of removed Gaussians, and the loss."""

    gaussians: int  # before
    invalid: int  # removed rows that cannot be drawn
    regions: int  # removed floaters in small regions
    free_space: int  # removed floaters in free space
    kept: int  # suspects that are kept for the budget
    psnr_before: float | None  # mean over the measuring photographs; None without
    psnr_after: float | None

    @property
    def removed(self) -> int:
        """Number of Gaussians that were removed."""
        return self.invalid + self.regions + self.free_space


def clean(
    scene: Scene, views: compact.Views, config: CleanConfig, progress: Progress = silent
) -> tuple[Array, CleanReport]:
    """Return the (N,) bool rows that stay, and the report.

    Raises InputError for a scene without valid rows, and for photographs of something else.
    """
    valid = scene.gaussians.valid()
    if not valid.any():
        raise InputError("the scene holds nothing that can be drawn: there is nothing to clean")
    measured = views.measured(scene)
    suspicion, region = find_floaters(scene, views.ranking, config.region, progress)
    cost = compact.contributions(scene, views.ranking, progress)
    suspects = np.flatnonzero(suspicion)
    keep = np.ones(len(valid), bool)

    def losses() -> Array:
        return compact.psnr_losses(scene.take(keep), measured, config.assumed_psnr)

    if views.photographs[0] is None:
        rising = suspects[np.argsort(cost[suspects], kind="stable")]
        _by_change(keep, rising, losses, config.max_psnr_loss, progress)
    else:
        order = suspects[np.lexsort((cost[suspects], -suspicion[suspects]))]
        _by_photographs(keep, order, scene.gaussians.means, losses, config.max_psnr_loss, progress)
    lost = losses()
    keep &= valid
    gone = valid & ~keep
    report = CleanReport.of(
        lost,
        config,
        views,
        gaussians=len(keep),
        invalid=int((~valid).sum()),
        regions=int((gone & region).sum()),
        free_space=int((gone & ~region).sum()),
        kept=int((suspicion[keep] > 0).sum()),
        psnr_before=compact.mean_psnr(scene, measured),
        psnr_after=compact.mean_psnr(scene.take(keep), measured),
    )
    return keep, report


def _by_change(keep: Array, rising: Array, losses_now: Losses, budget: float, progress: Progress) -> None:
    """Remove as many of `rising`, ordered by contribution, from `keep` as the budget allows, by bisection."""
    low, high = 0, len(rising) + 1
    middle = len(rising)  # first all of them
    while middle > low:
        keep[rising] = np.arange(len(rising)) >= middle
        if losses_now().mean() <= budget:
            low = middle
        else:
            high = middle
        middle = (low + high) // 2
        progress("removing within the budget", 1 - (high - low) / (len(rising) + 2))
    keep[rising] = np.arange(len(rising)) >= low


def _by_photographs(
    keep: Array, order: Array, means: Array, losses_now: Losses, budget: float, progress: Progress
) -> None:
    """Remove suspects from `keep` that photographs do not need, and as many more as the budget allows.

    Groups of `order` are removed one after the other. The cost of a group, its addition to the mean loss plus
    the standard error of that, is taken from the budget. A group that costs more than is left is halved, and
    its halves are tried. Gains are not added to the budget, else true floaters would pay for other Gaussians.
    Last, as they may hide each other's cost, groups of removed ones are measured again, without others, and
    the most costly are put back until the rest is within the budget.
    """
    losses, spent, done = np.zeros(1), 0.0, 0  # nothing is lost in any view
    resolution = 96  # groups are halved down to this fraction of the floaters
    least = max(len(order) // resolution, 1)
    waiting = [group for group in np.array_split(order, 12) if len(group)][::-1]
    while waiting:
        group = waiting.pop()
        keep[group] = False
        tried = losses_now()
        cost = _cost(tried - losses)
        if spent + cost <= budget:
            losses, spent = tried, spent + cost
        else:
            keep[group] = True
            if len(group) > least:
                waiting += [group[len(group) // 2 :], group[: len(group) // 2]]
                continue
        done += len(group)
        progress("removing within the budget", done / len(order))
    rows = np.flatnonzero(~keep)
    rows = rows[np.argsort(along_curve(means[rows]))]
    gone = [group for group in np.array_split(rows, resolution) if len(group)]
    costs = np.zeros(len(gone))
    for index, group in enumerate(gone):
        keep[group] = True
        costs[index] = _cost(losses - losses_now())
        keep[group] = False
        progress("measuring again", (index + 1) / len(gone))
    rising = np.argsort(costs, kind="stable")
    for index in rising[np.cumsum(costs[rising]) > budget]:
        keep[gone[index]] = True


def _cost(added: Array) -> float:
    """Return the cost of (V,) dB added to the losses of the views: their mean plus its standard error."""
    return max(float(added.mean() + added.std() / np.sqrt(len(added))), 0.0)


# `langsplat clean`.


@dataclass(frozen=True)
class Clean:
    """Remove floaters: small regions that touch nothing and veils in free space, the least visible first.

    As many are removed as the allowed loss of PSNR permits. The loss is measured on photographs with --photos
    (those not used in training, if there are any), else derived from the change of the scene's images.
    """

    scene: AnyScene
    out: WrittenScene
    photos: Photographs | None = None
    """Dataset the scene was trained on; removing true floaters then costs nothing, so more are removed."""
    json: JsonOption = False
    config: Annotated[CleanConfig, tyro.conf.arg(name="")] = field(default_factory=CleanConfig)

    def run(self) -> None:
        scene = compact.scene_for(self.out, self.scene)
        with TerminalProgress() as progress:
            views = compact.choose_views(scene, self.photos, self.config, progress)
            keep, report = clean(scene, views, self.config, progress)
            save_scene(self.out, replace(scene.take(keep), path=self.out), tell=False)
        if self.json:
            print_json({"out": str(self.out), "removed": report.removed, **asdict(report)})
            return
        print(*_clean_lines(report), f"written: {self.out}", sep="\n")


def _clean_lines(report: CleanReport) -> list[str]:
    lines = [
        f"removed: {report.removed} of {report.gaussians} Gaussians: {report.regions} in small regions, "
        f"{report.free_space} in free space, {report.invalid} that cannot be drawn",
        *report.lines,
    ]
    if report.psnr_before is not None and report.psnr_after is not None:
        lines.append(f"PSNR: {report.psnr_before:.2f} dB before, {report.psnr_after:.2f} after")
    if report.kept:
        lines.append(f"kept: {report.kept} more are suspected; --max-psnr-loss allows more")
    return lines
