"""The inventory of a scene: what is in it, where, how sure.

Every meaning of the scene has its best word, and so every Gaussian. Words that cover enough of the surface
are candidates; those that claim the same meanings are one thing by two names ("mug" and "cup"); and what is
listed was asked for, as a phrase, and found where it was claimed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.instances import connected_parts
from langsplat_core.query.words import Word, WordScores, certain
from langsplat_core.scene import LEVELS, LanguageField
from langsplat_core.semantics.relevancy import FLOOR

LEAST_SHARE = 5e-4  # of the scene's surface that a word, with others for the same, must be the best for
LEAST_SPOT = 0.15  # of its largest spot's surface: a smaller one is a splinter of a border
LEAST_COUNT = 12  # Gaussians of a spot
SAME = 0.5  # overlap of claims from which two words name the same thing
LIKELY = 0.5  # probability from which a word is listed
RUNNERS_UP = 5  # words per meaning that may be names for it
MOST = 200  # candidates per level, the largest first

LEVEL_NAMES: tuple[LevelChoice, ...] = (
    "subpart",
    "part",
    "whole",
)  # `LEVELS`, as `QueryEngine.run` takes them
Attributes = tuple[WordScores | None, WordScores | None]  # colours, materials


@dataclass(frozen=True, eq=False)
class Spot:
    """One connected place where a word is true."""

    centre: Array  # (3,) world units
    box: Array  # (2, 3) lower and upper corner, world units, between 2 % and 98 % of its Gaussians
    rows: Array  # (M,) int64 numbers of its Gaussians
    share: float  # of the scene's surface, in [0, 1]
    colour: Word | None
    material: Word | None


@dataclass(frozen=True, eq=False)
class Entry:
    """A word that is true in the scene."""

    phrase: str
    also: tuple[str, ...]  # other words for the same
    level: int  # index into LEVELS
    probability: float  # that it or a word of `also` is right, a mean over its surface
    score: float  # peak relevancy of the phrase, as a query gives it
    share: float  # of the scene's surface, in [0, 1]
    spots: tuple[Spot, ...]  # the largest first


@dataclass(frozen=True, eq=False)
class Meanings:
    """The M different meanings of a field, and who has which."""

    latents: Array  # (M, d)
    of: Array  # (3, N) int64 number of each Gaussian's meaning, -1 for none

    def surface(self, level: int, areas: Array) -> Array:
        """(N,) areas -> (M,) the area of each meaning at a level."""
        has = self.of[level] >= 0
        return np.bincount(self.of[level][has], areas[has], minlength=len(self.latents))


@dataclass(frozen=True, eq=False)
class _Claim:
    """A group of words that claim the same meanings at one level."""

    level: int
    phrases: tuple[str, ...]  # the most claimed first
    rows: Array  # (M,) int64 numbers of the Gaussians for which one of them is the best
    probability: float


def take_inventory(
    engine: QueryEngine,
    words: Sequence[WordScores],
    attributes: Attributes,
    areas: Array,
    progress: Progress = silent,
) -> list[Entry]:
    """Every word that is true in the scene, whole things first, then by surface. A word is listed once, at
    the coarsest level where it is claimed and found.

    words: of each level; areas: (N,) as of `surface_areas`.
    """
    field = engine.field
    held = field_meanings(field)
    entries: list[Entry] = []
    named: set[str] = set()
    for level in reversed(range(len(LEVELS))):
        claims = list(_claims(field, held, words[level], level, areas))
        for done, claim in enumerate(claims):
            progress(f"checking words: {LEVELS[level]}", done / len(claims))
            if named.isdisjoint(claim.phrases):
                entry = _verified(engine, words[level], attributes, areas, claim)
                if entry is not None:
                    entries.append(entry)
                    named.update(claim.phrases)
        progress(f"checking words: {LEVELS[level]}", 1.0)
    return entries


def field_meanings(field: LanguageField) -> Meanings:
    """Codewords, or the meaning of every Gaussian by itself where a codec has none."""
    if field.codec.space == "index":
        codes = np.arange(field.codec.index_size, dtype=np.uint16)[:, None]
        return Meanings(codes, np.where(field.known, field.latents[..., 0].astype(np.int64), -1))
    known = field.known
    of = np.full(known.shape, -1, np.int64)
    of[known] = np.arange(int(known.sum()))
    return Meanings(field.latents[known], of)


def _claims(
    field: LanguageField, held: Meanings, words: WordScores, level: int, areas: Array
) -> Iterator[_Claim]:
    """Groups of words at a level, those that cover most first."""
    best, shares = words.best(field.codec, held.latents, RUNNERS_UP)
    if best.size == 0:  # no words, or nothing that means anything
        return
    surface = held.surface(level, areas)
    least = LEAST_SHARE * max(float(areas.sum()), 1e-300)
    mass = np.bincount(best.ravel(), (surface[:, None] * shares).ravel())
    order = np.argsort(-mass, kind="stable")[:MOST]
    candidates = order[mass[order] >= least / 2]
    names = np.zeros((len(surface), len(candidates)), np.float32)  # (M, C) probability of each candidate
    for column, word in enumerate(candidates):
        names[:, column] = np.where(best == word, shares, 0).sum(1)
    for group in same_things(names, surface):
        numbers = candidates[group]
        winners = np.isin(best[:, 0], numbers)
        weight = surface[winners]
        if weight.sum() < least:
            continue
        probability = float(weight @ names[winners][:, group].sum(1)) / float(weight.sum())
        if probability < LIKELY:
            continue
        of = held.of[level]
        rows = np.flatnonzero((of >= 0) & winners[np.maximum(of, 0)])
        yield _Claim(level, tuple(words.phrases[number] for number in numbers), rows, probability)


def same_things(names: Array, surface: Array) -> list[list[int]]:
    """(M, C) probabilities of C words, the most claimed first, for meanings of (M,) surface -> groups of
    columns that name the same.

    Two words do where most of what either claims is claimed by the other as well:
    sum_m s_m min(p_ma, p_mb) >= SAME max(sum_m s_m p_ma, sum_m s_m p_mb). A word joins the first group whose
    most claimed word it agrees with.
    """
    weighted = names.astype(np.float64) * surface[:, None]
    totals = weighted.sum(0)
    groups: list[list[int]] = []
    for word in range(names.shape[1]):
        for group in groups:
            head = group[0]
            common = np.minimum(weighted[:, word], weighted[:, head]).sum()
            if common >= SAME * max(totals[word], totals[head]):
                group.append(word)
                break
        else:
            groups.append([word])
    return groups


def _verified(
    engine: QueryEngine, words: WordScores, attributes: Attributes, areas: Array, claim: _Claim
) -> Entry | None:
    """The claim as an entry under the first of its words that a query finds there; None if it finds none."""
    level: LevelChoice = LEVEL_NAMES[claim.level]
    for phrase in claim.phrases:
        result = engine.run(phrase, level, vector=words.vector(phrase))
        agreed = claim.rows[result.relevancy[claim.level, claim.rows] > FLOOR]
        if not result.found or 2 * areas[agreed].sum() < areas[claim.rows].sum():
            continue
        spots = _spots(engine, attributes, areas, claim.level, agreed)
        if spots:
            others = tuple(other for other in claim.phrases if other != phrase)
            share = float(sum(spot.share for spot in spots))
            return Entry(phrase, others, claim.level, claim.probability, result.peak, share, spots)
    return None


def _spots(
    engine: QueryEngine, attributes: Attributes, areas: Array, level: int, rows: Array
) -> tuple[Spot, ...]:
    """The connected places of Gaussians `rows` (M,), the largest first, without splinters."""
    total = float(areas.sum())
    surface = engine.surface
    numbers = np.flatnonzero(np.isin(surface.rows, rows))
    found = [surface.rows[part] for part in connected_parts(surface, numbers).each()]
    parts = sorted(found, key=lambda part: -areas[part].sum())
    least = LEAST_SPOT * areas[parts[0]].sum() if parts else 0.0
    kept = [part for part in parts if len(part) >= LEAST_COUNT and areas[part].sum() >= least]
    return tuple(_spot(engine, attributes, areas, level, part, total) for part in kept)


def _spot(
    engine: QueryEngine, attributes: Attributes, areas: Array, level: int, rows: Array, total: float
) -> Spot:
    field, weights = engine.field, np.maximum(areas[rows], 1e-300)
    positions = engine.scene.gaussians.means[rows].astype(np.float64)
    latents = field.latents[level, rows]
    colour, material = (
        None if known is None else certain(known, field.codec, latents, weights) for known in attributes
    )
    return Spot(
        centre=weights @ positions / weights.sum(),
        box=np.quantile(positions, [0.02, 0.98], axis=0),
        rows=rows,
        share=float(weights.sum()) / total,
        colour=colour,
        material=material,
    )
