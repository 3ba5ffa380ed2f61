"""Mask weights, how much of every mask each Gaussian paints; groups of masks; and 3D instances from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import LEVELS, NO_NODE, Camera, Gaussians
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language.kmeans import nearest_centres, spherical_kmeans

# Groups of masks that say the same: one vector for hundreds of crops of one thing.
#
# A Gaussian is seen by a hundred masks in a hundred photographs, and most say one of a few things; grouped
# first, its median is taken over a few vectors instead.

GROUPS = 2_048
ROUNDS = 6
SAMPLE = 16_384  # masks that the groups are found with


@dataclass(frozen=True, eq=False)
class MaskGroups:
    """The group, of G, of every mask of every view."""

    of_mask: tuple[Array, ...]  # of each view, (M,) int32
    vectors: Array  # (G, D) float32 unit vectors


def group_masks(vectors: Sequence[Array], groups: int = GROUPS) -> MaskGroups:
    """vectors: of each view, (M, D) float32 unit CLIP vectors. At most `groups` groups; where there are not
    more masks than that, each is its own."""
    counts = [len(view) for view in vectors]
    joined = np.concatenate(vectors)
    if len(joined) <= groups:
        return MaskGroups(_per_view(np.arange(len(joined)), counts), joined)
    generator = np.random.default_rng(0)
    sample = joined[np.sort(generator.permutation(len(joined))[:SAMPLE])]
    centres = spherical_kmeans(sample, groups, ROUNDS, generator=generator)
    return MaskGroups(_per_view(nearest_centres(joined, centres)[0], counts), centres)


def _per_view(groups: Array, counts: list[int]) -> tuple[Array, ...]:
    return tuple(np.split(groups.astype(np.int32), np.cumsum(counts)[:-1]))


# Mask weights: how much of every mask in every photograph each Gaussian paints, ``W^T onehot(mask)``.
#
# Targets are constant on masks, so this sparse matrix carries vectors of any length from photographs onto
# Gaussians. It is kept view by view, as pairs sorted by Gaussian, in memory or in files, and read block by
# block: what is held at a time does not grow with the number of photographs.

MIN_WEIGHT = 1e-3  # a Gaussian's weight in a mask, in pixels, below which the pair is not stored
BLOCK = 16_384  # Gaussians handled at a time
PAIR = np.dtype([("row", "<u4"), ("mask", "<u2"), ("level", "<u2"), ("weight", "<f4")])


@dataclass(frozen=True, eq=False)
class MaskWeights:
    """Mask weights of `count` Gaussians in all views, W^T onehot(mask), sparse."""

    pairs: Sequence[Array]  # of each view, of type PAIR, by rising row: Gaussian, mask, its level, pixels
    count: int

    @property
    def blocks(self) -> list[tuple[int, int]]:
        """First Gaussian, and the one after the last, of every block."""
        return [(first, min(first + BLOCK, self.count)) for first in range(0, self.count, BLOCK)]

    @cached_property
    def _edges(self) -> list[Array]:
        """Places in each view's pairs at which blocks begin, and the last one ends."""
        firsts = np.arange(0, self.count + BLOCK, BLOCK)
        return [np.searchsorted(view["row"], firsts) for view in self.pairs]

    def block(self, number: int, groups: MaskGroups) -> sparse.csr_matrix:
        """(n, 3 G) float32 weights, in pixels, of the Gaussians of a block in the G groups at each level."""
        first, last = self.blocks[number]
        rows, columns, weights = [], [], []
        for pairs, edges, group in zip(self.pairs, self._edges, groups.of_mask, strict=True):
            part = pairs[edges[number] : edges[number + 1]]
            rows.append(part["row"].astype(np.int32) - first)
            columns.append(part["level"].astype(np.int32) * len(groups.vectors) + group[part["mask"]])
            weights.append(part["weight"])
        shape = (last - first, len(LEVELS) * len(groups.vectors))
        if not rows:
            return sparse.csr_matrix(shape, dtype=np.float32)
        entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
        return sparse.coo_matrix(entries, shape).tocsr()  # which adds up what falls on one place


def find_mask_weights(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    settings: RasterSettings = INRIA,
    progress: Progress = silent,
) -> MaskWeights:
    """Gather the mask weights of all views, in memory."""
    pairs = []
    for camera, features in views:
        pairs.append(view_pairs(rasterizer, gaussians, camera, features, settings))
        progress("lifting masks onto the Gaussians", len(pairs) / len(views))
    return MaskWeights(pairs, len(gaussians))


def view_pairs(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    camera: Camera,
    features: ImageFeatures,
    settings: RasterSettings = INRIA,
) -> Array:
    """The (Gaussian, mask) pairs of a view, of type PAIR, by ascending row."""
    if len(features.vectors) == 0:
        return np.zeros(0, PAIR)
    if len(features.vectors) > np.iinfo(PAIR["mask"]).max:
        raise ValueError(f"{camera.name}: {len(features.vectors)} masks; at most 65 535 can be numbered")
    view = rasterizer.view(gaussians, camera, settings)
    weights = view.gather_labels(features.labels, len(features.vectors), MIN_WEIGHT)
    pairs = np.empty(weights.nnz, PAIR)
    pairs["row"] = np.repeat(np.arange(weights.shape[0]), np.diff(weights.indptr))
    pairs["mask"] = weights.indices
    pairs["level"] = _row_levels(features)[weights.indices]
    pairs["weight"] = weights.data
    return pairs


