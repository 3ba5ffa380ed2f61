"""Relevancies of a phrase at every Gaussian and pixel: each distinct feature is compared once.

A scene with a codebook has few distinct features. Latents of three numbers, as LangSplat's autoencoder makes,
are unit vectors that hardly ever repeat; they are read through a codebook of cells of their sphere, which is
decoded once. Of other codecs every latent is a feature of its own.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.display.displays import gated_mean
from langsplat_core.errors import InputError
from langsplat_core.raster.cpu.rasterizer import TileShares
from langsplat_core.raster.cpu.tiles import PIXELS, TILE
from langsplat_core.raster.protocol import View
from langsplat_core.scene import Camera, CodebookCodec, LanguageField
from langsplat_core.semantics.relevancy import Scale, latent_relevancy, relevancy_of

CELLS = 32_768  # of the sphere, at most: twice as many halve the squared error, and take twice the time
FINEST = 4096  # cells per side of the octahedral map
CHUNK = 16_384  # latents decoded and compared at a time: 32 MB at 512 numbers
TOGETHER = 16  # phrases compared with every feature at a time: 4 bytes each per feature


@dataclass(frozen=True, eq=False)
class Relevancy:
    """Relevancy of a phrase: of K distinct features, from which follows that of N Gaussians."""

    values: Array  # (K + 1,) float32 in [0, 1]; the last, 0, is that of no feature
    features: Array  # (3, N) number of the feature of each Gaussian at each level

    def __call__(self) -> Array:
        """(3, N) float32."""
        found = np.empty(self.features.shape, np.float32)
        flat = self.features.reshape(-1), found.reshape(-1)
        shared_workers().run(_fetch, found.size, self.values, *flat)
        return found

    def of_level(self, level: int, rows: Array | slice = slice(None)) -> Array:
        """(K,) float32 of some Gaussians at a level."""
        return np.asarray(self.values[self.features[level, rows]])


class Lookup:
    """What of the relevancies in a scene does not depend on the phrase."""

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
        for start in range(0, count, CHUNK):
            part = slice(start, start + CHUNK)
            cosines = self._codec.cosines(self._latents[part], scale.texts)
            self._zero[part], self._rate[part] = scale.of(cosines)

    def relevancies(self, phrases: Array) -> Iterator[Relevancy]:
        """Yield the relevancy of each of (Q, D) unit phrase vectors."""
        # A codebook's vectors are there already; what is decoded is decoded a chunk at a time.
        step = CHUNK if self._codec.blends else max(len(self._latents), 1)
        for first in range(0, len(phrases), TOGETHER):
            some = phrases[first : first + TOGETHER]
            values = np.zeros((len(some), len(self._latents) + 1), np.float32)  # the last: no feature
            for start in range(0, len(self._latents), step):
                part = slice(start, min(start + step, len(self._latents)))
                cosines = self._codec.cosines(self._latents[part], some)
                values[:, part] = relevancy_of(cosines, self._zero[part, None], self._rate[part, None]).T
            for row in values:
                yield Relevancy(row, self.features)


@partial(kernel, shapes="values K, codes N, found N")
def _fetch(first: int, last: int, values: Array, codes: Array, found: Array) -> None:
    """Fill rows [first, last) of `found` (3 N,)."""
    for i in range(first, last):
        found[i] = values[codes[i]]


def through_cells(field: LanguageField) -> LanguageField:
    """Return the field with a codebook in place of unit latents of three numbers; another as it is."""
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

    A cell is a square of an octahedral map, as small as leaves at most `most` that some latent lies in, and
    its centre the mean of these. Few latents are a cell each. Relevancies change smoothly over the sphere, so
    that their error falls with the side of a cell.
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
# uncovered pixel decodes to a confident something.


def splatted_relevancy(view: View, relevancy: Array, alpha_gate: float) -> Array:
    """Return (H, W, Q) relevancy in [0, 1] of pixels from (N, Q) of Gaussians; 0 under the gate."""
    total, alpha = view.splat(np.asarray(relevancy, np.float32))
    return gated_mean(total, alpha, alpha_gate)


def decoded_relevancy(
    view: View, field: LanguageField, level: int, phrases: Array, alpha_gate: float
) -> Array:
    """Return (H, W, Q) relevancy of the decoded pixel latents for (Q, D) phrase vectors: the paper's order.

    Raises InputError for a codebook, whose numbers cannot be blended.
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


def peak_pixel(relevancy: Array, window: int) -> tuple[int, int, float]:
    """Return the peak (column, row, value) of a (H, W) map's means over `window` px, edges repeated."""
    height, width = relevancy.shape
    window = max(1, min(window, height, width))
    means = _box_means(plain(relevancy), 0, 0, (height, width), window, (0, height, 0, width))
    row, column, value = _middle_peak(means)
    return int(column), int(row), float(value)


PLANES = 2**17  # of shares of regions in tiles, at most: 128 MB
ROUNDING = 1e-5  # of means of float32 shares, generously


class PeakPixels:
    """Peak pixels in one view of many answers whose relevancy is even over sets of Gaussians.

    The sets' shares in the pixels are blended once; an answer then costs the tiles where its peak may be. A
    mean over pixels is at most the largest relevancy in them, so that these are the tiles around those that
    see a set of at least the peak of any one tile.
    """

    def __init__(self, shares: TileShares, camera: Camera, window: int) -> None:
        """window: as of `peak_pixel`."""
        self._shares, self._averages = shares, shares.shares.mean(1)
        self._size = camera.height, camera.width
        self._window = max(1, min(window, *self._size))

    def of(self, values: Array) -> Array:
        """(Q, L) float32 relevancies >= 0 of the sets -> (Q, 3) float64 columns, rows and values."""
        peaks = np.empty((len(values), 3))
        arguments = self._shares, self._averages, self._size, self._window, plain(values), peaks
        shared_workers().run(_find_peaks, len(values), *arguments)
        return peaks


