"""The relevancies of a phrase at every Gaussian and pixel, and its answer: the regions of the surface that
are it, or its peak alone.

Absolute relevancy says little across encoders and phrases (a cosine margin of 0.1 is 0.73). So whether a
phrase is found is judged by what everyday phrases fit in the same scene, and how far it reaches by its best
region.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.sparse import csr_matrix

from langsplat_core.arrays import Array, logit, sigmoid
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.config import LevelChoice
from langsplat_core.display.displays import gated_mean
from langsplat_core.errors import InputError
from langsplat_core.query.grammar import Named, named
from langsplat_core.query.instances import axis_aligned_box
from langsplat_core.query.selection import Regions
from langsplat_core.raster.protocol import View
from langsplat_core.scene import LEVELS, Calibration, Codec, Fits, LanguageField
from langsplat_core.scene.surface import SMALLEST, Surface
from langsplat_core.semantics.relevancy import (
    FLOOR,
    MIN_HEAT_SPAN,
    NARROWEST,
    Scale,
    latent_relevancy,
    relevancy_of,
)

# Relevancy, by what the scene's codec allows. Each distinct latent is compared, exactly; those of a codebook
# are few, and every Gaussian costs a fetch. Of unit latents of three numbers, the relevancy of a phrase is a
# function on the sphere: the decoder is run once per scene at the nodes of an octahedral grid that its
# latents lie between; after that a phrase costs one matrix-vector product, and every Gaussian a bilinear
# interpolation at a place computed once.

CHUNK = 16_384  # latents compared with texts at a time
RESOLUTION = 256  # nodes per side; error against exact decoding falls with its square
TOGETHER = 16  # phrases compared with every latent at a time: 4 bytes each per latent


class SphereTable:
    """Unit latents of three numbers: decoded once at the nodes of a grid, then interpolated between them."""

    def __init__(self, codec: Codec, latents: Array, scale: Scale, resolution: int = RESOLUTION) -> None:
        """latents: (M, 3) float; those of no length have no meaning."""
        known = codec.known(latents)
        safe = np.where(known[:, None], latents, (0.0, 0.0, 1.0)).astype(np.float64)
        position = sphere_to_octahedral(safe) * (resolution - 1)
        cell = np.clip(np.floor(position), 0, resolution - 2).astype(np.int64)
        corner = cell[:, 1] * resolution + cell[:, 0]  # row-major: first coordinate fastest
        needed = np.zeros(resolution**2, bool)
        for step in (0, 1, resolution, resolution + 1):
            needed[corner[known] + step] = True
        self._resolution = resolution
        self._corner = np.where(known, corner, -1).astype(np.int32)  # (M,) lower left node
        self._fraction = (position - cell).astype(np.float32)  # (M, 2) place inside the cell, in [0, 1]
        self.used = np.flatnonzero(needed)  # (U,) nodes that some latent lies next to
        grid = np.stack([self.used % resolution, self.used // resolution], 1) / (resolution - 1)
        self._vectors = codec.decode(octahedral_to_sphere(grid).astype(np.float32))
        self._zero, self._rate = scale.of(self._vectors @ scale.texts.T)

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """(Q, D) unit phrase vectors -> of each in turn (M,) float32 relevancy; 0 for no meaning."""
        values = relevancy_of(self._vectors @ phrases.T, self._zero[:, None], self._rate[:, None])
        grid = np.zeros(self._resolution**2, np.float32)
        for row in values.T:
            grid[self.used] = row
            found = np.empty(len(self._corner), np.float32)
            arguments = grid, self._corner, self._fraction, self._resolution, found
            shared_workers().run(_interpolate, len(found), *arguments)
            yield found


def octahedral_to_sphere(uv: Array) -> Array:
    """(..., 2) in [0, 1]^2 -> (..., 3) unit vectors; the square's border is the lower hemisphere's pole."""
    xy = 2 * np.asarray(uv, np.float64) - 1
    z = 1 - np.abs(xy).sum(-1)
    vectors = np.concatenate([_folded(xy, z), z[..., None]], -1)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def sphere_to_octahedral(vectors: Array) -> Array:
    """(..., 3) non-zero vectors -> (..., 2) in [0, 1]^2; inverse of `octahedral_to_sphere`."""
    scaled = vectors / np.abs(vectors).sum(-1, keepdims=True)
    return (_folded(scaled[..., :2], scaled[..., 2]) + 1) / 2


def _folded(xy: Array, z: Array) -> Array:
    """Fold the lower half (z < 0) of the octahedron out into the square's corners, or back in."""
    return np.where((z < 0)[..., None], (1 - np.abs(xy[..., ::-1])) * np.where(xy >= 0, 1, -1), xy)


