"""Gradients of blending on the CPU: from an image's gradient to each footprint.

A tile is walked front to back once, as in `cpu_blend`, and alpha and T of every row touched are written to
a tape. The tape is then read from its end. With weight w_i = alpha_i T_i, s_i = <image gradient, x_i> +
alpha gradient (per pixel), and behind_i = sum over j > i of w_j s_j,

    d loss / d alpha_i = T_i s_i - behind_i / (1 - alpha_i),

a sum of positive products where s is: nothing is subtracted from a total, T is never divided back.
Alpha at its cap has no gradient. As log2(alpha) is a quadratic in the whitened coordinates (w, v) of
`cpu_project`, a footprint's gradient needs only the moments of q = alpha d loss / d alpha in (w, v).
"""

import numpy as np
from numba import njit, prange

from langsplat_core.raster import cpu_project as cp
from langsplat_core.raster.cpu_blend import (
    _CHECK_EVERY,
    PIXELS,
    blend_row,
    correlate,
    load_tile,
    row_offsets,
    running_rows,
    start_tile,
)
from langsplat_core.raster.cpu_tiles import TILE, spread
from langsplat_core.raster.lanes import lanes, load, ramp, reciprocal, store, total, where_greater

# Columns of the partial sums; the gradient by the values follows them.
Q, QW, QV, QWW, QWV, QVV = range(6)
MOMENTS = 6
_ENTRY = 2 * TILE  # numbers of tape per row: alpha and T


@njit(cache=True, forceinline=True)
def _grown(tape, used):
    """The tape, with room for one more Gaussian behind `used` numbers."""
    if used + TILE * _ENTRY <= tape.shape[0]:
        return tape
    longer = np.empty(2 * tape.shape[0], np.float32)
    longer[:used] = tape[:used]
    return longer


@njit(cache=True)
def _record(x0, y0, first, last, tiles, geometry, cutoffs, transmittance, spans):
    """Walk front to back; returns the tape, its length and the end of the intersections visited.

    spans[s - first] <- rows [low, high) of each intersection that were blended.
    """
    tape = np.empty(64 * TILE * _ENTRY, np.float32)
    used = 0
    top, bottom = 0, TILE
    for s in range(first, last):
        if (s - first) % _CHECK_EVERY == _CHECK_EVERY - 1:
            top, bottom = running_rows(transmittance, top, bottom)
            if top >= bottom:
                return tape, used, s
        tape = _grown(tape, used)
        rows = np.int64(tiles.rows[s])
        low, high = max(rows & 255, top), min(rows >> 8, bottom)
        spans[s - first, 0], spans[s - first, 1] = low, high
        g = geometry[tiles.ranks[s]]
        step = ramp() * g[cp.FACTOR_A]
        for row in range(low, high):
            w, v = row_offsets(g, x0 + 0.5, y0 + row + 0.5)
            added, before = blend_row(
                transmittance, row * TILE, step + w, g[cp.LOG2_OPACITY] - v * v, cutoffs
            )
            store(tape, used, added)
            store(tape, used + TILE, before)
            used += _ENTRY
    return tape, used, last


