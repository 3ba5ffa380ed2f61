"""A tree of things from masks that disagree: parts in things in groups, by the consensus of all views.

The surface of a scene is divided into small patches, and then the two neighbours merge between which least
stands, until no two are neighbours (average linkage). What stands between two neighbours x and y is

    cost(x, y) = [ SEEN (1 - agreement) + SEEN border + BENT concavity + |difference of chromaticity| ] s

    agreement     chance that a pixel of x and one of y lie in one mask, mean over views and levels, each
                  weighted by the smaller one's pixels there
    border        share of views and levels in which the two ends of a link across lie in two masks, mean over
                  the links between x and y
    concavity     how much the surface bends towards itself along these links: things meet where it does
    s             (smaller one's share of the area / PLAIN) ^ SMALL: crumbs join early

A mask of one photograph may be wrong; few are wrong in the same way from all sides. No mask's vector is read,
and masks of any source do. The tree is known from affinity trees of masks (THGS 2025, PairGS 2026); they need
a trained segmenter, this one does without: `--masks.source graph`.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel, shared_workers
from langsplat_core.io.shapes import base_colours
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS, Gaussians
from langsplat_core.scene.surface import Surface, divide, surface_areas
from langsplat_core.training.language.mask_weights import MaskWeights

SEEN, BENT, COLOUR = 0.5, 0.3, 1.0  # weights of the cost's terms
UNSEEN = 0.5  # disagreement of what no view shows together
STEP_BENT = 0.1  # weight of concavity in the step between two Gaussians
SCALE, SMALLEST = 0.6, 10  # of the division into patches, see `surface.divide`
PLAIN, SMALL = 1 / 200, 0.1  # share of the area that merges at its plain cost, and the power of the others
ENOUGH = 4.0  # pixels of a Gaussian in a mask from which it counts no more
STAGE = "merging what masks agree on"


@dataclass(frozen=True, eq=False)
class MergeTree:
    """A binary tree over P patches of a surface: nodes 0 to P - 1 are the patches, later ones merge two."""

    patches: Array  # (N,) int32 patch of every Gaussian; -1 for those on no surface
    children: Array  # (K, 2) int32 nodes that node P + k is made of, each made before
    costs: Array  # (K,) float64 what stood between these

    @property
    def count(self) -> int:
        """Count P of the patches: a forest of one tree a connected surface has P - K roots."""
        return int(self.patches.max(initial=-1)) + 1

    def cut(self, cost: float) -> Array:
        """Return the (P,) int32 number, from 0, of the largest node around each patch up to a cost.

        Nothing within the node costs more than `cost`.
        """
        total = self.count + len(self.children)
        highest, owner = np.zeros(total), np.arange(total)
        for node, (children, own) in enumerate(zip(self.children, self.costs, strict=True), self.count):
            highest[node] = max(own, *highest[children])
        for node in range(total - 1, self.count - 1, -1):
            if highest[node] <= cost:
                owner[self.children[node - self.count]] = owner[node]
        return np.unique(owner[: self.count], return_inverse=True)[1].astype(np.int32).reshape(-1)


@dataclass(frozen=True, eq=False)
class Borders:
    """Two neighbouring patches a row, first < second, with sums over the L links between them."""

    first: Array  # (B,) int32
    second: Array  # (B,) int32
    links: Array  # (B,) float64 count
    disagreement: Array  # (B,) float64 sum
    concavity: Array  # (B,) float64 sum


@dataclass(frozen=True, eq=False)
class Patches:
    """The masks, colours, areas and borders of P patches, from which they are merged."""

    masses: sparse.csr_matrix  # (P, masks of all views) float32 pixels, columns sorted
    labelling: Array  # (masks of all views,) int32 view and level of each mask, counted through
    colours: Array  # (P, 3) mean chromaticity
    areas: Array  # (P,) > 0
    borders: Borders


def find_tree(
    gaussians: Gaussians,
    surface: Surface,
    mask_weights: MaskWeights,
    counts: Sequence[int],
    eyes: Array,
    progress: Progress = silent,
) -> MergeTree:
    """Return the tree of a scene.

    counts: number of masks of each view; eyes: (V, 3) positions of the cameras.
    """
    everywhere = np.full(len(gaussians), -1, np.int32)
    if len(surface.rows) == 0:
        return MergeTree(everywhere, np.zeros((0, 2), np.int32), np.zeros(0))
    disagreement = link_disagreement(surface, mask_weights, progress)
    concavity = link_concavity(surface, eyes)
    colours = base_colours(gaussians)[surface.rows].astype(np.float64).clip(0.02, 1)  # black has none
    colours /= colours.sum(1, keepdims=True)  # chromaticity
    a, b = surface.ends
    steps = disagreement + STEP_BENT * concavity + COLOUR * np.linalg.norm(colours[a] - colours[b], axis=1)
    of = divide(surface, steps, np.argsort(steps, kind="stable").astype(np.int32), SCALE, SMALLEST)
    everywhere[surface.rows] = of
    sizes = np.bincount(of)
    patches = Patches(
        *mask_weights.sums(everywhere, len(sizes), counts),
        np.stack([np.bincount(of, channel) / sizes for channel in colours.T], 1),
        np.maximum(np.bincount(of, surface_areas(gaussians)[surface.rows]), 1e-30),
        find_borders(of, surface.ends, disagreement, concavity),
    )
    children, costs = merge(patches, progress)
    near = surface.anchors >= 0
    everywhere[near] = of[surface.anchors[near]]
    return MergeTree(everywhere, children, costs)


# What stands between two linked Gaussians.


def link_disagreement(surface: Surface, mask_weights: MaskWeights, progress: Progress = silent) -> Array:
    """Return the (E,) share of views and levels in which the ends of each link lie in two masks.

    In [0, 1], of those where both lie in one, weighted by the pixels of the fainter end, at most `ENOUGH`.
    """
    first, second = surface.ends
    apart, seen = np.zeros(len(first), np.float32), np.zeros(len(first), np.float32)
    number = np.full(mask_weights.count, -1, np.int32)
    number[surface.rows] = np.arange(len(surface.rows))
    for done, pairs in enumerate(mask_weights.pairs, 1):
        pairs = pairs[number[pairs["row"]] >= 0]
        place = pairs["level"].astype(np.int64) * len(surface.rows) + number[pairs["row"]]
        weight = np.ascontiguousarray(pairs["weight"])
        most = np.zeros(len(LEVELS) * len(surface.rows), np.float32)
        np.maximum.at(most, place, weight)
        # The mask that each Gaussian paints most of at each level; of equal ones the first, written last.
        mask = np.full(len(most), -1, np.int32)
        heaviest = np.flatnonzero(weight == most[place])[::-1]
        mask[place[heaviest]] = pairs["mask"][heaviest]
        levels = (one.reshape(len(LEVELS), -1) for one in (mask, most))
        shared_workers().run(_compare, len(first), first, second, *levels, apart, seen)
        progress(STAGE, 0.8 * done / len(mask_weights.pairs))
    return np.where(seen > 0, apart / np.maximum(seen, 1e-9), UNSEEN).astype(np.float64)


@kernel
def _compare(
    start: int,
    stop: int,
    first: Array,
    second: Array,
    masks: Array,
    weights: Array,
    apart: Array,
    seen: Array,
) -> None:
    """Add a view's levels to links [start, stop): (3, M) mask and weight of each Gaussian."""
    for link in range(start, stop):
        a, b = first[link], second[link]
        for level in range(masks.shape[0]):
            if masks[level, a] >= 0 and masks[level, b] >= 0:
                weight = min(weights[level, a], weights[level, b], np.float32(ENOUGH))
                seen[link] += weight
                if masks[level, a] != masks[level, b]:
                    apart[link] += weight


