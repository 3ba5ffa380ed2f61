"""The rule that turns the fits of regions into an answer: one table of numbers, `RULE`, and `decide`.

A fit (`semantics.relevancy.Scale`) is the number of spreads by which a region is nearer to a phrase than
everyday phrases are by chance, so one rule serves all encoders. The exported page has the table as JSON and
`decide` in JavaScript (`web/rule.js`); the index over scans calls these. Tuning: docs/answers.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array, logit, sigmoid
from langsplat_core.config import LevelChoice
from langsplat_core.query.grammar import COLOURS, Named
from langsplat_core.scene import LEVELS, Calibration, Fits, PlattScaling
from langsplat_core.scene.language import phrase_key
from langsplat_core.scene.surface import SMALLEST
from langsplat_core.semantics.relevancy import FLOOR, MIN_HEAT_SPAN, NARROWEST, fit_of

Sought = Named | Literal["inside"]  # "inside": a part among the regions of a given instance


@dataclass(frozen=True)
class Rule:
    """The numbers of the rule. Fits are in spreads, relevancies and probabilities in [0, 1]."""

    # Added to the fit of each level before the best level is chosen: a thing is one whole.
    advantage: Mapping[Named, Fits]
    # Threshold of what is found, in spreads above the median best fit of everyday phrases: for wholes, and
    # for the finer levels. One absent phrase in twenty exceeds it.
    found: Mapping[Sought, tuple[float, float]]
    part_share: float = 0.25  # weight of the best part of a region in its fit
    common_share: float = 0.4  # of a phrase's mean fit over all regions, subtracted from its fits
    reach: float = 0.45  # distance below the best fit within which regions are members, as a share of it,
    nearest: float = 0.15  # at least,
    farthest: float = 1.0  # and at most
    around: float = 2.0  # factor of the reach for the wholes of a thing in which its parts are searched
    strict: float = 0.25  # factor of the reach for the least number of instances
    wide: float = 2.0  # factor of the reach for the largest number
    nothing: float = float(logit(np.array(2 * NARROWEST)))  # fit at or below which a region has no feature
    smallest: int = SMALLEST  # Gaussians; smaller regions are crumbs, which count only if there are no others
    narrowest: float = NARROWEST  # least distance of a relevancy from 0 and 1; least spread
    floor: float = FLOOR  # relevancy at which a heat map begins
    heat_span: float = MIN_HEAT_SPAN  # least range of a heat map
    # Share of absent phrases that fit as well as what is just found, and the logits by which it falls with
    # each spread above that. From 1 828 phrases in four rooms, with real and simulated vectors.
    by_chance: tuple[float, float] = (0.05, 2.0)
    weak_probability: float = 0.5  # least probability of a weak match,
    weak_excess: float = -0.5  # or least excess in spreads, without a probability

    def least_fit(self, best: float, share: float = 1.0) -> float:
        """Return the least fit of a member of an answer; share: factor of the reach."""
        return best - share * float(np.clip(self.reach * best, self.nearest, self.farthest))


RULE = Rule(
    advantage={"thing": (0.0, 0.25, 0.75), "part": (0.0, 0.0, 0.5), "part of a thing": (0.0, 0.1, 0.0)},
    found={
        "thing": (1.1, 4.0),
        "part": (2.55, 1.3),
        "part of a thing": (2.55, 1.3),
        "inside": (np.inf, 1.8),
    },
)


# The fits of regions, of one scene or of many.


@dataclass(frozen=True, eq=False)
class RegionTable:
    """R regions of S scenes, scene by scene; of each its subparts first, then its parts and wholes."""

    counts: Array  # (S, 3) int64 regions of each level
    parents: Array  # (R,) int64 row of the region of the level above; -1 for none
    solid: Array  # (R,) bool, False for crumbs: regions of fewer Gaussians than `Rule.smallest`

    def level(self, level: int, values: Array) -> Array:
        """Return the (r, ...) rows of one level of the first scene, of (R, ...) values."""
        first = int(self.counts[0, :level].sum())
        return values[first : first + int(self.counts[0, level])]


def region_fits(table: RegionTable, own: Array) -> Array:
    """Return the (R, ...) fits of regions: the `own` fit of each mixed with that of its best part.

    own: fits of the regions' mean relevancies. Crumbs and parts without a feature do not count; a region
    without parts is its own part.
    """
    counted = np.where(((own > RULE.nothing).T & table.solid).T, own, -np.inf)
    best = np.full_like(counted, -np.inf)
    parts = np.flatnonzero(table.parents >= 0)
    np.maximum.at(best, table.parents[parts], counted[parts])
    best = np.where(np.isfinite(best), best, counted)
    return np.where(np.isfinite(best), (1 - RULE.part_share) * own + RULE.part_share * best, own)


def region_relevancies(fits: Array) -> Array:
    """Return the relevancies that fits stand for, 0 for regions without a feature."""
    return np.where(fits > RULE.nothing, sigmoid(fits), 0)


def on_things(table: RegionTable, thing: Array, touching: Array) -> Array:
    """Return the (R,) bool regions of wholes that fit nearly best, and of their pieces; thing: own fits."""
    fits = region_fits(table, thing)
    best = float(fit_of(best_relevancies(table, region_relevancies(fits))[0, -1]))
    wholes = np.arange(len(fits)) >= table.counts[0, :-1].sum()
    return with_pieces(table, wholes & (fits >= RULE.least_fit(best, RULE.around)), touching)


def with_pieces(table: RegionTable, on: Array, touching: Array) -> Array:
    """Return the (R,) bool regions `on`, wholes that touch these (`touching_wholes`), and all below."""
    on = np.append(on, False)  # which -1, no parent, indexes
    piece, thing = touching.T + table.counts[0, :-1].sum()
    on[piece[on[thing]]] = True
    for _ in LEVELS[1:]:
        on[:-1] |= on[table.parents]
    return on[:-1]


def common_fits(table: RegionTable, fits: Array) -> Array:
    """Return the (S, ...) means of (R, ...) fits over each scene's regions with features, without crumbs.

    Some phrases are near to all images and others far from all: over seven real scenes "hand" has a mean
    cosine of 0.23 in CLIP, "pink ice cream" one of 0.09. The best fit of a phrase grows with its mean.
    """
    counted = ((fits > RULE.nothing).T & table.solid).T
    counts = table.counts.sum(1)
    filled, starts = counts > 0, np.cumsum(counts) - counts
    totals = np.zeros((2, len(counts), *fits.shape[1:]))
    if filled.any():
        for total, values in zip(totals, (np.where(counted, fits, 0), counted), strict=True):
            total[filled] = np.add.reduceat(values, starts[filled], axis=0, dtype=np.float64)
    return np.asarray(totals[0] / np.maximum(totals[1], 1))


def best_relevancies(table: RegionTable, relevancies: Array) -> Array:
    """Return the (S, 3) best of the (R,) `relevancies`; crumbs count only if a level has no other regions."""
    counts = table.counts.ravel()
    filled, starts = counts > 0, np.cumsum(counts) - counts
    best = np.zeros((2, len(counts)))
    if filled.any():
        candidates = np.stack([np.where(table.solid, relevancies, -np.inf), relevancies])
        best[:, filled] = np.maximum.reduceat(candidates, starts[filled], axis=1)
    solid, every = best
    return np.maximum(np.where(np.isfinite(solid), solid, every), 0).reshape(-1, len(LEVELS))


# Chance: the more regions a scene has, the better the best of them fits a phrase for something absent. So the
# threshold is measured by the best fits of everyday phrases in the scene itself.

LOW = 0.16  # quantile one standard deviation below the median: everyday phrases that are present lie above it


@dataclass(frozen=True)
class Bar:
    """Distribution of the best fit of phrases by chance."""

    median: float
    spread: float

    def excess(self, fit: float, spreads: float) -> float:
        """Return the spreads by which `fit` exceeds the threshold of so many `spreads` above the median."""
        return (fit - self.median) / max(self.spread, RULE.narrowest) - spreads


Bars = tuple[Bar, Bar, Bar, Bar]  # of each level, and of the better of the two finer ones


def bars_of(table: RegionTable, chance: Array, chosen: Array | None = None) -> Bars:
    """Return the bars from (R, V) fits of everyday phrases in a scene, less their common fits.

    chosen: (R,) bool, to take the regions of one thing alone; their common fits are then not subtracted.
    """
    best, common = [], RULE.common_share * common_fits(table, chance)[0] if chosen is None else 0
    for level in range(len(LEVELS)):
        solid = table.level(level, table.solid)
        counts = solid if solid.any() else np.ones_like(solid)
        if chosen is not None:
            counts = counts & table.level(level, chosen)
        best.append(table.level(level, chance)[counts].max(0, initial=-np.inf) - common)
    subpart, part, whole = best
    return _bar(subpart), _bar(part), _bar(whole), _bar(np.maximum(subpart, part))


def _bar(best: Array) -> Bar:
    if len(best) == 0 or not np.isfinite(best).all():
        return Bar(np.inf, 1.0)
    low, median = np.quantile(best, [LOW, 0.5])
    return Bar(float(median), float(median - low))


def excess(fits: Fits, bars: Bars, sought: Sought, level: LevelChoice = "auto") -> float:
    """Return the spreads by which the best fits of a phrase, at a level or any, exceed the threshold."""
    whole, finer = RULE.found[sought]
    if level != "auto":
        index = LEVELS.index(level)
        return bars[index].excess(fits[index], min(whole, finer))
    return max(bars[2].excess(fits[2], whole), bars[3].excess(max(fits[:2]), finer))


# Verdicts.

Outcome = Literal["found", "weak match", "not here"]
# Basis of a verdict: a calibrated probability, fits of everyday phrases, similarity to examples of a taught
# word, masks in photographs, relevancy (as published), or different ones for parts of a compositional query.
Reached = Literal["calibration", "chance", "example", "masks", "relevancy", "several"]
IN_SPREADS: tuple[Reached, ...] = ("chance", "example")  # those whose margins can be compared


@dataclass(frozen=True)
class Verdict:
    """Whether what was searched for is in the scene, and how this was decided."""

    found: bool
    reached: Reached
    # above the threshold: in logits of the probability, spreads, tenths of relevancy or of the masks' share
    margin: float
    probability: float | None = None  # that it is in the scene; None without a calibration

    @property
    def outcome(self) -> Outcome:
        """The verdict in words: a weak match may be in the scene, but was not found."""
        if self.found:
            return "found"
        if self.probability is not None:
            weak = self.probability >= RULE.weak_probability
        else:
            weak = self.reached in IN_SPREADS and self.margin >= RULE.weak_excess
        return "weak match" if weak else "not here"

    @property
    def by_chance(self) -> float | None:
        """The share of absent phrases that fit as well; None unless the verdict is by chance."""
        if self.reached != "chance":
            return None
        at_bar, slope = RULE.by_chance
        return float(sigmoid(logit(np.array(at_bar)) - slope * self.margin))

    @property
    def absent(self) -> "Verdict":
        """The verdict for an answer without members."""
        return Verdict(False, self.reached, -np.inf, None if self.probability is None else 0.0)


class Judged:
    """An answer that has a verdict, under `judgement`."""

    judgement: Verdict

    @property
    def found(self) -> bool:
        """True if what was searched for is in the scene."""
        return self.judgement.found

    @property
    def verdict(self) -> Outcome:
        return self.judgement.outcome

    @property
    def probability(self) -> float | None:
        """The probability that it is in the scene; None without a calibration."""
        return self.judgement.probability

    @property
    def said(self) -> str:
        """The verdict with the percentage behind it, such as "found, 83 %" or "found, by chance 2 %"."""
        if self.probability is not None:
            elsewhere = "" if self.found or self.judgement.margin < 0 else " at another level"
            return f"{self.verdict}, {100 * self.probability:.0f} %{elsewhere}"
        if (by_chance := self.judgement.by_chance) is None:
            return self.verdict
        share = 100 * max(by_chance, 0.001)  # never 0 %
        return f"{self.verdict}, by chance {share:.{0 if share >= 1 else 1}f} %"


def combined(verdicts: Sequence[Verdict], all_needed: bool) -> Verdict:
    """Return the verdict on several things: the weakest if all are needed, else the strongest."""
    score, holds = (min, all) if all_needed else (max, any)
    kinds = {verdict.reached for verdict in verdicts}
    reached: Reached = "several"
    if len(kinds) == 1:
        reached = kinds.pop()
    elif kinds <= {*IN_SPREADS}:
        reached = "chance"
    probabilities = [verdict.probability for verdict in verdicts if verdict.probability is not None]
    return Verdict(
        found=holds(verdict.found for verdict in verdicts),
        reached=reached,
        margin=score(verdict.margin for verdict in verdicts),
        probability=score(probabilities) if len(probabilities) == len(verdicts) else None,
    )


def scaling_of(calibration: Calibration | None, sought: Sought, phrase: str) -> PlattScaling | None:
    """Return the logistic function of a calibration for a phrase; None without a calibration."""
    if calibration is None:
        return None
    if sought == "inside":
        return calibration.inside
    coloured = not COLOURS.isdisjoint(phrase_key(phrase).split()[:-1])
    if sought == "thing":
        return calibration.coloured_thing if coloured else calibration.thing
    return calibration.coloured_part if coloured else calibration.part


def judge(
    fits: Fits,
    sought: Sought,
    level: LevelChoice,
    bars: Bars | None,
    scaling: PlattScaling | None,
    common: float = 0.0,
) -> Verdict:
    """Return the verdict on the best fits of a phrase at the levels, by `scaling`, or without it by `bars`.

    common: the phrase's mean fit, see `common_fits`, in the scene or on the thing.
    """
    if scaling is None:
        assert bars is not None
        share = 0 if sought == "inside" else RULE.common_share  # as in `bars_of` for one thing
        subpart, part, whole = (fit - share * common for fit in fits)
        margin = excess((subpart, part, whole), bars, sought, level)
        return Verdict(margin >= 0, "chance", margin)
    probability = scaling.probability(fits, common)
    margin = float(logit(np.array(probability)) - logit(np.array(min(scaling.found, 1 - RULE.narrowest))))
    # It may be in the scene, but the regions of the wanted level are nearer to other phrases.
    shown = level == "auto" or sought == "inside" or fits[LEVELS.index(level)] >= 0
    return Verdict(shown and probability >= scaling.found, "calibration", margin, probability)


# The answer in one scene.


@dataclass(frozen=True, eq=False)
class Decision:
    """The level of an answer, its regions, and the verdict."""

    level: int  # index into LEVELS
    scores: Fits  # best relevancy per level
    fits: Fits  # best fit per level, by the first name, that the verdict is based on
    common: float  # mean fit of the same regions
    relevancies: Array  # (r,) float32 of the regions of the level
    inside: Array  # (r,) bool: the regions that are members
    best: int  # the region whose position is the answer's; -1 for none
    verdict: Verdict


def decide(
    table: RegionTable,
    own: Sequence[Array],
    sought: Sought,
    level: LevelChoice,
    bars: Bars,
    scaling: PlattScaling | None,
    on: Array | None = None,
) -> Decision:
    """Return the answer: the regions of a scene that fit nearly as well as the best one.

    own: (R,) fits of the regions' mean relevancies, for every name of what is sought. A part of a thing has
    the phrase ("mug handle") and, if known, the part ("handle"), which count the same. on: (R,) bool, the
    regions of its thing, which alone may be members; "auto" is then not "whole". The verdict is by the first
    name, over all regions, or over `on` if a part is sought "inside".
    """
    every, fits = region_fits(table, own[0]), region_fits(table, np.mean(own, axis=0))
    if on is not None:
        fits = np.where(on, fits, RULE.nothing)
    if on is not None and sought == "inside":
        every = np.where(on, every, RULE.nothing)
    common = float(common_fits(table, every)[0])
    evidence = triple(fit_of(best_relevancies(table, region_relevancies(every))[0]))
    relevancies = region_relevancies(fits)
    scores = best_relevancies(table, relevancies)[0]
    best = fit_of(scores)
    given = best + RULE.advantage["part of a thing" if sought == "inside" else sought]
    if on is not None:
        given[-1] = RULE.nothing
    # The coarsest of equal levels.
    chosen = int(np.flatnonzero(given == given.max())[-1]) if level == "auto" else LEVELS.index(level)
    shown = table.level(chosen, relevancies).astype(np.float32)
    solid = np.where(shown > np.float32(scores[chosen]), 0, shown)  # only crumbs exceed the best
    return Decision(
        level=chosen,
        scores=triple(scores),
        fits=evidence,
        common=common,
        relevancies=shown,
        inside=table.level(chosen, fits) >= RULE.least_fit(float(best[chosen])),
        best=int(solid.argmax()) if solid.max(initial=0) > 0 else -1,
        verdict=judge(evidence, sought, level, bars, scaling, common),
    )


def triple(values: Array) -> Fits:
    """Return (3,) values as Python numbers."""
    subpart, part, whole = values
    return float(subpart), float(part), float(whole)
