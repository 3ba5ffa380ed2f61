"""Answers to a phrase: regions of a scene's tree by `rule.decide`, or by its peak, as published."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, Literal

import numpy as np
import scipy

import langsplat_core
from langsplat_core.arrays import Array, pieces
from langsplat_core.config import LevelChoice
from langsplat_core.query.instances import axis_aligned_box
from langsplat_core.query.lookup import TOGETHER, Lookup, Relevancy
from langsplat_core.query.rule import RULE, Decision, Judged, RegionTable, Verdict, region_fits, triple
from langsplat_core.scene import LEVELS, Fits, LanguageField, Tree
from langsplat_core.scene.surface import NEIGHBOURS, Surface
from langsplat_core.semantics.relevancy import FLOOR, MIN_HEAT_SPAN, Scale

LIGHT = 40_000  # Gaussians, at most, of a page that shows an answer in a notebook
AnswerRule = Literal["regions", "peak"]  # by `rule.decide`, or as published


class Deferred:
    """A dataclass field: an array, or a function that computes it when the field is first read."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: object | None, owner: type) -> Array:
        if instance is None:
            raise AttributeError(self._name)  # the field has no default
        value = vars(instance)[self._name]
        if callable(value):
            value = vars(instance)[self._name] = value()
        return value

    def __set__(self, instance: object, value: Array | Callable[[], Array]) -> None:
        vars(instance)[self._name] = value


