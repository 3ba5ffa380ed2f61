"""Lifting: from masks in photographs to unit CLIP vectors of Gaussians.

Each Gaussian gets the geometric median, or the weighted mean, of the vectors of its masks; a codec encodes
these afterwards. Averages are taken in CLIP space: between two latents may lie that of a third object.

The mask weights ``W^T onehot(mask)`` are the pixels of every mask in every photograph that each Gaussian
paints. Targets are constant on masks, so this sparse matrix carries vectors of any length from photographs to
Gaussians. It is kept view by view, as pairs sorted by Gaussian, in memory or in files, and read block by
block, so that memory does not grow with the number of photographs. It also gives 3D instances
(`find_instances`) and votes of photographs for the nodes of a tree (`count_votes`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
import scipy

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import helper, kernel, plain, shared_workers
from langsplat_core.config import INRIA, LiftConfig, RasterSettings, check_settings
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LiftingRasterizer, LiftingView
from langsplat_core.scene import LEVELS, NO_NODE, Camera, Codec, Gaussians, Tree
from langsplat_core.semantics.features import ImageFeatures
from langsplat_core.training.language.codec_fit import nearest_centres, spherical_kmeans


@dataclass(frozen=True, eq=False)
class MaskGroups:
    """G groups of masks with similar vectors.

    Of a hundred masks that show a Gaussian few are distinct: its median is taken over groups of them.
    """

    of_mask: Array  # group of every mask, one view after the other
    vectors: Array  # (G, D) float32 unit vectors


def group_masks(vectors: Sequence[Array], groups: int = 2_048) -> MaskGroups:
    """Return the groups of masks: of equal vectors or, above `groups`, of clusters.

    vectors: (M, D) float32 unit vectors of each view.
    """
    joined, number = np.concatenate(vectors), dict[bytes, int]()
    of_mask = np.array([number.setdefault(vector.tobytes(), len(number)) for vector in joined], int)
    centres = joined[np.unique(of_mask, return_index=True)[1]]
    if len(centres) > groups:
        generator = np.random.default_rng(0)
        sample = joined[np.sort(generator.permutation(len(joined))[:16_384])]
        centres = spherical_kmeans(sample, groups, rounds=6, generator=generator)
        of_mask = nearest_centres(joined, centres)[0]
    return MaskGroups(of_mask.astype(np.int32), centres)


PAIR = np.dtype([("row", "<u4"), ("mask", "<u2"), ("level", "<u2"), ("weight", "<f4")])


@dataclass(frozen=True, eq=False)
class MaskWeights:
    """Mask weights of `count` Gaussians in all views, W^T onehot(mask), sparse."""

    pairs: Sequence[Array]  # of each view, of type PAIR, by rising row: Gaussian, mask, its level, pixels
    mask_counts: Sequence[int]  # of each view
    count: int
    block_size: int = 16_384  # Gaussians per block

    @property
    def blocks(self) -> list[tuple[int, int]]:
        """Return the first Gaussian, and the one after the last, of every block."""
        firsts = range(0, self.count, self.block_size)
        return [(first, min(first + self.block_size, self.count)) for first in firsts]

    @property
    def first_masks(self) -> Array:
        """The (V + 1,) number of each view's first mask, counted through all views, and that of all masks."""
        return np.cumsum([0, *self.mask_counts])

    @cached_property
    def _edges(self) -> list[Array]:
        """Indices of each view's pairs at which blocks begin, and the last one ends."""
        firsts = np.arange(0, self.count + self.block_size, self.block_size)
        return [np.searchsorted(view["row"], firsts) for view in self.pairs]

    def block(self, number: int, groups: MaskGroups) -> "scipy.sparse.csr_matrix":
        """Return the (n, 3 G) weights, in pixels, of a block's Gaussians in the groups, level after level."""
        first, last = self.blocks[number]
        rows, columns, weights = [], [], []
        of_mask = np.split(groups.of_mask, self.first_masks[1:-1])
        for pairs, edges, group in zip(self.pairs, self._edges, of_mask, strict=True):
            part = pairs[edges[number] : edges[number + 1]]
            rows.append(part["row"].astype(np.int32) - first)
            columns.append(part["level"].astype(np.int32) * len(groups.vectors) + group[part["mask"]])
            weights.append(part["weight"])
        shape = (last - first, len(LEVELS) * len(groups.vectors))
        entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
        return scipy.sparse.coo_matrix(entries, shape).tocsr()  # sums duplicates

    def sums(self, sets: Array, size: int) -> "tuple[scipy.sparse.csr_matrix, Array]":
        """Return the (size, masks of all views) float32 pixels that each set of Gaussians paints.

        Also returns the int32 number 3 view + level of each mask. sets: (N,) of each Gaussian, or -1.
        """
        views, labelling = [scipy.sparse.csr_matrix((size, 0))], [np.zeros(0, np.int32)]
        for view, (pairs, count) in enumerate(zip(self.pairs, self.mask_counts, strict=True)):
            within = pairs[sets[pairs["row"]] >= 0]
            place = sets[within["row"]], within["mask"]
            painted = scipy.sparse.coo_matrix((within["weight"].astype(np.float64), place), (size, count))
            views.append(painted.tocsr())  # sums duplicates
            labelling.append(np.zeros(count, np.int32))
            labelling[-1][within["mask"]] = len(LEVELS) * view + within["level"]
        sums = scipy.sparse.hstack(views, "csr", np.float32)
        sums.sort_indices()
        return sums, np.concatenate(labelling)


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