def _row_levels(features: ImageFeatures) -> Array:
    """(M,) the level each global row belongs to."""
    levels = np.zeros(len(features.vectors), np.uint16)
    for index, labels in enumerate(features.labels):
        levels[np.unique(labels[labels >= 0])] = index
    return levels


# Things: which masks of different photographs show one and the same, and so which Gaussians belong together.
#
# Two masks of different views are of one thing where most of what they claim, among the Gaussians that both
# views see, is claimed by both; masks linked so, directly or not, are one thing, and a Gaussian belongs to
# the thing whose masks it paints most of. No vector is looked at: that the front and the back of a thing
# mean slightly different things to the encoder does not tear it apart. (Clustering masks by what they claim
# in 3D is known from MaskClustering, Yan et al. 2024; this is its plainest form.)

SAME = 0.6  # overlap over union of what two masks claim from which they are one thing
# Gaussians that decide which masks go together: what is compared grows with views squared
THING_SAMPLE = 50_000


def find_instances(mask_weights: MaskWeights, counts: Sequence[int], level: int = len(LEVELS) - 1) -> Array:
    """(N,) int32 number of the thing that each Gaussian belongs to, at a level, by default the coarsest;
    NO_NODE where no mask of that level shows it. counts: number of masks of each view. Things are numbered
    from the largest, by number of Gaussians."""
    numbers = instances_of_masks(mask_weights, counts, level)
    size = int(numbers.max(initial=-1)) + 1
    of_mask = np.split(np.where(numbers >= 0, numbers, size).astype(np.int32), np.cumsum(counts)[:-1])
    groups = MaskGroups(tuple(of_mask), np.zeros((size + 1, 1), np.float32))
    things = np.full(mask_weights.count, size, np.int64)
    for number, (first, last) in enumerate(mask_weights.blocks):
        weights = mask_weights.block(number, groups)[:, level * (size + 1) : (level + 1) * (size + 1)].tocsr()
        if weights.nnz:
            known = np.diff(weights.indptr) > 0
            things[first:last] = np.where(known, np.asarray(weights.argmax(axis=1)).ravel(), size)
    order = np.argsort(-np.bincount(things, minlength=size + 1)[:size], kind="stable")
    rank = np.full(size + 1, NO_NODE, np.int32)
    rank[order] = np.arange(size)
    return np.asarray(rank[things])


def instances_of_masks(mask_weights: MaskWeights, counts: Sequence[int], level: int) -> Array:
    """(M,) number of the thing that each mask of all views shows, from 0; -1 for masks of other levels and
    for those that claim nothing."""
    firsts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    claims, views = _claims(mask_weights, firsts, level)
    _, found = connected_components(_overlapping(claims, views), directed=False)
    numbers = np.full(int(firsts[-1]), -1)
    at_level = np.flatnonzero(np.diff(claims.tocsc().indptr) > 0)
    numbers[at_level] = np.unique(found[at_level], return_inverse=True)[1]
    return numbers


def _claims(mask_weights: MaskWeights, firsts: Array, level: int) -> tuple[sparse.csr_matrix, Array]:
    """(n, M) ones where a mask holds more than half of a sampled Gaussian's weight in its view and level."""
    chosen = np.full(mask_weights.count, -1)
    sample = np.random.default_rng(0).permutation(mask_weights.count)[:THING_SAMPLE]
    chosen[np.sort(sample)] = np.arange(len(sample))
    rows, columns = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for view, pairs in enumerate(mask_weights.pairs):
        here = pairs[(pairs["level"] == level) & (chosen[pairs["row"]] >= 0)]
        row = chosen[here["row"]]
        total = np.bincount(row, here["weight"], len(sample))
        strong = here["weight"] > 0.5 * total[row]
        rows.append(row[strong])
        columns.append(firsts[view] + here["mask"][strong].astype(np.int64))
    joined_rows, joined_columns = np.concatenate(rows), np.concatenate(columns)
    ones = np.ones(len(joined_rows), np.float32)
    shape = (len(sample), int(firsts[-1]))
    views = np.searchsorted(firsts, np.arange(firsts[-1]), side="right") - 1
    return sparse.csr_matrix((ones, (joined_rows, joined_columns)), shape), views


def _overlapping(claims: sparse.csr_matrix, views: Array) -> sparse.csr_matrix:
    """(M, M) links between masks of different views whose overlap over union, where both see, is large."""
    both = (claims.T @ claims).tocoo()
    shape = len(views), int(views.max(initial=-1)) + 1
    of_view = sparse.csr_matrix((np.ones(len(views), np.float32), (np.arange(len(views)), views)), shape)
    seen = claims @ of_view  # (n, V): is the Gaussian claimed in the view at all
    visible = (claims.T @ seen).tocsr()  # (M, V): Gaussians of the mask that the view sees
    a, b = both.row, both.col
    union = _at(visible, a, views[b]) + _at(visible, b, views[a]) - both.data
    same = (views[a] != views[b]) & (both.data > SAME * union)
    square = (len(views), len(views))
    return sparse.csr_matrix((np.ones(int(same.sum()), bool), (a[same], b[same])), square)


def _at(matrix: sparse.csr_matrix, rows: Array, columns: Array) -> Array:
    return np.asarray(matrix[rows, columns]).ravel() if len(rows) else np.zeros(0, np.float32)
