"""Gradients of blending on the CPU: from an image's gradient to each footprint.

A tile is walked front to back once, and alpha and T of every row touched are written to a tape, which is
then read from its end. With weight w_i = alpha_i T_i, s_i = <image gradient, x_i> + alpha gradient (per
pixel), and behind_i = sum over j > i of w_j s_j,

    d loss / d alpha_i = T_i s_i - behind_i / (1 - alpha_i),

whose products are positive where s is: nothing is subtracted from a total, and T is never divided out.
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
from langsplat_core.raster.cpu.lanes import Lanes
from langsplat_core.raster.cpu.tiles import PIXELS, TILE, Tiles

# Columns of the partial sums (two are unused); the gradient by the values follows them.
Q, QW, QV, QWW, QWV, QVV = range(6)
MOMENTS = 8
_ENTRY = 2 * TILE  # numbers of tape per row: alpha and T


@helper
def _next_entry(work: Any, rank: int, later: int) -> int:
    """Return where the tape goes on."""
    return work[2][0]


@helper
def _record_row(work: Any, start: int, s: int, row: int, low: int, alpha: Lanes, before: Lanes) -> None:
    at = start + (row - low) * _ENTRY
    ln.store(work[0], at, alpha)
    ln.store(work[0], at + TILE, before)


@helper
def _keep_entry(work: Any, start: int, s: int, low: int, high: int) -> None:
    """Note the rows of an intersection, and keep what is on the tape, if any pixel got weight."""
    tape, spans, used, first = work
    most = ln.lanes(np.float32(0))
    for row in range(high - low):
        most = max(most, ln.load(tape, start + row * _ENTRY))
    if ln.largest(most) > 0:
        spans[s - first, 0], spans[s - first, 1] = low, high
        used[0] = start + (high - low) * _ENTRY


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
    """Pull back gradients by image (H, W, C) and alpha (H, W, 1); values: (M, C) in depth order.

    For tiles [first, last), fill (I,) bool `reached` and, where it is True, (I, 8 + padded(C)) float32
    partial sums.
    """
    image_grad, alpha_grad = grads
    channels, columns = values.shape[1], partial.shape[1]
    lines = tiling.padded_inside(channels)
    # Room for the fullest tile; of memory that is not touched the system takes none.
    tape = np.empty(np.diff(tiles.starts).max() * TILE * _ENTRY, np.float32)
    used = np.zeros(1, np.int64)
    for i in range(first, last):
        tile = tiling.tile_at(i, tiles)
        left, top = tile % tiles.columns * TILE + 0.5, tile // tiles.columns * TILE + 0.5
        start, stop = tiles.starts[tile], tiles.starts[tile + 1]
        spans = np.zeros((stop - start, 2), np.int64)  # rows with weight of each intersection
        used[0] = 0
        work = ln.borrowed((tape, spans, used, start))
        behind, end = tiling.walk(tile, tiles, work, _next_entry, _record_row, _keep_entry)
        behind[:] = 0
        reached[end:stop] = False
        planes, plane = np.empty(PIXELS * lines, np.float32), np.empty(PIXELS, np.float32)
        tiling.load_tile(planes, image_grad, tile, tiles)
        tiling.load_tile(plane, alpha_grad, tile, tiles)
        weights, at_row = np.empty(PIXELS, np.float32), np.empty(3 * TILE, np.float32)
        place = used[0]  # on the tape, read from its end
        for s in range(end - 1, start - 1, -1):
            low, high = spans[s - start, 0], spans[s - start, 1]
            reached[s] = low < high
            if low >= high:
                continue
            place -= (high - low) * _ENTRY
            rank, _ = tiling.enter(tiles, s, max(s - tiling.AHEAD, start))
            x = values[rank]
            steps = tiling.begin_rows(tiles.geometry[rank], left, top + low, at_row)
            q0 = qw = qv = qww = qwv = qvv = none = ln.lanes(np.float32(0))
            for row in range(low, high):
                w, v = steps + at_row[row - low], at_row[2 * TILE + row - low]
                at = place + (row - low) * _ENTRY
                alpha, before = ln.load(tape, at), ln.load(tape, at + TILE)
                weight = alpha * before
                ln.store(weights, (row - low) * TILE, weight)
                slope = ln.load(plane, row * TILE)
                for line in range(channels):
                    slope = slope + ln.load(planes, (row * lines + line) * TILE) * x[line]
                hidden = ln.load(behind, row * TILE)
                ln.store(behind, row * TILE, hidden + weight * slope)
                q = weight * slope - hidden * alpha / (1.0 - alpha)
                q = ln.where_at_least(alpha, tiles.alpha_max, 0.0, q)
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
    """Partial sums that `backward` fills, for the M Gaussians that are drawn."""

    rank_of: Array  # (N,) int32 place in depth order of every row, -1 where it is not drawn
    partial: Array  # (I, 8 + padded(C))
    reached: Array  # (I,) bool


@helper
def _fetch(i: int, last: int, tiles: Tiles, sums: Sums) -> None:
    """Prefetch what rows after `i` need, in three stages: each reads what the one before has loaded."""
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
    """Add the rank's partial sums up in `out`, in the order of its tiles; return False if there are none."""
    some = False
    for n in range(tiles.firsts[rank], tiles.firsts[rank + 1]):
        slot = tiles.slots[n]
        if sums.reached[slot]:
            for k in range(out.shape[0]):
                out[k] = sums.partial[slot, k] + (out[k] if some else 0.0)
            some = True
    return some


