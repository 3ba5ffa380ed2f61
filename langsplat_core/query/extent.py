"""How far an answer reaches: its level, the regions that are it, and how good the best one is.

Everything is judged by the fit of a region, in spreads of what phrases fit by chance (`chance`), so that one
rule serves all encoders. The numbers were chosen on rooms 201 to 203, with the bundled encoder and with the
geometry of CLIP, never on rooms that measure.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.query.regions import SMALLEST, Regions
from langsplat_core.query.vocabulary import Named
from langsplat_core.scene import LEVELS, Fits
from langsplat_core.semantics.relevancy import Scale

# Spreads that each level is given before the best is chosen, by what a phrase names. A thing is one whole,
# whatever some part of it looks like; a part is rather too fine than too coarse.
ADVANTAGE: Mapping[Named, tuple[float, float, float]] = {
    "thing": (0.0, 0.0, 0.5),
    "part": (0.0, 0.0, 0.25),
    "part of a thing": (0.0, 0.0, -0.25),
}
REACH = 0.4  # of the best fit: what fits less by no more than this, and by `NEAREST` to `FARTHEST`, is it too
NEAREST, FARTHEST = 0.15, 1.0  # spreads


@dataclass(frozen=True, eq=False)
class Extent:
    """What of a surface answers a phrase: some of the R regions of a level."""

    level: int  # index into LEVELS
    fits: Fits  # of the best region of each level
    peaks: tuple[float, float, float]  # relevancy of the best region of each level
    even: Array  # (R,) float32 relevancy, the same all over a region
    inside: Array  # (R,) bool


def find_extent(
    relevancy: Array,
    regions: Regions,
    scale: Scale,
    level: LevelChoice = "auto",
    named: Named = "thing",
) -> Extent:
    """From the (3, N) relevancy of a phrase. level: "auto", which depends on what is `named`, or the one that
    is wanted."""
    means = regions.means(relevancy)
    peaks = [_best(values, sizes) for values, sizes in zip(means, regions.sizes, strict=True)]
    best = scale.fit(np.array(peaks))
    chosen = _level(best, named) if level == "auto" else LEVELS.index(level)
    return Extent(
        level=chosen,
        fits=(float(best[0]), float(best[1]), float(best[2])),
        peaks=(peaks[0], peaks[1], peaks[2]),
        even=means[chosen].astype(np.float32),
        inside=scale.fit(means[chosen]) >= lowest(float(best[chosen])),
    )


def lowest(best: float, share: float = 1.0) -> float:
    """The fit from which a region belongs to an answer whose best region has the fit `best`; share: of the
    way that such an answer reaches."""
    return best - share * float(np.clip(REACH * best, NEAREST, FARTHEST))


def _best(means: Array, sizes: Array) -> float:
    """The best region's relevancy; crumbs that no neighbour took do not count where there are others."""
    solid = means[sizes >= SMALLEST]
    return float((solid if len(solid) else means).max(initial=0))


def _level(best: Array, named: Named) -> int:
    """The best after its advantage; of equal ones the coarsest."""
    given = best + ADVANTAGE[named]
    return int(np.flatnonzero(given == given.max())[-1])