@dataclass(frozen=True, eq=False)
class QueryResult(Judged):
    """The answer to one phrase; its arrays over N Gaussians are computed when they are first read."""

    phrase: str
    level: int  # index into LEVELS
    scores: Fits  # best relevancy per level: of a region, or of a neighbourhood
    peak: float  # score of the chosen level
    fits: Fits  # of the best region, or neighbourhood, of each level, see `Scale.fit`
    judgement: Verdict
    place: Array | None  # (3,) position in scene coordinates, see `Scene.in_world`; None if nothing fits
    box: Array | None  # (2, 3) corners, likewise
    points: Array  # (N, 3) means of the Gaussians
    relevancy: Deferred = Deferred()  # (3, N) float32 in [0, 1] per level and Gaussian
    even: Deferred = Deferred()  # (N,) float32 relevancy at the level, constant over a region
    members: Deferred = Deferred()  # (N,) bool: the Gaussians of the answer
    own_cut: float | None = None  # threshold of relevancy for members that the user set; None: by the rule
    common: float = 0.0  # mean fit of the regions that the verdict is based on
    engine: Any = None  # the QueryEngine, whose scene a notebook shows

    def __repr__(self) -> str:
        known = self.engine is not None and self.place is not None
        near = self.engine.scene.in_world(self.place) if known else self.place
        return f"<{self.phrase!r}: {self.said}, as {LEVELS[self.level]}, near {near}>"

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields for another process: deferred arrays computed, without the engine."""
        return {name: getattr(self, name) for name in vars(self)} | {"engine": None}

    def _repr_html_(self) -> str | None:
        """Return a small page of the scene with this query, for a notebook; None without an engine."""
        if self.engine is None:
            return None
        page = langsplat_core.show(self.engine, self.phrase, at_most=LIGHT, phrases=[self.phrase])
        return page._repr_html_()

    @property
    def cut(self) -> float:
        """The threshold: `own_cut`, else the least relevancy `even` of a member, the peak without members."""
        if self.own_cut is not None:
            return self.own_cut
        return float(self.even[self.members].min(initial=self.peak))

    @property
    def heat_range(self) -> tuple[float, float]:
        """The relevancies at the cold and hot end of a heat map of this answer."""
        high = max(self.peak, float(self.smooth[self.members].max(initial=0)))
        if self.own_cut is not None:
            return min(self.own_cut, self.peak - MIN_HEAT_SPAN), high
        if self.found and self.peak < FLOOR + MIN_HEAT_SPAN:  # found by other means than relevancy
            return self.peak - MIN_HEAT_SPAN, high
        return FLOOR, max(high, FLOOR + MIN_HEAT_SPAN)

    @cached_property
    def smooth(self) -> Array:
        """The (N,) float32 relevancy at the level, that of members averaged over nearby members."""
        values = self.relevancy[self.level].copy()
        values[self.members] = smoothed(self.points[self.members], values[self.members])
        return values


MOST_CELLS = 64  # along a side of the grid that relevancies are smoothed on
SIDE = 5.0  # of that grid, in standard deviations of the points along the widest axis


def smoothed(points: Array, values: Array) -> Array:
    """Return (K,) means of `values` around (K, 3) points, over about as many as a surface has neighbours.

    Values go to the corners of a grid, whose cells grow with the answer, and back; pages do the same.
    """
    if len(points) == 0:
        return values
    places = np.nan_to_num(points.astype(np.float64))
    side = int(np.clip(np.sqrt(len(points) / NEIGHBOURS), 2, MOST_CELLS))
    step = max(SIDE * float(places.std(0).max()) / side, 1e-30)
    at = np.clip((places - places.mean(0)) / step + side / 2, 0, side)
    low = np.minimum(at.astype(np.int64), side - 1)
    corners = []
    for corner in product((0, 1), repeat=3):
        share = np.abs(1 - np.array(corner) - (at - low)).prod(1)
        corners.append((((low + corner) @ ((side + 1) ** np.arange(3))), share))
    sums = np.zeros((2, (side + 1) ** 3))
    for cell, share in corners:
        for row, weights in zip(sums, (share, share * values), strict=True):
            row += np.bincount(cell, weights, len(row))
    weights, totals = (sum(share * row[cell] for cell, share in corners) for row in sums)
    return np.asarray(totals / weights, np.float32)


def recut(result: QueryResult, cut: float) -> QueryResult:
    """Return the answer whose members have an `even` of at least `cut`; the verdict stays."""
    return replace(result, own_cut=cut, members=result.even >= np.float32(cut))


# Regions: the nodes of a scene's tree at each level, as sets of Gaussians.

CHUNK = 16_384  # distinct features read at a time
MIDDLE = 16  # Gaussians around the centre of a region


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of the N Gaussians of a scene; R of them at a level."""

    nodes: tuple[Array, ...]  # (R,) number in the tree of each region of a level, rising
    everywhere: Array  # (3, N) int32 number of the region at each level, from 0; -1: in none
    weights: Array  # (N,) float32 opacity of Gaussians on the surface, else 0, see `surface_weights`
    sizes: tuple[Array, ...]  # (R,) Gaussians with a weight
    totals: tuple[Array, ...]  # (R,) float64 sums of their weights
    table: RegionTable  # of all levels one after the other, as `rule` reads them
    _places: dict[tuple[int, int], tuple[Array, Array]] = field(default_factory=dict)  # cache of `place`

    def means(self, values: Array) -> tuple[Array, ...]:
        """Return the (R,) float64 opacity-weighted means of (3, N) values over the regions of every level."""
        counts = self.counts
        weighted = self.weights[counts] * values[:, counts].astype(np.float64)
        return tuple(
            np.bincount(of, row, len(total)) / total
            for of, row, total in zip(self.everywhere[:, counts], weighted, self.totals, strict=True)
        )

    @cached_property
    def counts(self) -> Array:
        """The (M,) numbers of the Gaussians with a weight: they are in a region at every level."""
        return np.flatnonzero(self.weights > 0)

    def mixtures(self, features: Array, count: int) -> "scipy.sparse.csr_matrix":
        """Return (R, `count`) float64 shares of each of (3, N) features in the regions of all levels."""
        counts, parts = self.counts, []
        weights = self.weights[counts].astype(np.float64)
        for of, own, total in zip(self.everywhere[:, counts], features[:, counts], self.totals, strict=True):
            shape = len(total), count
            if len(total) * count < 8 * len(counts):  # much faster for a small table
                table = np.bincount(of * np.int64(count) + own, weights, len(total) * count).reshape(shape)
                parts.append(scipy.sparse.csr_matrix(table / total[:, None]))
            else:
                parts.append(scipy.sparse.csr_matrix((weights / total[of], (of, own)), shape))
        return scipy.sparse.vstack(parts, format="csr")

    def spread(self, level: int, values: Array, others: Array) -> Array:
        """Return (N,): the (R,) `values` of a level's regions at their Gaussians, else `others` (N,)."""
        of = self.everywhere[level]
        return np.where(of >= 0, np.append(values, others.dtype.type(0))[of], others)

    def mostly(self, members: Array) -> Array:
        """Return (R,) bool of all levels: regions that are by more than half among `members` (N,) bool."""
        return np.concatenate(self.means(np.tile(members, (len(LEVELS), 1)))) > 0.5

    def level_of(self, members: Array) -> int:
        """Return the level of the region most like `members` (N,) bool by IoU, of equal ones the coarsest."""
        best = []
        for of, sizes in zip(self.everywhere, self.sizes, strict=True):
            hits = np.bincount(of[members & (of >= 0) & (self.weights > 0)], minlength=len(sizes))
            best.append((hits / np.maximum(sizes + hits.sum() - hits, 1)).max(initial=0))
        return int(np.flatnonzero(np.array(best) == max(best))[-1])

    def place(self, means: Array, level: int, region: int) -> tuple[Array, Array] | tuple[None, None]:
        """Return position (3,) and box (2, 3) of a region, see `place_of`; region: -1 for none."""
        if region < 0:
            return None, None
        if (level, region) not in self._places:
            members = self.counts[self.everywhere[level, self.counts] == region]
            self._places[level, region] = place_of(means[members])
        return self._places[level, region]


