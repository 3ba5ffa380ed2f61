"""From relevancies to an answer: by regions of the surface, or by the peak alone, as published."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.query.chance import Bars, excess
from langsplat_core.query.cut import cut_level
from langsplat_core.query.extent import find_extent
from langsplat_core.query.places import locate
from langsplat_core.query.regions import Regions
from langsplat_core.query.surface import Surface
from langsplat_core.query.vocabulary import named
from langsplat_core.scene import LEVELS, Calibration, Fits, Odds
from langsplat_core.semantics.relevancy import FLOOR, MIN_HEAT_SPAN, Scale

AnswerRule = Literal["regions", "peak"]
Verdict = Literal["found", "weak match", "not here"]
WEAK = 0.5  # probability from which what is not found is at least a weak match
NEARLY = -0.5  # excess, spreads, from which it is where no probability is known


@dataclass(frozen=True, eq=False)
class QueryResult:
    """The answer to one phrase."""

    phrase: str
    level: int  # index into LEVELS
    scores: tuple[float, float, float]  # best relevancy per level: of a region, or of a neighbourhood
    relevancy: Array  # (3, N) float32 in [0, 1] per level and Gaussian
    even: Array  # (N,) float32 relevancy at the level, the same all over a region
    peak: float  # score of the chosen level
    fits: Fits  # of the best region, or neighbourhood, of each level, see `chance.Scale.fit`
    probability: float | None  # that the thing is there at all; None where the encoder is not calibrated
    found: bool
    members: Array  # (N,) bool: the Gaussians that answer, wherever they are
    place: Array | None  # (3,) world units
    box: Array | None  # (2, 3) corners, world units
    excess: float | None = None  # where there is none: spreads above chance, see `chance.excess`
    own_cut: float | None = None  # relevancy from which on everything is a member, where it was set by hand

    @property
    def cut(self) -> float:
        """The least relevancy of a member, of its region where it has one; the peak where there is none."""
        if self.own_cut is not None:
            return self.own_cut
        return float(self.even[self.members].min(initial=self.peak))

    @property
    def verdict(self) -> Verdict:
        """What to say about it."""
        if self.found:
            return "found"
        if self.probability is not None:
            return "weak match" if self.probability >= WEAK else "not here"
        near = self.excess is not None and self.excess >= NEARLY
        return "weak match" if near and self.members.any() else "not here"

    @property
    def heat_range(self) -> tuple[float, float]:
        """The relevancies at which a heat map of this answer is coldest and hottest."""
        if self.own_cut is not None:
            return min(self.own_cut, self.peak - MIN_HEAT_SPAN), self.peak
        if self.found and self.peak < FLOOR + MIN_HEAT_SPAN:  # best on its thing, not against all phrases
            return self.peak - MIN_HEAT_SPAN, self.peak
        return FLOOR, max(self.peak, FLOOR + MIN_HEAT_SPAN)


def recut(result: QueryResult, cut: float) -> QueryResult:
    """The same answer with everything as a member whose relevancy, that of its region where it has one, is
    at least `cut`. Place, box and verdict stay: they are of the best, wherever the answer ends."""
    return replace(result, own_cut=cut, members=result.even >= np.float32(cut))


def by_regions(
    phrase: str,
    relevancy: Array,
    surface: Surface,
    regions: Regions,
    scale: Scale,
    bars: Bars,
    calibration: Calibration | None,
    level: LevelChoice,
) -> QueryResult:
    """Whole regions that fit nearly as well as the best one (`extent`)."""
    extent = find_extent(relevancy, regions, scale, level, named(phrase))
    even = regions.spread(extent.level, extent.even, relevancy[extent.level])
    peak = extent.peaks[extent.level]
    lowest = float(extent.even[extent.inside].min(initial=1.0))
    odds, probability, above = _odds(phrase, calibration), None, None
    if odds is None:
        above = excess(extent.fits, bars, named(phrase), level)
        found = above >= 0
    else:  # it may be there, but what the wanted level shows is nearer to other phrases
        fits = level == "auto" or extent.fits[LEVELS.index(level)] >= 0
        probability = odds.probability(extent.fits)
        found = fits and probability >= odds.found
    solid = np.where(extent.even > np.float32(peak), 0, extent.even)  # what is above the best is a crumb
    place = locate(surface, solid[regions.of[extent.level]], np.nextafter(np.float32(lowest), np.float32(0)))
    return QueryResult(
        phrase=phrase,
        level=extent.level,
        scores=extent.peaks,
        relevancy=relevancy,
        even=even,
        peak=peak,
        fits=extent.fits,
        probability=probability,
        excess=above,
        found=found,
        members=regions.spread(extent.level, extent.inside, np.zeros(relevancy.shape[1], bool)),
        place=None if place is None else place.position,
        box=None if place is None else place.box,
    )


def by_peak(
    phrase: str, relevancy: Array, surface: Surface, scale: Scale, found: float, level: LevelChoice
) -> QueryResult:
    """The level with the highest smoothed peak, cut half way between the floor and that peak; relevancy is as
    published."""
    smoothed = surface.smooth(relevancy)
    scores = [float(values.max()) if len(values) else 0.0 for values in smoothed]
    chosen = int(np.argmax(scores)) if level == "auto" else LEVELS.index(level)
    peak, best = scores[chosen], scale.fit(np.array(scores))
    place = locate(surface, smoothed[chosen], max(FLOOR + 0.5 * (peak - FLOOR), FLOOR))
    return QueryResult(
        phrase=phrase,
        level=chosen,
        scores=(scores[0], scores[1], scores[2]),
        relevancy=relevancy,
        even=relevancy[chosen],
        peak=peak,
        fits=(float(best[0]), float(best[1]), float(best[2])),
        probability=None,
        found=peak >= FLOOR and max(scores) >= found,
        members=relevancy[chosen] > cut_level("floor", relevancy[chosen], peak, FLOOR),
        place=None if place is None else place.position,
        box=None if place is None else place.box,
    )


def _odds(phrase: str, calibration: Calibration | None) -> Odds | None:
    """A part asked for alone answers at the finer levels, where its fits are others than a thing's."""
    if calibration is None:
        return None
    return calibration.thing if named(phrase) == "thing" else calibration.part
