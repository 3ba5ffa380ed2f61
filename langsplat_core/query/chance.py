"""What phrases fit by chance: the scale of every answer, whatever the encoder.

Cosines of one encoder say 0.3 for what another calls 0.6. So a phrase is read against everyday phrases, most
of which are not there: at every meaning of the scene its cosine is compared with theirs, in units of their
spread,

    fit  =  (cosine - zero) / spread,        relevancy  =  1 / (1 + exp(-fit)),

where the spread is the standard deviation of the everyday phrases' cosines there, and zero is what the best
of them have by chance (the mean of the largest `TOP`), mixed with the nearest of the canonical phrases, which
are LERF's own null, of four. A meaning that lies near all phrases ("hub") thereby loses its advantage. What
the best of a whole scene is for phrases that are not there follows from the same phrases: "found" is what
exceeds it.

Without everyday phrases, and for answers as published, relevancy is LERF's (`semantics.relevancy`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import csr_matrix

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.config import LevelChoice
from langsplat_core.query.regions import SMALLEST, Regions
from langsplat_core.query.surface import Surface
from langsplat_core.query.vocabulary import Named
from langsplat_core.scene import LEVELS, Fits, LanguageField

TOP = 0.07  # of the everyday phrases: those that fit best by chance
CANONICAL = 0.25  # weight of the nearest canonical phrase in the zero
NARROWEST = 1e-6  # distance of a relevancy from 0 and 1, so that its fit is finite
SAMPLED = 96  # everyday phrases that are looked up in a scene without codewords, where each costs a query
# Spreads above the median best fit of everyday phrases from which a phrase is found, among whole things and
# at the finer levels, by what it names: where things like it are, and elsewhere, where more is asked for. One
# absent phrase in twenty exceeds it (rooms 201 to 203, both encoders). Some everyday phrases are there, which
# raises their median; that is in these numbers.
FOUND: Mapping[Named | Literal["inside"], tuple[float, float]] = {
    "thing": (1.25, 2.5),
    "part": (2.5, 1.5),
    "part of a thing": (2.5, 1.5),
    "inside": (np.inf, 2.0),  # a part, among what is on a thing that is there
}
LOW = (
    0.16  # quantile one standard deviation below the median: what is there lies above, and does not widen it
)


@dataclass(frozen=True, eq=False)
class Scale:
    """How the cosines of a field are read."""

    canonical: Array  # (C, D) float32 unit
    everyday: Array | None  # (V, D) float32 unit; None: as published
    temperature: float  # of relevancy as published

    @property
    def texts(self) -> Array:
        """(T, D) everything that `of` compares with."""
        return self.canonical if self.everyday is None else np.concatenate([self.canonical, self.everyday])

    def of(self, cosines: Array) -> tuple[Array, Array]:
        """(M, T) cosines of meanings with `texts` -> (M,) float32 zero and rate of each: relevancy is
        sigmoid(rate * (cosine - zero))."""
        nearest = cosines[:, : len(self.canonical)].max(1)
        if self.everyday is None:
            return nearest, np.full(len(cosines), self.temperature, np.float32)
        others = cosines[:, len(self.canonical) :]
        count = max(round(TOP * others.shape[1]), 1)
        top = np.partition(others, -count, axis=1)[:, -count:].mean(1)
        spread = np.maximum(others.std(1), NARROWEST)
        zero = CANONICAL * nearest + (1 - CANONICAL) * top
        return zero.astype(np.float32), (1 / spread).astype(np.float32)

    def fit(self, relevancy: Array | float) -> Array:
        """Relevancy in [0, 1] -> the fit it stands for, in spreads; as published, the margin of cosines."""
        clipped = np.clip(np.asarray(relevancy, np.float64), NARROWEST, 1 - NARROWEST)
        rate = 1.0 if self.everyday is not None else self.temperature
        return np.asarray(np.log(clipped / (1 - clipped)) / rate)


def relevancy_of(cosines: Array, zero: Array, rate: Array) -> Array:
    """Of shapes that go together, in (0, 1)."""
    return sigmoid(rate * (cosines - zero))


@dataclass(frozen=True)
class Bar:
    """What the best fit of phrases is by chance."""

    median: float
    spread: float

    def excess(self, fit: float, spreads: float) -> float:
        """By how many spreads `fit` exceeds what is so many above the median."""
        return (fit - self.median) / max(self.spread, NARROWEST) - spreads


Bars = tuple[Bar, Bar, Bar, Bar]  # of each level, and of the better one of the finer two


@dataclass(frozen=True, eq=False)
class Chance:
    """Fits of V everyday phrases at all regions of a scene."""

    fits: tuple[Array, Array, Array]  # (R, V) float32 of each level

    def bars(self, rows: tuple[Array, Array, Array] | None = None) -> Bars:
        """Of the scene, or of some regions `rows` of each level alone."""
        chosen = (
            self.fits if rows is None else [fits[some] for fits, some in zip(self.fits, rows, strict=True)]
        )
        subpart, part, whole = (fits.max(0, initial=-np.inf) for fits in chosen)
        return _bar(subpart), _bar(part), _bar(whole), _bar(np.maximum(subpart, part))


def _bar(best: Array) -> Bar:
    if len(best) == 0 or not np.isfinite(best).all():
        return Bar(np.inf, 1.0)
    low, median = np.quantile(best, [LOW, 0.5])
    return Bar(float(median), float(median - low))


def excess(fits: Fits, bars: Bars, named: Named | Literal["inside"], level: LevelChoice = "auto") -> float:
    """By how many spreads the best fits of a phrase exceed those from which it is found; it is from 0 on. At
    one `level`, or, where that is free, at any."""
    whole, finer = FOUND[named]
    if level != "auto":
        index = LEVELS.index(level)
        return bars[index].excess(fits[index], min(whole, finer))
    return max(bars[2].excess(fits[2], whole), bars[3].excess(max(fits[:2]), finer))


def chance_in(
    field: LanguageField, surface: Surface, regions: Regions, scale: Scale, lookup: Iterator[Array]
) -> Chance:
    """Of a scene. lookup: relevancies (3, N) of everyday phrases, which are looked at where there are no
    codewords to compare instead."""
    if field.codec.space == "index":
        return _by_codewords(field, surface, regions, scale)
    columns = [[scale.fit(means) for means in regions.means(values)] for values in lookup]
    subpart, part, whole = (
        _solid(np.stack(fits, 1).astype(np.float32), regions.sizes[level])
        for level, fits in enumerate(zip(*columns, strict=True))
    )
    return Chance((subpart, part, whole))


def _by_codewords(field: LanguageField, surface: Surface, regions: Regions, scale: Scale) -> Chance:
    assert scale.everyday is not None
    count = field.codec.index_size
    vectors = field.codec.decode(np.arange(count, dtype=np.uint16)[:, None])
    zero, rate = scale.of(vectors @ scale.texts.T)
    relevancy = relevancy_of(vectors @ scale.everyday.T, zero[:, None], rate[:, None])
    fits = []
    for level, known in enumerate(field.known):
        has = known[surface.rows]
        places = regions.of[level][has], field.latents[level, surface.rows[has], 0].astype(np.int64)
        shape = (len(regions.totals[level]), count)
        shares = csr_matrix((surface.weights[has], places), shape=shape)
        means = (shares @ relevancy) / regions.totals[level][:, None]
        fits.append(_solid(scale.fit(means).astype(np.float32), regions.sizes[level]))
    return Chance((fits[0], fits[1], fits[2]))


def _solid(fits: Array, sizes: Array) -> Array:
    """Crumbs do not count where there are others, as in `extent`."""
    solid = sizes >= SMALLEST
    return np.where(solid[:, None], fits, -np.inf) if solid.any() else fits
