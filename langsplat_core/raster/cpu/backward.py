"""Gradients of blending on the CPU: from an image's gradient to each footprint.

A tile is walked front to back once, as in `walk`, and alpha and T of every row touched are written to
a tape. The tape is then read from its end. With weight w_i = alpha_i T_i, s_i = <image gradient, x_i> +
alpha gradient (per pixel), and behind_i = sum over j > i of w_j s_j,

    d loss / d alpha_i = T_i s_i - behind_i / (1 - alpha_i),

a sum of positive products where s is: nothing is subtracted from a total, T is never divided back.
Alpha at its cap has no gradient. As log2(alpha) is a quadratic in the whitened coordinates (w, v) of
`projection`, a footprint's gradient needs only the moments of q = alpha d loss / d alpha in (w, v).
"""

from typing import Any, NamedTuple

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel
from langsplat_core.raster.cpu import lanes as ln
from langsplat_core.raster.cpu import projection as cp
from langsplat_core.raster.cpu import tiles as tiling
from langsplat_core.raster.cpu.tiles import PIXELS, TILE, Tiles

# Columns of the partial sums (two are unused); the gradient by the values follows them.
Q, QW, QV, QWW, QWV, QVV = range(6)
MOMENTS = 8
_ENTRY = 2 * TILE  # numbers of tape per row: alpha and T
_TAPE = 128 * TILE * _ENTRY  # its first length: 128 Gaussians that fill the tile


@helper
def _record(tile: int, tiles: Tiles, state: Array, spans: Array, tape: Array) -> tuple[Array, int, int]:
    """`walk`, but with a tape that may have to grow on the way.

    Returns it (a longer one where it was full), its length and the end of the intersections visited.

    spans[s - first] <- rows [low, high) of each intersection that were blended; none where no pixel got any
    weight, and nothing on the tape.
    """
    x, y = tile % tiles.columns * TILE + 0.5, tile // tiles.columns * TILE + 0.5
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    used, rows = 0, np.empty(3 * TILE, np.float32)
    top, bottom = 0, TILE
    for s in range(first, last):
        if (s - first) % tiling.CHECK_EVERY == tiling.CHECK_EVERY - 1:
            top, bottom = tiling.running_rows(state, top, bottom)
            if top >= bottom:
                return tape, used, s
        if used + TILE * _ENTRY > tape.shape[0]:
            tape = tiling.grown(tape, used)
        low, high = tiling.rows_to_blend(tiles, s, top, bottom)
        rank, _ = tiling.enter(tiles, s, min(s + tiling.AHEAD, last - 1))
        steps = tiling.begin_rows(tiles.geometry[rank], x, y + low, rows)
        start, most = used, ln.lanes(np.float32(0))
        for row in range(low, high):
            w, peak = steps + rows[row - low], rows[TILE + row - low]
            added, before = tiling.blend_row(state, row * TILE, w, peak, tiles.cutoffs)
            ln.store(tape, used, added)
            ln.store(tape, used + TILE, before)
            most = ln.where_at_least(added, most, added, most)
            used += _ENTRY
        if ln.largest(most) > 0:
            spans[s - first, 0], spans[s - first, 1] = low, high
        else:
            used = start
    return tape, used, last


