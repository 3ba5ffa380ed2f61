"""Stages that make no mistake, or known ones, from a procedural room's ground truth."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from assets.making.dataset import Truth
from langsplat_core.arrays import Array, unit
from langsplat_core.query.engine import TextEncoder
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import LEVELS, Camera, Gaussians
from langsplat_core.semantics.features import ImageFeatures
from langsplat_core.training.language.lift import MaskGroups
from tests.support.scenes import find_mask_weights

WRONG = 0.15  # share of masks with another region's vector


def oracle_vectors(features: ImageFeatures, ids: Array, vectors: Mapping[int, Array]) -> ImageFeatures:
    """`features` as if the encoder had read what most of every region's pixels truly are.

    ids: (3, H, W) truth; vectors: id -> (D,) unit text vector. A region that mostly shows nothing, or
    something without a name, keeps its own vector.
    """
    told = features.vectors.copy()
    for labels, truth in zip(features.labels, ids, strict=True):
        for row, number, _ in sorted(overlaps(labels, truth), key=itemgetter(2)):  # the largest comes last
            told[row] = vectors.get(number, features.vectors[row])
    return replace(features, vectors=told)


def overlaps(labels: Array, truth: Array) -> list[tuple[int, int, int]]:
    """(mask, truth id, pixels) of every mask of a level and everything that it shows."""
    inside = labels >= 0
    pairs, counts = np.unique(np.stack([labels[inside], truth[inside]]), axis=1, return_counts=True)
    return list(zip(*pairs.tolist(), counts.tolist(), strict=True))


def with_wrong_vectors(features: ImageFeatures, seed: int) -> ImageFeatures:
    """`features` as if the encoder had taken `WRONG` of the regions for another of the same photograph."""
    generator = np.random.default_rng(seed)
    count = len(features.vectors)
    wrong = np.flatnonzero(generator.uniform(size=count) < WRONG)
    vectors = features.vectors.copy()
    vectors[wrong] = features.vectors[generator.integers(max(count, 1), size=len(wrong))]
    return replace(features, vectors=vectors)


def moved_to_images(told: Sequence[ImageFeatures], seen: Sequence[ImageFeatures]) -> list[ImageFeatures]:
    """Text vectors moved by one vector, the same for all, to where the encoder puts images.

    CLIP's images and phrases lie in two separate clouds ("Mind the gap", Liang et al. 2022). Against the
    canonical phrases, which are text, every text vector is right or wrong by more than any image can be:
    relevancy saturates. What is shifted is the mean of `told`, onto the mean of `seen`; the differences
    between phrases, which are what a perfect embedding has, stay.
    """
    shift = np.concatenate([item.vectors for item in seen]).mean(0)
    shift = shift - np.concatenate([item.vectors for item in told]).mean(0)
    return [replace(item, vectors=unit(item.vectors + shift).astype(np.float32)) for item in told]


def surface_points(
    vertices: Array, triangles: Array, rng: np.random.Generator, *, count: int = 0, density: float = 0.0
) -> Array:
    """(P, 3) points spread evenly over triangles: `count` of them, or `density` on a square unit."""
    a, b, c = (vertices[triangles[:, corner]].astype(np.float64) for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    which = rng.choice(len(areas), count or int(density * areas.sum()), p=areas / areas.sum())
    u, v = rng.random((2, len(which), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.asarray(a[which] + u * (b - a)[which] + v * (c - a)[which])


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
    members = find_mask_weights(rasterizer, gaussians, described)
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
