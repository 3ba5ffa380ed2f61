"""Lifting: from masks in photographs to vectors on Gaussians, through the adjoint W^T alone.

Targets are constant on masks, so ``W^T onehot(mask)`` gives every Gaussian its membership in every mask,
a sparse matrix that carries vectors of any length. Two roads use it or its shortcut:

* `median` and `mean`: each Gaussian takes the (geometric median | weighted mean) of the CLIP vectors of
  its masks, on the unit sphere; the codec encodes that afterwards. Averaging in CLIP space never meets
  the meaning of a third object half way between two latents.
* `one-pass`, the paper's quantity: latents averaged directly, ``x = W^T H / W^T 1``.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import sparse

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import helper, kernel, shared_workers
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LabelView, LiftingRasterizer, LiftingView
from langsplat_core.scene import LEVELS, Camera, Codec, Gaussians
from langsplat_core.semantics.store import ImageFeatures

MIN_WEIGHT = 1e-3  # a Gaussian's weight in a mask, in pixels, below which the pair is not stored
MEDIAN_STEPS = 8
FAINT = 2e-3  # share of a Gaussian's weight below which a mask has no say in its median


@dataclass(frozen=True, eq=False)
class Memberships:
    """How strongly N Gaussians belong to the M masks of all views."""

    weights: sparse.csr_matrix  # (N, M) blending weight summed over the mask's pixels, in pixels
    levels: Array  # (M,) index into LEVELS
    vectors: Array  # (M, D) float32 unit CLIP vectors


def find_memberships(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    chunk: int = 32,
    settings: RasterSettings = INRIA,
    progress: Progress = silent,
) -> Memberships:
    """``W^T onehot(mask)`` over all views.

    Where a backend cannot lift label maps in one walk, `chunk` masks travel through one gather pass.
    """
    blocks, levels, vectors = [], [], []
    for done, (camera, features) in enumerate(views):
        if len(features.vectors):
            view = rasterizer.view(gaussians, camera, settings)
            blocks.append(_weights_in_masks(view, features, chunk))
            levels.append(_row_levels(features))
            vectors.append(features.vectors)
        progress("lifting masks onto the Gaussians", (done + 1) / len(views))
    if not blocks:
        return Memberships(
            sparse.csr_matrix((len(gaussians), 0)), np.zeros(0, int), np.zeros((0, 1), np.float32)
        )
    joined = sparse.hstack(blocks, format="csr")
    return Memberships(joined, np.concatenate(levels), np.concatenate(vectors).astype(np.float32))


def _weights_in_masks(view: LiftingView, features: ImageFeatures, chunk: int) -> sparse.csr_matrix:
    """(N, M) float32 weight of every Gaussian in the masks of one view, where it exceeds `MIN_WEIGHT`."""
    count = len(features.vectors)
    if isinstance(view, LabelView):
        return view.gather_labels(features.labels, count, MIN_WEIGHT)
    columns = []
    for start in range(0, count, chunk):
        weights = view.gather(_onehot(features.labels, start, min(chunk, count - start)))
        columns.append(sparse.csr_matrix(np.where(weights > MIN_WEIGHT, weights, 0).astype(np.float32)))
    return sparse.hstack(columns, format="csr")


def _onehot(labels: Array, start: int, size: int) -> Array:
    """(3, H, W) global row ids -> (H, W, size) float32 indicator of rows start .. start + size."""
    height, width = labels.shape[1:]
    image = np.zeros((height * width, size), np.float32)
    for level in labels.reshape(len(LEVELS), -1):
        inside = np.flatnonzero((level >= start) & (level < start + size))  # -1, no mask, is never inside
        image[inside, level[inside] - start] = 1
    return image.reshape(height, width, size)


def _row_levels(features: ImageFeatures) -> Array:
    """(M,) the level each global row belongs to."""
    levels = np.zeros(len(features.vectors), int)
    for index, labels in enumerate(features.labels):
        levels[np.unique(labels[labels >= 0])] = index
    return levels


def lift_vectors(memberships: Memberships, robust: bool) -> Iterator[tuple[Array, Array]]:
    """For each level: (N, D) float32 unit vectors (zero where unobserved) and (N,) confidence.

    Confidence is the total blending weight in pixels. `robust` takes the geometric median, else the mean.
    """
    for level in range(len(LEVELS)):
        columns = np.flatnonzero(memberships.levels == level)
        weights = memberships.weights[:, columns].tocsr()
        vectors = memberships.vectors[columns]
        confidence = np.asarray(weights.sum(1), np.float32).ravel()
        centre = unit(weights @ vectors).astype(np.float32)
        if robust and len(columns):
            strong = _without_faint(weights, confidence)
            parts = (strong.indptr, strong.indices, strong.data, vectors, centre)
            shared_workers().run(_weiszfeld, len(centre), *parts)
        yield np.where(confidence[:, None] > 0, centre, 0).astype(np.float32), confidence


def _without_faint(weights: sparse.csr_matrix, confidence: Array) -> sparse.csr_matrix:
    """Without the pairs below `FAINT` of their Gaussian's total: half of all pairs, little of the weight."""
    rows = np.repeat(np.arange(weights.shape[0]), np.diff(weights.indptr))
    keep = weights.data >= FAINT * confidence[rows]
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows[keep], minlength=weights.shape[0]))])
    return sparse.csr_matrix((weights.data[keep], weights.indices[keep], indptr), shape=weights.shape)


@partial(helper, fastmath={"reassoc", "contract", "nsz"})
def _add_reweighted(total: Array, vector: Array, centre: Array, weight: float) -> None:
    """total += weight / |vector - centre| vector, for unit vectors."""
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
    """Improve rows [first, last) of `centre` (N, D) in place towards the weighted geometric median on the
    unit sphere.

    Weiszfeld's iteration: reweight every vector by 1 / chordal distance and average again. The floor on
    the distance keeps a centre that coincides with a vector finite; it is far below the noise of CLIP.
    """
    dim = vectors.shape[1]
    total = np.empty(dim, np.float32)
    for row in range(first, last):
        start, stop = indptr[row], indptr[row + 1]
        if stop - start < 2:
            continue
        for _ in range(MEDIAN_STEPS):
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


def lift_latents(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    codec: Codec,
    settings: RasterSettings = INRIA,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """The paper's quantity in one pass: (3, N, d) latents ``W^T H / W^T 1`` and (3, N) confidence.

    H holds the encoded vector of each pixel's mask; pixels without a mask count in neither sum.
    All three levels go through one gather per view.
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
        view = rasterizer.view(gaussians, camera, settings)
        total += view.gather(np.ascontiguousarray(stacked)).reshape(count, len(LEVELS), d + 1)
        progress("lifting latents onto the Gaussians", (done + 1) / len(views))
    confidence = total[..., d]
    means = unit(total[..., :d] / np.maximum(confidence, 1e-9)[..., None])
    return (
        np.moveaxis(means, 1, 0).astype(np.float32).copy(),
        confidence.T.astype(np.float32).copy(),
    )
