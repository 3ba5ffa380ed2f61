"""Answers to single phrases, combined among the Gaussians into one of the same form.

The relevancy of a combined answer is zero wherever it does not hold, and the same at every level where it has
parts of several; its peak is that of its weakest necessary part.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.chance import excess
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.extent import lowest
from langsplat_core.query.places import locate
from langsplat_core.query.surface import Surface
from langsplat_core.scene import LEVELS

WHOLE = LEVELS.index("whole")
SHARE = 0.6  # of the way from what is typical of a thing's least fitting surface to the part's peak on it
LEAST = 0.05  # quantile of a part's relevancy on its thing that stands for "not this part"
SPAN = 0.02  # of relevancy: the least distance that is divided
SURE = 0.5  # of the way that an answer reaches: what fits an unwanted name so well is what was meant
HALF = 0.5  # of the peak: what is less is no longer the place


def grown(surface: Surface, members: Array) -> Array:
    """(N,) bool, and what is next to it on the surface."""
    inside = np.flatnonzero(members[surface.rows])
    result = members.copy()
    result[surface.rows[surface.links[inside].indices]] = True
    return result


def owners(surface: Surface, count: int, things: list[Array]) -> Array:
    """(N,) number of the thing (of `things`, as surface numbers) that each of `count` Gaussians belongs to;
    -1 for what belongs to none, as the faint Gaussians do that are not of the surface."""
    labels = np.full(count, -1)
    for number, thing in enumerate(things):
        labels[surface.rows[thing]] = number
    return labels


def cut_inside(
    engine: QueryEngine, asked: list[QueryResult], thing: QueryResult, there: Array, level: LevelChoice
) -> QueryResult:
    """What `asked` says of a part, cut anew among the Gaussians of its thing. there: (N,) bool."""
    surface, known = engine.surface, engine.field.known
    relevancy = np.asarray(np.mean([result.relevancy for result in asked], axis=0, dtype=np.float32))
    even = np.where(there, engine.evened(relevancy), 0)
    relevancy = np.where(there, relevancy, 0)
    numbers = np.flatnonzero(there[surface.rows])
    peaks = peaks_among(even[:, surface.rows[numbers]])
    own = int(np.argmax(peaks[:WHOLE])) if max(peaks[:WHOLE]) > 0 else WHOLE
    chosen = own if level == "auto" else LEVELS.index(level)
    peak, inside = peaks[chosen], there & known[chosen]
    own_surface = thing.members & known[chosen]  # without what it touches, which may be anything
    low = float(np.quantile(even[chosen][own_surface], LEAST)) if own_surface.any() else peak
    members = inside & (even[chosen] > low + SHARE * max(peak - low, SPAN))
    subpart, part, whole = engine.scale.fit(np.array(peaks)).tolist()
    fits, probability = (subpart, part, whole), thing.probability
    right, above = True, None
    if engine.calibration is not None and probability is not None:
        odds = engine.calibration.inside
        right = odds.probability(fits) >= odds.found
        probability = min(probability, odds.probability(fits))
    elif engine.chance is not None:
        above = excess(fits, engine.chance_among(there), "inside", level)
        right = above >= 0
        above = _combined([above, thing.excess], min)
    return replace(
        asked[0],
        level=chosen,
        scores=peaks,
        relevancy=relevancy,
        even=even[chosen],
        peak=peak,
        fits=fits,
        probability=_of_any(members, probability),
        excess=above,
        found=bool(members.any() and thing.found and right),
        members=members,
    )


def peaks_among(relevancy: Array) -> tuple[float, float, float]:
    """The highest of (3, K) relevancies per level; 0 for none."""
    subpart, part, whole = relevancy.max(axis=1, initial=0)
    return float(subpart), float(part), float(whole)


def joined(answers: list[QueryResult], all_needed: bool) -> QueryResult:
    """The union of answers, found if all are, or any is; what is not found of alternatives does not count."""
    counting = answers if all_needed else [answer for answer in answers if answer.found] or answers
    score = min if all_needed else max
    values = np.max([np.where(a.members, a.relevancy[a.level], 0) for a in counting], axis=0)
    peak = score(answer.peak for answer in counting)
    return replace(
        counting[0],
        scores=(peak, peak, peak),
        relevancy=np.tile(values.astype(np.float32), (len(LEVELS), 1)),
        even=np.max([np.where(a.members, a.even, 0) for a in counting], axis=0),
        peak=peak,
        probability=_combined([answer.probability for answer in counting], score),
        excess=_combined([answer.excess for answer in counting], score),
        found=(all if all_needed else any)(answer.found for answer in answers),
        members=np.any([answer.members for answer in counting], axis=0),
    )


def without(what: QueryResult, unwanted: QueryResult) -> QueryResult:
    """`what` but for `unwanted`, if that is there."""
    return restricted(what, ~unwanted.members, what) if unwanted.found else what


def surest(engine: QueryEngine, answer: QueryResult) -> QueryResult:
    """Those members alone that fit nearly as well as the best one does. A green mug may be in the answer to
    "red mug", for want of a better one; it is not what "not red mug" means."""
    fits = engine.scale.fit(answer.even)
    best = float(fits[answer.members].max(initial=-np.inf))
    return replace(answer, members=answer.members & (fits >= lowest(best, SURE)))


def _combined(values: Sequence[float | None], score: Callable[[Iterable[float]], float]) -> float | None:
    """The weakest or the best, as `score` says; None where one is not known."""
    known = [value for value in values if value is not None]
    return score(known) if len(known) == len(values) else None


def _of_any(members: Array, probability: float | None) -> float | None:
    """0 where there are no members, in a scene that has probabilities."""
    return probability if probability is None or members.any() else 0.0


def restricted(answer: QueryResult, keep: Array, needed: QueryResult) -> QueryResult:
    """`answer` where `keep` (N,) holds alone; nothing is found without `needed`."""
    members = answer.members & keep
    return replace(
        answer,
        relevancy=np.where(members, answer.relevancy, 0),
        even=np.where(members, answer.even, 0),
        probability=_of_any(members, _combined([answer.probability, needed.probability], min)),
        excess=_combined([answer.excess, needed.excess], min),
        peak=answer.peak if members.any() else 0.0,
        found=bool(members.any() and answer.found and needed.found),
        members=members,
    )


def placed(surface: Surface, answer: QueryResult) -> QueryResult:
    """`answer` with the place of its strongest connected members."""
    values = np.where(answer.members, answer.relevancy[answer.level], 0)
    smoothed = surface.smooth(np.tile(values.astype(np.float32), (len(LEVELS), 1)))[0]
    place = locate(surface, smoothed, HALF * float(smoothed.max(initial=0)))
    found = (None, None) if place is None else (place.position, place.box)
    return replace(answer, place=found[0], box=found[1])
