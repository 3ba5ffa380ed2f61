"""Relevancies of a phrase at every Gaussian and pixel: each distinct feature is compared once.

A scene with a codebook has few distinct features. Latents of three numbers, as LangSplat's autoencoder makes,
hardly ever repeat: cells of their sphere are decoded once. Else every distinct latent is a feature.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from langsplat_core.arrays import Array, pieces, unit
from langsplat_core.compiled import kernel, shared_workers
from langsplat_core.errors import InputError
from langsplat_core.raster.protocol import View
from langsplat_core.scene import CodebookCodec, LanguageField
from langsplat_core.semantics.relevancy import Scale, latent_relevancy, relevancy_of

CELLS = 32_768  # of the sphere, at most: twice as many halve the squared error and double the time
FINEST = 4096  # cells per side of the octahedral map
CHUNK = 16_384  # latents decoded and compared at a time: 32 MB at 512 numbers
TOGETHER = 16  # phrases compared with every feature at a time: 4 bytes each per feature


@dataclass(frozen=True, eq=False)
class Relevancy:
    """Relevancy of a phrase at K distinct features, and which of them each of N Gaussians has."""

    values: Array  # (K + 1,) float32 in [0, 1]; the last, 0, is for Gaussians without a feature
    features: Array  # (3, N) number of the feature of each Gaussian at each level

    def __call__(self) -> Array:
        """Return the (3, N) float32 relevancy of the Gaussians."""
        found = np.empty(self.features.shape, np.float32)
        flat = self.features.reshape(-1), found.reshape(-1)
        shared_workers().run(_fetch, found.size, self.values, *flat)
        return found


class Lookup:
    """Part of the relevancies in a scene that does not depend on the phrase."""

    def __init__(self, field: LanguageField, scale: Scale) -> None:
        """Compare every distinct feature with the phrases of the scale."""
        self._codec = field.codec
        self._latents, of = field.codec.unique(field.latents.reshape(-1, field.latents.shape[-1]))
        count = len(self._latents)
        kind = np.uint16 if count <= np.iinfo(np.uint16).max else np.uint32
        # (3, N) number of the feature of each Gaussian and level, `count` for none.
        self.features = np.where(field.known, of.reshape(field.known.shape), count).astype(kind)
        self.count = count
        self._zero, self._rate = np.empty(count, np.float32), np.empty(count, np.float32)
        for part in pieces(count, CHUNK):
            cosines = self._codec.cosines(self._latents[part], scale.texts)
            self._zero[part], self._rate[part] = scale.of(cosines)

    def relevancies(self, phrases: Array) -> Iterator[Relevancy]:
        """Yield the relevancy of each of (Q, D) unit phrase vectors."""
        # The vectors of a codebook are in memory; latents are decoded a chunk at a time.
        step = CHUNK if self._codec.blends else max(len(self._latents), 1)
        for first in range(0, len(phrases), TOGETHER):
            some = phrases[first : first + TOGETHER]
            values = np.zeros((len(some), len(self._latents) + 1), np.float32)  # the last: no feature
            for part in pieces(len(self._latents), step):
                cosines = self._codec.cosines(self._latents[part], some)
                found = relevancy_of(cosines, self._zero[part, None], self._rate[part, None])
                values[:, :-1][:, part] = found.T
            for row in values:
                yield Relevancy(row, self.features)


@partial(kernel, shapes="values K, codes N, found N")
def _fetch(first: int, last: int, values: Array, codes: Array, found: Array) -> None:
    """Fill rows [first, last) of `found` (3 N,)."""
    for i in range(first, last):
        found[i] = values[codes[i]]


def through_cells(field: LanguageField) -> LanguageField:
    """Return the field with a codebook in place of unit latents of three numbers; other fields unchanged."""
    if not (field.codec.unit_latents and field.codec.latent_dim == 3):
        return field
    known = field.known
    latents = field.latents[known] if known.any() else np.array([[0, 0, 1]], np.float32)
    cells, centres = sphere_cells(latents)
    codes = np.zeros((*known.shape, 1), np.uint16)
    codes[known, 0] = cells[: known.sum()]
    codec = CodebookCodec(field.codec.decode(centres), np.zeros((len(centres), 3), np.float32))
    confidence = np.where(known, field.confidence, np.float32(0))
    return replace(field, latents=codes, confidence=confidence, codec=codec)


def sphere_cells(latents: Array, most: int = CELLS) -> tuple[Array, Array]:
    """Divide (M, 3) non-zero latents among at most `most` cells: (M,) numbers, (K, 3) float32 unit centres.

    A cell is a square of an octahedral map, as small as `most` filled cells allow; its centre is the mean of
    its latents. Up to `most` latents are a cell each. The error of relevancies falls with a cell's side.
    """
    directions = unit(latents.astype(np.float64), 1e-30)
    if len(directions) <= most:
        return np.arange(len(directions)), directions.astype(np.float32)
    # The sphere is projected onto an octahedron, whose lower half is folded out into the square's corners.
    scaled = directions / np.abs(directions).sum(-1, keepdims=True)
    upper, z = scaled[:, :2], scaled[:, 2:]
    lower = (1 - np.abs(upper[:, ::-1])) * np.where(upper >= 0, 1, -1)
    square = (np.where(z < 0, lower, upper) + 1) / 2

    def numbers(side: int) -> Array:
        columns, rows = np.minimum((square * side).astype(np.int64), side - 1).T
        return rows * side + columns

    def used(side: int) -> Array:
        filled = np.zeros(side * side, bool)
        filled[numbers(side)] = True
        return filled

    fits, fails = int(np.sqrt(most)), FINEST + 1
    while fails - fits > max(fits // 128, 1):
        side = (fits + fails) // 2
        fits, fails = (side, fails) if np.count_nonzero(used(side)) <= most else (fits, side)
    cells = (np.cumsum(used(fits)) - 1)[numbers(fits)]
    sums = np.stack([np.bincount(cells, axis) for axis in directions.T], 1)
    return cells, unit(sums, 1e-30).astype(np.float32)


# Pixels: relevancies of Gaussians are blended, one linear channel per phrase (ours); or latents are blended
# and then decoded (the paper's order, section 3.4). Both are gated by alpha, because the zero latent of an
# uncovered pixel decodes to some unit vector.


def splatted_relevancy(view: View, relevancy: Array, alpha_gate: float) -> Array:
    """Return (H, W, Q) relevancy in [0, 1] of pixels from (N, Q) of Gaussians; 0 below the alpha gate."""
    total, alpha = view.splat(np.asarray(relevancy, np.float32))
    return np.asarray(total / np.where(alpha > alpha_gate, alpha, np.float32(np.inf))[..., None])


def decoded_relevancy(
    view: View, field: LanguageField, level: int, phrases: Array, alpha_gate: float
) -> Array:
    """Return (H, W, Q) relevancy of the decoded pixel latents for (Q, D) phrase vectors: the paper's order.

    Raises InputError for a codebook, whose indices cannot be blended.
    """
    if not field.codec.blends:
        raise InputError(
            f"the paper's order blends latents, and this scene has a {field.codec.kind}; train one with "
            "`--codec.kind autoencoder`"
        )
    blended, alpha = view.splat(field.latents[level])
    latents = np.where(alpha[..., None] > alpha_gate, blended, 0).reshape(-1, blended.shape[2])
    values = latent_relevancy(field.codec, latents, phrases, field.canonical, field.temperature)
    return values.reshape(*alpha.shape, len(phrases))


TIED = 1e-6  # difference of two means up to which they are equal


def peak_pixel(relevancy: Array, window: int) -> tuple[int, int, float]:
    """Return the peak (column, row, value) of a (H, W) map's means over `window` px, edges repeated.

    Of several equal peaks the middle one is taken: their last digits depend on the scene's unit of length.
    """
    size = max(1, min(window, *relevancy.shape))
    means = scipy.ndimage.uniform_filter(np.asarray(relevancy, np.float64), size=size, mode="nearest")
    rows, columns = np.nonzero(means >= means.max() - TIED)
    away = (rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2
    middle = np.lexsort((columns, rows, away))[0]
    row, column = int(rows[middle]), int(columns[middle])
    return column, row, float(means[row, column])