class ExactLookup:
    """Compares every distinct latent, then fetches per Gaussian: exact, in bounded memory."""

    def __init__(self, field: LanguageField, scale: Scale) -> None:
        self._codec = field.codec
        self._latents, of = field.codec.unique(field.latents.reshape(-1, field.latents.shape[-1]))
        count = len(self._latents)
        kind = np.uint16 if count <= np.iinfo(np.uint16).max else np.uint32
        self._of = np.where(field.known.reshape(-1), of, count).astype(kind)
        self._zero, self._rate = np.empty(count, np.float32), np.empty(count, np.float32)
        for part in self._parts():
            cosines = self._codec.cosines(self._latents[part], scale.texts)
            self._zero[part], self._rate[part] = scale.of(cosines)

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """(Q, D) unit phrase vectors -> of each in turn (3 N,) float32 relevancy; 0 for no meaning."""
        for first in range(0, len(phrases), TOGETHER):
            some = phrases[first : first + TOGETHER]
            values = np.zeros((len(some), len(self._latents) + 1), np.float32)  # the last: no meaning
            for part in self._parts():
                cosines = self._codec.cosines(self._latents[part], some)
                zero, rate = self._zero[part, None], self._rate[part, None]
                values[:, :-1][:, part] = relevancy_of(cosines, zero, rate).T
            for row in values:
                found = np.empty(len(self._of), np.float32)
                shared_workers().run(_fetch, len(found), row, self._of, found)
                yield found

    def _parts(self) -> Iterator[slice]:
        for start in range(0, len(self._latents), CHUNK):
            yield slice(start, min(start + CHUNK, len(self._latents)))


Lookup = SphereTable | ExactLookup  # what of a language field does not depend on the phrase


def build_lookup(field: LanguageField, scale: Scale, exact: bool = False) -> Lookup:
    """The fastest lookup for `field`; with `exact` none that interpolates, to measure a table by."""
    if field.codec.spherical and not exact:
        latents = np.where(field.known[..., None], field.latents, 0)
        return SphereTable(field.codec, latents.reshape(-1, 3), scale)
    return ExactLookup(field, scale)


@kernel
def _fetch(first: int, last: int, values: Array, codes: Array, found: Array) -> None:
    """Fill rows [first, last) of `found` (3 N,)."""
    for i in range(first, last):
        found[i] = values[codes[i]]


@kernel
def _interpolate(
    first: int, last: int, nodes: Array, corner: Array, fraction: Array, resolution: int, found: Array
) -> None:
    """Fill rows [first, last) of `found` (M,), bilinear."""
    one = np.float32(1)
    for i in range(first, last):
        node, u, v = corner[i], fraction[i, 0], fraction[i, 1]
        if node < 0:
            found[i] = 0
            continue
        low = nodes[node] * (one - u) + nodes[node + 1] * u
        high = nodes[node + resolution] * (one - u) + nodes[node + resolution + 1] * u
        found[i] = low * (one - v) + high * v


