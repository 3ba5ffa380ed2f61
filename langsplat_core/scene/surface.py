"""The surface of a scene, a neighbour graph of its Gaussians, and its segmentation into the scene's tree.

Connected components are found by an own breadth-first search: an answer has few of all Gaussians, and
extracting their subgraph for `scipy.sparse.csgraph` takes ten times as long.
"""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy

from langsplat_core.arrays import Array, pieces, sigmoid
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.scene.codec import Codec
from langsplat_core.scene.gaussians import Gaussians
from langsplat_core.scene.language import LEVELS, NO_NODE, Tree

NEIGHBOURS = 16
FAINTEST = 1e-3  # least weight of a Gaussian, so that no mean divides by zero
AT_ONCE = 1 << 18  # Gaussians whose distances are held at a time: all of five million take gigabytes
REACH = 4.0  # times the median distance of a Gaussian's neighbours: what is farther is another surface


@dataclass(frozen=True, eq=False, repr=False)
class Surface:
    """Graph of the M visible Gaussians and their k nearest neighbours; close ones have close numbers."""

    rows: Array  # (M,) int64 indices of the Gaussians: valid, and visible to the eye
    positions: Array  # (M, 3) float64 their means, world units
    neighbours: Array  # (M, k) int32 numbers in [0, M), nearest first: each itself
    weights: Array  # (M,) float32 opacity
    links: "scipy.sparse.csr_matrix"  # (M, M) bool adjacency on one surface; symmetric
    anchors: Array  # (N,) int32 number of each Gaussian, or of the nearest to a faint one; -1: none is near

    @cached_property
    def ends(self) -> tuple[Array, Array]:
        """(E,) int32 numbers of the first ends and of the second ends of the links, each link once."""
        links = self.links.tocoo()
        once = links.row < links.col
        return links.row[once].astype(np.int32), links.col[once].astype(np.int32)

    def smooth(self, values: Array, numbers: Array | None = None) -> Array:
        """Return (K,) float32 opacity-weighted means over neighbourhoods of all Gaussians' (N,) values.

        numbers: (K,) Gaussians whose neighbourhoods are averaged, by default all M. This is the paper's mean
        filter of images (section 4.1, "implementation details") in 3D: one stray Gaussian decides nothing.
        """
        chosen = np.arange(len(self.rows)) if numbers is None else numbers
        smoothed = np.empty(len(chosen), np.float32)
        arguments = chosen, self.neighbours, self.rows, self.weights, plain(values), smoothed
        shared_workers().run(_smooth, len(chosen), *arguments)
        return smoothed

    def parts(self, numbers: Array) -> list[Array]:
        """Return the connected components of the Gaussians `numbers` (K,), each in ascending order."""
        inside = np.zeros(len(self.rows), bool)
        inside[numbers] = True
        order, starts = _search(self.links.indptr, self.links.indices, numbers, inside)
        return [np.sort(part) for part in np.split(order, starts)]

    def connected(self, inside: Array, seed: int) -> Array:
        """Return the numbers in the connected component of `seed` among the members `inside` (M,) bool."""
        return _search(self.links.indptr, self.links.indices, np.array([seed]), inside.copy())[0]


def surface_weights(gaussians: Gaussians, min_opacity: float = 0.1) -> Array:
    """Return (N,) float32 opacity of valid Gaussians above `min_opacity`, of all if none is; else 0."""
    valid = gaussians.valid()
    opacity = np.where(valid, sigmoid(gaussians.opacity_logits.astype(np.float64)), 0)
    counts = opacity >= min_opacity
    counts = counts if counts.any() else valid
    return np.where(counts, np.maximum(opacity, FAINTEST), 0).astype(np.float32)