@njit(cache=True)
def _backward_tile(tile, tiles, geometry, values, image_grad, alpha_grad, cutoffs, partial):
    height, width, channels = image_grad.shape
    x0, y0 = tile % tiles.columns * TILE, tile // tiles.columns * TILE
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    state = np.empty(PIXELS, np.float32)
    start_tile(state, x0, y0, width, height)
    spans = np.zeros((last - first, 2), np.int64)
    tape, used, end = _record(x0, y0, first, last, tiles, geometry, cutoffs, state, spans)
    partial[end:last] = 0
    planes, plane = np.empty(PIXELS * channels, np.float32), np.empty(PIXELS, np.float32)
    load_tile(planes, image_grad, x0, y0)
    load_tile(plane, alpha_grad, x0, y0)
    weights = np.empty(PIXELS, np.float32)
    behind = state
    behind[:] = 0
    for s in range(end - 1, first - 1, -1):
        low, high = max(spans[s - first, 0], 0), spans[s - first, 1]
        used -= max(high - low, 0) * _ENTRY
        g = geometry[tiles.ranks[s]]
        x = values[tiles.ranks[s]]
        step = ramp() * g[cp.FACTOR_A]
        q0 = qw = qv = qww = qwv = qvv = lanes(np.float32(0))
        for row in range(low, high):
            offset, v = row_offsets(g, x0 + 0.5, y0 + row + 0.5)
            w = step + offset
            at = used + (row - low) * _ENTRY
            alpha, before = load(tape, at), load(tape, at + TILE)
            weight = alpha * before
            store(weights, (row - low) * TILE, weight)
            slope = load(plane, row * TILE)
            for channel in range(channels):
                slope = slope + load(planes, (row * channels + channel) * TILE) * x[channel]
            hidden = load(behind, row * TILE)
            store(behind, row * TILE, hidden + weight * slope)
            q = weight * slope - hidden * alpha * reciprocal(1.0 - alpha)
            q = where_greater(cutoffs.alpha_max, alpha, q, 0.0)
            moved, lifted = q * w, q * v
            q0, qw, qv = q0 + q, qw + moved, qv + lifted
            qww, qwv, qvv = qww + moved * w, qwv + moved * v, qvv + lifted * v
        sums = partial[s]
        sums[Q], sums[QW], sums[QV] = total(q0), total(qw), total(qv)
        sums[QWW], sums[QWV], sums[QVV] = total(qww), total(qwv), total(qvv)
        correlate(planes, channels, weights, low, high, sums[MOMENTS:])


@njit(cache=True, parallel=True, nogil=True)
def backward(tiles, geometry, values, image_grad, alpha_grad, cutoffs, partial):
    """(M, C) values in depth order, (H, W, C) and (H, W, 1) gradients -> (I, 6 + C) partial sums, float32."""
    count = tiles.starts.shape[0] - 1
    for i in prange(count):
        _backward_tile(spread(i, count), tiles, geometry, values, image_grad, alpha_grad, cutoffs, partial)


@njit(cache=True, forceinline=True)
def _sum_moments(rank, tiles, partial, moments):
    moments[:] = 0
    for n in range(tiles.firsts[rank], tiles.firsts[rank + 1]):
        for m in range(MOMENTS):
            moments[m] += partial[tiles.slots[n], m]


@njit(cache=True, forceinline=True)
def _covariance_gradient(g, moments):
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
        scale * a * a * ww,
        scale * a * (b * ww + c * wv),
        scale * (b * b * ww + 2 * b * c * wv + c * c * vv),
    )


@njit(cache=True, forceinline=True)
def _compensation_gradient(a, lens, q, gxx, gxy, gyy):
    """Adds the gradient of Mip-Splatting's factor sqrt(det sharp / det dilated) to that by the covariance."""
    xx, xy, yy, det, sharp = cp._covariance(a, lens.dilation)
    if not lens.antialiased or sharp / det <= cp._COMPENSATION_MIN:
        return gxx, gxy, gyy
    half = 0.5 * q
    return (
        gxx + half * ((yy - lens.dilation) / sharp - yy / det),
        gxy + half * (xy / det - xy / sharp),
        gyy + half * ((xx - lens.dilation) / sharp - xx / det),
    )


@njit(cache=True, forceinline=True)
def _quat_gradient(quat, inverse, d):
    """Gradient by the raw quaternion from `d`, that by its rotation matrix."""
    w, x, y, z = quat[0] * inverse, quat[1] * inverse, quat[2] * inverse, quat[3] * inverse
    gw = 2 * (z * (d[1, 0] - d[0, 1]) + y * (d[0, 2] - d[2, 0]) + x * (d[2, 1] - d[1, 2]))
    gx = 2 * (
        y * (d[0, 1] + d[1, 0])
        + z * (d[0, 2] + d[2, 0])
        + w * (d[2, 1] - d[1, 2])
        - 2 * x * (d[1, 1] + d[2, 2])
    )
    gy = 2 * (
        x * (d[0, 1] + d[1, 0])
        + z * (d[1, 2] + d[2, 1])
        + w * (d[0, 2] - d[2, 0])
        - 2 * y * (d[0, 0] + d[2, 2])
    )
    gz = 2 * (
        x * (d[0, 2] + d[2, 0])
        + y * (d[1, 2] + d[2, 1])
        + w * (d[1, 0] - d[0, 1])
        - 2 * z * (d[0, 0] + d[1, 1])
    )
    along = gw * w + gx * x + gy * y + gz * z
    return (
        (gw - along * w) * inverse,
        (gx - along * x) * inverse,
        (gy - along * y) * inverse,
        (gz - along * z) * inverse,
    )


