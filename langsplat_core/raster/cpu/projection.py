"""Projection of Gaussians for the CPU backend: steps 1 and 2 of `reference.py`, compiled.

Everything here is float64, in the reference's order of operations: depths agree with it bit for bit, and
coordinates of a million world units lose nothing. It costs about 0.1 microseconds a Gaussian.

A footprint is kept as the triangular factor of its conic, not as the conic: with (dx, dy) = pixel - mean,

    log2(alpha) = log2(opacity) - w^2 - v^2,   w = a (dx - k dy),   v = c dy,

where a^2 = log2(e)/2 * yy/det, k = xy/yy, c^2 = log2(e)/2 / yy (completing the square in dx; xx, xy, yy
and det are the 2D covariance's). A long thin footprint's conic is a difference of huge products; its factor
is not, so float32 pixels suffice.
"""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.compiled import helper, kernel, plain, shared_workers
from langsplat_core.config import RasterSettings
from langsplat_core.raster.cpu.lanes import borrowed, prefetch
from langsplat_core.raster.protocol import dilation, farthest, tangent_limits
from langsplat_core.scene import Camera, Gaussians
from langsplat_core.scene.transform import C0, C1, C2, C3

COLUMNS = 8  # of the geometry: one cache line a row
UNUSABLE = -1.0  # size of a row that is not valid
MEAN_X, MEAN_Y, FACTOR_A, FACTOR_K, FACTOR_C, LOG2_OPACITY, HALF_WIDTH, HALF_HEIGHT = range(8)  # columns
HALF_LOG2_E = 0.5 / np.log(2.0)
LN2 = np.log(2.0)
COMPENSATION_MIN = 0.005**2  # floor of det with the fitted dilation / det with all of it, as INRIA has it
_TINY = 1e-30


Point = tuple[float, float, float]


class Rows(NamedTuple):
    """N Gaussians as `Gaussians` stores them."""

    means: Array  # (N, 3) float32
    log_scales: Array  # (N, 3) float32
    quats_wxyz: Array  # (N, 4) float32
    opacity_logits: Array  # (N,) float32
    sizes: Array  # (N,) float32 the largest of a row's scales or a little more, world units; or `UNUSABLE`


class Projection(NamedTuple):
    """Gaussians projected onto the image plane, as `project` returns them."""

    geometry: Array  # (N, 8) float64, columns MEAN_X to HALF_HEIGHT; only where drawn
    depths: Array  # (N,) float64 camera z; only where drawn
    drawn: Array  # (N,) bool


class KernelCamera(NamedTuple):
    """Camera and settings as the kernels take them."""

    rotation: Array  # (3, 3) world to camera
    translation: Array  # (3,)
    fx: float  # px
    fy: float
    cx: float
    cy: float
    width: float  # px
    height: float
    left: float  # limits of |x/z| and |y/z| in the Jacobian, on each side of the axis
    right: float
    top: float
    bottom: float
    near: float
    far: float
    dilation: float
    fitted: float  # of the dilation, see `protocol.Dilation`
    alpha_min: float
    orthographic: bool
    reach_x: float  # bounds of a footprint's half width and height: px for each unit of size over depth
    reach_y: float
    margin: float  # px that are to be added


def kernel_camera(camera: Camera, settings: RasterSettings) -> KernelCamera:
    """Return camera and settings as kernels take them."""
    limits = dict(zip(("left", "top", "right", "bottom"), tangent_limits(camera, settings), strict=True))
    added, fitted = dilation(camera, settings)
    # Half width = reach sqrt((A A^T)_xx + dilation), A = J R S: so at most
    # reach (|J_x| |R| size + sqrt(dilation)).
    reach = np.sqrt(-2 * np.log(min(settings.alpha_min, 1.0)))
    wide, high = (
        (0.0, 0.0)
        if camera.orthographic
        else (max(limits["left"], limits["right"]), max(limits["top"], limits["bottom"]))
    )
    most = 1.001 * reach * np.linalg.norm(camera.rotation, 2)  # 1.001: room for rounding
    plane = {name: float(value) for name, value in vars(camera.intrinsics).items()}
    return KernelCamera(
        rotation=np.ascontiguousarray(camera.rotation),
        translation=np.ascontiguousarray(camera.world_to_camera[:3, 3]),
        **plane,
        **{side: float(limit) for side, limit in limits.items()},
        near=float(settings.near),
        far=float(farthest(settings)),
        dilation=float(added),
        fitted=float(fitted),
        alpha_min=float(settings.alpha_min),
        orthographic=camera.orthographic,
        reach_x=float(most * camera.fx * np.hypot(1, wide)),
        reach_y=float(most * camera.fy * np.hypot(1, high)),
        margin=float(1.001 * reach * np.sqrt(added) + 1e-3),
    )


@helper
def camera_point(mean: Array, camera: KernelCamera) -> Point:
    """Return a mean in the camera's frame, float64, in the reference's order of operations."""
    r, t = camera.rotation, camera.translation
    m0, m1, m2 = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
    return (
        r[0, 0] * m0 + r[0, 1] * m1 + r[0, 2] * m2 + t[0],
        r[1, 0] * m0 + r[1, 1] * m1 + r[1, 2] * m2 + t[1],
        r[2, 0] * m0 + r[2, 1] * m1 + r[2, 2] * m2 + t[2],
    )


