"""Projection of Gaussians for the CPU backend: steps 1 and 2 of `reference.py`, compiled.

Everything here is float64. Depths are in the reference's order of operations and agree with it bit for bit,
and coordinates of a million world units lose nothing. Eight are projected at once, at 0.02 microseconds each.

A footprint is kept as the triangular factor of its conic, not as the conic: with (dx, dy) = pixel - mean,

    log2(alpha) = log2(opacity) - w^2 - v^2,   w = a (dx - k dy),   v = c dy,

where a^2 = log2(e)/2 * yy/det, k = xy/yy, c^2 = log2(e)/2 / yy (completing the square in dx; xx, xy, yy
and det are the 2D covariance's). A long thin footprint's conic is a difference of huge products; its factor
is not, so float32 pixels suffice.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.compiled import Workers, helper, kernel, plain, shared_workers
from langsplat_core.config import RasterSettings
from langsplat_core.raster.cpu import lanes as ln
from langsplat_core.raster.cpu.lanes import Lanes
from langsplat_core.raster.protocol import dilation, far_plane, tangent_limits
from langsplat_core.scene import Camera, Gaussians
from langsplat_core.scene.transform import C0, C1, C2, C3

COLUMNS = 8  # of the geometry: one cache line a row
MEAN_X, MEAN_Y, FACTOR_A, FACTOR_K, FACTOR_C, LOG2_OPACITY, HALF_WIDTH, HALF_HEIGHT = range(8)  # columns
HALF_LOG2_E = 0.5 / np.log(2.0)
LN2 = np.log(2.0)
COMPENSATION_MIN = 0.005**2  # floor of det with the fitted dilation / det with all of it, as INRIA has it

Point = tuple[float, float, float]


class Rows(NamedTuple):
    """N Gaussians as `Gaussians` stores them."""

    means: Array  # (N, 3) float32
    log_scales: Array  # (N, 3) float32
    quats_wxyz: Array  # (N, 4) float32
    opacity_logits: Array  # (N,) float32
    valid: Array  # (N,) bool


class Projection(NamedTuple):
    """Gaussians projected onto the image plane, as `project` returns them."""

    geometry: Array  # (N, 8) float64, columns MEAN_X to HALF_HEIGHT; defined only where drawn
    depths: Array  # (N,) float64 camera z; defined only where drawn
    drawn: Array  # (M,) int32 ascending rows of those that are drawn


class KernelCamera(NamedTuple):
    """Camera and settings as the kernels take them."""

    rotation: Array  # (3, 3) world to camera
    translation: Array  # (3,)
    orthographic: bool
    fx: float  # px
    fy: float
    cx: float
    cy: float
    width: float  # px
    height: float
    left: float  # limits of |x/z| and |y/z| in the Jacobian, on each side of the axis
    top: float
    right: float
    bottom: float
    near: float
    far: float
    dilation: float
    fitted: float  # part of the dilation, see `protocol.Dilation`
    alpha_min: float


def kernel_camera(camera: Camera, settings: RasterSettings) -> KernelCamera:
    """Return camera and settings as kernels take them."""
    plane = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
    formed = settings.near, far_plane(settings), *dilation(camera, settings), settings.alpha_min
    return KernelCamera(
        np.ascontiguousarray(camera.rotation),
        np.ascontiguousarray(camera.world_to_camera[:3, 3]),
        camera.orthographic,
        *map(float, (*plane, *tangent_limits(camera, settings), *formed)),
    )


@helper
def camera_point(mean: Point, camera: KernelCamera) -> Point:
    """Return a mean in the camera's frame, float64, in the reference's order of operations."""
    r, t, (x, y, z) = camera.rotation, camera.translation, mean
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0],
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1],
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2],
    )


@helper
def _over(z: float, camera: KernelCamera) -> float:
    """Return the factor from camera coordinates to tangents: the inverse depth, or 1 if orthographic."""
    return z * 0.0 + 1.0 if camera.orthographic else 1.0 / z


@helper
def _jacobian(point: Point, camera: KernelCamera) -> tuple[float, float, float, float]:
    """Return entries (0,0), (0,2), (1,1), (1,2) of d(pixel)/d(clamped camera point); others are 0."""
    x, y, z = point
    over = _over(z, camera)
    fx, fy, along = camera.fx * over, camera.fy * over, 0.0 if camera.orthographic else -1.0
    tx = min(max(x * over, -camera.left), camera.right)
    ty = min(max(y * over, -camera.top), camera.bottom)
    return fx, along * fx * tx, fy, along * fy * ty


@helper
def _scaled(b: Point, turn: tuple[Point, Point, Point], scales: Point) -> Point:
    """Return a row of B rotation diag(s)."""
    first, second, third = turn
    return (
        (b[0] * first[0] + b[1] * second[0] + b[2] * third[0]) * scales[0],
        (b[0] * first[1] + b[1] * second[1] + b[2] * third[1]) * scales[1],
        (b[0] * first[2] + b[1] * second[2] + b[2] * third[2]) * scales[2],
    )


@helper
def axes(point: Point, scales: Point, quat: tuple[float, float, float, float], camera: KernelCamera) -> Any:
    """Return the inverse length of the quaternion, its rotation, and B = J R, A = B rotation diag(s).

    Matrices are tuples of rows; the last two have two.
    """
    r, (j00, j02, j11, j12), (q0, q1, q2, q3) = camera.rotation, _jacobian(point, camera), quat
    inverse = 1.0 / np.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    q0, q1, q2, q3 = q0 * inverse, q1 * inverse, q2 * inverse, q3 * inverse
    turn = (
        (1 - 2 * (q2 * q2 + q3 * q3), 2 * (q1 * q2 - q0 * q3), 2 * (q1 * q3 + q0 * q2)),
        (2 * (q1 * q2 + q0 * q3), 1 - 2 * (q1 * q1 + q3 * q3), 2 * (q2 * q3 - q0 * q1)),
        (2 * (q1 * q3 - q0 * q2), 2 * (q2 * q3 + q0 * q1), 1 - 2 * (q1 * q1 + q2 * q2)),
    )
    across = j00 * r[0, 0] + j02 * r[2, 0], j00 * r[0, 1] + j02 * r[2, 1], j00 * r[0, 2] + j02 * r[2, 2]
    down = j11 * r[1, 0] + j12 * r[2, 0], j11 * r[1, 1] + j12 * r[2, 1], j11 * r[1, 2] + j12 * r[2, 2]
    return inverse, turn, (across, down), (_scaled(across, turn, scales), _scaled(down, turn, scales))


@helper
def covariance(
    a: tuple[Point, Point], dilation: float, fitted: float
) -> tuple[float, float, float, float, float]:
    """Return the 2D covariance xx, xy, yy with dilation, its determinant, and that with the fitted dilation.

    det(A A^T) = |row0 x row1|^2 (Cauchy-Binet): no cancellation, however thin the needle.
    """
    (a0, a1, a2), (d0, d1, d2) = a
    xx, yy, xy = a0 * a0 + a1 * a1 + a2 * a2, d0 * d0 + d1 * d1 + d2 * d2, a0 * d0 + a1 * d1 + a2 * d2
    c0, c1, c2 = a1 * d2 - a2 * d1, a2 * d0 - a0 * d2, a0 * d1 - a1 * d0
    sharp = c0 * c0 + c1 * c1 + c2 * c2
    det = sharp + dilation * (xx + yy) + dilation * dilation
    return xx + dilation, xy, yy + dilation, det, sharp + fitted * (xx + yy) + fitted * fitted


def rows_of(gaussians: Gaussians) -> Rows:
    """Return the Gaussians as kernels take them."""
    return Rows(
        plain(gaussians.means),
        plain(gaussians.log_scales),
        plain(gaussians.quats_wxyz),
        plain(gaussians.opacity_logits),
        gaussians.valid(),
    )


@helper
def exp(x: Lanes) -> Lanes:
    """Return e^x of doubles up to 708, relative error 1e-15 for |x| < 10; below -708 as at -708."""
    return ln.exp2(max(x * (2 * HALF_LOG2_E), -1022.0))


@helper
def _three(array: Array, which: Array) -> Point:
    return ln.gathered(array, which, 0, 0), ln.gathered(array, which, 0, 1), ln.gathered(array, which, 0, 2)


@helper
def parameters(rows: Rows, which: Array, camera: KernelCamera) -> Any:
    """Return camera points, scales and raw quaternions of eight Gaussians; which: (8,) their rows."""
    (s0, s1, s2), (q0, q1, q2) = _three(rows.log_scales, which), _three(rows.quats_wxyz, which)
    quat = q0, q1, q2, ln.gathered(rows.quats_wxyz, which, 0, 3)
    return camera_point(_three(rows.means, which), camera), (exp(s0), exp(s1), exp(s2)), quat


@helper
def _footprints(rows: Rows, which: Array, camera: KernelCamera, each: Array, out: Array) -> None:
    """Fill `out` (8, 10) for eight Gaussians: geometry, depth, and a number < 0 if the Gaussian is not drawn.

    which: (8,) their rows; each: (8,) 0 to 7.
    """
    point, scales, quat = parameters(rows, which, camera)
    (x, y, z), (_, _, _, a) = point, axes(point, scales, quat, camera)
    logit = ln.gathered(rows.opacity_logits, which, 0, 0)
    faint = exp(min(logit, -logit))
    opacity = ln.where_at_least(logit, 0.0, 1.0, faint) / (1 + faint)
    xx, xy, yy, det, det_fitted = covariance(a, camera.dilation, camera.fitted)
    if camera.fitted < camera.dilation:
        opacity = opacity * np.sqrt(max(det_fitted / det, COMPENSATION_MIN))
    log2_opacity = ln.log2(opacity)
    reach = 2 * LN2 * max(log2_opacity - np.log2(camera.alpha_min), 0.0)  # squared
    over = _over(z, camera)
    u, v = camera.fx * x * over + camera.cx, camera.fy * y * over + camera.cy
    wide, high, inverse = np.sqrt(reach * xx), np.sqrt(reach * yy), 1.0 / yy
    ln.scatter(out, each, 0, MEAN_X, u)
    ln.scatter(out, each, 0, MEAN_Y, v)
    ln.scatter(out, each, 0, FACTOR_A, np.sqrt(HALF_LOG2_E * yy / det))
    ln.scatter(out, each, 0, FACTOR_K, xy * inverse)
    ln.scatter(out, each, 0, FACTOR_C, np.sqrt(HALF_LOG2_E * inverse))
    ln.scatter(out, each, 0, LOG2_OPACITY, log2_opacity)
    ln.scatter(out, each, 0, HALF_WIDTH, wide)
    ln.scatter(out, each, 0, HALF_HEIGHT, high)
    ln.scatter(out, each, 0, COLUMNS, z)
    across = min(u + wide, camera.width - (u - wide))
    inside = min(across, min(v + high, camera.height - (v - high))) - 0.5
    least = min(min(inside, opacity - camera.alpha_min), camera.far - z)
    ln.scatter(out, each, 0, COLUMNS + 1, ln.where_at_least(camera.near, z, -1.0, least))


@kernel
def project(first: int, last: int, rows: Rows, camera: KernelCamera, geometry: Array, depths: Array) -> Array:
    """Fill geometry and depths, as in `Projection`, for rows [first, last), and return those that are drawn.

    A Gaussian whose alpha = alpha_min contour meets no pixel centre is not drawn.
    """
    rows, camera, geometry, depths = ln.borrowed((rows, camera, geometry, depths))
    which, each, found = np.empty(8, np.int64), np.arange(8), np.empty((8, COLUMNS + 2))
    drawn, number = np.empty(last - first, np.int32), 0
    for start in range(first, last, 8):
        for j in range(8):
            which[j] = min(start + j, last - 1)
        _footprints(rows, which, camera, each, found)
        for j in range(min(8, last - start)):
            i = start + j
            drawn[number], depths[i] = i, found[j, COLUMNS]
            number += rows.valid[i] and found[j, COLUMNS + 1] >= 0
            for n in range(COLUMNS):
                geometry[i, n] = found[j, n]
    return drawn[:number]


def project_all(
    rows: Rows, camera: KernelCamera, workers: Workers, empty: Callable[..., Array] = np.empty
) -> Projection:
    """Project all rows; empty: allocates their geometry as `numpy.empty` does."""
    n = len(rows.valid)
    geometry, depths = empty((n, COLUMNS), np.float64), np.empty(n)
    drawn = workers.run(project, n, rows, camera, geometry, depths)
    return Projection(geometry, depths, np.concatenate([np.empty(0, np.int32), *drawn]))


# View-dependent colours on the CPU: the compiled twin of `reference.colours`, and its adjoint.

_C20, _C21, _C22 = C2
_C30, _C31, _C32, _C33, _C34 = C3
_AHEAD = 20  # rows between prefetching a Gaussian and using it
_NEAREST = 1e-12  # world units; a Gaussian closer to the camera than this has no direction


@helper
def _direction(mean: Array, position: Array) -> tuple[float, float, float, float]:
    """Return the unit vector from the camera to the Gaussian, and the inverse distance."""
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
def _channels(sh: Array, b: Array) -> Point:
    """Return three colour channels before the clamp."""
    red = green = blue = 0.5
    for k in range(b.shape[0]):
        red, green, blue = red + b[k] * sh[k, 0], green + b[k] * sh[k, 1], blue + b[k] * sh[k, 2]
    return red, green, blue


@kernel
def _forward(
    first: int, last: int, rows: Array, sh: Array, means: Array, position: Array, out: Array
) -> None:
    """out[place] <- colour of the Gaussian rows[place]; columns of `out` beyond the third are left."""
    rows, sh, means, position, out = ln.borrowed((rows, sh, means, position, out))
    b, numbers = np.empty(sh.shape[1]), 3 * sh.shape[1]
    for place in range(first, last):
        later = np.int64(rows[min(place + _AHEAD, last - 1)])
        ln.prefetch(means, 3 * later)
        for start in range(0, numbers, 16):  # cache lines
            ln.prefetch(sh, numbers * later + start)
        ln.prefetch(sh, numbers * later + numbers - 1)  # the last may lie in one more
        n = rows[place]
        x, y, z, _ = _direction(means[n], position)
        _basis(x, y, z, b)
        for channel, value in enumerate(_channels(sh[n], b)):
            out[place, channel] = max(value, 0.0) if np.isfinite(value) else 0.0


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
    sh, means, position, colour_grad = ln.borrowed((sh, means, position, colour_grad))
    sh_grad, means_grad = ln.borrowed((sh_grad, means_grad))
    b, h = np.empty(sh.shape[1]), np.empty(sh.shape[1])
    for n in range(first, last):
        if colour_grad[n, 0] == 0 and colour_grad[n, 1] == 0 and colour_grad[n, 2] == 0:
            sh_grad[n] = 0  # as for about half, which are out of view
            continue
        x, y, z, inverse = _direction(means[n], position)
        _basis(x, y, z, b)
        h[:] = 0
        for channel, value in enumerate(_channels(sh[n], b)):
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


def colours(sh: Array, means: Array, camera_position: Array, rows: Array | None = None) -> Array:
    """Map (N, K, 3) float32 coefficients, (N, 3) float32 means to (N, 3) float32 display colours >= 0.

    rows: (M,) int32 Gaussians whose (M, 3) colours are returned; by default all.

    Invalid rows give 0; see `reference.colours`.
    """
    n = check_array("sh", sh, ("N", "K", 3), dtype=np.float32)
    check_array("means", means, ("N", 3), n, dtype=np.float32)
    rows = np.arange(len(sh), dtype=np.int32) if rows is None else rows
    out = np.empty((len(rows), 3), np.float32)
    position = np.array(camera_position, np.float64)
    shared_workers().run(_forward, len(rows), rows, plain(sh), plain(means), position, out)
    return out


def colours_backward(
    sh: Array, means: Array, camera_position: Array, colour_grad: Array
) -> tuple[Array, Array]:
    """Return float32 gradients (N, K, 3) by coefficients and (N, 3) by means, from (N, 3) by colours.

    They are 0 for channels clamped at 0 and for invalid rows.
    """
    n = check_array("sh", sh, ("N", "K", 3), dtype=np.float32)
    check_array("means", means, ("N", 3), n, dtype=np.float32)
    check_array("colour_grad", colour_grad, ("N", 3), n)
    sh_grad, means_grad = np.empty(sh.shape, np.float32), np.zeros(means.shape, np.float32)
    inputs = (plain(sh), plain(means), np.array(camera_position, np.float64), plain(colour_grad))
    shared_workers().run(_backward, len(sh), *inputs, sh_grad, means_grad)
    return sh_grad, means_grad