@njit(cache=True, forceinline=True)
def _point_gradient(point, lens, du, dv, db):
    """Gradient by the camera-space point from those by its pixel and by B = J R (two rows).

    A clamped coordinate is a constant multiple of z in the Jacobian, so it gets no gradient there.
    """
    x, y, z = point
    r = lens.rotation
    j00 = db[0, 0] * r[0, 0] + db[0, 1] * r[0, 1] + db[0, 2] * r[0, 2]
    j02 = db[0, 0] * r[2, 0] + db[0, 1] * r[2, 1] + db[0, 2] * r[2, 2]
    j11 = db[1, 0] * r[1, 0] + db[1, 1] * r[1, 1] + db[1, 2] * r[1, 2]
    j12 = db[1, 0] * r[2, 0] + db[1, 1] * r[2, 1] + db[1, 2] * r[2, 2]
    sx, sy = lens.fx / (z * z), lens.fy / (z * z)
    tx, ty = min(max(x / z, -lens.left), lens.right), min(max(y / z, -lens.top), lens.bottom)
    dx, dy = du * lens.fx / z, dv * lens.fy / z
    dz = -du * sx * x - dv * sy * y - j00 * sx - j11 * sy + j02 * sx * tx + j12 * sy * ty
    if tx == x / z:
        dx -= j02 * sx
        dz += j02 * sx * tx
    if ty == y / z:
        dy -= j12 * sy
        dz += j12 * sy * ty
    return dx, dy, dz


@njit(cache=True, forceinline=True)
def _axes_gradient(work, scales, gxx, gxy, gyy, by_turn, by_b, by_log_scale):
    """From the covariance's gradient G: dA = 2 G A, then to rotation, B and log scales (A = B turn diag(s))."""
    turn, b, a = work[0], work[1], work[2]
    for k in range(3):
        d0, d1 = 2 * (gxx * a[0, k] + gxy * a[1, k]), 2 * (gxy * a[0, k] + gyy * a[1, k])
        by_log_scale[k] = d0 * a[0, k] + d1 * a[1, k]
        d0, d1 = d0 * scales[k], d1 * scales[k]
        for m in range(3):
            by_turn[m, k] = b[0, m] * d0 + b[1, m] * d1
            by_b[0, m] += d0 * turn[m, k]
            by_b[1, m] += d1 * turn[m, k]


@njit(cache=True, parallel=True, nogil=True)
def to_parameters(tiles, order, geometry, partial, parameters, lens, gradients):
    """Sum the partial moments of each drawn Gaussian and pull them back through the projection.

    `parameters` are (means, log_scales, quats, logits); `gradients` the same, then means_px, to be filled.
    """
    means, log_scales, quats, logits = parameters
    by_mean, by_log_scale, by_quat, by_logit, by_mean_px = gradients
    for rank in prange(order.shape[0]):
        i = order[rank]
        moments, work, by_b, by_turn = (
            np.empty(MOMENTS),
            np.empty((3, 3, 3)),
            np.zeros((2, 3)),
            np.empty((3, 3)),
        )
        _sum_moments(rank, tiles, partial, moments)
        du, dv, gxx, gxy, gyy = _covariance_gradient(geometry[rank], moments)
        point = cp._camera_point(means[i], lens)
        scales, inverse = cp._fill_axes(point, log_scales[i], quats[i], lens, work)
        gxx, gxy, gyy = _compensation_gradient(work[2], lens, moments[Q], gxx, gxy, gyy)
        _axes_gradient(work, scales, gxx, gxy, gyy, by_turn, by_b, by_log_scale[i])
        dx, dy, dz = _point_gradient(point, lens, du, dv, by_b)
        r = lens.rotation
        for n in range(3):
            by_mean[i, n] = dx * r[0, n] + dy * r[1, n] + dz * r[2, n]
        gw, gx, gy, gz = _quat_gradient(quats[i], inverse, by_turn)
        by_quat[i, 0], by_quat[i, 1], by_quat[i, 2], by_quat[i, 3] = gw, gx, gy, gz
        by_logit[i] = moments[Q] * (1 - cp._opacity(logits[i]))
        by_mean_px[i, 0], by_mean_px[i, 1] = du, dv
