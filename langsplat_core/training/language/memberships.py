"""Memberships: how much of every mask in every photograph each Gaussian paints, ``W^T onehot(mask)``.

Targets are constant on masks, so this sparse matrix carries vectors of any length from photographs onto
Gaussians. It is kept view by view, as pairs sorted by Gaussian, in memory or in files, and read block by
block: what is held at a time does not grow with the number of photographs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LabelView, LiftingRasterizer, LiftingView
from langsplat_core.scene import LEVELS, Camera, Gaussians
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language.mask_groups import MaskGroups

MIN_WEIGHT = 1e-3  # a Gaussian's weight in a mask, in pixels, below which the pair is not stored
BLOCK = 16_384  # Gaussians handled at a time
PAIR = np.dtype([("row", "<u4"), ("mask", "<u2"), ("level", "<u2"), ("weight", "<f4")])


@dataclass(frozen=True, eq=False)
class Memberships:
    """How strongly `count` Gaussians belong to the masks of all views."""

    pairs: Sequence[Array]  # of each view, of type PAIR, by rising row: Gaussian, mask, its level, pixels
    count: int

    @property
    def blocks(self) -> list[tuple[int, int]]:
        """First Gaussian, and the one after the last, of every block."""
        return [(first, min(first + BLOCK, self.count)) for first in range(0, self.count, BLOCK)]

    @cached_property
    def _edges(self) -> list[Array]:
        """Of each view, where each block begins in its pairs, and where the last ends."""
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


def find_memberships(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    chunk: int = 32,
    settings: RasterSettings = INRIA,
    progress: Progress = silent,
) -> Memberships:
    """Of all views, in memory."""
    pairs = []
    for camera, features in views:
        pairs.append(view_pairs(rasterizer, gaussians, camera, features, chunk, settings))
        progress("lifting masks onto the Gaussians", len(pairs) / len(views))
    return Memberships(pairs, len(gaussians))


def view_pairs(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    camera: Camera,
    features: ImageFeatures,
    chunk: int = 32,
    settings: RasterSettings = INRIA,
) -> Array:
    """The pairs of one view, of type PAIR, by rising row.

    Where a backend cannot lift label maps in one walk, `chunk` masks travel through one gather pass.
    """
    if len(features.vectors) == 0:
        return np.zeros(0, PAIR)
    if len(features.vectors) > np.iinfo(PAIR["mask"]).max:
        raise ValueError(f"{camera.name}: {len(features.vectors)} masks; at most 65 535 can be numbered")
    view = rasterizer.view(gaussians, camera, settings)
    weights = _weights_in_masks(view, features, chunk).tocsr()
    pairs = np.empty(weights.nnz, PAIR)
    pairs["row"] = np.repeat(np.arange(weights.shape[0]), np.diff(weights.indptr))
    pairs["mask"] = weights.indices
    pairs["level"] = _row_levels(features)[weights.indices]
    pairs["weight"] = weights.data
    return pairs


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
    levels = np.zeros(len(features.vectors), np.uint16)
    for index, labels in enumerate(features.labels):
        levels[np.unique(labels[labels >= 0])] = index
    return levels
