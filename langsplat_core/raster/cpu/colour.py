"""View-dependent colours on the CPU: the compiled twin of `spherical_harmonics.colours`, and its adjoint."""

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.compiled import helper, kernel, plain, shared_workers
from langsplat_core.raster.spherical_harmonics import C0, C1, C2, C3

_C20, _C21, _C22 = C2
_C30, _C31, _C32, _C33, _C34 = C3
_NEAREST = 1e-12  # world units; a Gaussian closer to the camera than this has no direction


@helper
def _direction(mean: Array, position: Array) -> tuple[float, float, float, float]:
    """Unit vector from the camera to the Gaussian, and the inverse distance."""
    x, y, z = mean[0] - position[0], mean[1] - position[1], mean[2] - position[2]
    inverse = 1 / max(np.sqrt(x * x + y * y + z * z), _NEAREST)
    return x * inverse, y * inverse, z * inverse, inverse


@helper
def _basis(x: float, y: float, z: float, b: Array) -> None:
    """b[k] <- the first len(b) basis functions at a unit vector."""
    b[0] = C0
    if b.shape[0] > 1:
        b[1], b[2], b[3] = -C1 * y, C1 * z, -C1 * x
    if b.shape[0] > 4:
        b[4], b[5], b[6] = _C20 * x * y, -_C20 * y * z, _C21 * (2 * z * z - x * x - y * y)
        b[7], b[8] = -_C20 * x * z, _C22 * (x * x - y * y)
    if b.shape[0] > 9:
        b[9], b[10] = -_C30 * y * (3 * x * x - y * y), _C31 * x * y * z
        b[11] = -_C32 * y * (4 * z * z - x * x - y * y)
        b[12] = _C33 * z * (2 * z * z - 3 * x * x - 3 * y * y)
        b[13] = -_C32 * x * (4 * z * z - x * x - y * y)
        b[14], b[15] = _C34 * z * (x * x - y * y), -_C30 * x * (x * x - 3 * y * y)


@helper
def _basis_gradient(x: float, y: float, z: float, h: Array) -> tuple[float, float, float]:
    """Gradient of sum_k h[k] basis_k by x, y, z, as polynomials (the unit length is not used)."""
    dx, dy, dz = -C1 * h[3], -C1 * h[1], C1 * h[2]
    if h.shape[0] > 4:
        dx += _C20 * (h[4] * y - h[7] * z) - 2 * _C21 * h[6] * x + 2 * _C22 * h[8] * x
        dy += _C20 * (h[4] * x - h[5] * z) - 2 * _C21 * h[6] * y - 2 * _C22 * h[8] * y
        dz += -_C20 * (h[5] * y + h[7] * x) + 4 * _C21 * h[6] * z
    if h.shape[0] > 9:
        xx, yy, zz = x * x, y * y, z * z
        dx += -6 * _C30 * h[9] * x * y + _C31 * h[10] * y * z + 2 * _C32 * h[11] * x * y
        dx += -6 * _C33 * h[12] * x * z - _C32 * h[13] * (4 * zz - 3 * xx - yy)
        dx += 2 * _C34 * h[14] * x * z - 3 * _C30 * h[15] * (xx - yy)
        dy += -3 * _C30 * h[9] * (xx - yy) + _C31 * h[10] * x * z - _C32 * h[11] * (4 * zz - xx - 3 * yy)
        dy += -6 * _C33 * h[12] * y * z + 2 * _C32 * h[13] * x * y
        dy += -2 * _C34 * h[14] * y * z + 6 * _C30 * h[15] * x * y
        dz += _C31 * h[10] * x * y - 8 * _C32 * h[11] * y * z + 3 * _C33 * h[12] * (2 * zz - xx - yy)
        dz += -8 * _C32 * h[13] * x * z + _C34 * h[14] * (xx - yy)
    return dx, dy, dz


@helper
def _channel(sh: Array, b: Array, channel: int) -> float:
    """One colour channel before the clamp."""
    value = 0.5
    for k in range(b.shape[0]):
        value += b[k] * sh[k, channel]
    return value


@kernel
def _forward(first: int, last: int, sh: Array, means: Array, position: Array, out: Array) -> None:
    b = np.empty(sh.shape[1])
    for n in range(first, last):
        x, y, z, _ = _direction(means[n], position)
        _basis(x, y, z, b)
        for channel in range(3):
            value = _channel(sh[n], b, channel)
            out[n, channel] = max(value, 0.0) if np.isfinite(value) else 0.0


@kernel
def _backward(
    first: int,
    last: int,
    sh: Array,
    means: Array,
    position: Array,
    colour_grad: Array,
    sh_grad: Array,
    means_grad: Array,
) -> None:
    b, h = np.empty(sh.shape[1]), np.empty(sh.shape[1])
    for n in range(first, last):
        x, y, z, inverse = _direction(means[n], position)
        _basis(x, y, z, b)
        h[:] = 0
        for channel in range(3):
            value = _channel(sh[n], b, channel)
            grad = np.float64(colour_grad[n, channel]) if np.isfinite(value) and value > 0 else 0.0
            for k in range(b.shape[0]):
                sh_grad[n, k, channel] = b[k] * grad if grad != 0 else 0.0
                h[k] += grad * sh[n, k, channel] if grad != 0 else 0.0
        if b.shape[0] > 1 and inverse < 1 / _NEAREST:
            dx, dy, dz = _basis_gradient(x, y, z, h)
            along = dx * x + dy * y + dz * z
            means_grad[n, 0] = (dx - along * x) * inverse
            means_grad[n, 1] = (dy - along * y) * inverse
            means_grad[n, 2] = (dz - along * z) * inverse


def colours(sh: Array, means: Array, camera_position: Array) -> Array:
    """(N, K, 3) float32 coefficients, (N, 3) float32 means -> (N, 3) float32 display colours >= 0.

    Invalid rows give 0; see `spherical_harmonics.colours`.
    """
    n = check_array("sh", sh, ("N", "K", 3), dtype=np.float32)
    check_array("means", means, ("N", 3), n, dtype=np.float32)
    out = np.empty(means.shape, np.float32)
    position = np.array(camera_position, np.float64)
    shared_workers().run(_forward, len(sh), plain(sh), plain(means), position, out)
    return out


def colours_backward(
    sh: Array, means: Array, camera_position: Array, colour_grad: Array
) -> tuple[Array, Array]:
    """Gradients (N, K, 3) by the coefficients and (N, 3) by the means, from (N, 3) by the colours; float32.

    A channel clamped at 0 and an invalid row get none.
    """
    n = check_array("sh", sh, ("N", "K", 3), dtype=np.float32)
    check_array("means", means, ("N", 3), n, dtype=np.float32)
    check_array("colour_grad", colour_grad, ("N", 3), n)
    sh_grad, means_grad = np.empty(sh.shape, np.float32), np.zeros(means.shape, np.float32)
    position = np.array(camera_position, np.float64)
    inputs = (plain(sh), plain(means), position, plain(colour_grad))
    shared_workers().run(_backward, len(sh), *inputs, sh_grad, means_grad)
    return sh_grad, means_grad