# Relevancy of pixels: per Gaussian and splatted, one linear channel per phrase (ours); or of latents that are
# splatted and decoded (the paper's order, section 3.4). Both are gated by alpha, because an uncovered pixel's
# zero latent decodes to a confident something.


def splatted_relevancy(view: View, relevancy: Array, alpha_gate: float) -> Array:
    """(N, Q) per-Gaussian relevancy -> (H, W, Q) per-pixel relevancy in [0, 1]; 0 under the gate."""
    total, alpha = view.splat(np.asarray(relevancy, np.float32))
    return gated_mean(total, alpha, alpha_gate)


def decoded_relevancy(
    view: View, field: LanguageField, level: int, phrases: Array, alpha_gate: float
) -> Array:
    """The paper's order: (Q, D) phrase vectors -> (H, W, Q) relevancy of the decoded pixel latents. Raises
    InputError for a codebook, whose numbers cannot be blended."""
    if not field.codec.blends:
        raise InputError(
            f"the paper's order blends latents, and this scene has a {field.codec.kind}; train one with "
            "`--codec.kind autoencoder`"
        )
    blended, alpha = view.splat(field.latents[level])
    height, width, d = blended.shape
    flat = np.where(alpha[..., None] > alpha_gate, blended, 0).reshape(-1, d)
    values = latent_relevancy(field.codec, flat, phrases, field.canonical, field.reading.temperature)
    return values.reshape(height, width, len(phrases))


# The answer, whatever rule made it.

Triple = tuple[float, float, float]  # one number a level
AnswerRule = Literal["regions", "peak"]
Verdict = Literal["found", "weak match", "not here"]
WEAK = 0.5  # probability from which what is not found is at least a weak match
NEARLY = -0.5  # excess, spreads, from which it is where no probability is known


@dataclass(frozen=True, eq=False)
class QueryResult:
    """The answer to one phrase."""

    phrase: str
    level: int  # index into LEVELS
    scores: Triple  # best relevancy per level: of a region, or of a neighbourhood
    relevancy: Array  # (3, N) float32 in [0, 1] per level and Gaussian
    even: Array  # (N,) float32 relevancy at the level, the same all over a region
    peak: float  # score of the chosen level
    fits: Fits  # of the best region, or neighbourhood, of each level, see `Scale.fit`
    probability: float | None  # that the thing is there at all; None where the encoder is not calibrated
    found: bool
    members: Array  # (N,) bool: the Gaussians that answer, wherever they are
    place: Array | None  # (3,) world units
    box: Array | None  # (2, 3) corners, world units
    excess: float | None = None  # where there is none: spreads above chance, see `Bar.excess`
    own_cut: float | None = None  # relevancy from which on everything is a member, where it was set by hand

    @property
    def cut(self) -> float:
        """The least relevancy of a member, of its region where it has one; the peak where there is none."""
        if self.own_cut is not None:
            return self.own_cut
        return float(self.even[self.members].min(initial=self.peak))

    @property
    def verdict(self) -> Verdict:
        """The verdict in words: "weak match" is what may be there, but was not found."""
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
    """Return the answer with everything as a member whose relevancy (of its region, where it has one) is at
    least `cut`. Place, box and verdict stay: they are of the best, wherever the answer ends."""
    return replace(result, own_cut=cut, members=result.even >= np.float32(cut))


def triple(values: Iterable[float]) -> Triple:
    """Three values as Python numbers."""
    subpart, part, whole = values
    return float(subpart), float(part), float(whole)


# Chance: the fits of everyday phrases in a scene, most of which name nothing there. What exceeds it is found.
#
# Fits are those of `semantics.relevancy.Scale`. The more places a scene has, the better the best of them
# fits a phrase by chance; so "found" is said by the best fits of everyday phrases in the scene itself.

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
    """The best fit of phrases by chance: its median and spread."""

    median: float
    spread: float

    def excess(self, fit: float, spreads: float) -> float:
        """Spreads by which `fit` exceeds what is so many above the median."""
        return (fit - self.median) / max(self.spread, NARROWEST) - spreads