def link_concavity(surface: Surface, eyes: Array) -> Array:
    """Return how far the normals at the ends of each link lean towards each other, (E,) in [0, 1].

    0 where the surface is flat or bends away. eyes: (V, 3) of the cameras, which tell outside from inside.
    """
    normals = _normals(surface)
    away = surface.positions - eyes[cKDTree(eyes).query(surface.positions)[1]]
    normals[(normals * away).sum(1) > 0] *= -1
    a, b = surface.ends
    along = surface.positions[b] - surface.positions[a]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return np.asarray((((normals[a] - normals[b]) * along).sum(1) / 2).clip(0, 1))


def _normals(surface: Surface) -> Array:
    """(M, 3) unit normals of the planes through the neighbourhoods, of either sign."""
    normals = np.empty((len(surface.rows), 3))
    for start in range(0, len(normals), 65_536):
        near = surface.neighbours[start : start + 65_536]
        weights = surface.weights[near].astype(np.float64)[..., None]
        points = surface.positions[near]
        middles = (points * weights).sum(1, keepdims=True) / weights.sum(1, keepdims=True)
        spread = (points - middles) * np.sqrt(weights)
        normals[start : start + 65_536] = np.linalg.eigh(spread.swapaxes(1, 2) @ spread)[1][..., 0]
    return normals


# Patches, and their merging.


