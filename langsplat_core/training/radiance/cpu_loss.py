"""`losses.radiance_loss` and its gradient for the CPU, fused in three passes over the picture's rows.

The same formulas as in `losses` (whose torch version is the reference it is tested against). The windows
are separable, so: pass 1 blurs the raw moments along rows; pass 2 blurs them across rows, forms SSIM and
its derivatives by the moments, and blurs those along rows; pass 3 blurs the derivatives across rows and
adds everything up. Rows are independent within a pass, so results do not depend on the number of threads.
"""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel, shared_workers

RADIUS = 5  # of the window, pixels
_TWO = np.float32(2)  # a plain 2 would turn every product into float64 and halve the speed
_ONE = np.float32(1)


@helper
def _add_scaled(out: Array, tap: float, source: Array) -> None:
    """out += tap * source. A loop over two plain rows is one the compiler vectorises."""
    for i in range(out.shape[0]):
        out[i] += tap * source[i]


@helper
def _along(padded: Array, out: Array, taps: Array, channels: int) -> None:
    """Blur one row; `padded` has RADIUS pixels of zeros at both ends."""
    out[:] = 0
    for k in range(taps.shape[0]):
        _add_scaled(out, taps[k], padded[k * channels : k * channels + out.shape[0]])


@helper
def _across(rows: Array, y: int, out: Array, taps: Array) -> None:
    """Blur `rows` (H, n) at row y over the rows around it; zeros beyond the picture."""
    out[:] = 0
    for k in range(max(RADIUS - y, 0), min(taps.shape[0], rows.shape[0] + RADIUS - y)):
        _add_scaled(out, taps[k], rows[y + k - RADIUS])


@kernel
def _blur_moments(
    first: int, last: int, picture: Array, target: Array, channels: int, taps: Array, moments: Array
) -> None:
    """Pass 1: (H, n) pictures -> `moments` (4, H, n), x, y, x^2 + y^2, x y blurred along rows."""
    n, edge = picture.shape[1], RADIUS * channels
    padded = np.zeros((4, n + 2 * edge), np.float32)
    squares, products = padded[2, edge : edge + n], padded[3, edge : edge + n]
    for row in range(first, last):
        x, y = picture[row], target[row]
        padded[0, edge : edge + n] = x
        padded[1, edge : edge + n] = y
        for i in range(n):
            squares[i] = x[i] * x[i] + y[i] * y[i]
            products[i] = x[i] * y[i]
        for m in range(4):
            _along(padded[m], moments[m, row], taps, channels)


@kernel
def _compare(
    first: int,
    last: int,
    moments: Array,
    constants: Array,
    channels: int,
    taps: Array,
    derivatives: Array,
    row_ssim: Array,
) -> None:
    """Pass 2: `derivatives` (3, H, n) by the blurred x, x^2, xy, blurred along rows; SSIM sums per row."""
    n, edge = moments.shape[2], RADIUS * channels
    c1, c2 = constants[0], constants[1]
    m = np.empty((4, n), np.float32)
    padded = np.zeros((3, n + 2 * edge), np.float32)
    by_mx, by_xx, by_xy = padded[0, edge : edge + n], padded[1, edge : edge + n], padded[2, edge : edge + n]
    similarity = np.empty(n, np.float32)
    for row in range(first, last):
        for k in range(4):
            _across(moments[k], row, m[k], taps)
        for i in range(n):
            mx, my = m[0, i], m[1, i]
            product, squares = mx * my, mx * mx + my * my
            a1, a2 = _TWO * product + c1, _TWO * (m[3, i] - product) + c2
            b1, b2 = squares + c1, m[2, i] - squares + c2
            inverse_b1, inverse_b2 = _ONE / b1, _ONE / b2
            inverse = inverse_b1 * inverse_b2
            s = a1 * a2 * inverse
            similarity[i] = s
            by_mx[i] = _TWO * (my * (a2 - a1) * inverse - mx * s * (inverse_b1 - inverse_b2))
            by_xx[i] = -s * inverse_b2
            by_xy[i] = _TWO * a1 * inverse
        row_ssim[row] = similarity.sum()
        for k in range(3):
            _along(padded[k], derivatives[k, row], taps, channels)


@kernel
def _gather_gradient(
    first: int,
    last: int,
    picture: Array,
    target: Array,
    derivatives: Array,
    weights: Array,
    taps: Array,
    gradient: Array,
    row_l1: Array,
) -> None:
    """Pass 3: the gradient by the picture, weights[0] sign(x - y) - weights[1] dSSIM/dx; L1 sums per row."""
    n = picture.shape[1]
    d = np.empty((3, n), np.float32)
    difference = np.empty(n, np.float32)
    l1, dssim, zero = weights[0], weights[1], np.float32(0)
    for row in range(first, last):
        for k in range(3):
            _across(derivatives[k], row, d[k], taps)
        x, y, out = picture[row], target[row], gradient[row]
        for i in range(n):
            difference[i] = abs(x[i] - y[i])
            sign = l1 if x[i] > y[i] else (-l1 if x[i] < y[i] else zero)
            out[i] = sign - dssim * (d[0, i] + _TWO * x[i] * d[1, i] + y[i] * d[2, i])
        row_l1[row] = difference.sum()


def loss_and_gradient(
    picture: Array, target: Array, lambda_dssim: float, taps: Array, constants: tuple[float, float]
) -> tuple[float, Array]:
    """(H, W, C) contiguous float32 pictures -> the loss and its (H, W, C) gradient by `picture`.

    `taps` are the window's 11 taps, `constants` SSIM's C1 and C2.
    """
    height, width, channels = picture.shape
    n = width * channels
    x, y = picture.reshape(height, n), target.reshape(height, n)
    taps = np.ascontiguousarray(taps, np.float32)
    moments, derivatives = np.empty((4, height, n), np.float32), np.empty((3, height, n), np.float32)
    row_ssim, row_l1 = np.empty(height), np.empty(height)
    gradient = np.empty((height, n), np.float32)
    weights = np.array([1 - lambda_dssim, lambda_dssim], np.float32) / np.float32(x.size)
    run = shared_workers().run
    run(_blur_moments, height, x, y, channels, taps, moments)
    run(_compare, height, moments, np.array(constants, np.float32), channels, taps, derivatives, row_ssim)
    run(_gather_gradient, height, x, y, derivatives, weights, taps, gradient, row_l1)
    loss = (1 - lambda_dssim) * row_l1.sum() / x.size + lambda_dssim * (1 - row_ssim.sum() / x.size)
    return float(loss), gradient.reshape(picture.shape)