# 3D instances, by the simplest form of MaskClustering (Yan et al. 2024).
#
# A mask claims the Gaussians of which it has more than half of the weight in its view. Two masks of different
# views are linked if the IoU of their claims, among the Gaussians that both views see, is large. Connected
# masks are one instance, and a Gaussian belongs to the instance whose masks it paints most of. Vectors are
# not used, since those of the front and the back of an instance differ.

SAME = 0.6  # IoU of the claims of two masks above which they are linked


def find_instances(mask_weights: MaskWeights, level: int = len(LEVELS) - 1, sample: int = 50_000) -> Array:
    """Return the (N,) int32 number of each Gaussian's instance at a level; NO_NODE if it is in no mask.

    Instances are numbered from the largest. sample: Gaussians by which masks are compared, view by view.
    """
    view_of = np.repeat(np.arange(len(mask_weights.pairs)), mask_weights.mask_counts)
    claims = _claims(mask_weights, level, sample)
    _, found = scipy.sparse.csgraph.connected_components(_overlapping(claims, view_of), directed=False)
    claiming = np.flatnonzero(np.diff(claims.tocsc().indptr) > 0)
    names, numbers = np.unique(found[claiming], return_inverse=True)
    size = len(names)
    of_mask = np.full(len(view_of), size, np.int32)  # masks of other levels, and those that claim nothing
    of_mask[claiming] = numbers
    groups = MaskGroups(of_mask, np.zeros((size + 1, 1), np.float32))
    instances = np.full(mask_weights.count, size, np.int64)
    for number, (first, last) in enumerate(mask_weights.blocks):
        weights = mask_weights.block(number, groups)[:, level * (size + 1) : (level + 1) * (size + 1)].tocsr()
        row = np.repeat(np.arange(first, last), np.diff(weights.indptr))
        most = np.zeros(mask_weights.count, np.float32)
        np.maximum.at(most, row, weights.data)
        heaviest = np.flatnonzero(weights.data == most[row])[::-1]
        instances[row[heaviest]] = weights.indices[heaviest]  # the first of equal ones is written last
    order = np.argsort(-np.bincount(instances, minlength=size + 1)[:size], kind="stable")
    rank = np.full(size + 1, NO_NODE, np.int32)
    rank[order] = np.arange(size)
    return np.asarray(rank[instances])