def find_borders(of: Array, ends: tuple[Array, Array], disagreement: Array, concavity: Array) -> Borders:
    """Return the borders of patches.

    of: (M,) patch of each end; ends, disagreement, concavity: (E,) of each link.
    """
    a, b = of[ends[0]].astype(np.int64), of[ends[1]].astype(np.int64)
    between, size = a != b, int(of.max(initial=-1)) + 1
    keys = np.minimum(a, b)[between] * size + np.maximum(a, b)[between]
    found, row = np.unique(keys, return_inverse=True)
    sums = [np.bincount(row, values[between], len(found)) for values in (disagreement, concavity)]
    first, second = (found // max(size, 1)).astype(np.int32), (found % max(size, 1)).astype(np.int32)
    return Borders(first, second, np.bincount(row, minlength=len(found)).astype(np.float64), *sums)


class _Merger:
    """The nodes that are not merged yet, with their sums and neighbours."""

    def __init__(self, patches: Patches) -> None:
        count, masses = len(patches.areas), patches.masses
        most = max(2 * count - 1, 0)
        self._labelling = patches.labelling
        spare, ends = most - count, masses.indptr[1:-1]
        self._columns = [*np.split(masses.indices, ends), *[np.zeros(0, np.int32)] * spare]
        self._values = [*np.split(masses.data, ends), *[np.zeros(0, np.float32)] * spare]
        self._pixels = np.zeros((most, int(patches.labelling.max(initial=-1)) + 1), np.float32)
        entries = sparse.csr_matrix((masses.data, patches.labelling[masses.indices], masses.indptr),
            shape=(count, self._pixels.shape[1]))  # fmt: skip
        self._pixels[:count] = entries.toarray()
        self._areas = np.concatenate([patches.areas, np.zeros(spare)])
        self._colours = np.zeros((most, 3))
        self._colours[:count] = patches.colours * patches.areas[:, None]
        self._plain = PLAIN * float(patches.areas.sum())
        self.neighbours: list[dict[int, Array]] = [{} for _ in range(most)]
        borders = patches.borders
        sums = np.stack([borders.links, borders.disagreement, borders.concavity], 1)
        for a, b, own in zip(borders.first.tolist(), borders.second.tolist(), sums, strict=True):
            self.neighbours[a][b] = self.neighbours[b][a] = own

    def cost(self, a: int, b: int) -> float:
        links, disagreement, concavity = self.neighbours[a][b]
        agreement = _agreement(
            *(self._columns[a], self._values[a], self._columns[b], self._values[b]),
            *(self._labelling, self._pixels[a], self._pixels[b]),
        )
        colours = self._colours[a] / self._areas[a] - self._colours[b] / self._areas[b]
        between = SEEN * (1 - agreement) + (SEEN * disagreement + BENT * concavity) / links
        between += COLOUR * float(np.sqrt(colours @ colours))
        return float(between * (min(self._areas[a], self._areas[b]) / self._plain) ** SMALL)

    def join(self, a: int, b: int, new: int) -> None:
        """Merge the nodes a and b into node `new`."""
        columns = np.concatenate([self._columns[a], self._columns[b]])
        self._columns[new], place = np.unique(columns, return_inverse=True)
        values = np.concatenate([self._values[a], self._values[b]])
        self._values[new] = np.bincount(place, values).astype(np.float32)
        for sums in (self._pixels, self._areas, self._colours):
            sums[new] = sums[a] + sums[b]
        for old in (a, b):
            self._columns[old] = self._values[old] = self._columns[old][:0]
            for other, own in self.neighbours[old].items():
                del self.neighbours[other][old]
                if other not in (a, b):
                    joined = own + self.neighbours[new].get(other, 0)
                    self.neighbours[new][other] = self.neighbours[other][new] = joined
            self.neighbours[old] = {}


def merge(patches: Patches, progress: Progress = silent) -> tuple[Array, Array]:
    """Return the (K, 2) int32 nodes that are merged and the (K,) float64 costs, in their order.

    See `MergeTree`. Of equal costs the older nodes merge first.
    """
    nodes, count = _Merger(patches), len(patches.areas)
    waiting = [(nodes.cost(a, b), a, b) for a in range(count) for b in nodes.neighbours[a] if a < b]
    heapq.heapify(waiting)
    children: list[tuple[int, int]] = []
    costs: list[float] = []
    while waiting:
        cost, a, b = heapq.heappop(waiting)
        if b not in nodes.neighbours[a]:  # one of them is part of another node by now
            continue
        new = count + len(children)
        nodes.join(a, b, new)
        children.append((a, b))
        costs.append(cost)
        for other in nodes.neighbours[new]:
            heapq.heappush(waiting, (nodes.cost(other, new), other, new))
        progress(STAGE, 0.8 + 0.2 * len(children) / count)
    return np.array(children, np.int32).reshape(-1, 2), np.array(costs, np.float64)


@kernel
def _agreement(
    columns_a: Array,
    values_a: Array,
    columns_b: Array,
    values_b: Array,
    labelling: Array,
    pixels_a: Array,
    pixels_b: Array,
) -> float:
    """Chance that a pixel of a and one of b lie in one mask; `1 - UNSEEN` where no labelling has both."""
    seen = agreed = 0.0
    for k in range(len(pixels_a)):
        seen += min(pixels_a[k], pixels_b[k])
    if seen <= 0:
        return 1.0 - UNSEEN
    i = j = 0
    while i < len(columns_a) and j < len(columns_b):
        if columns_a[i] < columns_b[j]:
            i += 1
        elif columns_a[i] > columns_b[j]:
            j += 1
        else:
            k = labelling[columns_a[i]]
            agreed += values_a[i] * values_b[j] / max(pixels_a[k], pixels_b[k])
            i += 1
            j += 1
    return agreed / seen