@helper
def _jacobian(x: float, y: float, z: float, camera: KernelCamera) -> tuple[float, float, float, float]:
    """Non-zero entries (0,0), (0,2), (1,1), (1,2) of d(pixel)/d(camera point), taken at the clamped point."""
    if camera.orthographic:
        return camera.fx, 0.0, camera.fy, 0.0
    tx = min(max(x / z, -camera.left), camera.right)
    ty = min(max(y / z, -camera.top), camera.bottom)
    return camera.fx / z, -camera.fx * tx / z, camera.fy / z, -camera.fy * ty / z


@helper
def fill_axes(
    point: Point, log_scales: Array, quat: Array, camera: KernelCamera, work: Array
) -> tuple[Point, float]:
    """Fill work: [0] the quaternion's rotation, [1] B = J R (two rows), [2] A = B rotation diag(s).

    Returns the scales s and the inverse length of the quaternion.
    """
    x, y, z = point
    j00, j02, j11, j12 = _jacobian(x, y, z, camera)
    q0, q1, q2, q3 = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    inverse = 1 / np.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    q0, q1, q2, q3 = q0 * inverse, q1 * inverse, q2 * inverse, q3 * inverse
    turn, b, a = work[0], work[1], work[2]
    turn[0, 0] = 1 - 2 * (q2 * q2 + q3 * q3)
    turn[0, 1] = 2 * (q1 * q2 - q0 * q3)
    turn[0, 2] = 2 * (q1 * q3 + q0 * q2)
    turn[1, 0] = 2 * (q1 * q2 + q0 * q3)
    turn[1, 1] = 1 - 2 * (q1 * q1 + q3 * q3)
    turn[1, 2] = 2 * (q2 * q3 - q0 * q1)
    turn[2, 0] = 2 * (q1 * q3 - q0 * q2)
    turn[2, 1] = 2 * (q2 * q3 + q0 * q1)
    turn[2, 2] = 1 - 2 * (q1 * q1 + q2 * q2)
    s0, s1, s2 = np.float64(log_scales[0]), np.float64(log_scales[1]), np.float64(log_scales[2])
    scales = np.exp(s0), np.exp(s1), np.exp(s2)
    for n in range(3):
        b[0, n] = j00 * camera.rotation[0, n] + j02 * camera.rotation[2, n]
        b[1, n] = j11 * camera.rotation[1, n] + j12 * camera.rotation[2, n]
    for r in range(2):
        a[r, 0] = (b[r, 0] * turn[0, 0] + b[r, 1] * turn[1, 0] + b[r, 2] * turn[2, 0]) * scales[0]
        a[r, 1] = (b[r, 0] * turn[0, 1] + b[r, 1] * turn[1, 1] + b[r, 2] * turn[2, 1]) * scales[1]
        a[r, 2] = (b[r, 0] * turn[0, 2] + b[r, 1] * turn[1, 2] + b[r, 2] * turn[2, 2]) * scales[2]
    return scales, inverse


@helper
def covariance(a: Array, dilation: float, fitted: float) -> tuple[float, float, float, float, float]:
    """2D covariance xx, xy, yy with dilation, its determinant, and that with the fitted dilation.

    det(A A^T) = |row0 x row1|^2 (Cauchy-Binet): no cancellation, however thin the needle.
    """
    xx = a[0, 0] * a[0, 0] + a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2]
    yy = a[1, 0] * a[1, 0] + a[1, 1] * a[1, 1] + a[1, 2] * a[1, 2]
    xy = a[0, 0] * a[1, 0] + a[0, 1] * a[1, 1] + a[0, 2] * a[1, 2]
    c0 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    c1 = a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]
    c2 = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    sharp = c0 * c0 + c1 * c1 + c2 * c2
    det = sharp + dilation * (xx + yy) + dilation * dilation
    return xx + dilation, xy, yy + dilation, det, sharp + fitted * (xx + yy) + fitted * fitted


@helper
def opacity_of(logit: float) -> float:
    """Return the logistic function of a logit, float64."""
    e = np.exp(-abs(np.float64(logit)))
    return (1.0 if logit >= 0 else e) / (1 + e)


@helper
def _is_outside(x: float, y: float, over: float, size: float, camera: KernelCamera) -> bool:
    """Return True only for footprints that cannot meet a pixel centre, whatever their shape.

    These are most of those that do not. over: depth, or 1 without perspective.
    """
    u, v = camera.fx * x / over + camera.cx, camera.fy * y / over + camera.cy
    wide = camera.reach_x * size / over + camera.margin
    high = camera.reach_y * size / over + camera.margin
    return (u + wide < 0) | (u - wide > camera.width) | (v + high < 0) | (v - high > camera.height)


_SIZES: WeakKeyDictionary[Gaussians, Array] = WeakKeyDictionary()  # Gaussians are not changed


