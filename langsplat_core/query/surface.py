"""The surface that Gaussians lie on, as the nearest neighbours of each: to smooth over it, to walk along it,
and to divide it into regions that mean the same."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.scene import LEVELS, NO_THING, Codec, Gaussians, LanguageField

NEIGHBOURS = 16
FAINTEST = 1e-3  # weight of a Gaussian whose opacity is less, so that no mean divides by nothing
REACH = 4.0  # times the median distance of a Gaussian's neighbours: what is farther is another surface

_OUTSIDE, _WAITING = -1, -2  # labels that are no part


@dataclass(frozen=True, eq=False)
class Parts:
    """The C connected parts of some members of a surface, with the members part by part."""

    order: Array  # (K,) int32 numbers on the surface
    starts: Array  # (C,) int32 where each part begins in `order`
    labels: Array  # (M,) int32 part of every Gaussian of the surface; -1 for those that are no members

    def each(self) -> list[Array]:
        """The numbers of every part, ascending."""
        return [np.sort(part) for part in np.split(self.order, self.starts[1:])] if len(self.starts) else []


@dataclass(frozen=True, eq=False)
class Surface:
    """The M Gaussians that count, each with its k nearest, itself first; near ones have near numbers."""

    rows: Array  # (M,) int64 indices of the Gaussians: valid, and visible to the eye
    positions: Array  # (M, 3) float64 their means, world units
    neighbours: Array  # (M, k) int32 numbers in [0, M)
    weights: Array  # (M,) float32 opacity
    links: csr_matrix  # (M, M) who is next to whom on one surface; symmetric
    anchors: Array  # (N,) int32 number of every Gaussian, if it is too faint of the nearest; -1: none is near

    def smooth(self, values: Array, numbers: Array | None = None) -> Array:
        """(N,) float32 values of all Gaussians -> (K,) float32 opacity-weighted means over the neighbourhoods
        of `numbers` (K,), by default of all M.

        The 3D counterpart of the mean filter that the paper applies to a relevancy map before it takes the
        peak (section 4.1, "implementation details"): one stray Gaussian decides nothing.
        """
        chosen = np.arange(len(self.rows)) if numbers is None else numbers
        smoothed = np.empty(len(chosen), np.float32)
        arguments = chosen, self.neighbours, self.rows, self.weights, plain(values), smoothed
        shared_workers().run(_smooth, len(chosen), *arguments)
        return smoothed

    def parts(self, numbers: Array) -> Parts:
        """The connected parts of the Gaussians `numbers` (K,), in [0, M), each once."""
        labels = np.full(len(self.rows), _OUTSIDE, np.int32)
        labels[numbers] = _WAITING
        order, starts = np.empty(len(numbers), np.int32), np.empty(len(numbers), np.int32)
        count, _ = _label(self.links.indptr, self.links.indices, numbers, labels, order, starts)
        return Parts(order, starts[:count].copy(), labels)

    def connected(self, inside: Array, seed: int) -> Array:
        """(M,) bool, and a member of it -> numbers of all that are linked to that member through members."""
        labels = np.where(inside, np.int32(_WAITING), np.int32(_OUTSIDE))
        order, starts = np.empty(int(inside.sum()), np.int32), np.empty(1, np.int32)
        _, count = _label(self.links.indptr, self.links.indices, np.array([seed]), labels, order, starts)
        return order[:count]


def build_surface(gaussians: Gaussians, min_opacity: float = 0.1) -> Surface:
    """Surface of all valid Gaussians with at least `min_opacity` (of all valid ones if none has)."""
    valid = gaussians.valid()
    opacity = np.where(valid, sigmoid(gaussians.opacity_logits.astype(np.float64)), 0)
    rows = np.flatnonzero(opacity >= min_opacity)
    if len(rows) == 0:
        rows = np.flatnonzero(valid)
    k = min(NEIGHBOURS, len(rows))
    if k == 0:
        nothing = np.zeros((0, 1), np.int32), np.zeros(0, np.float32), csr_matrix((0, 0), dtype=bool)
        return Surface(rows, np.zeros((0, 3)), *nothing, np.full(len(gaussians), -1, np.int32))
    rows = rows[cKDTree(gaussians.means[rows].astype(np.float64)).indices]  # leaf by leaf: near ones meet
    positions = gaussians.means[rows].astype(np.float64)
    tree = cKDTree(positions)
    distances, neighbours = tree.query(positions, k=k, workers=-1)
    shape = (len(rows), k)
    distances, neighbours = distances.reshape(shape), neighbours.reshape(shape).astype(np.int32)
    weights = np.maximum(opacity[rows], FAINTEST).astype(np.float32)
    reach = REACH * np.median(distances, axis=1) + 1e-12
    anchors = np.full(len(gaussians), -1, np.int32)
    anchors[rows] = np.arange(len(rows))
    faint = np.flatnonzero(valid & (anchors < 0))
    gap, nearest = tree.query(gaussians.means[faint].astype(np.float64), workers=-1)
    anchors[faint] = np.where(gap <= reach[nearest], nearest, -1)
    return Surface(rows, positions, neighbours, weights, _links(neighbours, distances, reach), anchors)


def surface_areas(gaussians: Gaussians) -> Array:
    """(N,) float64 area that each Gaussian covers, world units squared: opacity times its two longest axes
    (one standard deviation each), 0 for invalid rows. What is larger than 99 % of them counts as that: a
    veil of a few huge Gaussians is no surface."""
    valid = gaussians.valid()
    scales = np.sort(np.where(valid[:, None], gaussians.log_scales, -np.inf).astype(np.float64), axis=1)
    opacity = sigmoid(np.where(valid, gaussians.opacity_logits, -np.inf).astype(np.float64))
    areas = opacity * np.exp(scales[:, 1:].sum(1))
    return np.minimum(areas, np.quantile(areas, 0.99)) if len(areas) else areas


def _links(neighbours: Array, distances: Array, reach: Array) -> csr_matrix:
    near = distances <= reach[:, None]
    count = len(neighbours)
    source = np.repeat(np.arange(count, dtype=np.int32), near.sum(1))
    one_way = csr_matrix((np.ones(len(source), bool), (source, neighbours[near])), shape=(count, count))
    return (one_way + one_way.T).tocsr()


@kernel
def _smooth(
    first: int,
    last: int,
    chosen: Array,
    neighbours: Array,
    rows: Array,
    weights: Array,
    values: Array,
    smoothed: Array,
) -> None:
    """Elements [first, last) of `smoothed` (K,)."""
    for i in range(first, last):
        value = total = np.float32(0)
        for k in range(neighbours.shape[1]):
            j = neighbours[chosen[i], k]
            value += weights[j] * values[rows[j]]
            total += weights[j]
        smoothed[i] = value / total


@kernel
def _label(
    indptr: Array, indices: Array, seeds: Array, labels: Array, order: Array, starts: Array
) -> tuple[int, int]:
    """Number the parts that `seeds` are in, breadth first over what is `_WAITING` in `labels`; how many parts
    there are, and Gaussians in them."""
    parts = found = done = 0
    for seed in seeds:
        if labels[seed] != _WAITING:
            continue
        starts[parts] = found
        labels[seed] = parts
        order[found] = seed
        found += 1
        while done < found:
            here = order[done]
            done += 1
            for entry in range(indptr[here], indptr[here + 1]):
                there = indices[entry]
                if labels[there] == _WAITING:
                    labels[there] = parts
                    order[found] = there
                    found += 1
        parts += 1
    return parts, found


# Regions: patches of the surface that mean the same, at each level.
#
# Gaussians vary, things do not: an answer made of whole regions has the borders of the things and no
# speckles, and its peak is a mean over a patch instead of one lucky Gaussian. Regions are found once for a
# scene, on the graph of neighbours along its surface, by the criterion of Felzenszwalb and Huttenlocher
# (2004): two patches merge where the step between their meanings is no larger than the steps within either.
# Where a scene knows which thing a Gaussian belongs to (`LanguageField.things`), these are the borders of
# the coarsest level: the encoder may see the front and the back of a thing differently, and it stays one.

SCALE = 6.8  # of the criterion, in typical steps times Gaussians: larger prefers larger regions
SMALLEST = 10  # Gaussians; smaller patches join the neighbour that means the most similar
BORDER = 0.6  # added to the step between two things, in typical steps
UNKNOWN = 2.0  # step between a Gaussian with a meaning and one without: as much as between opposites
PIECES = 4  # that a level is summed in, so that more than three cores have work
STEPS = 65_535 / (UNKNOWN + 2 * BORDER)  # of 1 - cosine that are told apart: 16 bits sort in linear time


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of the M Gaussians of a surface, and of the N of its scene."""

    of: Array  # (3, M) int32 number of the region at each level, from 0
    sizes: tuple[Array, ...]  # (R,) Gaussians in each region of a level
    everywhere: Array  # (3, N) int32 the same of all Gaussians, faint ones with the nearest; -1: none is near
    weights: Array  # (N,) float32 opacity of the surface's Gaussians, 0 for all others
    totals: tuple[Array, ...]  # (R,) float64 sums of these weights

    def means(self, values: Array) -> tuple[Array, ...]:
        """(3, N) values of all Gaussians -> of every level the (R,) float64 opacity-weighted means.

        In the order of the Gaussians and not of the surface: memory is read from front to back.
        """
        longest = max(len(total) for total in self.totals)
        sums = np.zeros((len(LEVELS) * PIECES, longest))
        workers = shared_workers()
        workers.run(_sum_pieces, len(sums), plain(values), self.everywhere, self.weights, sums)
        levels = sums.reshape(len(LEVELS), PIECES, longest).sum(1)
        return tuple(row[: len(total)] / total for row, total in zip(levels, self.totals, strict=True))

    def spread(self, level: int, values: Array, others: Array) -> Array:
        """(R,) values of a level's regions -> (N,) of all Gaussians: of a faint one what is next to it, and
        where nothing is, its own of `others` (N,) of the same type."""
        spread = np.empty_like(others)
        shared_workers().run(_spread, len(others), self.everywhere[level], values, others, spread)
        return spread

    def even(self, values: Array) -> Array:
        """(3, N) float32 values -> the same, of every region its mean; of what is off the surface its own."""
        own = plain(values)
        means = [row.astype(np.float32) for row in self.means(own)]
        return np.stack([self.spread(level, row, own[level]) for level, row in enumerate(means)])