@kernel
def backward(
    first: int,
    last: int,
    tiles: Tiles,
    values: Array,
    grads: tuple[Array, Array],
    partial: Array,
    reached: Array,
) -> None:
    """Pull gradients (H, W, C) by the image and (H, W, 1) by alpha back; values: (M, C) in depth order.

    Fills (I,) bool `reached`, and (I, 8 + padded(C)) partial sums where that is True. float32, for tiles
    [first, last).
    """
    image_grad, alpha_grad = grads
    channels, columns = values.shape[1], partial.shape[1]
    lines = tiling.padded_inside(channels)
    tape = np.empty(_TAPE, np.float32)
    for i in range(first, last):
        tile = tiling.tile_at(i, tiles)
        left, top = tile % tiles.columns * TILE + 0.5, tile // tiles.columns * TILE + 0.5
        start, stop = tiles.starts[tile], tiles.starts[tile + 1]
        state = tiling.start_tile(tile, tiles)
        spans = np.zeros((stop - start, 2), np.int64)
        tape, used, end = _record(tile, tiles, state, spans, tape)
        reached[end:stop] = False
        planes, plane = np.empty(PIXELS * lines, np.float32), np.empty(PIXELS, np.float32)
        tiling.load_tile(planes, image_grad, tile, tiles)
        tiling.load_tile(plane, alpha_grad, tile, tiles)
        weights, at_row = np.empty(PIXELS, np.float32), np.empty(3 * TILE, np.float32)
        behind = state
        behind[:] = 0
        for s in range(end - 1, start - 1, -1):
            low, high = spans[s - start, 0], spans[s - start, 1]
            reached[s] = low < high
            if low >= high:
                continue
            used -= (high - low) * _ENTRY
            rank, _ = tiling.enter(tiles, s, max(s - tiling.AHEAD, start))
            x = values[rank]
            steps = tiling.begin_rows(tiles.geometry[rank], left, top + low, at_row)
            q0 = qw = qv = qww = qwv = qvv = none = ln.lanes(np.float32(0))
            for row in range(low, high):
                w, v = steps + at_row[row - low], at_row[2 * TILE + row - low]
                at = used + (row - low) * _ENTRY
                alpha, before = ln.load(tape, at), ln.load(tape, at + TILE)
                weight = alpha * before
                ln.store(weights, (row - low) * TILE, weight)
                slope = ln.load(plane, row * TILE)
                for line in range(channels):
                    slope = slope + ln.load(planes, (row * lines + line) * TILE) * x[line]
                hidden = ln.load(behind, row * TILE)
                ln.store(behind, row * TILE, hidden + weight * slope)
                q = weight * slope - hidden * alpha / (1.0 - alpha)
                q = ln.where_at_least(alpha, tiles.cutoffs.alpha_max, 0.0, q)
                moved, lifted = q * w, q * v
                q0, qw, qv = q0 + q, qw + moved, qv + lifted
                qww, qwv, qvv = qww + moved * w, qwv + moved * v, qvv + lifted * v
            ln.store_totals(partial, s * columns, q0, qw, qv, qww)
            ln.store_totals(partial, s * columns + QWV, qwv, qvv, none, none)
            tiling.correlate(planes, lines, weights, low, high, partial, s, MOMENTS)


# Gradients of the CPU backend, second half: from a footprint back to the Gaussian's parameters.


class GaussianGradients(NamedTuple):
    """Gradient of a scalar by every parameter of N Gaussians, float32; 0 for those that are not drawn."""

    means: Array  # (N, 3) per world unit
    log_scales: Array  # (N, 3)
    quats_wxyz: Array  # (N, 4) by the unnormalised quaternion
    opacity_logits: Array  # (N,)
    values: Array  # (N, C)
    means_px: Array  # (N, 2) per pixel, by the 2D mean alone (densification watches its length)


class Sums(NamedTuple):
    """Gradients that `backward` left of the M Gaussians that are drawn."""

    rank_of: Array  # (N,) int32 place in depth order of every row, -1 where it is not drawn
    partial: Array  # (I, 8 + padded(C))
    reached: Array  # (I,) bool


@helper
def _fetch(i: int, last: int, tiles: Tiles, sums: Sums) -> None:
    """Ask for the memory of rows after `i`, in steps: each needs what the one before brought."""
    rank = sums.rank_of[min(i + 3 * tiling.AHEAD, last - 1)]
    if rank >= 0:
        ln.prefetch(tiles.firsts, np.int64(rank))
        ln.prefetch(tiles.geometry, np.int64(rank) * cp.COLUMNS)
    rank = sums.rank_of[min(i + 2 * tiling.AHEAD, last - 1)]
    if rank >= 0:
        ln.prefetch(tiles.slots, tiles.firsts[rank])
    rank = sums.rank_of[min(i + tiling.AHEAD, last - 1)]
    if rank >= 0:
        for n in range(tiles.firsts[rank], min(tiles.firsts[rank + 1], tiles.firsts[rank] + 4)):
            if sums.reached[tiles.slots[n]]:
                ln.prefetch(sums.partial, np.int64(tiles.slots[n]) * sums.partial.shape[1])


