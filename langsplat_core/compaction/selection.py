"""Which Gaussians stay: those that contribute most, and as few as the error budget allows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compaction.contribution import MeasuringView, contributions, psnr_losses, reduced
from langsplat_core.compaction.views import Views
from langsplat_core.config import CompactConfig
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import SH_COUNTS, Scene

RESOLUTION = 256  # the number of Gaussians is found to this fraction of the whole


@dataclass(frozen=True)
class Choice:
    """How many of the ranked Gaussians stay, and with which SH degree."""

    count: int
    sh_degree: int


@dataclass(frozen=True, eq=False)
class Selection:
    """What stays of a scene of N Gaussians."""

    keep: Array  # (N,) bool
    sh_degree: int
    threshold: float  # no other Gaussian contributes more to any view
    unseen_loss: float  # dB, mean over the measuring views, before these had a say


def select(
    rasterizer: LiftingRasterizer,
    scene: Scene,
    views: Views,
    measured: Sequence[MeasuringView],
    config: CompactConfig,
    progress: Progress = silent,
) -> Selection:
    """What of `scene` to keep; `measured` are those of ``views.measuring``. Raises InputError where nothing
    is visible, nothing fits the budget or nothing can be dropped."""
    score = contributions(rasterizer, scene, views.ranking, progress)
    if not score.any():
        raise InputError(f"no Gaussian of the scene is visible from {views.origin}")
    order = np.argsort(-score, kind="stable")  # ties by index

    def loss_of(choice: Choice) -> float:
        candidate = reduced(scene, np.sort(order[: choice.count]), choice.sh_degree)
        return float(psnr_losses(rasterizer, candidate, measured, config.assumed_psnr).mean())

    degree = scene.gaussians.sh_degree
    choice = smallest(Choice(len(order), degree), loss_of, config.max_psnr_loss, progress)
    if choice is None:
        raise InputError(f"the new file's format alone loses more than {config.max_psnr_loss} dB; allow more")
    threshold = float(score[order[choice.count - 1]])
    keep = contributions(rasterizer, scene, views.measuring) > threshold
    keep[order[: choice.count]] = True
    if keep.all() and choice.sh_degree == degree:
        raise InputError(f"nothing can be dropped within {config.max_psnr_loss} dB; allow more")
    return Selection(keep, choice.sh_degree, threshold, loss_of(choice))


def smallest(
    whole: Choice, loss_of: Callable[[Choice], float], budget: float, progress: Progress = silent
) -> Choice | None:
    """The choice with the fewest numbers whose loss was measured to be within `budget` dB; None if even
    `whole` exceeds it.

    `loss_of` should not rise with the count; where it does, the answer is within the budget all the same,
    only perhaps not the smallest.
    """
    best: Choice | None = None
    for degree in range(whole.sh_degree, -1, -1):
        progress("finding the smallest scene", (whole.sh_degree - degree) / (whole.sh_degree + 1))
        high, low = whole.count, 0
        if not loss_of(Choice(high, degree)) <= budget:
            break  # a lower degree can only lose more
        while high - low > max(whole.count // RESOLUTION, 1):
            middle = (low + high) // 2
            if loss_of(Choice(middle, degree)) <= budget:
                high = middle
            else:
                low = middle
        if best is None or high * _numbers(degree) < best.count * _numbers(best.sh_degree):
            best = Choice(high, degree)
    progress("finding the smallest scene", 1.0)
    return best


def _numbers(sh_degree: int) -> int:
    """Numbers of a Gaussian that any format must hold: position, scale, rotation, opacity, colour."""
    return 11 + 3 * SH_COUNTS[sh_degree]
