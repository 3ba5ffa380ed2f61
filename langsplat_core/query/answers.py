"""Answers to a phrase: whole regions by `rule.decide`, or, as published, what is around the peak."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import plain
from langsplat_core.config import LevelChoice
from langsplat_core.query.grammar import named
from langsplat_core.query.instances import axis_aligned_box
from langsplat_core.query.regions import Regions, place_of
from langsplat_core.query.rule import (
    Bars,
    Outcome,
    Verdict,
    decide,
    region_fits,
    region_relevancies,
    triple,
)
from langsplat_core.scene import LEVELS, Calibration, Fits
from langsplat_core.scene.surface import Surface
from langsplat_core.semantics.relevancy import FLOOR, MIN_HEAT_SPAN, Scale

AnswerRule = Literal["regions", "peak"]  # by `rule.decide`, or as published


@dataclass(frozen=True, eq=False)
class QueryResult:
    """The answer to one phrase."""

    phrase: str
    level: int  # index into LEVELS
    scores: Fits  # best relevancy per level: of a region, or of a neighbourhood
    relevancy: Array  # (3, N) float32 in [0, 1] per level and Gaussian
    even: Array  # (N,) float32 relevancy at the level, the same all over a region
    peak: float  # score of the chosen level
    fits: Fits  # of the best region, or neighbourhood, of each level, see `Scale.fit`
    judgement: Verdict
    members: Array  # (N,) bool: the Gaussians that answer, wherever they are
    place: Array | None  # (3,) world units
    box: Array | None  # (2, 3) corners, world units
    own_cut: float | None = None  # relevancy from which on everything is a member, where it was set by hand

    @property
    def found(self) -> bool:
        """True if what was asked for is there."""
        return self.judgement.found

    @property
    def verdict(self) -> Outcome:
        """The verdict in words."""
        return self.judgement.outcome

    @property
    def probability(self) -> float | None:
        """The probability that it is there at all; None where nothing is calibrated."""
        return self.judgement.probability

    @property
    def cut(self) -> float:
        """The least relevancy of a member, of its region where it has one; the peak where there is none."""
        if self.own_cut is not None:
            return self.own_cut
        return float(self.even[self.members].min(initial=self.peak))

    @property
    def heat_range(self) -> tuple[float, float]:
        """The relevancies at which a heat map of this answer is coldest and hottest."""
        if self.own_cut is not None:
            return min(self.own_cut, self.peak - MIN_HEAT_SPAN), self.peak
        if self.found and self.peak < FLOOR + MIN_HEAT_SPAN:  # best on its thing, not against all phrases
            return self.peak - MIN_HEAT_SPAN, self.peak
        return FLOOR, max(self.peak, FLOOR + MIN_HEAT_SPAN)


def recut(result: QueryResult, cut: float) -> QueryResult:
    """Return the answer with everything as a member whose relevancy is at least `cut`.

    The relevancy counts that is even over a region. Place, box and verdict stay: they are of the best,
    wherever the answer ends.
    """
    return replace(result, own_cut=cut, members=result.even >= np.float32(cut))


def by_regions(
    phrase: str,
    relevancy: Array,
    means: Array,
    regions: Regions,
    scale: Scale,
    bars: Bars,
    calibration: Calibration | None,
    level: LevelChoice,
) -> QueryResult:
    """Return the answer by the rule. relevancy: (3, N); means: (N, 3) of the Gaussians."""
    own = np.concatenate([scale.fit(values) for values in regions.means(relevancy)])
    decision = decide(regions.table, own, named(phrase), level, bars, calibration)
    chosen = decision.level
    place = box = None
    if decision.best >= 0:
        place, box = place_of(means[regions.counted(chosen, decision.best)])
    return QueryResult(
        phrase=phrase,
        level=chosen,
        scores=decision.scores,
        relevancy=relevancy,
        even=regions.spread(chosen, decision.relevancies, relevancy[chosen]),
        peak=decision.scores[chosen],
        fits=decision.fits,
        judgement=decision.verdict,
        members=regions.spread(chosen, decision.inside, np.zeros(relevancy.shape[1], bool)),
        place=place,
        box=box,
    )


def even_relevancy(regions: Regions, scale: Scale, relevancy: Array) -> Array:
    """Return (3, N) relevancy with that of its region's fit for every Gaussian; its own for one in none."""
    own = plain(relevancy)
    fits = region_fits(regions.table, np.concatenate([scale.fit(values) for values in regions.means(own)]))
    values = region_relevancies(fits).astype(np.float32)
    return np.stack(
        [regions.spread(level, regions.table.level(level, values), row) for level, row in enumerate(own)]
    )


# The answer as published, by the peak alone.

SPAN = 0.02  # the least distance between the floor and the peak that is divided


def by_peak(
    phrase: str, relevancy: Array, surface: Surface, scale: Scale, found: float, level: LevelChoice
) -> QueryResult:
    """Return the answer as published: the level with the highest smoothed peak.

    Members are cut half way between the floor and that peak. found: relevancy from which a phrase counts as
    found.
    """
    smoothed = np.stack([surface.smooth(values) for values in relevancy])
    scores = triple(smoothed.max(1, initial=0))
    chosen = int(np.argmax(scores)) if level == "auto" else LEVELS.index(level)
    peak = scores[chosen]
    place, box = locate(surface, smoothed[chosen], max(FLOOR + 0.5 * (peak - FLOOR), FLOOR))
    there = peak >= FLOOR and max(scores) >= found
    return QueryResult(
        phrase=phrase,
        level=chosen,
        scores=scores,
        relevancy=relevancy,
        even=relevancy[chosen],
        peak=peak,
        fits=triple(scale.fit(np.array(scores))),
        judgement=Verdict(there, "relevancy", 10 * (peak - found)),
        members=relevancy[chosen] > FLOOR + 0.5 * max(peak - FLOOR, SPAN),
        place=place,
        box=box,
    )


PLATEAU = 1e-3  # of relevancy: what is this close to the peak is as high


def locate(surface: Surface, smoothed: Array, threshold: float) -> tuple[Array, Array] | tuple[None, None]:
    """Return place and box, world units, of the connected part above `threshold` that holds the peak.

    smoothed: (M,) relevancy of the surface. The place (3,) is around the middle of what is as high as the
    peak; the box (2, 3) holds the part's Gaussians between 2 % and 98 %. None where all is 0.
    """
    if smoothed.max(initial=0) <= 0:
        return None, None
    peak = int(smoothed.argmax())
    inside = smoothed > threshold
    inside[peak] = True
    members = surface.connected(inside, peak)
    # All of a thing may have the very same feature: then its middle is the place, not whichever comes first.
    highest = members[smoothed[members] >= smoothed[peak] - PLATEAU]
    centre = surface.positions[highest].mean(0)
    middle = highest[((surface.positions[highest] - centre) ** 2).sum(1).argmin()]
    near = surface.neighbours[middle]
    weights = surface.weights[near] * smoothed[near]
    position = (surface.positions[near] * weights[:, None]).sum(0) / weights.sum()
    return position, axis_aligned_box(surface.positions[members])
