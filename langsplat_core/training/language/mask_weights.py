"""Mask weights: how much of every mask in every photograph each Gaussian paints, ``W^T onehot(mask)``.

Targets are constant on masks, so this sparse matrix carries vectors of any length from photographs onto
Gaussians. It is kept view by view, as pairs sorted by Gaussian, in memory or in files, and read block by
block: what is held at a time does not grow with the number of photographs. From it follow 3D instances
(`find_instances`) and votes of photographs for the nodes of a tree (`count_votes`).
"""

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
from langsplat_core.scene import LEVELS, NO_NODE, Camera, Gaussians, Tree
from langsplat_core.semantics.features import ImageFeatures
from langsplat_core.training.language.codec_fit import nearest_centres, spherical_kmeans


@dataclass(frozen=True, eq=False)
class MaskGroups:
    """Groups of masks that say the same: the group, of G, of every mask of every view.

    Most of the hundred masks that show a Gaussian say one of a few things: its median is taken over these.
    """

    of_mask: tuple[Array, ...]  # of each view, (M,) int32
    vectors: Array  # (G, D) float32 unit vectors


def group_masks(vectors: Sequence[Array], groups: int = 2_048) -> MaskGroups:
    """Return at most `groups` groups of the masks; where there are not more masks than that, each is its own.

    vectors: of each view, (M, D) float32 unit CLIP vectors.
    """
    joined = np.concatenate(vectors)
    of_mask, centres = np.arange(len(joined)), joined
    if len(joined) > groups:
        generator = np.random.default_rng(0)
        sample = joined[np.sort(generator.permutation(len(joined))[:16_384])]
        centres = spherical_kmeans(sample, groups, rounds=6, generator=generator)
        of_mask = nearest_centres(joined, centres)[0]
    edges = np.cumsum([len(view) for view in vectors])[:-1]
    return MaskGroups(tuple(np.split(of_mask.astype(np.int32), edges)), centres)


PAIR = np.dtype([("row", "<u4"), ("mask", "<u2"), ("level", "<u2"), ("weight", "<f4")])


@dataclass(frozen=True, eq=False)
class MaskWeights:
    """Mask weights of `count` Gaussians in all views, W^T onehot(mask), sparse."""

    pairs: Sequence[Array]  # of each view, of type PAIR, by rising row: Gaussian, mask, its level, pixels
    count: int
    block_size: int = 16_384  # Gaussians handled at a time

    @property
    def blocks(self) -> list[tuple[int, int]]:
        """Return the first Gaussian, and the one after the last, of every block."""
        firsts = range(0, self.count, self.block_size)
        return [(first, min(first + self.block_size, self.count)) for first in firsts]

    @cached_property
    def _edges(self) -> list[Array]:
        """Places in each view's pairs at which blocks begin, and the last one ends."""
        firsts = np.arange(0, self.count + self.block_size, self.block_size)
        return [np.searchsorted(view["row"], firsts) for view in self.pairs]

    def block(self, number: int, groups: MaskGroups) -> sparse.csr_matrix:
        """Return the (n, 3 G) weights, in pixels, of a block's Gaussians in the groups, level after level."""
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

    def sums(self, sets: Array, size: int, counts: Sequence[int]) -> tuple[sparse.csr_matrix, Array]:
        """Return the (size, masks of all views) float32 pixels that each set of Gaussians paints.

        And the int32 view and level of each mask as one number, 3 view + level. sets: (N,) set of each
        Gaussian, -1 for those of none; counts: number of masks of each view.
        """
        views, labelling = [sparse.csr_matrix((size, 0))], [np.zeros(0, np.int32)]
        for view, (pairs, count) in enumerate(zip(self.pairs, counts, strict=True)):
            within = pairs[sets[pairs["row"]] >= 0]
            place = sets[within["row"]], within["mask"]
            painted = sparse.coo_matrix((within["weight"].astype(np.float64), place), (size, count))
            views.append(painted.tocsr())  # which adds up what falls on one place
            labelling.append(np.zeros(count, np.int32))
            labelling[-1][within["mask"]] = len(LEVELS) * view + within["level"]
        sums = sparse.hstack(views, "csr", np.float32)
        sums.sort_indices()
        return sums, np.concatenate(labelling)


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
    """Return the (Gaussian, mask) pairs of a view, of type PAIR, by ascending row."""
    if len(features.vectors) == 0:
        return np.zeros(0, PAIR)
    if len(features.vectors) > np.iinfo(PAIR["mask"]).max:
        raise ValueError(f"{camera.name}: {len(features.vectors)} masks; at most 65 535 can be numbered")
    view = rasterizer.view(gaussians, camera, settings)
    weights = view.gather_labels(features.labels, len(features.vectors), least=1e-3)
    level_of = np.zeros(len(features.vectors), np.uint16)
    for level, labels in enumerate(features.labels):
        level_of[np.unique(labels[labels >= 0])] = level
    pairs = np.empty(weights.nnz, PAIR)
    pairs["row"] = np.repeat(np.arange(weights.shape[0]), np.diff(weights.indptr))
    pairs["mask"] = weights.indices
    pairs["level"] = level_of[weights.indices]
    pairs["weight"] = weights.data
    return pairs


