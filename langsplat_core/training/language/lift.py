"""Lifting: from masks in photographs to CLIP vectors on Gaussians, on the unit sphere.

Each Gaussian takes the geometric median, or the weighted mean, of the vectors of the masks it belongs to; a
codec encodes that afterwards. Averaging in CLIP space never meets the meaning of a third object half way
between two latents.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import sparse

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import helper, kernel, shared_workers
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS
from langsplat_core.training.language.mask_groups import MaskGroups
from langsplat_core.training.language.memberships import Memberships

MEDIAN_STEPS = 8
FAINT = 2e-3  # share of a Gaussian's weight below which a mask has no say in its median


@dataclass(frozen=True, eq=False)
class Lifted:
    """What n Gaussians mean at the three levels."""

    vectors: Array  # (3, n, D) float32 unit vectors; zero where unobserved
    confidence: Array  # (3, n) float32 total blending weight, in pixels


def lift_block(memberships: Memberships, groups: MaskGroups, number: int, robust: bool) -> Lifted:
    """Of the Gaussians of one block. `robust` takes the geometric median, else the mean."""
    return lift_weights(memberships.block(number, groups), groups.vectors, robust)


def lift_sample(
    memberships: Memberships, groups: MaskGroups, rows: Array, robust: bool, progress: Progress = silent
) -> Lifted:
    """Of the Gaussians at `rows`, in rising order."""
    parts = []
    for number, (first, last) in enumerate(memberships.blocks):
        inside = rows[(rows >= first) & (rows < last)] - first
        if len(inside):
            weights = memberships.block(number, groups)[inside]
            parts.append(lift_weights(weights, groups.vectors, robust))
        progress("averaging the masks of a sample", last / memberships.count)
    if not parts:
        nothing = np.zeros((len(LEVELS), 0, groups.vectors.shape[1]), np.float32)
        return Lifted(nothing, np.zeros((len(LEVELS), 0), np.float32))
    return Lifted(
        np.concatenate([part.vectors for part in parts], axis=1),
        np.concatenate([part.confidence for part in parts], axis=1),
    )


def lift_weights(weights: sparse.csr_matrix, vectors: Array, robust: bool) -> Lifted:
    """weights: (n, 3 G) of n Gaussians in G groups of masks, level after level; vectors: (G, D) float32."""
    levels = list(_levels(weights, vectors, robust))
    return Lifted(np.stack([vectors for vectors, _ in levels]), np.stack([c for _, c in levels]))


def _levels(weights: sparse.csr_matrix, vectors: Array, robust: bool) -> Iterator[tuple[Array, Array]]:
    for level in range(len(LEVELS)):
        at_level = weights[:, level * len(vectors) : (level + 1) * len(vectors)].tocsr()
        confidence = np.asarray(at_level.sum(1), np.float32).ravel()
        centre = unit(at_level @ vectors).astype(np.float32)
        if robust and at_level.nnz:
            strong = _without_faint(at_level, confidence)
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