Bars = tuple[Bar, Bar, Bar, Bar]  # of each level, and of the better one of the finer two
Chance = tuple[Array, ...]  # (R, V) float32 of each level: fits of V everyday phrases at R regions


def bars(chance: Chance, rows: Sequence[Array] | None = None) -> Bars:
    """The bars of a scene, or of some regions `rows` of each level alone."""
    chosen = [fits if rows is None else fits[rows[level]] for level, fits in enumerate(chance)]
    subpart, part, whole = (fits.max(0, initial=-np.inf) for fits in chosen)
    return _bar(subpart), _bar(part), _bar(whole), _bar(np.maximum(subpart, part))


def _bar(best: Array) -> Bar:
    if len(best) == 0 or not np.isfinite(best).all():
        return Bar(np.inf, 1.0)
    low, median = np.quantile(best, [LOW, 0.5])
    return Bar(float(median), float(median - low))


def excess(fits: Fits, bars: Bars, named: Named | Literal["inside"], level: LevelChoice = "auto") -> float:
    """Spreads by which the best fits of a phrase exceed those from which it is found; it is from 0 on. At one
    `level`, or, where that is free, at any."""
    whole, finer = FOUND[named]
    if level != "auto":
        index = LEVELS.index(level)
        return bars[index].excess(fits[index], min(whole, finer))
    return max(bars[2].excess(fits[2], whole), bars[3].excess(max(fits[:2]), finer))


def chance_in(field: LanguageField, regions: Regions, scale: Scale) -> Chance:
    """The fits of everyday phrases in a scene."""
    assert scale.everyday is not None

    def everyday(latents: Array) -> Array:
        cosines = field.codec.cosines(latents, scale.texts)
        zero, rate = scale.of(cosines)
        return relevancy_of(cosines[:, len(scale.canonical) :], zero[:, None], rate[:, None])

    fits: list[Array] = []
    for level, totals in enumerate(regions.totals):
        of = regions.everywhere[level]
        sums = sums_of_meanings(field, level, of, regions.weights, len(totals), everyday)
        fits.append(scale.fit(sums / totals[:, None]).astype(np.float32))
    solid = [sizes >= SMALLEST for sizes in regions.sizes]
    return tuple(
        np.where(rows[:, None], own, -np.inf) if rows.any() else own  # as in `_best`
        for own, rows in zip(with_parts(regions, tuple(fits)), solid, strict=True)
    )


def sums_of_meanings(
    field: LanguageField, level: int, of: Array, weights: Array, count: int, read: Callable[[Array], Array]
) -> Array:
    """(count, V) weighted sums, over sets of Gaussians, of what `read`, (M, d) latents -> (M, V), makes of
    what they mean at a level. of: (N,) set of each, -1 for none; weights: (N,)."""
    rows = np.flatnonzero(field.known[level] & (of >= 0) & (weights > 0))
    latents, kinds = field.codec.unique(field.latents[level, rows])
    shares = csr_matrix((weights[rows], (of[rows], kinds)), shape=(count, len(latents))).tocsc()
    parts = [slice(start, start + CHUNK) for start in range(0, max(len(latents), 1), CHUNK)]
    return sum((shares[:, part] @ read(latents[part])).astype(np.float64) for part in parts)


# The answer by regions: its level, the regions that are it, and how good the best one is.
#
# Everything is judged by the fit of a region, in spreads of what phrases fit by chance, so that one rule
# serves all encoders. The numbers were chosen on rooms 201 to 203, with the bundled encoder and with the
# geometry of CLIP, never on rooms that measure.