# 3D instances: which Gaussians belong together, by the plainest form of MaskClustering (Yan et al. 2024).
#
# Two masks of different views are of one instance where most of what they claim, among the Gaussians that
# both views see, is claimed by both; masks linked so, directly or not, are one instance, and a Gaussian
# belongs to the instance whose masks it paints most of. No vector is looked at: that the front and the back
# of a thing have slightly different vectors does not tear it apart.

SAME = 0.6  # overlap over union of what two masks claim from which they are one instance


def find_instances(
    mask_weights: MaskWeights, counts: Sequence[int], level: int = len(LEVELS) - 1, sample: int = 50_000
) -> Array:
    """Return the (N,) int32 number of the instance that each Gaussian belongs to, at a level.

    NO_NODE where no mask of that level shows it. Instances are numbered from the largest, by number of
    Gaussians. counts: number of masks of each view; sample: Gaussians that decide which masks go together,
    since what is compared grows with views squared.
    """
    view_of = np.repeat(np.arange(len(counts)), counts)
    claims = _claims(mask_weights, np.cumsum([0, *counts]), level, sample)
    _, found = connected_components(_overlapping(claims, view_of), directed=False)
    claiming = np.flatnonzero(np.diff(claims.tocsc().indptr) > 0)
    names, numbers = np.unique(found[claiming], return_inverse=True)
    size = len(names)
    of_mask = np.full(len(view_of), size, np.int32)  # masks of other levels, and those that claim nothing
    of_mask[claiming] = numbers
    by_view = np.split(of_mask, np.cumsum(counts)[:-1])
    groups = MaskGroups(tuple(by_view), np.zeros((size + 1, 1), np.float32))
    instances = np.full(mask_weights.count, size, np.int64)
    for number, (first, last) in enumerate(mask_weights.blocks):
        weights = mask_weights.block(number, groups)[:, level * (size + 1) : (level + 1) * (size + 1)].tocsr()
        if weights.nnz:
            known = np.diff(weights.indptr) > 0
            instances[first:last] = np.where(known, np.asarray(weights.argmax(axis=1)).ravel(), size)
    order = np.argsort(-np.bincount(instances, minlength=size + 1)[:size], kind="stable")
    rank = np.full(size + 1, NO_NODE, np.int32)
    rank[order] = np.arange(size)
    return np.asarray(rank[instances])


