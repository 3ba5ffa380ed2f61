"""Projection of Gaussians for the CPU backend: steps 1 and 2 of `reference.py`, compiled, and their adjoint.

Everything here is float64, in the reference's order of operations: depths agree with it bit for bit, and
coordinates of a million world units lose nothing. It costs about 0.1 microseconds a Gaussian.

A footprint is kept as the triangular factor of its conic, not as the conic: with (dx, dy) = pixel - mean,

    log2(alpha) = log2(opacity) - w^2 - v^2,   w = a (dx - k dy),   v = c dy,

where a^2 = log2(e)/2 * yy/det, k = xy/yy, c^2 = log2(e)/2 / yy (completing the square in dx; xx, xy, yy
and det are the 2D covariance's). A long thin footprint's conic is a difference of huge products; its factor
is not, so float32 pixels suffice.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from langsplat_core.arrays import Array
from langsplat_core.config import RasterSettings
from langsplat_core.scene import Camera

INVALID, UNDRAWN, DRAWN = 0, 1, 2  # what `project` says of a row
MEAN_X, MEAN_Y, FACTOR_A, FACTOR_K, FACTOR_C, LOG2_OPACITY, HALF_WIDTH, HALF_HEIGHT = range(8)  # columns
HALF_LOG2_E = 0.5 / np.log(2.0)
LN2 = np.log(2.0)
_COMPENSATION_MIN = 0.005**2  # floor of det before / det after dilation, as gsplat has it
_MAX_LOG_SCALE, _MIN_QUAT_SQUARED, _INFINITY_BITS = 80.0, 1e-24, 0x7F800000  # see Gaussians.valid


class Lens(NamedTuple):
    """What the kernels need to know of a camera and the settings."""

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
    dilation: float
    alpha_min: float
    antialiased: bool


def make_lens(camera: Camera, settings: RasterSettings) -> Lens:
    """The clamp is 1.3 times the half field of view beyond the image's borders; see `reference.project`."""
    margin_x = (settings.fov_clamp - 1) * 0.5 * camera.width / camera.fx
    margin_y = (settings.fov_clamp - 1) * 0.5 * camera.height / camera.fy
    return Lens(
        rotation=np.ascontiguousarray(camera.rotation),
        translation=np.ascontiguousarray(camera.world_to_camera[:3, 3]),
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(camera.cx),
        cy=float(camera.cy),
        width=float(camera.width),
        height=float(camera.height),
        left=camera.cx / camera.fx + margin_x,
        right=(camera.width - camera.cx) / camera.fx + margin_x,
        top=camera.cy / camera.fy + margin_y,
        bottom=(camera.height - camera.cy) / camera.fy + margin_y,
        near=float(settings.near),
        dilation=float(settings.dilation),
        alpha_min=float(settings.alpha_min),
        antialiased=bool(settings.antialiased),
    )


@njit(cache=True, forceinline=True)
def _camera_point(mean, lens):
    r, t = lens.rotation, lens.translation
    m0, m1, m2 = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
    return (
        r[0, 0] * m0 + r[0, 1] * m1 + r[0, 2] * m2 + t[0],
        r[1, 0] * m0 + r[1, 1] * m1 + r[1, 2] * m2 + t[1],
        r[2, 0] * m0 + r[2, 1] * m1 + r[2, 2] * m2 + t[2],
    )


@njit(cache=True, forceinline=True)
def _jacobian(x, y, z, lens):
    """Non-zero entries (0,0), (0,2), (1,1), (1,2) of d(pixel)/d(camera point), taken at the clamped point."""
    tx = min(max(x / z, -lens.left), lens.right)
    ty = min(max(y / z, -lens.top), lens.bottom)
    return lens.fx / z, -lens.fx * tx / z, lens.fy / z, -lens.fy * ty / z