def rows_of(gaussians: Gaussians) -> Rows:
    """Return the Gaussians as kernels take them; their sizes are measured once."""
    sizes = _SIZES.get(gaussians)
    if sizes is None:
        with np.errstate(over="ignore", invalid="ignore"):  # of rows that are not valid
            a, b, c = gaussians.log_scales.T
            largest = 1.000001 * np.exp(np.maximum(np.maximum(a, b), c)) + np.float32(_TINY)
        _SIZES[gaussians] = sizes = np.where(gaussians.valid(), largest, np.float32(UNUSABLE))
    return Rows(
        plain(gaussians.means),
        plain(gaussians.log_scales),
        plain(gaussians.quats_wxyz),
        plain(gaussians.opacity_logits),
        sizes,
    )


@kernel
def project(first: int, last: int, rows: Rows, camera: KernelCamera, out: Projection) -> None:
    """Fill `out` for rows [first, last).

    A Gaussian whose alpha = alpha_min contour meets no pixel centre is not drawn.
    """
    rows, camera, out = borrowed((rows, camera, out))
    work = np.empty((3, 3, 3))
    log2_least = np.log2(camera.alpha_min)
    for i in range(first, last):
        out.drawn[i] = False
        if rows.sizes[i] == UNUSABLE:
            continue
        x, y, z = camera_point(rows.means[i], camera)
        if not (camera.near < z <= camera.far):
            continue
        over = 1.0 if camera.orthographic else z
        if _is_outside(x, y, over, rows.sizes[i], camera):
            continue
        opacity = opacity_of(rows.opacity_logits[i])
        if not opacity >= camera.alpha_min:
            continue
        fill_axes((x, y, z), rows.log_scales[i], rows.quats_wxyz[i], camera, work)
        xx, xy, yy, det, det_fitted = covariance(work[2], camera.dilation, camera.fitted)
        if camera.fitted < camera.dilation:
            opacity *= np.sqrt(max(det_fitted / det, COMPENSATION_MIN))
            if opacity < camera.alpha_min:
                continue
        log2_opacity = np.log2(opacity)
        reach = 2 * LN2 * max(log2_opacity - log2_least, 0.0)  # squared
        u, v = camera.fx * x / over + camera.cx, camera.fy * y / over + camera.cy
        wide, high = np.sqrt(reach * xx), np.sqrt(reach * yy)
        right, bottom = camera.width - 0.5, camera.height - 0.5  # the last pixel's centre
        if u + wide < 0.5 or u - wide > right or v + high < 0.5 or v - high > bottom:
            continue
        out.drawn[i] = True
        out.depths[i] = z
        g = out.geometry[i]
        g[MEAN_X], g[MEAN_Y] = u, v
        g[FACTOR_A] = np.sqrt(HALF_LOG2_E * yy / det)
        g[FACTOR_K] = xy / yy
        g[FACTOR_C] = np.sqrt(HALF_LOG2_E / yy)
        g[LOG2_OPACITY] = log2_opacity
        g[HALF_WIDTH], g[HALF_HEIGHT] = wide, high


# View-dependent colours on the CPU: the compiled twin of `reference.colours`, and its adjoint.

_C20, _C21, _C22 = C2
_C30, _C31, _C32, _C33, _C34 = C3
_AHEAD = 20  # rows between asking for a Gaussian and using it
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
def _channel(sh: Array, b: Array, channel: int) -> float:
    """One colour channel before the clamp."""
    value = 0.5
    for k in range(b.shape[0]):
        value += b[k] * sh[k, channel]
    return value


@kernel
def _forward(
    first: int, last: int, rows: Array, sh: Array, means: Array, position: Array, out: Array
) -> None:
    """out[place] <- colour of the Gaussian rows[place]; columns of `out` beyond the third are left."""
    rows, sh, means, position, out = borrowed((rows, sh, means, position, out))
    b, numbers = np.empty(sh.shape[1]), 3 * sh.shape[1]
    for place in range(first, last):
        later = np.int64(rows[min(place + _AHEAD, last - 1)])
        prefetch(means, 3 * later)
        for start in range(0, numbers, 16):  # cache lines
            prefetch(sh, numbers * later + start)
        prefetch(sh, numbers * later + numbers - 1)  # in half of them it begins another
        n = rows[place]
        x, y, z, _ = _direction(means[n], position)
        _basis(x, y, z, b)
        for channel in range(3):
            value = _channel(sh[n], b, channel)
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
    sh, means, position, colour_grad = borrowed((sh, means, position, colour_grad))
    sh_grad, means_grad = borrowed((sh_grad, means_grad))
    b, h = np.empty(sh.shape[1]), np.empty(sh.shape[1])
    for n in range(first, last):
        if colour_grad[n, 0] == 0 and colour_grad[n, 1] == 0 and colour_grad[n, 2] == 0:
            sh_grad[n] = 0  # as half of them, which the view does not show
            continue
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


def colours(sh: Array, means: Array, camera_position: Array, rows: Array | None = None) -> Array:
    """Map (N, K, 3) float32 coefficients, (N, 3) float32 means to (N, 3) float32 display colours >= 0.

    With `rows`, (M,) int32, those of these Gaussians.

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