@kernel
def _find_peaks(
    first: int,
    last: int,
    shares: TileShares,
    averages: Array,
    size: tuple[int, int],
    window: int,
    values: Array,
    peaks: Array,
) -> None:
    """Fill rows [first, last) of `peaks`."""
    columns = (size[1] + TILE - 1) // TILE
    rows, around = (size[0] + TILE - 1) // TILE, (window // 2 + TILE - 1) // TILE
    largest = np.empty(rows * columns, np.float32)
    for q in range(first, last):
        own, lead, highest = values[q], 0, -1.0
        for tile in range(len(largest)):
            largest[tile], mean = 0, 0.0
            for plane in range(shares.starts[tile], shares.starts[tile + 1]):
                value = own[shares.labels[plane]]
                largest[tile] = max(largest[tile], value)
                mean += averages[plane] * value
            if mean > highest:
                lead, highest = tile, mean
        y, x = lead // columns, lead % columns
        _, _, least = _peak_in(shares, own, size, window, (y, y + 1, x, x + 1))
        top, bottom, left, right = rows, 0, columns, 0
        for tile in range(len(largest)):
            if largest[tile] >= least - ROUNDING:
                y, x = tile // columns, tile % columns
                top, bottom = min(top, y - around), max(bottom, y + around + 1)
                left, right = min(left, x - around), max(right, x + around + 1)
        box = max(top, 0), min(bottom, rows), max(left, 0), min(right, columns)
        row, column, value = _peak_in(shares, own, size, window, box)
        peaks[q, 0], peaks[q, 1], peaks[q, 2] = column, row, value


@kernel
def _peak_in(
    shares: TileShares, values: Array, size: tuple[int, int], window: int, box: tuple[int, int, int, int]
) -> tuple[int, int, float]:
    """Return row, column and value of the peak in the tiles of `box`: top, bottom, left, right."""
    columns, rows = (size[1] + TILE - 1) // TILE, (size[0] + TILE - 1) // TILE
    around = (window // 2 + TILE - 1) // TILE
    top, left = max(box[0] - around, 0), max(box[2] - around, 0)
    bottom, right = min(box[1] + around, rows), min(box[3] + around, columns)
    image = np.empty((TILE * (bottom - top), TILE * (right - left)), np.float32)
    mean = np.empty(PIXELS, np.float32)
    for y in range(top, bottom):
        for x in range(left, right):
            mean[:] = 0
            tile = y * columns + x
            for plane in range(shares.starts[tile], shares.starts[tile + 1]):
                value, share = values[shares.labels[plane]], shares.shares[plane]
                for n in range(PIXELS):
                    mean[n] += value * share[n]
            at = TILE * (y - top), TILE * (x - left)
            image[at[0] : at[0] + TILE, at[1] : at[1] + TILE] = mean.reshape(TILE, TILE)
    y0, x0 = TILE * box[0], TILE * box[2]
    region = y0, min(TILE * box[1], size[0]), x0, min(TILE * box[3], size[1])
    row, column, value = _middle_peak(_box_means(image, TILE * top, TILE * left, size, window, region))
    return y0 + row, x0 + column, value


@kernel
def _box_means(
    part: Array, top: int, left: int, size: tuple[int, int], window: int, box: tuple[int, int, int, int]
) -> Array:
    """Return float64 means over `window` px, edges repeated, of the pixels in `box` of an image of `size`.

    part: the image from row `top` and column `left` on, as far as it is needed.
    """
    y0, y1, x0, x1 = box
    before, after = window // 2, window - 1 - window // 2
    means, sums, scale = np.empty((y1 - y0, x1 - x0)), np.zeros(part.shape[1]), 1 / window**2
    running = np.zeros(x1 - x0 + window)
    for y in range(y0, y1):
        if y == y0:
            for other in range(y - before, y + after + 1):
                sums += part[min(max(other, 0), size[0] - 1) - top]
        else:
            new, old = part[min(y + after, size[0] - 1) - top], part[max(y - before - 1, 0) - top]
            for x in range(len(sums)):
                sums[x] += np.float64(new[x]) - np.float64(old[x])
        for n in range(1, len(running)):
            column = min(max(x0 - before + n - 1, 0), size[1] - 1)
            running[n] = running[n - 1] + sums[column - left]
        for x in range(x1 - x0):
            means[y - y0, x] = (running[x + window] - running[x]) * scale
    return means


@partial(kernel, fastmath={"nnan", "nsz", "reassoc"})
def _highest_of_rows(means: Array) -> Array:
    """(H, W) -> (H,); a loop of its own, which runs in lanes."""
    highest = np.empty(len(means))
    for y in range(len(means)):
        top = means[y, 0]
        for x in range(means.shape[1]):
            top = means[y, x] if means[y, x] > top else top
        highest[y] = top
    return highest


@kernel
def _middle_peak(means: Array) -> tuple[int, int, float]:
    """Return row, column and value of the highest pixel, of those as high the middle one.

    Which is higher by its last digits follows from the unit of lengths.
    """
    highest = _highest_of_rows(means)
    least = highest.max() - 1e-6
    high = [y for y in range(len(means)) if highest[y] >= least]
    count = rows = columns = 0
    for y in high:
        for x in range(means.shape[1]):
            if means[y, x] >= least:
                count, rows, columns = count + 1, rows + y, columns + x
    nearest, row, column = np.inf, 0, 0
    for y in high:
        for x in range(means.shape[1]):
            far = (y - rows / count) ** 2 + (x - columns / count) ** 2
            if means[y, x] >= least and far < nearest:
                nearest, row, column = far, y, x
    return row, column, means[row, column]