@helper
def _add_up(rank: int, tiles: Tiles, sums: Sums, out: Array) -> bool:
    """Add up the rank's partial sums into `out`, in the order of its tiles; False where there are none."""
    some = False
    for n in range(tiles.firsts[rank], tiles.firsts[rank + 1]):
        slot = tiles.slots[n]
        if sums.reached[slot]:
            for k in range(out.shape[0]):
                out[k] = sums.partial[slot, k] + (out[k] if some else 0.0)
            some = True
    return some


@helper
def _clear(i: int, out: GaussianGradients) -> None:
    out.means[i] = 0
    out.log_scales[i] = 0
    out.quats_wxyz[i] = 0
    out.opacity_logits[i] = 0
    out.values[i] = 0
    out.means_px[i] = 0


@helper
def _footprint_gradient(g: Array, moments: Array) -> tuple[float, float, cp.Point]:
    """Gradient by the 2D mean, and by the 2D covariance (a symmetric matrix's xx, xy, yy).

    With M = [[a, -a k], [0, c]] and u = (w, v) = M (pixel - mean):
    ln alpha = const - ln2 |u|^2, so d/d mean = 2 ln2 M^T u and d/d cov = 2 ln2^2 M^T u u^T M.
    """
    a, b, c = g[cp.FACTOR_A], -g[cp.FACTOR_A] * g[cp.FACTOR_K], g[cp.FACTOR_C]
    ww, wv, vv = moments[QWW], moments[QWV], moments[QVV]
    twice = 2 * cp.LN2
    scale = twice * cp.LN2
    return (
        twice * a * moments[QW],
        twice * (b * moments[QW] + c * moments[QV]),
        (
            scale * a * a * ww,
            scale * a * (b * ww + c * wv),
            scale * (b * b * ww + 2 * b * c * wv + c * c * vv),
        ),
    )


@helper
def _with_compensation(by_covariance: cp.Point, a: Array, camera: cp.KernelCamera, q: float) -> cp.Point:
    """Add the gradient of the factor sqrt(det fitted / det dilated) to that by the covariance."""
    xx, xy, yy, det, fitted = cp.covariance(a, camera.dilation, camera.fitted)
    if camera.fitted >= camera.dilation or fitted / det <= cp.COMPENSATION_MIN:
        return by_covariance
    gxx, gxy, gyy = by_covariance
    half = 0.5 * q
    more = camera.dilation - camera.fitted
    return (
        gxx + half * ((yy - more) / fitted - yy / det),
        gxy + half * (xy / det - xy / fitted),
        gyy + half * ((xx - more) / fitted - xx / det),
    )


@helper
def _quat_gradient(quat: Array, inverse: float, d: Array, out: Array) -> None:
    """Fill `out`, the gradient by the raw quaternion, from `d`, that by its rotation matrix."""
    w, x, y, z = quat[0] * inverse, quat[1] * inverse, quat[2] * inverse, quat[3] * inverse
    xy, xz, yz = d[0, 1] + d[1, 0], d[0, 2] + d[2, 0], d[1, 2] + d[2, 1]
    by_x, by_y, by_z = d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]  # by the axis of the turn
    gw = 2 * (z * by_z + y * by_y + x * by_x)
    gx = 2 * (y * xy + z * xz + w * by_x - 2 * x * (d[1, 1] + d[2, 2]))
    gy = 2 * (x * xy + z * yz + w * by_y - 2 * y * (d[0, 0] + d[2, 2]))
    gz = 2 * (x * xz + y * yz + w * by_z - 2 * z * (d[0, 0] + d[1, 1]))
    along = gw * w + gx * x + gy * y + gz * z
    out[0], out[1] = (gw - along * w) * inverse, (gx - along * x) * inverse
    out[2], out[3] = (gy - along * y) * inverse, (gz - along * z) * inverse


