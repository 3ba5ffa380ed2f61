"""Lifting: from masks in photographs to CLIP vectors on Gaussians, on the unit sphere.

Each Gaussian takes the geometric median, or the weighted mean, of the vectors of the masks it belongs to; a
codec encodes that afterwards. Averaging in CLIP space never yields the vector of a third object half way
between two latents.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy import sparse

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import helper, kernel, plain, shared_workers
from langsplat_core.config import LiftConfig, check_settings
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LiftingRasterizer, LiftingView
from langsplat_core.scene import LEVELS, Camera, Codec, Gaussians
from langsplat_core.semantics.features import ImageFeatures
from langsplat_core.training.language.mask_weights import MaskGroups, MaskWeights


def lift_sample(
    mask_weights: MaskWeights, groups: MaskGroups, rows: Array, robust: bool, progress: Progress = silent
) -> tuple[Array, Array]:
    """Lift onto the Gaussians at `rows`, which ascend; see `lift_weights`."""
    parts = [sparse.csr_matrix((0, len(LEVELS) * len(groups.vectors)), dtype=np.float32)]
    for number, (first, last) in enumerate(mask_weights.blocks):
        inside = rows[(rows >= first) & (rows < last)] - first
        if len(inside):
            parts.append(mask_weights.block(number, groups)[inside])
        progress("averaging the masks of a sample", last / mask_weights.count)
    return lift_weights(sparse.vstack(parts, "csr"), groups.vectors, robust)


def lift_weights(weights: sparse.csr_matrix, vectors: Array, robust: bool) -> tuple[Array, Array]:
    """Return (3, n, D) float32 unit vectors, zero where unobserved, and (3, n) float32 confidence.

    Confidence is the total blending weight, in pixels. weights: (n, 3 G) of n Gaussians in G groups of masks,
    level after level; vectors: (G, D) float32 unit vectors of the groups. `robust` takes the geometric
    median, else the mean.
    """
    lifted = np.zeros((len(LEVELS), weights.shape[0], vectors.shape[1]), np.float32)
    confidences = np.zeros((len(LEVELS), weights.shape[0]), np.float32)
    for level, (centre, confidence) in enumerate(zip(lifted, confidences, strict=True)):
        at_level = weights[:, level * len(vectors) : (level + 1) * len(vectors)].tocsr()
        confidence[:] = np.asarray(at_level.sum(1)).ravel()
        centre[:] = unit(at_level @ vectors)
        if robust and at_level.nnz:
            # Pairs below 0.2 % of their Gaussian's total: half of all pairs, and little of the weight.
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


# Sums may be reordered: without that the compiler cannot use vector instructions, which are 10 times faster.
@partial(kernel, fastmath={"reassoc", "contract", "nsz"})
def _weiszfeld(
    first: int, last: int, indptr: Array, indices: Array, data: Array, vectors: Array, centre: Array
) -> None:
    """Improve rows [first, last) of `centre` (N, D) towards the weighted geometric median on the sphere.

    Weiszfeld's iteration: reweight every vector by 1 / chordal distance and average again. The floor on the
    distance keeps a centre that coincides with a vector finite; it is far below the noise of CLIP.
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


# The paper's lifting in one pass: latents averaged directly, ``x = W^T H / W^T 1``.