def _claims(mask_weights: MaskWeights, level: int, most: int) -> "scipy.sparse.csr_matrix":
    """Return (n, M) ones where a mask has over half of a sampled Gaussian's weight in its view and level."""
    chosen = np.full(mask_weights.count, -1)
    sample = np.random.default_rng(0).permutation(mask_weights.count)[:most]
    chosen[np.sort(sample)] = np.arange(len(sample))
    rows, columns = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    *firsts, masks = mask_weights.first_masks.tolist()
    for first, pairs in zip(firsts, mask_weights.pairs, strict=True):
        here = pairs[(pairs["level"] == level) & (chosen[pairs["row"]] >= 0)]
        row = chosen[here["row"]]
        total = np.bincount(row, here["weight"], len(sample))
        strong = here["weight"] > 0.5 * total[row]
        rows.append(row[strong])
        columns.append(first + here["mask"][strong].astype(np.int64))
    places = np.concatenate(rows), np.concatenate(columns)
    ones = np.ones(len(places[0]), np.float32)
    return scipy.sparse.csr_matrix((ones, places), (len(sample), masks))


def _overlapping(claims: "scipy.sparse.csr_matrix", view_of: Array) -> "scipy.sparse.csr_matrix":
    """Return (M, M) links between masks of different views whose claims have an IoU above `SAME`."""
    count, views = len(view_of), int(view_of.max(initial=-1)) + 1
    both = (claims.T @ claims).tocoo()
    a, b = both.row, both.col
    entries = np.ones(count, np.float32), (np.arange(count), view_of)
    of_view = scipy.sparse.csr_matrix(entries, (count, views))
    seen = claims @ of_view  # (n, V): 1 if the Gaussian is claimed in the view
    visible = (claims.T @ seen).tocsr()  # (M, V): Gaussians of the mask that the view sees
    union = -both.data
    for mask, other in ((a, b), (b, a)):
        union = union + np.asarray(visible[mask, view_of[other]]).ravel()
    same = (view_of[a] != view_of[b]) & (both.data > SAME * union)
    return scipy.sparse.csr_matrix((np.ones(int(same.sum()), bool), (a[same], b[same])), (count, count))


# Votes of photographs for the nodes of a scene's tree.

VOTE = 0.5  # IoU of a node and a mask above which the mask is a vote for the node
SHOWN = 25.0  # least pixels of a node in a photograph that shows it


def count_votes(tree: Tree, mask_weights: MaskWeights) -> Array:
    """Return the (K, 2) uint16 numbers of photographs with a mask of exactly each node, and without one.

    Masks are compared with the visible part of a node; a photograph that hardly shows it does not vote.
    """
    sums, labelling = mask_weights.sums(tree.leaves, tree.count)
    sums = sums.tocsc()
    votes = np.zeros((tree.count, 2), np.uint16)
    for pairs, (first, last) in zip(mask_weights.pairs, pairwise(mask_weights.first_masks), strict=True):
        shared = sums[:, first:last].toarray()  # (K, M) pixels, then with those of descendants
        for node, parent in enumerate(tree.parents):
            if parent != NO_NODE:
                shared[parent] += shared[node]
        level_of = labelling[first:last] % len(LEVELS)
        visible = np.stack([shared[:, level_of == level].sum(1) for level in range(len(LEVELS))], 1)
        every = np.bincount(pairs["mask"], pairs["weight"], last - first)
        union = visible[:, level_of] + every - shared
        agree = (shared > VOTE * union).any(1)
        shown = visible.max(1) >= SHOWN
        votes += np.stack([shown & agree, shown & ~agree], 1).astype(np.uint16)
    return votes


# Lifting by mask weights.


def lift_sample(
    mask_weights: MaskWeights, groups: MaskGroups, rows: Array, robust: bool, progress: Progress = silent
) -> tuple[Array, Array]:
    """Return what `lift_weights` does, for the Gaussians at ascending `rows`."""
    parts = [scipy.sparse.csr_matrix((0, len(LEVELS) * len(groups.vectors)), dtype=np.float32)]
    for number, (first, last) in enumerate(mask_weights.blocks):
        inside = rows[(rows >= first) & (rows < last)] - first
        if len(inside):
            parts.append(mask_weights.block(number, groups)[inside])
        progress("averaging the masks of a sample", last / mask_weights.count)
    return lift_weights(scipy.sparse.vstack(parts, "csr"), groups.vectors, robust)