# Spreads that each level is given before the best is chosen, by what a phrase names. A thing is one whole,
# whatever some part of it looks like.
ADVANTAGE: Mapping[Named, tuple[float, float, float]] = {
    "thing": (0.0, 0.25, 0.75),
    "part": (0.0, 0.0, 0.5),
    "part of a thing": (0.0, 0.1, 0.0),
}
PARTS = 0.25  # weight of its best part in the fit of a region: of a thing, something in it is sure
REACH = 0.45  # of the best fit: what fits less by this or less, within `NEAREST` and `FARTHEST`, is it too
NEAREST, FARTHEST = 0.15, 1.0  # spreads
NOTHING = float(logit(np.array(2 * NARROWEST)))  # fit: of less there is no meaning


def lowest(best: float, share: float = 1.0) -> float:
    """The fit from which a region belongs to an answer whose best region has the fit `best`; share: of the
    way that such an answer reaches."""
    return best - share * float(np.clip(REACH * best, NEAREST, FARTHEST))


def with_parts(regions: Regions, own: tuple[Array, ...]) -> tuple[Array, ...]:
    """The fits of regions, of each level (R, ...), from those of their own Gaussians' mean relevancy. Parts
    that mean nothing, and crumbs, say nothing."""
    telling = [sizes >= SMALLEST for sizes in regions.sizes]
    parts = tuple(
        np.where((fits.T > NOTHING) & rows, fits.T, -np.inf).T
        for fits, rows in zip(own, telling, strict=True)
    )
    best = (regions.best_parts(level, parts) for level in range(len(own)))
    return tuple(
        np.where(np.isfinite(part), (1 - PARTS) * fits + PARTS * part, fits)
        for fits, part in zip(own, best, strict=True)
    )


def _relevancy(fits: Array) -> Array:
    """The relevancy of fits, 0 for what has no meaning."""
    return np.where(fits > NOTHING, sigmoid(fits), 0)


def even_relevancy(regions: Regions, scale: Scale, relevancy: Array) -> Array:
    """(3, N) relevancy -> the same, of every region what its fit stands for; of what is in none its own."""
    own = plain(relevancy)
    fits = with_parts(regions, tuple(map(scale.fit, regions.means(own))))
    values = [_relevancy(row).astype(np.float32) for row in fits]
    return np.stack([regions.spread(level, row, own[level]) for level, row in enumerate(values)])


def _best(values: Array, sizes: Array) -> float:
    """The best region's relevancy; crumbs that no neighbour took do not count where there are others."""
    solid = values[sizes >= SMALLEST]
    return float((solid if len(solid) else values).max(initial=0))


def _level(best: Array, named: Named) -> int:
    """The level with the best fit, advantage included; the coarsest of equal ones."""
    given = best + ADVANTAGE[named]
    return int(np.flatnonzero(given == given.max())[-1])


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
    """The answer of whole regions that fit nearly as well as the best one. means: (N, 3) of the Gaussians."""
    kind, every = named(phrase), with_parts(regions, tuple(map(scale.fit, regions.means(relevancy))))
    peaks = triple(_best(_relevancy(each), sizes) for each, sizes in zip(every, regions.sizes, strict=True))
    best = scale.fit(np.array(peaks))
    chosen = _level(best, kind) if level == "auto" else LEVELS.index(level)
    inside = every[chosen] >= lowest(float(best[chosen]))  # (R,) bool
    values, peak, fits = _relevancy(every[chosen]).astype(np.float32), peaks[chosen], triple(best)
    probability = above = None
    if calibration is None:
        above = excess(fits, bars, kind, level)
        found = above >= 0
    else:  # a part that is asked for alone answers at the finer levels, where fits are others
        odds = calibration.thing if kind == "thing" else calibration.part
        probability = odds.probability(fits)
        # It may be there, but what the wanted level shows is nearer to other phrases.
        found = (level == "auto" or fits[chosen] >= 0) and probability >= odds.found
    solid = np.where(values > np.float32(peak), 0, values)  # what is above the best is a crumb
    place = box = None
    if solid.max(initial=0) > 0:
        place, box = place_of(means[regions.counted(chosen, int(solid.argmax()))])
    return QueryResult(
        phrase=phrase,
        level=chosen,
        scores=peaks,
        relevancy=relevancy,
        even=regions.spread(chosen, values, relevancy[chosen]),
        peak=peak,
        fits=fits,
        probability=probability,
        excess=above,
        found=found,
        members=regions.spread(chosen, inside, np.zeros(relevancy.shape[1], bool)),
        place=place,
        box=box,
    )