@njit(cache=True, forceinline=True)
def _fill_axes(camera_point, log_scales, quat, lens, work):
    """work[0] <- rotation of the quaternion, work[1] <- B = J R (two rows), work[2] <- A = B rotation diag(s);
    returns the scales and the inverse length of the quaternion."""
    x, y, z = camera_point
    j00, j02, j11, j12 = _jacobian(x, y, z, lens)
    q0, q1, q2, q3 = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    inverse = 1 / np.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    q0, q1, q2, q3 = q0 * inverse, q1 * inverse, q2 * inverse, q3 * inverse
    turn, b, a = work[0], work[1], work[2]
    turn[0, 0], turn[0, 1], turn[0, 2] = (
        1 - 2 * (q2 * q2 + q3 * q3),
        2 * (q1 * q2 - q0 * q3),
        2 * (q1 * q3 + q0 * q2),
    )
    turn[1, 0], turn[1, 1], turn[1, 2] = (
        2 * (q1 * q2 + q0 * q3),
        1 - 2 * (q1 * q1 + q3 * q3),
        2 * (q2 * q3 - q0 * q1),
    )
    turn[2, 0], turn[2, 1], turn[2, 2] = (
        2 * (q1 * q3 - q0 * q2),
        2 * (q2 * q3 + q0 * q1),
        1 - 2 * (q1 * q1 + q2 * q2),
    )
    scales = (
        np.exp(np.float64(log_scales[0])),
        np.exp(np.float64(log_scales[1])),
        np.exp(np.float64(log_scales[2])),
    )
    for n in range(3):
        b[0, n] = j00 * lens.rotation[0, n] + j02 * lens.rotation[2, n]
        b[1, n] = j11 * lens.rotation[1, n] + j12 * lens.rotation[2, n]
    for r in range(2):
        a[r, 0] = (b[r, 0] * turn[0, 0] + b[r, 1] * turn[1, 0] + b[r, 2] * turn[2, 0]) * scales[0]
        a[r, 1] = (b[r, 0] * turn[0, 1] + b[r, 1] * turn[1, 1] + b[r, 2] * turn[2, 1]) * scales[1]
        a[r, 2] = (b[r, 0] * turn[0, 2] + b[r, 1] * turn[1, 2] + b[r, 2] * turn[2, 2]) * scales[2]
    return scales, inverse


@njit(cache=True, forceinline=True)
def _covariance(a, dilation):
    """2D covariance xx, xy, yy with dilation, its determinant, and the determinant before dilation.

    det(A A^T) = |row0 x row1|^2 (Cauchy-Binet): no cancellation, however thin the needle.
    """
    xx = a[0, 0] * a[0, 0] + a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2]
    yy = a[1, 0] * a[1, 0] + a[1, 1] * a[1, 1] + a[1, 2] * a[1, 2]
    xy = a[0, 0] * a[1, 0] + a[0, 1] * a[1, 1] + a[0, 2] * a[1, 2]
    c0 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    c1 = a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]
    c2 = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    sharp = c0 * c0 + c1 * c1 + c2 * c2
    return xx + dilation, xy, yy + dilation, sharp + dilation * (xx + yy) + dilation * dilation, sharp


@njit(cache=True, forceinline=True)
def _opacity(logit):
    e = np.exp(-abs(np.float64(logit)))
    return (1.0 if logit >= 0 else e) / (1 + e)


@njit(cache=True, forceinline=True)
def _is_valid(mean, log_scales, quat, logit, sh_bits):
    """The compiled twin of `Gaussians.valid`."""
    ok = not np.isnan(logit)
    squared = 0.0
    for n in range(3):
        ok &= np.isfinite(mean[n]) & (log_scales[n] <= _MAX_LOG_SCALE)
    for n in range(4):
        squared += np.float64(quat[n]) * np.float64(quat[n])
    highest = np.uint32(0)
    for n in range(sh_bits.shape[0]):
        highest = max(highest, sh_bits[n] & np.uint32(0x7FFFFFFF))
    return ok & np.isfinite(squared) & (squared > _MIN_QUAT_SQUARED) & (highest < np.uint32(_INFINITY_BITS))


@njit(cache=True, parallel=True, nogil=True)
def project(means, log_scales, quats, logits, sh_bits, lens, geometry, depths, status):
    """Fill `geometry` (N, 8), `depths` (N,) and `status` (N,) for N Gaussians.

    A Gaussian whose alpha = alpha_min contour meets no pixel centre is UNDRAWN.
    """
    for i in prange(means.shape[0]):
        if not _is_valid(means[i], log_scales[i], quats[i], logits[i], sh_bits[i]):
            status[i] = INVALID
            continue
        status[i] = UNDRAWN
        x, y, z = _camera_point(means[i], lens)
        opacity = _opacity(logits[i])
        if not (z > lens.near and opacity >= lens.alpha_min):
            continue
        work = np.empty((3, 3, 3))
        _fill_axes((x, y, z), log_scales[i], quats[i], lens, work)
        xx, xy, yy, det, sharp = _covariance(work[2], lens.dilation)
        if lens.antialiased:
            opacity *= np.sqrt(max(sharp / det, _COMPENSATION_MIN))
            if opacity < lens.alpha_min:
                continue
        reach = np.sqrt(2 * np.log(max(opacity / lens.alpha_min, 1.0)))
        u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
        wide, high = reach * np.sqrt(xx), reach * np.sqrt(yy)
        if u + wide < 0.5 or u - wide > lens.width - 0.5 or v + high < 0.5 or v - high > lens.height - 0.5:
            continue
        status[i] = DRAWN
        depths[i] = z
        row = geometry[i]
        row[MEAN_X], row[MEAN_Y] = u, v
        row[FACTOR_A] = np.sqrt(HALF_LOG2_E * yy / det)
        row[FACTOR_K] = xy / yy
        row[FACTOR_C] = np.sqrt(HALF_LOG2_E / yy)
        row[LOG2_OPACITY] = np.log2(opacity)
        row[HALF_WIDTH], row[HALF_HEIGHT] = wide, high