@helper
def _point_gradient(point: cp.Point, camera: cp.KernelCamera, du: float, dv: float, db: Array) -> cp.Point:
    """Gradient by the camera-space point from those by its pixel and by B = J R (two rows).

    A clamped coordinate is a constant multiple of z in the Jacobian, so it gets no gradient there.
    """
    if camera.orthographic:
        return du * camera.fx, dv * camera.fy, 0.0
    x, y, z = point
    r = camera.rotation
    j00 = db[0, 0] * r[0, 0] + db[0, 1] * r[0, 1] + db[0, 2] * r[0, 2]
    j02 = db[0, 0] * r[2, 0] + db[0, 1] * r[2, 1] + db[0, 2] * r[2, 2]
    j11 = db[1, 0] * r[1, 0] + db[1, 1] * r[1, 1] + db[1, 2] * r[1, 2]
    j12 = db[1, 0] * r[2, 0] + db[1, 1] * r[2, 1] + db[1, 2] * r[2, 2]
    sx, sy = camera.fx / (z * z), camera.fy / (z * z)
    tx, ty = min(max(x / z, -camera.left), camera.right), min(max(y / z, -camera.top), camera.bottom)
    dx, dy = du * camera.fx / z, dv * camera.fy / z
    dz = -du * sx * x - dv * sy * y - j00 * sx - j11 * sy + j02 * sx * tx + j12 * sy * ty
    if tx == x / z:
        dx -= j02 * sx
        dz += j02 * sx * tx
    if ty == y / z:
        dy -= j12 * sy
        dz += j12 * sy * ty
    return dx, dy, dz


@helper
def _doubles(row: Array) -> cp.Point:
    return np.float64(row[0]), np.float64(row[1]), np.float64(row[2])


@helper
def _axes_gradient(
    matrices: Any, scales: cp.Point, by_covariance: cp.Point, by_turn: Array, by_b: Array, by_log_scale: Array
) -> None:
    """Pull the covariance's gradient G back: A = B turn diag(s) gets 2 G A, then B, turn and log(s)."""
    turn, b, a = matrices
    gxx, gxy, gyy = by_covariance
    by_b[:] = 0
    for k in range(3):
        d0, d1 = 2 * (gxx * a[0][k] + gxy * a[1][k]), 2 * (gxy * a[0][k] + gyy * a[1][k])
        by_log_scale[k] = d0 * a[0][k] + d1 * a[1][k]
        d0, d1 = d0 * scales[k], d1 * scales[k]
        for m in range(3):
            by_turn[m, k] = b[0][m] * d0 + b[1][m] * d1
            by_b[0, m] += d0 * turn[m][k]
            by_b[1, m] += d1 * turn[m][k]


@kernel
def to_parameters(
    first: int,
    last: int,
    tiles: Tiles,
    sums: Sums,
    rows: cp.Rows,
    camera: cp.KernelCamera,
    out: GaussianGradients,
) -> None:
    """Fill `out` for rows [first, last).

    Sums what `backward` left, in the order of the tiles, and pulls the moments back through the projection.
    """
    added = np.empty(sums.partial.shape[1])
    moments = added[:MOMENTS]
    by_b, by_turn = np.empty((2, 3)), np.empty((3, 3))
    r = camera.rotation
    for i in range(first, last):
        _fetch(i, last, tiles, sums)
        rank = sums.rank_of[i]
        if rank < 0 or not _add_up(rank, tiles, sums, added):
            _clear(i, out)
            continue
        out.values[i] = added[MOMENTS : MOMENTS + out.values.shape[1]]
        du, dv, by_covariance = _footprint_gradient(tiles.geometry[rank], moments)
        out.means_px[i, 0], out.means_px[i, 1] = du, dv
        out.opacity_logits[i] = moments[Q] / (1 + np.exp(np.float64(rows.opacity_logits[i])))
        point = cp.camera_point(_doubles(rows.means[i]), camera)
        s0, s1, s2 = _doubles(rows.log_scales[i])
        scales, quat = (np.exp(s0), np.exp(s1), np.exp(s2)), rows.quats_wxyz[i]
        q0, q1, q2 = _doubles(quat)
        inverse, turn, b, a = cp.axes(point, scales, (q0, q1, q2, np.float64(quat[3])), camera)
        by_covariance = _with_compensation(by_covariance, a, camera, moments[Q])
        _axes_gradient((turn, b, a), scales, by_covariance, by_turn, by_b, out.log_scales[i])
        dx, dy, dz = _point_gradient(point, camera, du, dv, by_b)
        for n in range(3):
            out.means[i, n] = dx * r[0, n] + dy * r[1, n] + dz * r[2, n]
        _quat_gradient(rows.quats_wxyz[i], inverse, by_turn, out.quats_wxyz[i])
