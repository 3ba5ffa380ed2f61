"""A tile's own memory: sixteen numbers per row and channel, `planes[(row, channel, column)]`, one flat array.

Images are (H, W, C) with the channels of a pixel side by side; here each channel's row is one vector.
"""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper
from langsplat_core.raster.cpu.lanes import Lanes, lanes, store_totals, total
from langsplat_core.raster.cpu.lanes_memory import load, load_four, load_three, store, store_four, store_three
from langsplat_core.raster.cpu.tiles import TILE


def padded(channels: int) -> int:
    """Channels are blended in fours; three take a fourth along, which is zero."""
    return channels + (channels % 4 == 3)


padded_inside = helper(padded)


@helper
def add_weighted(sums: Array, at: int, channels: int, weight: Lanes, x: Array) -> None:
    """sums[at + 16 channel : + 16] += weight x[channel]"""
    fours = channels & ~3
    for channel in range(0, fours, 4):
        store(sums, at, load(sums, at) + weight * x[channel])
        store(sums, at + TILE, load(sums, at + TILE) + weight * x[channel + 1])
        store(sums, at + 2 * TILE, load(sums, at + 2 * TILE) + weight * x[channel + 2])
        store(sums, at + 3 * TILE, load(sums, at + 3 * TILE) + weight * x[channel + 3])
        at += 4 * TILE
    for channel in range(fours, channels):
        store(sums, at, load(sums, at) + weight * x[channel])
        at += TILE


@helper
def write_tile(planes: Array, image: Array, tile: int, columns: int) -> None:
    """That tile (of `columns` in a row of tiles) of (H, W, C) image <- planes[(row, channel, column)]."""
    x0, y0 = tile % columns * TILE, tile // columns * TILE
    height, width, channels = image.shape
    lines = padded_inside(channels)
    fours = channels & ~3 if x0 + TILE <= width else 0
    for row in range(min(TILE, height - y0)):
        first, at = row * lines * TILE, ((y0 + row) * width + x0) * channels
        if channels == 1 and x0 + TILE <= width:
            store(image, at, load(planes, first))
            continue
        if channels == 3 and x0 + TILE <= width:
            a, b, c = load(planes, first), load(planes, first + TILE), load(planes, first + 2 * TILE)
            store_three(image, at, a, b, c)
            continue
        for channel in range(0, fours, 4):
            f = first + channel * TILE
            a, b, c, d = (
                load(planes, f),
                load(planes, f + TILE),
                load(planes, f + 2 * TILE),
                load(planes, f + 3 * TILE),
            )
            store_four(image, at + channel, channels, a, b, c, d)
        for column in range(min(TILE, width - x0)):
            for channel in range(fours, channels):
                image[y0 + row, x0 + column, channel] = planes[first + channel * TILE + column]


@helper
def load_tile(planes: Array, image: Array, tile: int, columns: int) -> None:
    """planes[(row, channel, column)] <- that tile (of `columns` in a row of tiles) of (H, W, C) image; 0
    beyond its border and in the fourth channel of three."""
    x0, y0 = tile % columns * TILE, tile // columns * TILE
    height, width, channels = image.shape
    lines = padded_inside(channels)
    planes[:] = 0
    fours = channels & ~3 if x0 + TILE <= width else 0
    for row in range(min(TILE, height - y0)):
        first, at = row * lines * TILE, ((y0 + row) * width + x0) * channels
        if channels == 3 and x0 + TILE <= width:
            p, q, r = load_three(image, at)
            store(planes, first, p)
            store(planes, first + TILE, q)
            store(planes, first + 2 * TILE, r)
            continue
        for channel in range(0, fours, 4):
            a, b, c, d = load_four(image, at + channel, channels)
            f = first + channel * TILE
            store(planes, f, a)
            store(planes, f + TILE, b)
            store(planes, f + 2 * TILE, c)
            store(planes, f + 3 * TILE, d)
        for column in range(min(TILE, width - x0)):
            for channel in range(fours, channels):
                planes[first + channel * TILE + column] = image[y0 + row, x0 + column, channel]


@helper
def correlate(
    planes: Array, lines: int, weights: Array, low: int, high: int, out: Array, s: int, column: int
) -> None:
    """out[s, column + line] <- sum over rows [low, high) of weights (stored from row `low`) times planes."""
    fours = lines & ~3
    for line in range(0, fours, 4):
        a = b = c = d = lanes(np.float32(0))
        f = (low * lines + line) * TILE
        for row in range(high - low):
            weight = load(weights, row * TILE)
            a = a + weight * load(planes, f)
            b = b + weight * load(planes, f + TILE)
            c = c + weight * load(planes, f + 2 * TILE)
            d = d + weight * load(planes, f + 3 * TILE)
            f += lines * TILE
        store_totals(out, s * out.shape[1] + column + line, a, b, c, d)
    for line in range(fours, lines):
        a = lanes(np.float32(0))
        for row in range(low, high):
            a = a + load(weights, (row - low) * TILE) * load(planes, (row * lines + line) * TILE)
        out[s, column + line] = total(a)