def build_regions(tree: Tree, weights: Array) -> Regions:
    """Return the regions of a scene. weights: (N,) float32, see `surface_weights`."""
    weights = np.where(tree.leaves >= 0, weights, np.float32(0))
    counts = np.flatnonzero(weights > 0)
    nodes, everywhere, members, sizes, totals = [], [], [], [], []
    for level in range(len(LEVELS)):
        at = tree.at(level)
        there, first, row = np.unique(at[counts], return_index=True, return_inverse=True)
        number = np.full(tree.count + 1, -1, np.int32)
        number[there] = np.arange(len(there))
        nodes.append(there)
        everywhere.append(number[at])
        sizes.append(np.bincount(row, minlength=len(there)))
        totals.append(np.bincount(row, weights[counts], minlength=len(there)))
        members.append(counts[first])  # a Gaussian of each region
    subparts, parts, wholes = map(len, nodes)
    above = everywhere[1][members[0]] + subparts, everywhere[2][members[1]] + subparts + parts
    parents = np.concatenate([*above, np.full(wholes, -1)])
    solid = np.concatenate(sizes) >= RULE.smallest
    table = RegionTable(np.array([[subparts, parts, wholes]]), parents, solid)
    return Regions(tuple(nodes), np.stack(everywhere), weights, tuple(sizes), tuple(totals), table)


BORDER = 0.2  # least share of the border of two touching wholes in all borders of either
LARGER = 2.0  # most Gaussians of the first of the two, in those of the second


def touching_wholes(regions: Regions, ends: tuple[Array, Array], rows: Array) -> Array:
    """Return (P, 2) pairs of wholes, of which the first may be a piece of the thing that the second shows.

    ends: of the links of a surface, as numbers on it; rows: its Gaussians.
    """
    count = len(regions.sizes[-1])
    a, b = (regions.everywhere[-1, rows[numbers]] for numbers in ends)
    apart = (a != b) & (a >= 0) & (b >= 0)
    links = scipy.sparse.csr_matrix((np.ones(apart.sum()), (a[apart], b[apart])), (count, count))
    shared = (links + links.T).tocoo()
    borders, sizes = np.bincount(shared.row, shared.data, count), regions.sizes[-1]
    pairs = np.stack([shared.row, shared.col], 1)
    touch = shared.data >= BORDER * borders[pairs].max(1)
    return pairs[touch & (sizes[shared.row] <= LARGER * sizes[shared.col])]