def lift_weights(weights: "scipy.sparse.csr_matrix", vectors: Array, robust: bool) -> tuple[Array, Array]:
    """Return (3, n, D) float32 unit vectors, zero where unobserved, and (3, n) float32 confidence.

    Confidence is the total blending weight, in pixels. weights: (n, 3 G) of n Gaussians in G groups of masks,
    level after level; vectors: (G, D) float32 unit vectors of the groups; robust: by geometric medians.
    """
    lifted = np.zeros((len(LEVELS), weights.shape[0], vectors.shape[1]), np.float32)
    confidences = np.zeros((len(LEVELS), weights.shape[0]), np.float32)
    for level, (centre, confidence) in enumerate(zip(lifted, confidences, strict=True)):
        at_level = weights[:, level * len(vectors) : (level + 1) * len(vectors)].tocsr()
        confidence[:] = np.asarray(at_level.sum(1)).ravel()
        centre[:] = unit(at_level @ vectors)
        if robust and at_level.nnz:
            # Pairs below 0.2 % of their Gaussian's total are half of all pairs with little of the weight.
            at_level.data[at_level.data < 2e-3 * np.repeat(confidence, np.diff(at_level.indptr))] = 0
            at_level.eliminate_zeros()
            parts = (at_level.indptr, at_level.indices, at_level.data, vectors, centre)
            shared_workers().run(_weiszfeld, len(centre), *parts)
        centre[confidence == 0] = 0
    return lifted, confidences


@partial(helper, fastmath={"reassoc", "contract", "nsz"})
def _add_reweighted(total: Array, vector: Array, centre: Array, weight: float) -> None:
    """Add weight / |vector - centre| vector to `total`, for unit vectors."""
    cosine = np.float32(0)
    for k in range(total.shape[0]):
        cosine += vector[k] * centre[k]
    distance = np.sqrt(max(np.float32(2) - np.float32(2) * cosine, np.float32(1e-4)))
    scaled = weight / distance
    for k in range(total.shape[0]):
        total[k] += scaled * vector[k]


# `fastmath` allows reordered sums, which the compiler needs for vector instructions, 10 times as fast.
@partial(kernel, fastmath={"reassoc", "contract", "nsz"})
def _weiszfeld(
    first: int, last: int, indptr: Array, indices: Array, data: Array, vectors: Array, centre: Array
) -> None:
    """Move rows [first, last) of `centre` (N, D) to the weighted geometric median on the sphere.

    Weiszfeld's iteration: weight every vector by 1 / chordal distance and average again. The least distance
    keeps a centre that coincides with a vector finite; it is far below the noise of CLIP.
    """
    dim = vectors.shape[1]
    total = np.empty(dim, np.float32)
    for row in range(first, last):
        start, stop = indptr[row], indptr[row + 1]
        if stop - start < 2:
            continue
        for _ in range(8):  # within a degree of the converged median
            total[:] = 0
            for entry in range(start, stop):
                _add_reweighted(total, vectors[indices[entry]], centre[row], data[entry])
            length = np.float32(0)
            for k in range(dim):
                length += total[k] * total[k]
            length = np.sqrt(length)
            if length > 1e-12:
                for k in range(dim):
                    centre[row, k] = total[k] / length


# One-pass lifting: weighted means of latents, ``x = W^T H / W^T 1``.


