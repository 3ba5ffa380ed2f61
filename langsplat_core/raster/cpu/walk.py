"""The walk over a tile that every operation shares: its Gaussians front to back, of each the rows it touches.

What an operation does on the way is given as three helpers, compiled into the walk:

    open_(work, s, later)          before the rows of intersection s; its result is handed to the next two
    row_(work, mine, s, at, low, added, before)
                                   at a row `at` of rows from `low`: alpha (0 where not added) and T before it
    close_(work, mine, s, low, high)  after rows [low, high)

A row is sixteen lanes, without branches. A tile's state is one flat float32 array, sixteen numbers a row. A
pixel's transmittance is stored negative once the pixel has stopped: its size stays readable, and
`T - alpha T > transmittance_min` is then false for every later Gaussian.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper
from langsplat_core.config import RasterSettings
from langsplat_core.raster.cpu import projection as cp
from langsplat_core.raster.cpu.lanes import (
    Lanes,
    exp2,
    largest,
    ramp,
    smaller,
    where_at_least,
    where_greater,
)
from langsplat_core.raster.cpu.lanes_memory import load, prefetch, store
from langsplat_core.raster.cpu.tiles import TILE, Tiles, unpack_span

AHEAD = 8  # intersections between asking for a footprint and using it
CHECK_EVERY = 16  # Gaussians between two looks at whether a tile still has running pixels
PIXELS = TILE * TILE


class Cutoffs(NamedTuple):
    """The constants of step 3 and 4 of `reference.py`."""

    alpha_min: float
    alpha_max: float
    transmittance_min: float


def make_cutoffs(settings: RasterSettings) -> Cutoffs:
    """The settings as kernels take them."""
    return Cutoffs(float(settings.alpha_min), float(settings.alpha_max), float(settings.transmittance_min))


@helper
def start_tile(tile: int, tiles: Tiles, width: int, height: int) -> Array:
    """A tile's transmittance: 1 inside the image; pixels beyond its border have stopped already."""
    x0, y0 = tile % tiles.columns * TILE, tile // tiles.columns * TILE
    transmittance = np.empty(PIXELS, np.float32)
    for row in range(TILE):
        for column in range(TILE):
            inside = (x0 + column < width) & (y0 + row < height)
            transmittance[row * TILE + column] = 1.0 if inside else -1.0
    return transmittance


@helper
def running_rows(transmittance: Array, low: int, high: int) -> tuple[int, int]:
    """Shrink rows [low, high) to those that begin and end with a row that has a running pixel."""
    while low < high and largest(load(transmittance, low * TILE)) <= 0:
        low += 1
    while low < high and largest(load(transmittance, (high - 1) * TILE)) <= 0:
        high -= 1
    return low, high


@helper
def rows_to_blend(packed: int, top: int, bottom: int) -> tuple[int, int]:
    """The rows of a packed span that are within the running rows [top, bottom)."""
    low, high = unpack_span(packed)
    return max(low, top), min(high, bottom)


@helper
def enter(geometry: Array, tiles: Tiles, s: int, later: int) -> Array:
    """The footprint of intersection `s`; that of `later` is asked for, as memory is far away."""
    prefetch(geometry, np.int64(tiles.ranks[later]) * cp.COLUMNS)
    return geometry[tiles.ranks[s]]


@helper
def begin_rows(g: Array, x: float, y: float) -> tuple[Lanes, float, float, float, float, float]:
    """For rows whose first pixel centre is (x, y): of sixteen pixels the steps in w (see `projection`);
    the log2 of the peak alpha; w and v at (x, y), and what a step of one row adds to them.

    float64: across a long thin footprint w is the small difference of large numbers.
    """
    dy = y - g[cp.MEAN_Y]
    skew = g[cp.FACTOR_A] * g[cp.FACTOR_K]
    w, v = g[cp.FACTOR_A] * (x - g[cp.MEAN_X]) - skew * dy, g[cp.FACTOR_C] * dy
    return ramp() * g[cp.FACTOR_A], g[cp.LOG2_OPACITY], w, v, -skew, g[cp.FACTOR_C]


@helper
def blend_row(
    transmittance: Array, at: int, w: Lanes, log2_height: float, cutoffs: Cutoffs
) -> tuple[Lanes, Lanes]:
    """Step 3 and 4 for one row: returns alpha (0 where the Gaussian is not added) and T before it.

    All sixteen lanes are stored: a masked store would stall the next Gaussian's load of the same row.
    """
    before = load(transmittance, at)
    alpha = smaller(exp2(log2_height - w * w), cutoffs.alpha_max)
    alpha = where_at_least(alpha, cutoffs.alpha_min, alpha, 0.0)
    after = before - alpha * before
    stopped = smaller(before, 0.0 - before)
    store(transmittance, at, where_greater(after, cutoffs.transmittance_min, after, stopped))
    return where_greater(after, cutoffs.transmittance_min, alpha, 0.0), before


@helper
def walk(
    tile: int,
    tiles: Tiles,
    geometry: Array,
    cutoffs: Cutoffs,
    transmittance: Array,
    work: Any,
    open_: Callable[..., Any],
    row_: Callable[..., None],
    close_: Callable[..., None],
) -> int:
    """Blend the tile, changing its `transmittance`; returns the end of the intersections visited, which comes
    early where no pixel runs any more."""
    x, y = tile % tiles.columns * TILE + 0.5, tile // tiles.columns * TILE + 0.5
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    top, bottom = 0, TILE
    for s in range(first, last):
        if (s - first) % CHECK_EVERY == CHECK_EVERY - 1:
            top, bottom = running_rows(transmittance, top, bottom)
            if top >= bottom:
                return s
        low, high = rows_to_blend(tiles.rows[s], top, bottom)
        later = min(s + AHEAD, last - 1)
        g = enter(geometry, tiles, s, later)
        mine = open_(work, s, later)
        step, peak, w, v, w_step, v_step = begin_rows(g, x, y + low)
        for row in range(low, high):
            added, before = blend_row(transmittance, row * TILE, step + w, peak - v * v, cutoffs)
            w, v = w + w_step, v + v_step
            row_(work, mine, s, row, low, added, before)
        close_(work, mine, s, low, high)
    return last


@helper
def nothing_to_open(work: Any, s: int, later: int) -> int:
    """For operations that keep nothing per intersection."""
    return 0


@helper
def nothing_to_close(work: Any, mine: Any, s: int, low: int, high: int) -> None:
    """For operations that are done with an intersection after its last row."""
