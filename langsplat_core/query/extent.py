"""How far an answer reaches: its level, the regions that are it, and how good the best one is.

Everything is judged by the margin of a region, its cosine with the phrase minus that with the nearest
canonical phrase: relevancy without its temperature, so that one rule fits all encoders of one family. Shares
and differences were chosen on the rooms that the demo encoder is calibrated on, never on those that measure.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.query.regions import SMALLEST, Regions
from langsplat_core.query.vocabulary import Named
from langsplat_core.scene import LEVELS

# Of margin that each level is given before the best is chosen, by what a phrase names. A thing is one whole,
# whatever some part of it looks like; the best of a part asked for alone may stand for the thing it is on.
ADVANTAGE: Mapping[Named, tuple[float, float, float]] = {
    "thing": (0.0, 0.0, 0.12),
    "part": (0.0, 0.0, 0.03),
    "part of a thing": (0.0, 0.03, -0.03),
}
SHARES = (0.4, 0.4, 0.3)  # of the best margin at each level from which a region belongs to the answer
FAINT = 0.03  # a best margin below this is no scale to take shares of
NARROWEST = 1e-6  # distance of a relevancy from 0 and 1, so that its margin is finite


@dataclass(frozen=True, eq=False)
class Extent:
    """What of a surface answers a phrase: some of the R regions of a level."""

    level: int  # index into LEVELS
    margins: tuple[float, float, float]  # of the best region of each level
    peaks: tuple[float, float, float]  # relevancy of the best region of each level
    even: Array  # (R,) float32 relevancy, the same all over a region
    inside: Array  # (R,) bool


def find_extent(
    relevancy: Array,
    regions: Regions,
    temperature: float,
    level: LevelChoice = "auto",
    named: Named = "thing",
) -> Extent:
    """From the (3, N) relevancy of a phrase. level: "auto", which depends on what is `named`, or the one that
    is wanted."""
    means = regions.means(relevancy)
    peaks = [_best(values, sizes) for values, sizes in zip(means, regions.sizes, strict=True)]
    best = to_margin(np.array(peaks), temperature)
    chosen = _level(best, named) if level == "auto" else LEVELS.index(level)
    return Extent(
        level=chosen,
        margins=(float(best[0]), float(best[1]), float(best[2])),
        peaks=(peaks[0], peaks[1], peaks[2]),
        even=means[chosen].astype(np.float32),
        inside=to_margin(means[chosen], temperature) > cut(float(best[chosen]), SHARES[chosen]),
    )


def to_margin(relevancy: Array, temperature: float) -> Array:
    """Relevancy in [0, 1] -> the margin of cosines that it stands for."""
    clipped = np.clip(np.asarray(relevancy, np.float64), NARROWEST, 1 - NARROWEST)
    return np.asarray(np.log(clipped / (1 - clipped)) / temperature)


def cut(best: float, share: float) -> float:
    """The margin above which a region belongs to an answer whose best region has the margin `best`."""
    return share * best if best > FAINT else best - (1 - share) * FAINT


def _best(means: Array, sizes: Array) -> float:
    """The best region's relevancy; crumbs that no neighbour took do not count where there are others."""
    solid = means[sizes >= SMALLEST]
    return float((solid if len(solid) else means).max(initial=0))


def _level(best: Array, named: Named) -> int:
    """The best after its advantage; of equal ones the coarsest."""
    given = best + ADVANTAGE[named]
    return int(np.flatnonzero(given == given.max())[-1])