def lift_latents(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    codec: Codec,
    settings: RasterSettings = INRIA,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """Return (3, N, d) unit latents of ``W^T H / W^T 1`` over pixels with a mask, and (3, N) confidence."""
    count, d = len(gaussians), codec.latent_dim
    total = np.zeros((count, len(LEVELS), d + 1))
    for done, (camera, features) in enumerate(views):
        latents = np.zeros((len(features.vectors) + 1, d + 1), np.float32)
        latents[:-1, :d] = codec.encode(features.vectors)
        latents[:-1, d] = 1
        images = latents[features.labels]  # label -1 indexes the last row: zeros
        height, width = features.labels.shape[1:]
        stacked = np.moveaxis(images, 0, 2).reshape(height, width, -1)
        view = rasterizer.view(gaussians, camera, settings)
        total += view.gather(np.ascontiguousarray(stacked)).reshape(count, len(LEVELS), d + 1)
        progress("lifting latents onto the Gaussians", (done + 1) / len(views))
    confidence = total[..., d]
    means = unit(total[..., :d] / np.maximum(confidence, 1e-9)[..., None])
    return np.moveaxis(means, 1, 0).astype(np.float32).copy(), confidence.T.astype(np.float32).copy()


# Lifting by gradient descent: latents trained through the rasterizer, as the paper does it.
#
# LangSplat (section 3.3, and its public code): only the language features are trained. A step compares one
# photograph's latents H with the blended features, ``F = W y``, by their mean absolute difference over pixels
# with a mask, and Adam moves the features x. The renderer is linear, so a step is one `splat` and one
# `gather` for all three levels:
#
#     d loss / d y = W^T (mask * sign(F - H)) / (pixels times d).
#
# Blended are y = x or, as published, y = x / (|x| + 1e-9). With the published start at zero the first
# gradients are about 1e9 times too large, until Adam's second moment has forgotten them; a start at the
# one-pass mean reaches the same loss much sooner.

KEPT_BYTES = 4e9  # of projected views that are kept; others are projected again at every step


def lift_by_gradient(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    codec: Codec,
    config: LiftConfig,
    settings: RasterSettings = INRIA,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """Return (3, N, d) float32 unit latents and (3, N) confidence, both as in `lift_latents`.

    Latents are zero where unobserved. config: steps, learning rate, start. Deterministic on the CPU.
    """
    start, confidence = lift_latents(rasterizer, gaussians, views, codec, settings, progress)
    import torch  # takes seconds; other modes do not need it

    check_settings(config, "--lift.")
    published = config.start == "zeros-as-published"
    x = np.zeros_like(start) if published else start.copy()
    features = torch.from_numpy(x).requires_grad_()  # the same memory
    adam = torch.optim.Adam([features], config.lr, (0.9, 0.999), 1e-15, fused=True)  # as in the INRIA code
    targets = [
        (camera, seen.labels, np.pad(codec.encode(seen.vectors), ((0, 1), (0, 0)))) for camera, seen in views
    ]
    kept: dict[int, LiftingView] = {}
    generator = np.random.default_rng(config.seed)
    order = generator.permutation(len(views))
    for step in range(config.steps):
        if step and step % len(views) == 0:  # each view once in every pass
            order = generator.permutation(len(views))
        index = int(order[step % len(views)])
        camera, labels, latents = targets[index]
        if (view := kept.get(index)) is None:  # the geometry is fixed
            view = rasterizer.view(gaussians, camera, settings)
            if sum(one.nbytes for one in (view, *kept.values())) <= KEPT_BYTES:
                kept[index] = view
        y = features / (features.norm(dim=-1, keepdim=True) + 1e-9) if published else features
        loss, gradient = _loss_and_gradient(view, labels, latents, y.detach().numpy())
        y.backward(torch.from_numpy(plain(gradient)))
        adam.step()
        adam.zero_grad()
        if (step + 1) % 20 == 0 or step + 1 == config.steps:
            progress("training language features", (step + 1) / config.steps, loss=loss)
    return np.where(confidence[..., None] > 0, unit(x), 0).astype(np.float32), confidence


def _loss_and_gradient(view: LiftingView, labels: Array, latents: Array, y: Array) -> tuple[float, Array]:
    """Return the masked L1 of one view, a mean over levels, pixels and components, and its gradient by `y`.

    The target of each pixel is the row of the (M + 1, d) `latents` at its (3, H, W) `labels`; -1 is none. y:
    (3, N, d), like the gradient.
    """
    levels, count, d = y.shape
    image = view.splat(np.ascontiguousarray(np.moveaxis(y, 0, 1).reshape(count, levels * d)))[0]
    rows = np.moveaxis(labels, 0, -1)
    difference = image.reshape(*rows.shape, d) - latents[rows]
    difference[rows < 0] = 0
    signs = np.sign(difference, dtype=np.float32) / np.float32(image.size)
    gradient = view.gather(signs.reshape(image.shape))
    return float(np.abs(difference).mean()), np.moveaxis(gradient.reshape(count, levels, d), 1, 0)
