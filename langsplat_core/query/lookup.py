"""The relevancies of a phrase at every Gaussian: each distinct feature is compared once, then fetched.

A scene with a codebook has few distinct features. Latents of three numbers, as LangSplat's autoencoder makes,
are unit vectors that hardly ever repeat; they are read through a codebook of cells of their sphere, which is
decoded once. Of other codecs every latent is a feature of its own.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import kernel, shared_workers
from langsplat_core.scene import CodebookCodec, LanguageField
from langsplat_core.semantics.relevancy import Scale, relevancy_of

CELLS = 32_768  # of the sphere, at most: twice as many halve the squared error, and take twice the time
CHUNK = 16_384  # latents decoded and compared at a time: 32 MB at 512 numbers
TOGETHER = 16  # phrases compared with every feature at a time: 4 bytes each per feature


class Lookup:
    """What of the relevancies in a scene does not depend on the phrase."""

    def __init__(self, field: LanguageField, scale: Scale) -> None:
        """Compare every distinct feature with the phrases of the scale."""
        self._codec = field.codec
        self._latents, of = field.codec.unique(field.latents.reshape(-1, field.latents.shape[-1]))
        count = len(self._latents)
        kind = np.uint16 if count <= np.iinfo(np.uint16).max else np.uint32
        self._of = np.where(field.known.reshape(-1), of, count).astype(kind)
        self._zero, self._rate = np.empty(count, np.float32), np.empty(count, np.float32)
        for start in range(0, count, CHUNK):
            part = slice(start, start + CHUNK)
            self._zero[part], self._rate[part] = scale.of(
                self._codec.cosines(self._latents[part], scale.texts)
            )

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """Yield of (Q, D) unit phrase vectors each one's (3 N,) float32 relevancies, 0 without a feature."""
        # A codebook's vectors are there already; what is decoded is decoded a chunk at a time.
        step = CHUNK if self._codec.blends else max(len(self._latents), 1)
        for first in range(0, len(phrases), TOGETHER):
            some = phrases[first : first + TOGETHER]
            values = np.zeros((len(some), len(self._latents) + 1), np.float32)  # the last: no feature
            for start in range(0, len(self._latents), step):
                part = slice(start, min(start + step, len(self._latents)))
                cosines = self._codec.cosines(self._latents[part], some)
                zero, rate = self._zero[part, None], self._rate[part, None]
                values[:, part] = relevancy_of(cosines, zero, rate).T
            for row in values:
                found = np.empty(len(self._of), np.float32)
                shared_workers().run(_fetch, len(found), row, self._of, found)
                yield found


@kernel
def _fetch(first: int, last: int, values: Array, codes: Array, found: Array) -> None:
    """Fill rows [first, last) of `found` (3 N,)."""
    for i in range(first, last):
        found[i] = values[codes[i]]


# Cells of the sphere: squares of an octahedral map, as small as leave at most `CELLS` that some latent lies
# in, each read as the mean of the latents in it. Relevancies change smoothly over the sphere, so that the
# error falls with the side of a cell.

FINEST = 4096  # cells per side of the map


def through_cells(field: LanguageField) -> LanguageField:
    """Return the field with a codebook in place of unit latents of three numbers; another as it is."""
    if not field.codec.spherical:
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
    """Divide (M, 3) latents, none of them zero, among at most `most` cells, M and most >= 1.

    Returns the (M,) number of each latent's cell and the (K, 3) float32 unit centres of the cells. Where
    there are no more latents than cells, each is a cell of its own.
    """
    directions = unit(latents.astype(np.float64), 1e-30)
    if len(directions) <= most:
        return np.arange(len(directions)), directions.astype(np.float32)
    square = sphere_to_octahedral(directions)

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


def sphere_to_octahedral(vectors: Array) -> Array:
    """Return the (..., 2) places in [0, 1]^2 of (..., 3) non-zero vectors.

    The sphere is projected onto an octahedron, whose lower half is folded out into the square's corners.
    """
    scaled = vectors / np.abs(vectors).sum(-1, keepdims=True)
    upper, z = scaled[..., :2], scaled[..., 2:]
    lower = (1 - np.abs(upper[..., ::-1])) * np.where(upper >= 0, 1, -1)
    return (np.where(z < 0, lower, upper) + 1) / 2