# The answer as published, by the peak alone.

SPAN = 0.02  # the least distance between the floor and the peak that is divided


def by_peak(
    phrase: str, relevancy: Array, surface: Surface, scale: Scale, found: float, level: LevelChoice
) -> QueryResult:
    """The answer as published: the level with the highest smoothed peak, cut half way between the floor and
    that peak."""
    smoothed = np.stack([surface.smooth(values) for values in relevancy])
    scores = triple(smoothed.max(1, initial=0))
    chosen = int(np.argmax(scores)) if level == "auto" else LEVELS.index(level)
    peak = scores[chosen]
    place, box = locate(surface, smoothed[chosen], max(FLOOR + 0.5 * (peak - FLOOR), FLOOR))
    return QueryResult(
        phrase=phrase,
        level=chosen,
        scores=scores,
        relevancy=relevancy,
        even=relevancy[chosen],
        peak=peak,
        fits=triple(scale.fit(np.array(scores))),
        probability=None,
        found=peak >= FLOOR and max(scores) >= found,
        members=relevancy[chosen] > FLOOR + 0.5 * max(peak - FLOOR, SPAN),
        place=place,
        box=box,
    )


# Places: the strongest among the Gaussians, and the pixel of the peak in a view.

MIDDLE = 16  # Gaussians around the middle of a region


def place_of(points: Array) -> tuple[Array, Array]:
    """Place (3,), at what is nearest to the middle, and box (2, 3) of a region's (K, 3) points, K >= 1."""
    points = points.astype(np.float64)
    far = ((points - points.mean(0)) ** 2).sum(1)
    near = np.argpartition(far, min(MIDDLE, len(far)) - 1)[:MIDDLE]
    return points[near].mean(0), axis_aligned_box(points)


PLATEAU = 1e-3  # of relevancy: what is this close to the peak is as high


def locate(surface: Surface, smoothed: Array, threshold: float) -> tuple[Array, Array] | tuple[None, None]:
    """Place and box, world units, of the connected part above `threshold` that holds the peak of `smoothed`
    (M,): (3,) around the middle of what is as high as the peak, and (2, 3) lower and upper corner between 2 %
    and 98 % of its Gaussians. None where all is 0."""
    if smoothed.max(initial=0) <= 0:
        return None, None
    peak = int(smoothed.argmax())
    inside = smoothed > threshold
    inside[peak] = True
    members = surface.connected(inside, peak)
    # All of a thing may mean the very same: then its middle is the place, not whichever comes first.
    highest = members[smoothed[members] >= smoothed[peak] - PLATEAU]
    centre = surface.positions[highest].mean(0)
    middle = highest[((surface.positions[highest] - centre) ** 2).sum(1).argmin()]
    near = surface.neighbours[middle]
    weights = surface.weights[near] * smoothed[near]
    position = (surface.positions[near] * weights[:, None]).sum(0) / weights.sum()
    return position, axis_aligned_box(surface.positions[members])


def peak_pixel(relevancy: Array, window: int) -> tuple[int, int, float]:
    """Peak (column, row, value) of a relevancy map (H, W) after a mean filter of `window` px (paper: 20). The
    window never exceeds the image; borders repeat the edge pixels."""
    window = max(1, min(window, *relevancy.shape))
    smooth = uniform_filter(np.asarray(relevancy, np.float64), size=window, mode="nearest")
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    return int(column), int(row), float(smooth[row, column])