# From here on, eight Gaussians at once: scalars are lanes, and vectors tuples of three lanes.


@helper
def _footprint_gradient(g: Array, ranks: Array, added: Array, each: Array) -> Any:
    """Return opacity * d/d opacity and the gradients by 2D mean and covariance (symmetric: xx, xy, yy).

    With M = [[a, -a k], [0, c]] and u = (w, v) = M (pixel - mean):
    ln alpha = const - ln2 |u|^2, so d/d mean = 2 ln2 M^T u and d/d cov = 2 ln2^2 M^T u u^T M.
    """
    a, c = ln.gathered(g, ranks, 0, cp.FACTOR_A), ln.gathered(g, ranks, 0, cp.FACTOR_C)
    b, twice = -a * ln.gathered(g, ranks, 0, cp.FACTOR_K), 2 * cp.LN2
    w, v, ww = (
        ln.gathered(added, each, 0, QW),
        ln.gathered(added, each, 0, QV),
        ln.gathered(added, each, 0, QWW),
    )
    wv, vv = ln.gathered(added, each, 0, QWV), ln.gathered(added, each, 0, QVV)
    scale = twice * cp.LN2
    return (
        ln.gathered(added, each, 0, Q),
        (twice * a * w, twice * (b * w + c * v)),
        (
            scale * a * a * ww,
            scale * a * (b * ww + c * wv),
            scale * (b * b * ww + 2 * b * c * wv + c * c * vv),
        ),
    )


@helper
def _with_compensation(by_covariance: cp.Point, a: Any, camera: cp.KernelCamera, q: Lanes) -> cp.Point:
    """Add the gradient of the factor sqrt(det fitted / det dilated) to that by the covariance."""
    if camera.fitted >= camera.dilation:
        return by_covariance
    xx, xy, yy, det, fitted = cp.covariance(a, camera.dilation, camera.fitted)
    least = cp.COMPENSATION_MIN * det
    half, fitted = ln.where_at_least(least, fitted, 0.0, 0.5 * q), max(least, fitted)
    gxx, gxy, gyy = by_covariance
    more = camera.dilation - camera.fitted
    return (
        gxx + half * ((yy - more) / fitted - yy / det),
        gxy + half * (xy / det - xy / fitted),
        gyy + half * ((xx - more) / fitted - xx / det),
    )