def lift_latents(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    codec: Codec,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """Return (3, N, d) latents ``W^T H / W^T 1`` and (3, N) confidence.

    H holds the encoded vector of each pixel's mask; pixels without a mask count in neither sum.
    """
    count, d = len(gaussians), codec.latent_dim
    total = np.zeros((count, len(LEVELS), d + 1))
    for done, (camera, features) in enumerate(views):
        latents = np.zeros((len(features.vectors) + 1, d + 1), np.float32)
        latents[:-1, :d] = codec.encode(features.vectors)
        latents[:-1, d] = 1
        images = latents[features.labels]  # label -1 indexes the last row: zeros
        height, width = features.labels.shape[1:]
        stacked = np.moveaxis(images, 0, 2).reshape(height, width, -1)
        view = rasterizer.view(gaussians, camera)
        total += view.gather(np.ascontiguousarray(stacked)).reshape(count, len(LEVELS), d + 1)
        progress("lifting latents onto the Gaussians", (done + 1) / len(views))
    confidence = total[..., d]
    means = unit(total[..., :d] / np.maximum(confidence, 1e-9)[..., None])
    return np.moveaxis(means, 1, 0).astype(np.float32).copy(), confidence.T.astype(np.float32).copy()


# Lifting by gradient descent: latents trained through the rasterizer, as the paper does it.
#
# LangSplat (section 3.3, and its public code): everything but the language features is frozen; a step
# compares one photograph's latents H with the blended features, ``F = W y``, by their mean absolute
# difference over pixels with a mask, and Adam moves the features x. The renderer is linear, so that a step
# is one `splat` and one `gather`, which serve all three levels:
#
#     d loss / d y = W^T (mask * sign(F - H)) / (pixels times d).
#
# What is blended is y = x, or, as published, y = x / (|x| + 1e-9). The published start at zero then makes
# the first gradients about 1e9 times too large, which Adam's second moment must forget before anything
# moves; from the one-pass mean the same loss is reached much sooner.


def lift_by_gradient(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    codec: Codec,
    config: LiftConfig,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """Return (3, N, d) float32 unit latents and (3, N) confidence, both as of `lift_latents`.

    Latents are zero where unobserved. `config` says for how many steps, how fast, from where. Deterministic
    for a given seed on the CPU.
    """
    start, confidence = lift_latents(rasterizer, gaussians, views, codec, progress)
    import torch  # seconds that other modes need not pay

    check_settings(config, "--lift.")
    published = config.start == "zeros-as-published"
    x = np.zeros_like(start) if published else start.copy()
    features = torch.from_numpy(x)  # the same memory
    adam = torch.optim.Adam([features], config.lr, (0.9, 0.999), 1e-15, fused=True)  # as in the INRIA code
    targets = [
        (camera, np.asarray(seen.labels, np.int32), plain(codec.encode(seen.vectors)))
        for camera, seen in views
    ]
    # The geometry is frozen: views are kept as far as memory allows, 100 bytes a Gaussian in each.
    most = int(4e9 / (100 * max(len(gaussians), 1)))
    kept = [rasterizer.view(gaussians, camera) for camera, _ in views[:most]]
    generator = np.random.default_rng(config.seed)
    order = generator.permutation(len(views))
    for step in range(config.steps):
        if step and step % len(views) == 0:  # each view once in every pass
            order = generator.permutation(len(views))
        index = int(order[step % len(views)])
        camera, labels, latents = targets[index]
        view = kept[index] if index < len(kept) else rasterizer.view(gaussians, camera)
        loss, gradient = _loss_and_gradient(view, labels, latents, blended(x) if published else x)
        features.grad = torch.from_numpy(plain(by_features(x, gradient) if published else gradient))
        adam.step()
        if (step + 1) % 20 == 0 or step + 1 == config.steps:
            progress("training language features", (step + 1) / config.steps, loss=loss)
    return np.where(confidence[..., None] > 0, unit(x), 0).astype(np.float32), confidence


def blended(x: Array) -> Array:
    """Return the values that are blended as published, x / (|x| + 1e-9) of (..., d) features."""
    return x / (np.linalg.norm(x, axis=-1, keepdims=True) + 1e-9)


def by_features(x: Array, by_y: Array) -> Array:
    """Return the gradient by x from that by y = `blended` x; at zero the norm's own counts as zero."""
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    along = (x * by_y).sum(-1, keepdims=True) / np.maximum(length, 1e-30)
    return by_y / (length + 1e-9) - x * along / (length + 1e-9) ** 2


def _loss_and_gradient(view: LiftingView, labels: Array, latents: Array, y: Array) -> tuple[float, Array]:
    """Masked L1 of one view, the mean over levels, pixels and numbers, and its (3, N, d) gradient by y.

    What each pixel ought to show: the row of the (M, d) `latents` by its (3, H, W) `labels`, -1 for none.
    """
    levels, count, d = y.shape
    image = view.splat(np.ascontiguousarray(np.moveaxis(y, 0, 1).reshape(count, levels * d)))[0]
    signs, losses = np.empty_like(image), np.empty(len(image))
    share = np.float32(1 / image.size)
    shared_workers().run(_compare, len(image), image, labels, latents, share, signs, losses)
    gradient = view.gather(signs)
    return float(losses.sum() / image.size), np.moveaxis(gradient.reshape(count, levels, d), 1, 0)


@kernel
def _compare(
    first: int,
    last: int,
    image: Array,
    labels: Array,
    latents: Array,
    share: float,
    signs: Array,
    losses: Array,
) -> None:
    """Compare rows [first, last) of an image with the latents of its labels.

    `signs`: `share` with the sign of (image - latents), zero where there is no label; `losses`: the sum of
    the absolute differences of each row.
    """
    levels, d = labels.shape[0], latents.shape[1]
    for row in range(first, last):
        total = 0.0
        for column in range(image.shape[1]):
            for channel in range(levels * d):
                label = labels[channel // d, row, column]
                difference = 0.0
                if label >= 0:
                    difference = image[row, column, channel] - latents[label, channel % d]
                total += abs(difference)
                signs[row, column, channel] = share * np.sign(difference)
        losses[row] = total