def build_regions(surface: Surface, field: LanguageField) -> Regions:
    """Regions of a scene's surface, by what its field means there; once for a scene."""
    links = surface.links.tocoo()
    once = links.row < links.col
    ends = links.row[once].astype(np.int32), links.col[once].astype(np.int32)
    of = []
    for level, known in enumerate(field.known[:, surface.rows]):
        latents = field.latents[level, surface.rows]
        steps = _steps(field.codec, latents, known, ends)
        # Between two Gaussians drawn by chance, on average: what is far in this encoder's space.
        typical = field.codec.spread(latents[known]) if known.any() else 1.0
        if level == len(LEVELS) - 1 and field.things is not None:
            steps = _along_things(steps, field.things[surface.rows], ends, BORDER * typical)
        ranks = np.round(steps * STEPS).astype(np.uint16)
        order = np.argsort(ranks, kind="stable").astype(np.int32)
        roots = _merge(len(surface.rows), *ends, steps.astype(np.float32), order, SCALE * typical, SMALLEST)
        of.append(np.unique(roots, return_inverse=True)[1].astype(np.int32).reshape(-1))
    return regions_from(surface, np.stack(of))


def regions_from(surface: Surface, of: Array) -> Regions:
    """Regions by the (3, M) int32 number of each Gaussian's region at each level, counted from 0."""
    everywhere = np.full((len(LEVELS), len(surface.anchors)), -1, np.int32)
    near = surface.anchors >= 0
    everywhere[:, near] = of[:, surface.anchors[near]]
    weights = np.zeros(len(surface.anchors), np.float32)
    weights[surface.rows] = surface.weights
    totals = tuple(np.bincount(row, surface.weights) for row in of)
    return Regions(of, tuple(map(np.bincount, of)), everywhere, weights, totals)


