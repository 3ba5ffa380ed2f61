"""Taught words: names of examples that a user pointed at, and the regions that resemble these.

Any two image vectors of CLIP have a cosine of 0.65: light and background hide what distinguishes instances.
So regions are compared in the *word space*, along the directions in which everyday phrases differ, after the
mean of the scene's regions is subtracted. The *rival* of a scene is the similarity in this space below which
most pairs of its wholes lie; the other pairs may show one thing twice. A region matches an example if their
similarity exceeds a threshold that follows from the mean rival of both scenes, see `FOUND`.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.config import LevelChoice
from langsplat_core.errors import InputError
from langsplat_core.query.answers import QueryResult, Regions, by_regions, feature_sums
from langsplat_core.query.lookup import Relevancy
from langsplat_core.query.rule import Decision, Verdict, triple
from langsplat_core.scene import LEVELS, LanguageField, TaughtWord
from langsplat_core.scene.surface import SMALLEST

VARIANCE = 0.95  # share of the everyday phrases' variance that the word space holds
OTHERS = 0.9  # quantile of the similarities of pairs of wholes that is the rival
# Threshold of each level: the first number plus the second times the rival. Of what was shown in one of rooms
# 201 to 203 and is absent in another, 95 % stays below, with the bundled encoder and with CLIP's geometry.
FOUND = ((0.0, 2.8), (0.0, 2.8), (0.1, 1.9))
HIGHEST = 0.95  # largest threshold
# Where everything is similar, as in real scenes, the example tells more than the scene: a rival is at most
# `LIKEST`, and the threshold of a whole at most half way from its `NEXT` most similar others to 1.
LIKEST, NEXT = 0.42, 3
# Unit of fits, as a share of the way from the threshold to 1, and of margins, as a share of the threshold.
# Half a unit below it lies 80 % of what is absent. A copy of an example has fit 1 / UNIT, relevancy 0.97.
UNIT = 0.3
LEAST = -1 / UNIT  # fit, and margin, at similarity 0


@dataclass(frozen=True, eq=False)
class WordSpace:
    """The regions of a scene in the word space of its encoder, of W dimensions."""

    basis: Array  # (W, D) float32 orthonormal
    centres: Array  # (3, W) mean over the regions of each level
    regions: tuple[Array, ...]  # (R, W) of each level, unit; zero for a region without features
    rival: float  # in [0, 1], see above; 0 with fewer than two wholes


def build_word_space(field: LanguageField, regions: Regions, votes: Array) -> WordSpace:
    """Return the word space of a scene; without everyday phrases it is the whole space of vectors.

    votes: (K,) of the tree's nodes. Mean and rival are over regions with a vote: most others are fragments.
    """
    basis = np.eye(field.codec.vector_dim, dtype=np.float32)
    if field.everyday is not None and len(field.everyday) > 1:
        _, spreads, axes = np.linalg.svd(field.everyday - field.everyday.mean(0), full_matrices=False)
        shares = np.cumsum(spreads.astype(np.float64) ** 2)
        basis = axes[: int(np.searchsorted(shares, VARIANCE * shares[-1])) + 1]
    centres, every, solid = [], [], np.zeros(0, bool)
    for level, (of, sizes) in enumerate(zip(regions.everywhere, regions.sizes, strict=True)):
        means, known = _means(field, basis, level, of, regions.weights, len(sizes))
        solid = known & (sizes >= SMALLEST)
        told = solid & (votes[regions.nodes[level]] > 0)
        solid = told if told.sum() > 1 else solid
        centres.append(means[solid].mean(0) if solid.any() else np.zeros(len(basis)))
        every.append(np.where(known[:, None], unit(means - centres[-1]), 0))
    alike = every[-1][solid] @ every[-1][solid].T
    pairs = alike[np.triu_indices(len(alike), 1)].clip(0, 1)
    rival = min(float(np.quantile(pairs, OTHERS)), LIKEST) if len(pairs) else 0.0
    return WordSpace(basis, np.stack(centres), tuple(every), rival)


def _means(
    field: LanguageField, basis: Array, level: int, of: Array, weights: Array, count: int
) -> tuple[Array, Array]:
    """Return (count, W) mean features of sets of Gaussians in a space, and (count,) bool: the set has any."""
    counted = field.known[level] & (of >= 0)
    totals = np.bincount(of[counted], weights[counted], count)
    sums = feature_sums(field, level, of, weights, count, partial(field.codec.cosines, vectors=basis))
    return sums / np.maximum(totals, 1e-12)[:, None], totals > 0


def of_example(
    space: WordSpace, field: LanguageField, regions: Regions, name: str, members: Array, level: int
) -> TaughtWord:
    """Return the word for `members` (N,) bool at a level; InputError if they resemble all the rest."""
    sets = np.where(members, 0, -1)
    (mean,), (known,) = _means(field, space.basis, level, sets, regions.weights, 1)
    vector = unit(mean - space.centres[level]) @ space.basis
    if not known or not np.linalg.norm(vector) > 0.5:
        raise InputError(f"what was shown means nothing at level {LEVELS[level]}; point at something else")
    rival, whole = space.rival, len(LEVELS) - 1
    if level == whole:
        of, sizes = regions.everywhere[whole], regions.sizes[whole]
        others = np.setdiff1d(np.flatnonzero(sizes >= SMALLEST), of[members])
        alike = np.sort(space.regions[whole][others] @ (space.basis @ unit(vector)))[-NEXT:]
        base, times = FOUND[whole]
        if len(alike) == NEXT:
            rival = float(np.clip(((1 + alike.mean()) / 2 - base) / times, 0, rival))
    # Rounded as in files, so that a word gives the same answer after it was saved.
    vector = unit(vector).astype(np.float16).astype(np.float32)
    return TaughtWord(name, level, vector[None], np.array([rival], np.float16).astype(np.float32))


def compare(word: TaughtWord, space: WordSpace, vectors: Array, level: int) -> tuple[Array, Array]:
    """Return (M,) largest cosines of (M, D) unit image vectors with an example, and (M,) fits, at a level."""
    examples, bars = _examples(word, space)
    alike = unit(vectors @ space.basis.T - space.centres[level]) @ examples.T
    return alike.max(1), _fits(alike, bars[level])


def _examples(word: TaughtWord, space: WordSpace) -> tuple[Array, Array]:
    """Return (T, W) unit examples, and the (3, T) thresholds of similarity at each level."""
    rivals = np.maximum((word.rivals + space.rival) / 2, 0.08)  # a few regions say little
    base, times = np.array(FOUND).T
    bars = np.minimum(base[:, None] + np.outer(times, rivals), HIGHEST)
    return unit(word.vectors @ space.basis.T), bars


def _fits(alike: Array, bar: Array) -> Array:
    return np.asarray(((alike - bar) / (1 - bar) / UNIT).max(1, initial=LEAST))


def likeness(word: TaughtWord, space: WordSpace) -> tuple[list[Array], list[Array]]:
    """Return the (R,) fits of the regions of each level, and their (R,) margins in `UNIT`s."""
    examples, bars = _examples(word, space)
    fits, above = [], []
    for row, bar in zip(space.regions, bars, strict=True):
        alike = row @ examples.T  # (R, T)
        fits.append(_fits(alike, bar))
        above.append(((alike / bar - 1) / UNIT).max(1, initial=LEAST))
    return fits, above


def by_examples(
    word: TaughtWord, space: WordSpace, regions: Regions, means: Array, level: LevelChoice
) -> QueryResult:
    """Return the answer to a taught word: regions that match one of its examples; "auto" is its own level."""
    chosen = word.level if level == "auto" else LEVELS.index(level)
    fits, above = likeness(word, space)
    every = [sigmoid(row) for row in fits]
    solid = [sizes >= min(SMALLEST, sizes.max(initial=0)) for sizes in regions.sizes]
    best = np.where(solid[chosen], fits[chosen], -np.inf)
    excess = float(np.where(solid[chosen], above[chosen], -np.inf).max(initial=LEAST))
    decision = Decision(
        level=chosen,
        scores=triple(np.array([row[some].max(initial=0) for row, some in zip(every, solid, strict=True)])),
        fits=triple(np.array([row[some].max(initial=LEAST) for row, some in zip(fits, solid, strict=True)])),
        common=0.0,
        relevancies=every[chosen].astype(np.float32),
        inside=solid[chosen] & (best >= min(0.0, best.max(initial=-np.inf))),
        best=int(best.argmax()) if len(best) else -1,
        verdict=Verdict(excess >= 0, "example", excess),
    )
    firsts = np.cumsum([0, *map(len, every)])  # the last: of Gaussians in no region
    rows = np.where(regions.everywhere < 0, firsts[-1], regions.everywhere + firsts[:-1, None])
    relevancy = Relevancy(np.append(np.concatenate(every), 0).astype(np.float32), rows)
    return by_regions(word.name, relevancy, decision, means, regions)