def place_of(points: Array) -> tuple[Array, Array]:
    """Return the mean (3,) of the points nearest to the centre, and box (2, 3) of (K, 3) points, K >= 1."""
    points = points.astype(np.float64)
    far = ((points - points.mean(0)) ** 2).sum(1)
    near = np.argpartition(far, min(MIDDLE, len(far)) - 1)[:MIDDLE]
    return points[near].mean(0), axis_aligned_box(points)


def feature_sums(
    field: LanguageField, level: int, of: Array, weights: Array, count: int, read: Callable[[Array], Array]
) -> Array:
    """Return (count, V) sums over sets `of` (N,), -1: none, of features that `read` maps to (M, V)."""
    rows = np.flatnonzero(field.known[level] & (of >= 0) & (weights > 0))
    latents, kinds = field.codec.unique(field.latents[level, rows])
    shares = scipy.sparse.csr_matrix((weights[rows], (of[rows], kinds)), shape=(count, len(latents))).tocsc()
    parts = pieces(max(len(latents), 1), CHUNK)
    return sum((shares[:, part] @ read(latents[part])).astype(np.float64) for part in parts)


def chance_in(table: RegionTable, mixtures: "scipy.sparse.csr_matrix", lookup: Lookup, scale: Scale) -> Array:
    """Return the (R, V) float32 fits of everyday phrases in the regions of all levels; see `mixtures`."""
    assert scale.everyday is not None
    means = [
        mixtures @ np.stack([one.values for one in lookup.relevancies(scale.everyday[part])], 1)
        for part in pieces(len(scale.everyday), TOGETHER)
    ]
    return region_fits(table, scale.fit(np.concatenate(means, 1)).astype(np.float32))


# The answers.


def by_regions(
    phrase: str, relevancy: Relevancy, decision: Decision, means: Array, regions: Regions
) -> QueryResult:
    """Return the answer that a decision of `rule` stands for. means: (N, 3) of the Gaussians."""
    chosen, values = decision.level, relevancy.values
    place, box = regions.place(means, chosen, decision.best)
    return QueryResult(
        phrase=phrase,
        level=chosen,
        scores=decision.scores,
        relevancy=relevancy,
        even=lambda: regions.spread(chosen, decision.relevancies, values[relevancy.features[chosen]]),
        peak=decision.scores[chosen],
        fits=decision.fits,
        common=decision.common,
        judgement=decision.verdict,
        members=lambda: regions.spread(chosen, decision.inside, np.zeros(len(means), bool)),
        place=place,
        box=box,
        points=means,
    )


SPAN = 0.02  # least distance from floor to peak by which members are cut


def by_peak(
    phrase: str,
    relevancy: Array,
    means: Array,
    surface: Surface,
    scale: Scale,
    found: float,
    level: LevelChoice,
) -> QueryResult:
    """Return the published answer: the level of the highest peak, cut half way to the floor.

    relevancy: (3, N); means: (N, 3) of the Gaussians; found: least peak of what is found.
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
        points=means,
    )


def locate(surface: Surface, smoothed: Array, threshold: float) -> tuple[Array, Array] | tuple[None, None]:
    """Return position (3,) and box (2, 3) of the connected part above `threshold` that holds the peak.

    smoothed: (M,) relevancy of the surface; None if all is 0. The position is the middle of all at the peak.
    """
    if smoothed.max(initial=0) <= 0:
        return None, None
    peak = int(smoothed.argmax())
    inside = smoothed > threshold
    inside[peak] = True
    members = surface.connected(inside, peak)
    highest = members[smoothed[members] >= smoothed[peak] - 1e-3]
    centre = surface.positions[highest].mean(0)
    middle = highest[((surface.positions[highest] - centre) ** 2).sum(1).argmin()]
    near = surface.neighbours[middle]
    weights = surface.weights[near] * smoothed[near]
    position = (surface.positions[near] * weights[:, None]).sum(0) / weights.sum()
    return position, axis_aligned_box(surface.positions[members])