def _claims(mask_weights: MaskWeights, firsts: Array, level: int, most: int) -> sparse.csr_matrix:
    """(n, M) ones where a mask holds more than half of a sampled Gaussian's weight in its view and level."""
    chosen = np.full(mask_weights.count, -1)
    sample = np.random.default_rng(0).permutation(mask_weights.count)[:most]
    chosen[np.sort(sample)] = np.arange(len(sample))
    rows, columns = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for first, pairs in zip(firsts, mask_weights.pairs, strict=False):
        here = pairs[(pairs["level"] == level) & (chosen[pairs["row"]] >= 0)]
        row = chosen[here["row"]]
        total = np.bincount(row, here["weight"], len(sample))
        strong = here["weight"] > 0.5 * total[row]
        rows.append(row[strong])
        columns.append(first + here["mask"][strong].astype(np.int64))
    places = np.concatenate(rows), np.concatenate(columns)
    ones = np.ones(len(places[0]), np.float32)
    return sparse.csr_matrix((ones, places), (len(sample), int(firsts[-1])))


def _overlapping(claims: sparse.csr_matrix, view_of: Array) -> sparse.csr_matrix:
    """(M, M) links between masks of different views whose overlap over union, where both see, is large."""
    count, views = len(view_of), int(view_of.max(initial=-1)) + 1
    both = (claims.T @ claims).tocoo()
    a, b = both.row, both.col
    of_view = sparse.csr_matrix((np.ones(count, np.float32), (np.arange(count), view_of)), (count, views))
    seen = claims @ of_view  # (n, V): is the Gaussian claimed in the view at all
    visible = (claims.T @ seen).tocsr()  # (M, V): Gaussians of the mask that the view sees
    union = -both.data
    for mask, other in ((a, b), (b, a)):
        union = union + np.asarray(visible[mask, view_of[other]]).ravel()
    same = (view_of[a] != view_of[b]) & (both.data > SAME * union)
    return sparse.csr_matrix((np.ones(int(same.sum()), bool), (a[same], b[same])), (count, count))


# Votes of photographs for the nodes of a scene's tree.

VOTE = 0.5  # overlap over union of a node and a mask from which the mask is of just that node
SHOWN = 25.0  # pixels of a node from which a photograph shows it


def count_votes(tree: Tree, mask_weights: MaskWeights, counts: Sequence[int]) -> Array:
    """Return the (K, 2) uint16 numbers of photographs with a mask of just each node, and without one.

    Compared is what a view shows of the node; a photograph that hardly shows it has no vote. counts: number
    of masks of each view.
    """
    sums, labelling = mask_weights.sums(tree.leaves, tree.count, counts)
    sums, inside = sums.tocsc(), _descendants(tree)
    votes = np.zeros((tree.count, 2), np.uint16)
    for pairs, first, count in zip(mask_weights.pairs, np.cumsum([0, *counts]), counts, strict=False):
        shared = (inside @ sums[:, first : first + count]).toarray()  # (K, M) pixels
        level_of = labelling[first : first + count] % len(LEVELS)
        visible = np.stack([shared[:, level_of == level].sum(1) for level in range(len(LEVELS))], 1)
        every = np.bincount(pairs["mask"], pairs["weight"], count)
        union = visible[:, level_of] + every - shared
        agree = (shared > VOTE * union).any(1)
        shown = visible.max(1) >= SHOWN
        votes += np.stack([shown & agree, shown & ~agree], 1).astype(np.uint16)
    return votes


def _descendants(tree: Tree) -> sparse.csr_matrix:
    """(K, K) float32, 1 where the column's node is the row's or a descendant of it."""
    rows, columns = [np.arange(tree.count)], [np.arange(tree.count)]
    while len(rows[-1]):
        above = tree.parents[rows[-1]]
        rows.append(above[above != NO_NODE])
        columns.append(columns[-1][above != NO_NODE])
    places = np.concatenate(rows), np.concatenate(columns)
    return sparse.csr_matrix((np.ones(len(places[0]), np.float32), places), (tree.count, tree.count))
