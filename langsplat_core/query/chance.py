"""What everyday phrases fit in a scene, where most of them are not: what exceeds that is found.

Fits are those of `semantics.relevancy.Scale`. The more places a scene has, the better the best of them fits a
phrase by chance; so "found" is said by the best fits of everyday phrases in the scene itself.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import csr_matrix

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.query.regions import SMALLEST, Regions
from langsplat_core.query.surface import Surface
from langsplat_core.query.vocabulary import Named
from langsplat_core.scene import LEVELS, Fits, LanguageField
from langsplat_core.semantics.relevancy import NARROWEST, Scale, relevancy_of

SAMPLED = 96  # everyday phrases that are looked up in a scene without codewords, where each costs a query
# Spreads above the median best fit of everyday phrases from which a phrase is found, among whole things and
# at the finer levels, by what it names: where things like it are, and elsewhere, where more is asked for. One
# absent phrase in twenty exceeds it (rooms 201 to 203, the bundled encoder and CLIP's geometry with six sets
# of vectors). Some everyday phrases are there, which raises their median; that is in these numbers.
FOUND: Mapping[Named | Literal["inside"], tuple[float, float]] = {
    "thing": (1.35, 2.6),
    "part": (2.55, 1.3),
    "part of a thing": (2.55, 1.3),
    "inside": (np.inf, 1.8),  # a part, among what is on a thing that is there
}
LOW = 0.16  # quantile one standard deviation below the median; what is there lies above, and widens nothing


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