@helper
def _quat_gradient(quat: Any, inverse: Lanes, d: Any) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Return the gradient by the raw quaternion from `d`, the gradient by its rotation matrix (rows)."""
    (d00, d01, d02), (d10, d11, d12), (d20, d21, d22) = d
    w, x, y, z = quat[0] * inverse, quat[1] * inverse, quat[2] * inverse, quat[3] * inverse
    xy, xz, yz = d01 + d10, d02 + d20, d12 + d21
    by_x, by_y, by_z = d21 - d12, d02 - d20, d10 - d01  # by the axis of the turn
    gw = 2 * (z * by_z + y * by_y + x * by_x)
    gx = 2 * (y * xy + z * xz + w * by_x - 2 * x * (d11 + d22))
    gy = 2 * (x * xy + z * yz + w * by_y - 2 * y * (d00 + d22))
    gz = 2 * (x * xz + y * yz + w * by_z - 2 * z * (d00 + d11))
    along = gw * w + gx * x + gy * y + gz * z
    gw, gx, gy, gz = gw - along * w, gx - along * x, gy - along * y, gz - along * z
    return gw * inverse, gx * inverse, gy * inverse, gz * inverse


@helper
def _point_gradient(
    point: cp.Point, camera: cp.KernelCamera, by_mean: tuple[Lanes, Lanes], db: Any
) -> cp.Point:
    """Return the gradient by the camera-space point from those by its pixel and by B = J R (two rows).

    A clamped coordinate is a constant multiple of z in the Jacobian, so it gets no gradient there.
    """
    (x, y, z), (du, dv), r = point, by_mean, camera.rotation
    if camera.orthographic:
        return du * camera.fx, dv * camera.fy, z * 0.0
    over = 1.0 / z
    sx, sy, u, v = camera.fx * over * over, camera.fy * over * over, x * over, y * over
    tx, ty = min(max(u, -camera.left), camera.right), min(max(v, -camera.top), camera.bottom)
    across, down = _dot(db[0], r[2]) * sx, _dot(db[1], r[2]) * sy
    dz = across * tx + down * ty - du * sx * x - dv * sy * y - _dot(db[0], r[0]) * sx - _dot(db[1], r[1]) * sy
    across, down = _within(u, camera.left, camera.right, across), _within(v, camera.top, camera.bottom, down)
    return du * camera.fx * over - across, dv * camera.fy * over - down, dz + across * tx + down * ty


@helper
def _within(x: Lanes, below: float, above: float, value: Lanes) -> Lanes:
    """Return `value` where -below <= x <= above, else 0."""
    return ln.where_at_least(x, -below, ln.where_at_least(above, x, value, 0.0), 0.0)


@helper
def _dot(x: Any, y: Any) -> Lanes:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@helper
def _times(x: cp.Point, y: cp.Point) -> cp.Point:
    return x[0] * y[0], x[1] * y[1], x[2] * y[2]


@helper
def _mixed(p: Any, x: cp.Point, q: Any, y: cp.Point) -> cp.Point:
    return p * x[0] + q * y[0], p * x[1] + q * y[1], p * x[2] + q * y[2]


@helper
def _axes_gradient(matrices: Any, scales: cp.Point, by_covariance: cp.Point) -> Any:
    """Return gradients by log(s), turn and B from G, by the covariance: A = B turn diag(s) has 2 G A."""
    ((t0, t1, t2), (b0, b1), (a0, a1)), (gxx, gxy, gyy) = matrices, by_covariance
    d0, d1 = _mixed(2 * gxx, a0, 2 * gxy, a1), _mixed(2 * gxy, a0, 2 * gyy, a1)
    e0, e1 = _times(d0, scales), _times(d1, scales)
    by_turn = _mixed(b0[0], e0, b1[0], e1), _mixed(b0[1], e0, b1[1], e1), _mixed(b0[2], e0, b1[2], e1)
    by_b = (_dot(e0, t0), _dot(e0, t1), _dot(e0, t2)), (_dot(e1, t0), _dot(e1, t1), _dot(e1, t2))
    return _mixed(1.0, _times(d0, a0), 1.0, _times(d1, a1)), by_turn, by_b


@helper
def _put(array: Array, rows: Array, values: Any) -> None:
    for column in range(len(values)):
        ln.scatter(array, rows, 0, column, values[column])


@helper
def _pull_back(
    which: Array, footprints: Any, rows: cp.Rows, camera: cp.KernelCamera, out: GaussianGradients
) -> None:
    """Fill the gradients of the eight Gaussians `which`; footprints: arguments of `_footprint_gradient`."""
    q, by_mean, by_covariance = _footprint_gradient(*footprints)
    point, scales, quat = cp.parameters(rows, which, camera)
    inverse, turn, b, a = cp.axes(point, scales, quat, camera)
    by_covariance = _with_compensation(by_covariance, a, camera, q)
    by_log_scales, by_turn, by_b = _axes_gradient((turn, b, a), scales, by_covariance)
    d, r = _point_gradient(point, camera, by_mean, by_b), camera.rotation.T
    _put(out.means, which, (_dot(d, r[0]), _dot(d, r[1]), _dot(d, r[2])))
    _put(out.log_scales, which, by_log_scales)
    _put(out.quats_wxyz, which, _quat_gradient(quat, inverse, by_turn))
    logits = ln.gathered(rows.opacity_logits, which, 0, 0)
    ln.scatter(out.opacity_logits, which, 0, 0, q / (1 + cp.exp(min(logits, 700.0))))
    _put(out.means_px, which, by_mean)


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
    """Fill `out`, initially 0, for those of the rows [first, last) that are drawn.

    Partial sums of `backward` are added in the order of tiles; moments pulled back through the projection.
    """
    tiles, sums, rows, camera, out = ln.borrowed((tiles, sums, rows, camera, out))
    added, each = np.empty((8, sums.partial.shape[1])), np.arange(8)
    which, ranks, number = np.empty(8, np.int64), np.empty(8, np.int64), 0
    for i in range(first, last):
        _fetch(i, last, tiles, sums)
        rank = sums.rank_of[i]
        if rank >= 0 and _add_up(rank, tiles, sums, added[number]):
            out.values[i] = added[number, MOMENTS : MOMENTS + out.values.shape[1]]
            which[number], ranks[number], number = i, rank, number + 1
        if number == 8 or (number > 0 and i == last - 1):
            # The last are fewer.
            which[number:], ranks[number:], added[number:] = which[0], ranks[0], added[0]
            _pull_back(which, (tiles.geometry, ranks, added, each), rows, camera, out)
            number = 0