def build_surface(gaussians: Gaussians, min_opacity: float = 0.1) -> Surface:
    """Return the surface of the Gaussians whose `surface_weights` are above 0."""
    valid, every = gaussians.valid(), surface_weights(gaussians, min_opacity)
    rows = np.flatnonzero(every)
    k = min(NEIGHBOURS, len(rows))
    anchors = np.full(len(gaussians), -1, np.int32)
    if k == 0:
        none = np.zeros((0, 1), np.int32)
        no_links = scipy.sparse.csr_matrix((0, 0), dtype=bool)
        return Surface(rows, np.zeros((0, 3)), none, np.zeros(0, np.float32), no_links, anchors)
    # In the order of a k-d tree's leaves: close Gaussians get close numbers.
    rows = rows[scipy.spatial.cKDTree(gaussians.means[rows].astype(np.float64)).indices]
    positions = gaussians.means[rows].astype(np.float64)
    tree = scipy.spatial.cKDTree(positions)
    neighbours, near = np.empty((len(rows), k), np.int32), np.empty((len(rows), k), bool)
    reach, middle = np.empty(len(rows)), slice((k - 1) // 2, k // 2 + 1)
    for part in pieces(len(rows), AT_ONCE):
        distances, found = (of.reshape(-1, k) for of in tree.query(positions[part], k=k, workers=-1))
        neighbours[part] = found
        reach[part] = REACH * distances[:, middle].mean(1) + 1e-12  # the median: distances ascend
        near[part] = distances <= reach[part, None]
    weights = every[rows]
    anchors[rows] = np.arange(len(rows))
    faint = np.flatnonzero(valid & (anchors < 0))
    gap, nearest = tree.query(gaussians.means[faint].astype(np.float64), workers=-1)
    anchors[faint] = np.where(gap <= reach[nearest], nearest, -1)
    return Surface(rows, positions, neighbours, weights, _links(neighbours, near), anchors)


def cross_sections(log_scales: Array, opacity_logits: Array) -> Array:
    """Return (N,) float64 opacity times both longest scales, units^2, which flat Gaussians have too."""
    longest = np.sort(log_scales.astype(np.float64), axis=1)[:, 1:]
    return np.asarray(sigmoid(opacity_logits.astype(np.float64)) * np.exp(longest.sum(1)))


def surface_areas(gaussians: Gaussians) -> Array:
    """Return (N,) float64 `cross_sections`, clipped at the 99 % quantile; 0 for invalid Gaussians."""
    valid = gaussians.valid()
    scales = np.where(valid[:, None], gaussians.log_scales, -np.inf)
    areas = cross_sections(scales, np.where(valid, gaussians.opacity_logits, -np.inf))
    return np.minimum(areas, np.quantile(areas, 0.99)) if len(areas) else areas


def _links(neighbours: Array, near: Array) -> "scipy.sparse.csr_matrix":
    starts = np.zeros(len(neighbours) + 1, np.int32)
    np.cumsum(near.sum(1), out=starts[1:])
    ends = neighbours[near]
    one_way = scipy.sparse.csr_matrix((np.ones(len(ends), bool), ends, starts), shape=2 * (len(neighbours),))
    one_way.sort_indices()
    return (one_way + one_way.T).copy()  # a sum keeps room for twice as much


@partial(kernel, shapes="chosen K, neighbours M k, rows M, weights M, values N, smoothed K")
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
    """Fill elements [first, last) of `smoothed` (K,)."""
    for i in range(first, last):
        value = total = np.float32(0)
        for k in range(neighbours.shape[1]):
            j = neighbours[chosen[i], k]
            value += weights[j] * values[rows[j]]
            total += weights[j]
        smoothed[i] = value / total


@kernel
def _search(indptr: Array, indices: Array, seeds: Array, waiting: Array) -> tuple[Array, Array]:
    """Collect the connected components of `seeds` in `waiting` (M,) bool, breadth first; clear them there.

    Return (K,) int32 numbers, component by component, and the (C - 1,) starts of all but the first.
    """
    order, starts = np.empty(waiting.sum(), np.int32), np.empty(len(seeds), np.int32)
    parts = found = done = 0
    for seed in seeds:
        if not waiting[seed]:
            continue
        starts[parts] = found
        parts += 1
        waiting[seed] = False
        order[found] = seed
        found += 1
        while done < found:
            here = order[done]
            done += 1
            for entry in range(indptr[here], indptr[here + 1]):
                there = indices[entry]
                if waiting[there]:
                    waiting[there] = False
                    order[found] = there
                    found += 1
    return order[:found], starts[1:parts]


# The tree of a scene: patches of similar language features at each level. Wholes are found first, parts
# within each, then subparts within these. An instance by the masks of many photographs stays one whole, since
# the encoder may see its front and its back differently; borders of instances count at all levels.

SCALE = 6.8  # of the merge criterion, in typical steps times Gaussians: larger prefers larger patches
SMALLEST = 10  # Gaussians; smaller patches join the neighbour with the most similar features
BORDER = 0.6  # added to the step between two instances, in typical steps
UNKNOWN = 2.0  # step between a Gaussian with a feature and one without: that between opposite vectors
STEPS = 65_535 / (UNKNOWN + 2 * BORDER)  # distinct ranks per unit of 1 - cosine: 16 bits sort in linear time


def divide(surface: Surface, steps: Array, order: Array, scale: float, smallest: int) -> Array:
    """Return the (M,) int32 number, from 0, of the patch of each Gaussian of a surface.

    Two patches become one where the step between them is no larger than the steps within either (Felzenszwalb
    and Huttenlocher 2004); then those of fewer than `smallest` Gaussians join the neighbour at the least
    step. steps: (E,) of the links `Surface.ends`, >= 0; order: (E,) int32 of the links, by rising step;
    scale: of the criterion, in steps times Gaussians, larger for larger patches.
    """
    roots = merge_patches(len(surface.rows), *surface.ends, steps.astype(np.float32), order, scale, smallest)
    return np.unique(roots, return_inverse=True)[1].astype(np.int32).reshape(-1)


@kernel
def merge_patches(
    count: int, first: Array, second: Array, steps: Array, order: Array, scale: float, smallest: int
) -> Array:
    """Return (M,) int32 root of each Gaussian's patch (union-find), the same for all its members."""
    parent, size = np.arange(count, dtype=np.int32), np.ones(count, np.int32)
    largest = np.zeros(count, np.float32)  # largest step within each patch
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


def build_tree(
    surface: Surface, codec: Codec, latents: Array, known: Array, things: Array | None = None
) -> Tree:
    """Return the tree of (3, N, d) latents, votes 0; things: (3, N) int32 instances by masks, or NO_NODE."""
    above: Array | None = None  # (M,) node of the level above
    of: list[Array] = []
    for level in range(len(LEVELS) - 1, -1, -1):
        own = latents[level, surface.rows], known[level, surface.rows]
        told = np.full(len(surface.rows), NO_NODE) if things is None else things[level, surface.rows]
        above = _divided(surface, codec, *own, above, told)
        of.insert(0, above)
    counts = [int(row.max(initial=-1)) + 1 for row in of]
    firsts = np.cumsum([0, *counts])
    parents = np.full(firsts[-1], NO_NODE, np.int32)
    for level in range(len(LEVELS) - 1):
        parents[firsts[level] + of[level]] = firsts[level + 1] + of[level + 1]
    leaves = np.append(of[0], np.int32(NO_NODE))[surface.anchors]  # an anchor of -1 is none
    levels = np.repeat(np.arange(len(LEVELS), dtype=np.uint8), counts)
    return Tree(leaves, parents, levels, np.zeros((len(levels), 2), np.uint16))


def _divided(
    surface: Surface, codec: Codec, latents: Array, known: Array, above: Array | None, things: Array
) -> Array:
    """Return (M,) int32 number, from 0, of each Gaussian's patch at a level, within patches `above` (M,)."""
    a, b = surface.ends
    # 1 - cosine between the features at the two ends of each link.
    both, neither = known[a] & known[b], ~known[a] & ~known[b]
    steps = np.where(both, codec.distances(latents, a, b), np.where(neither, 0.0, UNKNOWN)).clip(0, UNKNOWN)
    # Mean step between two random Gaussians: what is far in this encoder's space.
    typical = codec.spread(latents[known]) if known.any() else 1.0
    told = (things[a] != NO_NODE) & (things[b] != NO_NODE)
    within = 0 if above is None else steps  # a thing is one whole
    steps = np.where(told, np.where(things[a] == things[b], within, steps + BORDER * typical), steps)
    ranks = np.round(steps * STEPS).astype(np.uint16)
    order = np.argsort(ranks, kind="stable").astype(np.int32)
    if above is not None:
        order = order[above[a[order]] == above[b[order]]]
    return divide(surface, steps, order, SCALE * typical, SMALLEST)
