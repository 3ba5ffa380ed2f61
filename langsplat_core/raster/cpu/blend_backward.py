"""Gradients of blending on the CPU: from an image's gradient to each footprint.

A tile is walked front to back once, as in `walk`, and alpha and T of every row touched are written to
a tape. The tape is then read from its end. With weight w_i = alpha_i T_i, s_i = <image gradient, x_i> +
alpha gradient (per pixel), and behind_i = sum over j > i of w_j s_j,

    d loss / d alpha_i = T_i s_i - behind_i / (1 - alpha_i),

a sum of positive products where s is: nothing is subtracted from a total, T is never divided back.
Alpha at its cap has no gradient. As log2(alpha) is a quadratic in the whitened coordinates (w, v) of
`projection`, a footprint's gradient needs only the moments of q = alpha d loss / d alpha in (w, v).
"""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel
from langsplat_core.raster.cpu.lanes import lanes, reciprocal, store_totals, where_greater
from langsplat_core.raster.cpu.lanes_memory import load, store
from langsplat_core.raster.cpu.planes import correlate, load_tile
from langsplat_core.raster.cpu.tiles import TILE, Tiles, spread
from langsplat_core.raster.cpu.walk import (
    AHEAD,
    CHECK_EVERY,
    PIXELS,
    Cutoffs,
    begin_rows,
    blend_row,
    enter,
    rows_to_blend,
    running_rows,
    start_tile,
)

# Columns of the partial sums (two are unused); the gradient by the values follows them.
Q, QW, QV, QWW, QWV, QVV = range(6)
MOMENTS = 8
_ENTRY = 2 * TILE  # numbers of tape per row: alpha and T
_TAPE = 128 * TILE * _ENTRY  # its first length: 128 Gaussians that fill the tile


@helper
def _grown(tape: Array, used: int) -> Array:
    """The tape, with room for one more Gaussian behind `used` numbers."""
    if used + TILE * _ENTRY <= tape.shape[0]:
        return tape
    longer = np.empty(2 * tape.shape[0], np.float32)
    for n in range(used):
        longer[n] = tape[n]
    return longer


@helper
def _record(
    tile: int, tiles: Tiles, geometry: Array, cutoffs: Cutoffs, state: Array, spans: Array, tape: Array
) -> tuple[Array, int, int]:
    """`walk`, but with a tape that may have to grow on the way; returns it (a longer one where it was full),
    its length and the end of the intersections visited.

    spans[s - first] <- rows [low, high) of each intersection that were blended.
    """
    x, y = tile % tiles.columns * TILE + 0.5, tile // tiles.columns * TILE + 0.5
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    used = 0
    top, bottom = 0, TILE
    for s in range(first, last):
        if (s - first) % CHECK_EVERY == CHECK_EVERY - 1:
            top, bottom = running_rows(state, top, bottom)
            if top >= bottom:
                return tape, used, s
        tape = _grown(tape, used)
        low, high = rows_to_blend(tiles.rows[s], top, bottom)
        spans[s - first, 0], spans[s - first, 1] = low, high
        g = enter(geometry, tiles, s, min(s + AHEAD, last - 1))
        step, peak, w, v, w_step, v_step = begin_rows(g, x, y + low)
        for row in range(low, high):
            added, before = blend_row(state, row * TILE, step + w, peak - v * v, cutoffs)
            w, v = w + w_step, v + v_step
            store(tape, used, added)
            store(tape, used + TILE, before)
            used += _ENTRY
    return tape, used, last


@helper
def _backward_tile(
    tile: int,
    tiles: Tiles,
    geometry: Array,
    values: Array,
    grads: tuple[Array, Array],
    cutoffs: Cutoffs,
    partial: Array,
    tape: Array,
) -> Array:
    """One tile; returns the tape, for the next tile to write over."""
    image_grad, alpha_grad = grads
    height, width, _ = image_grad.shape
    lines, columns = values.shape[1], partial.shape[1]
    left, top = tile % tiles.columns * TILE + 0.5, tile // tiles.columns * TILE + 0.5
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    state = start_tile(tile, tiles, width, height)
    spans = np.zeros((last - first, 2), np.int64)
    tape, used, end = _record(tile, tiles, geometry, cutoffs, state, spans, tape)
    partial[end:last] = 0
    planes, plane = np.empty(PIXELS * lines, np.float32), np.empty(PIXELS, np.float32)
    load_tile(planes, image_grad, tile, tiles.columns)
    load_tile(plane, alpha_grad, tile, tiles.columns)
    weights = np.empty(PIXELS, np.float32)
    behind = state
    behind[:] = 0
    for s in range(end - 1, first - 1, -1):
        low, high = max(spans[s - first, 0], 0), spans[s - first, 1]
        used -= max(high - low, 0) * _ENTRY
        g = enter(geometry, tiles, s, max(s - AHEAD, first))
        x = values[tiles.ranks[s]]
        step, _, offset, v, w_step, v_step = begin_rows(g, left, top + low)
        q0 = qw = qv = qww = qwv = qvv = none = lanes(np.float32(0))
        for row in range(low, high):
            w = step + offset
            at = used + (row - low) * _ENTRY
            alpha, before = load(tape, at), load(tape, at + TILE)
            weight = alpha * before
            store(weights, (row - low) * TILE, weight)
            slope = load(plane, row * TILE)
            for line in range(lines):
                slope = slope + load(planes, (row * lines + line) * TILE) * x[line]
            hidden = load(behind, row * TILE)
            store(behind, row * TILE, hidden + weight * slope)
            q = weight * slope - hidden * alpha * reciprocal(1.0 - alpha)
            q = where_greater(cutoffs.alpha_max, alpha, q, 0.0)
            moved, lifted = q * w, q * v
            q0, qw, qv = q0 + q, qw + moved, qv + lifted
            qww, qwv, qvv = qww + moved * w, qwv + moved * v, qvv + lifted * v
            offset, v = offset + w_step, v + v_step
        store_totals(partial, s * columns, q0, qw, qv, qww)
        store_totals(partial, s * columns + QWV, qwv, qvv, none, none)
        correlate(planes, lines, weights, low, high, partial, s, MOMENTS)
    return tape


@kernel
def backward(
    first: int,
    last: int,
    tiles: Tiles,
    geometry: Array,
    values: Array,
    grads: tuple[Array, Array],
    cutoffs: Cutoffs,
    partial: Array,
) -> None:
    """(M, padded(C)) values in depth order; gradients (H, W, C) and (H, W, 1) by image and alpha; fills
    (I, 8 + padded(C)) partial sums. All float32, for tiles [first, last)."""
    count = tiles.starts.shape[0] - 1
    tape = np.empty(_TAPE, np.float32)
    for i in range(first, last):
        tape = _backward_tile(spread(i, count), tiles, geometry, values, grads, cutoffs, partial, tape)