def _steps(codec: Codec, latents: Array, known: Array, ends: tuple[Array, Array]) -> Array:
    """(E,) 1 - cosine between what the two ends of each link mean, in [0, 2]."""
    a, b = ends
    steps = codec.distances(latents, a, b)
    both, neither = known[a] & known[b], ~known[a] & ~known[b]
    return np.asarray(np.where(both, steps, np.where(neither, 0.0, UNKNOWN)).clip(0, UNKNOWN))


def _along_things(steps: Array, things: Array, ends: tuple[Array, Array], border: float) -> Array:
    """No step within a thing, a larger one between two."""
    a, b = things[ends[0]], things[ends[1]]
    told = (a != NO_THING) & (b != NO_THING)
    return np.where(told, np.where(a == b, 0, steps + border), steps)


@kernel
def _merge(
    count: int, first: Array, second: Array, steps: Array, order: Array, scale: float, smallest: int
) -> Array:
    """(M,) a member of each Gaussian's region, the same for all of a region. order: of the links, by rising
    step."""
    parent, size = np.arange(count, dtype=np.int32), np.ones(count, np.int32)
    largest = np.zeros(count, np.float32)  # step within each region
    for gathering in range(2):  # the criterion, then the small ones
        for link in order:
            a, b = first[link], second[link]
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            if a == b:
                continue
            if gathering == 0:
                join = steps[link] <= min(largest[a] + scale / size[a], largest[b] + scale / size[b])
            else:
                join = size[a] < smallest or size[b] < smallest
            if join:
                parent[b] = a
                size[a] += size[b]
                largest[a] = max(steps[link], largest[a], largest[b])
    for item in range(count):
        root = item
        while parent[root] != root:
            root = parent[root]
        parent[item] = root
    return parent


@kernel
def _sum_pieces(first: int, last: int, values: Array, everywhere: Array, weights: Array, sums: Array) -> None:
    """Rows [first, last) of `sums` (3 P, R): of a level's P pieces the weighted sums over its regions."""
    count, pieces = len(weights), len(sums) // len(values)
    for row in range(first, last):
        level, piece = row // pieces, row % pieces
        for i in range(count * piece // pieces, count * (piece + 1) // pieces):
            if weights[i] > 0:
                sums[row, everywhere[level, i]] += np.float64(weights[i]) * values[level, i]


@kernel
def _spread(first: int, last: int, of: Array, values: Array, others: Array, spread: Array) -> None:
    """Rows [first, last) of `spread` (N,)."""
    for i in range(first, last):
        region = of[i]
        spread[i] = values[region] if region >= 0 else others[i]
