"""Stages that make no mistake, or known ones, from a procedural room's ground truth."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from assets.making.truth import Truth
from langsplat_core.arrays import Array, unit
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import TextEncoder
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import LEVELS, Camera, Gaussians
from langsplat_core.semantics.masks import LevelMasks, MaskSource
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language.mask_weights import MaskGroups, find_mask_weights

SIDES = (1 / 16, 1 / 8, 1 / 4)  # of the picture's height, at the levels subpart, part, whole


def oracle_vectors(features: ImageFeatures, ids: Array, vectors: Mapping[int, Array]) -> ImageFeatures:
    """`features` as if the encoder had read what most of every region's pixels truly are.

    ids: (3, H, W) truth; vectors: id -> (D,) unit text vector. A region that mostly shows nothing, or
    something without a name, keeps its own vector.
    """
    told = features.vectors.copy()
    for labels, truth in zip(features.labels, ids, strict=True):
        inside = labels >= 0
        pairs, counts = np.unique(np.stack([labels[inside], truth[inside]]), axis=1, return_counts=True)
        for row, number in pairs[:, np.argsort(counts, kind="stable")].T:  # the most frequent comes last
            told[row] = vectors.get(int(number), features.vectors[row])
    return replace(features, vectors=told)


def with_wrong_vectors(features: ImageFeatures, seed: int, share: float = 0.15) -> ImageFeatures:
    """`features` as if the encoder had taken `share` of the regions for another of the same photograph."""
    generator = np.random.default_rng(seed)
    count = len(features.vectors)
    wrong = np.flatnonzero(generator.uniform(size=count) < share)
    vectors = features.vectors.copy()
    vectors[wrong] = features.vectors[generator.integers(max(count, 1), size=len(wrong))]
    return replace(features, vectors=vectors)


def moved_to_pictures(told: Sequence[ImageFeatures], seen: Sequence[ImageFeatures]) -> list[ImageFeatures]:
    """Text vectors moved by one vector, the same for all, to where the encoder puts pictures.

    CLIP's pictures and phrases lie in two separate clouds ("Mind the gap", Liang et al. 2022). Against the
    canonical phrases, which are text, every text vector is right or wrong by more than any picture can be:
    relevancy saturates. What is shifted is the mean of `told`, onto the mean of `seen`; the differences
    between phrases, which are what a perfect embedding has, stay.
    """
    shift = np.concatenate([item.vectors for item in seen]).mean(0)
    shift = shift - np.concatenate([item.vectors for item in told]).mean(0)
    return [replace(item, vectors=unit(item.vectors + shift).astype(np.float32)) for item in told]


def phrase_vectors(truth: Truth, encoder: TextEncoder) -> dict[int, Array]:
    """The text vector of every id's own phrase, such as "handle of the red mug"; ids without one,
    or with words that the encoder was never taught, are left out."""
    names = {number: region.phrase for number, region in truth.regions.items()}
    texts = sorted({text for text in names.values() if text and not encoder.unknown_words(text)})
    known = dict(zip(texts, encoder.encode_texts(texts), strict=True))
    return {number: known[text] for number, text in names.items() if text in known}


def true_labels(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, Array]],
    progress: Progress = silent,
) -> Array:
    """(3, N) int64: the truth id that each Gaussian shows most of, ``argmax W^T onehot(ids)`` over all views.

    views: cameras with their (3, H, W) ids; -1 for Gaussians that none of them shows.
    """
    columns: list[Array] = []
    described = []
    for camera, ids in views:
        rows, numbers = _as_rows(ids)
        described.append((camera, ImageFeatures(rows, np.zeros((len(numbers), 1), np.float32))))
        columns.append(numbers)
    members = find_mask_weights(rasterizer, gaussians, described, progress=progress)
    known, group = np.unique(np.concatenate(columns), return_inverse=True)
    edges = np.cumsum([len(numbers) for numbers in columns])[:-1]
    groups = MaskGroups(tuple(np.split(group.astype(np.int32), edges)), np.zeros((len(known), 1), np.float32))
    result = np.full((len(LEVELS), len(gaussians)), -1, np.int64)
    for number, (first, last) in enumerate(members.blocks):
        weights = members.block(number, groups)
        for level in range(len(LEVELS)):
            at_level = weights[:, level * len(known) : (level + 1) * len(known)].tocsr()
            if at_level.nnz:
                best = np.asarray(at_level.argmax(axis=1)).ravel()
                result[level, first:last] = np.where(np.diff(at_level.indptr) > 0, known[best], -1)
    return result


def _as_rows(ids: Array) -> tuple[Array, Array]:
    """(3, H, W) ids -> the same as rows that count through the levels, and (M,) the id of each row."""
    rows = np.full(ids.shape, -1, np.int32)
    numbers: list[int] = []
    for level, truth in enumerate(ids):
        for number in np.unique(truth[truth >= 0]):
            rows[level][truth == number] = len(numbers)
            numbers.append(int(number))
    return rows, np.array(numbers, np.int64)


class TileMasks(MaskSource):
    """A `semantics.masks.MaskSource` that looks at nothing: a grid of squares at each level."""

    name = "tiles"
    key = json.dumps(["tiles", 1, SIDES])

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """The grids of an image (H, W, 3)."""
        subpart, part, whole = (_grid(image.shape[0], image.shape[1], share) for share in SIDES)
        progress("tiles", 1.0)
        scores = [np.ones(len(masks), np.float32) for masks in (subpart, part, whole)]
        return LevelMasks((subpart, part, whole), (scores[0], scores[1], scores[2]))


def _grid(height: int, width: int, share: float) -> Array:
    """(M, H, W) bool: squares from the upper left; the last ones may be cut off."""
    side = max(round(share * height), 1)
    rows, columns = np.arange(height) // side, np.arange(width) // side
    number = rows[:, None] * (columns[-1] + 1) + columns
    return np.asarray(number == np.arange(number.max() + 1)[:, None, None])
