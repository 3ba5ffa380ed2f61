"""Lenses of photographs: their formulas, their inverses, and resampling to a pinhole.

A point in the camera's frame has *normalised* coordinates (x/z, y/z), float64. A distortion maps these to
distorted ones, and the pixel position is ``(fx * x_d + cx, fy * y_d + cy)``, with pixel centres at +0.5.
Formulas: OpenCV's "Camera Calibration and 3D Reconstruction" and "Fisheye camera model".
"""

from dataclasses import dataclass

import numpy as np
import scipy
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.scene import Camera, Intrinsics


@dataclass(frozen=True)
class BrownDistortion:
    """Radial (rational, k1 to k6) and decentring (p1, p2) distortion of ordinary lenses."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __call__(self, xy: Array) -> Array:
        """Return (N, 2) float64 distorted coordinates of (N, 2) normalised ones."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        radial = radial / (1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6)))
        dx = 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        dy = self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([x * radial + dx, y * radial + dy], -1)


@dataclass(frozen=True)
class FisheyeDistortion:
    """Equidistant projection with a polynomial in the angle from the axis."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def __call__(self, xy: Array) -> Array:
        """Return (N, 2) float64 distorted coordinates of (N, 2) normalised ones."""
        r = np.linalg.norm(xy, axis=-1)
        theta = np.arctan(r)
        t2 = theta * theta
        distorted = theta * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))
        return xy * np.divide(distorted, r, out=np.ones_like(r), where=r > 1e-12)[:, None]


Distortion = BrownDistortion | FisheyeDistortion


@dataclass(frozen=True)
class PhotoIntrinsics(Intrinsics):
    """Intrinsics of a photograph as it lies on disk, of whole pixels."""

    width: int
    height: int
    distortion: Distortion | None = None  # None: a pinhole

    def __post_init__(self) -> None:
        super().__post_init__()
        # What no photograph exceeds; numbers of damaged files would overflow in what is computed from them. A
        # telescope of 100 m has a focal length of 3000 sides of a 36 mm sensor.
        side, shift = max(self.width, self.height), max(abs(self.cx), abs(self.cy))
        if side > 1 << 20:
            raise ValueError(f"a photograph of {side} pixels a side; at most {1 << 20} are read")
        if not 1e-3 * side <= min(self.fx, self.fy) <= max(self.fx, self.fy) <= 1e5 * side:
            raise ValueError(f"focal lengths {self.fx:g} and {self.fy:g} for {side} pixels, as of no lens")
        if shift > 1e3 * side:
            raise ValueError(f"the principal point ({self.cx:g}, {self.cy:g}) is far outside")
        if self.distortion == BrownDistortion():  # all zero, as many files write a pinhole
            object.__setattr__(self, "distortion", None)

    def pixels(self, xy: Array) -> Array:
        """Return (N, 2) pixel positions in the photograph of (N, 2) normalised coordinates."""
        distorted = xy if self.distortion is None else self.distortion(xy)
        return distorted * (self.fx, self.fy) + (self.cx, self.cy)


# From a lens to a pinhole: the inverse of a distortion, the choice of pinhole, and the resampling.

MAX_HALF_ANGLE = np.radians(65)  # from the axis; a pinhole image stretches without bound towards 90


def _radial_profile(distortion: Distortion) -> tuple[Array, Array]:
    """Return radii 0 to R that can be inverted, and the mean distorted radius of each.

    R is the cap `MAX_HALF_ANGLE` or just inside the first radius at which the Jacobian is singular.
    """
    radii = np.tan(np.linspace(0, MAX_HALF_ANGLE, 400))
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    points = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
    with np.errstate(all="ignore"):  # absurd coefficients overflow; what is not a number counts as folded
        determinant = np.linalg.det(_jacobian(distortion, points.reshape(-1, 2)))
        folded = ~(determinant > 0).reshape(len(radii), -1).all(1)
        end = int(np.argmax(folded)) if folded.any() else len(radii)
        distorted = distortion(points[:end].reshape(-1, 2)).reshape(end, -1, 2)
        profile = np.linalg.norm(distorted, axis=-1).mean(1)
    return radii[:end], profile


def _jacobian(distortion: Distortion, xy: Array) -> Array:
    """Return (N, 2, 2) by central differences; Newton's method needs no better."""
    step = 1e-6
    columns = [(distortion(xy + move) - distortion(xy - move)) / (2 * step) for move in np.eye(2) * step]
    return np.stack(columns, -1)


def undistorted_points(distortion: Distortion, distorted: Array) -> Array:
    """Return (N, 2) normalised coordinates of distorted ones, by Newton's method from the radial inverse.

    Points beyond the invertible radius come back on it. ValueError for a distortion singular on the axis.
    """
    radii, profile = _radial_profile(distortion)
    if len(radii) < 2:
        raise ValueError("the distortion cannot be inverted even at the centre")
    length = np.linalg.norm(distorted, axis=-1)
    direction = distorted / np.maximum(length, 1e-12)[:, None]
    xy = direction * np.interp(length, profile, radii)[:, None]
    limit = radii[-1]
    for _ in range(30):
        step = np.linalg.solve(_jacobian(distortion, xy), (distortion(xy) - distorted)[:, :, None])[:, :, 0]
        # A short step cannot leap over a fold; the radius cannot leave the invertible disc.
        step *= np.minimum(1, 0.2 * limit / np.maximum(np.linalg.norm(step, axis=-1), 1e-300))[:, None]
        xy = xy - step
        xy *= np.minimum(1, limit / np.maximum(np.linalg.norm(xy, axis=-1), 1e-300))[:, None]
        if np.abs(step).max(initial=0) < 1e-13:
            break
    return xy


def pinhole_for(intrinsics: PhotoIntrinsics, max_side: int) -> Camera:
    """Return the pinhole camera (identity pose) that a photograph is resampled to.

    It shows the largest upright rectangle inside the photograph (OpenCV's ``alpha = 0``), magnified as in
    its centre, then shrunk to at most `max_side` pixels. InputError if the lens leaves no such rectangle.
    """
    if intrinsics.distortion is None:
        scale = min(1.0, max_side / max(intrinsics.width, intrinsics.height))
        size = max(1, round(intrinsics.width * scale)), max(1, round(intrinsics.height * scale))
        small = intrinsics.resized(*size)
        return Camera(*size, small.fx, small.fy, small.cx, small.cy, np.eye(4))
    left, top, right, bottom = _inner_rectangle(intrinsics)
    wide, high = intrinsics.fx * (right - left), intrinsics.fy * (bottom - top)
    if not (wide >= 1 and high >= 1):
        raise InputError(f"a lens of fx {intrinsics.fx:g} leaves no undistorted image; calibrate it again")
    scale = min(1.0, max_side / max(wide, high))
    width, height = max(1, int(wide * scale)), max(1, int(high * scale))
    fx, fy = intrinsics.fx * scale, intrinsics.fy * scale
    # Whole pixels: what is cut off is shared between both edges.
    cx = -left * fx - (wide * scale - width) / 2
    cy = -top * fy - (high * scale - height) / 2
    return Camera(width, height, fx, fy, cx, cy, np.eye(4))


def _inner_rectangle(intrinsics: PhotoIntrinsics) -> tuple[float, float, float, float]:
    """Return normalised left, top, right, bottom of a rectangle wholly inside the undistorted outline."""
    assert intrinsics.distortion is not None
    t = np.linspace(0, 1, 64)
    zero, one = np.zeros_like(t), np.ones_like(t)
    sides = np.stack([np.stack(side, -1) for side in ((zero, t), (t, zero), (one, t), (t, one))])
    pixels = sides.reshape(-1, 2) * (intrinsics.width, intrinsics.height)
    distorted = (pixels - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy)
    try:
        left, top, right, bottom = undistorted_points(intrinsics.distortion, distorted).reshape(4, -1, 2)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise InputError(f"a lens of fx {intrinsics.fx:g}: {error}; calibrate it again") from None
    most, least = (left[:, 0].max(), top[:, 1].max()), (right[:, 0].min(), bottom[:, 1].min())
    return float(most[0]), float(most[1]), float(least[0]), float(least[1])


def source_positions(intrinsics: PhotoIntrinsics, camera: Camera) -> Array:
    """Return (H, W, 2) float64 position in the photograph of the centre of each of the camera's pixels."""
    grid = (camera.pixel_centres() - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return intrinsics.pixels(grid.reshape(-1, 2)).reshape(grid.shape)


def resample(
    photo: Image.Image, intrinsics: PhotoIntrinsics, camera: Camera, positions: Array | None
) -> Array:
    """Return the (H, W, 3) uint8 image of `camera` from an RGB photograph.

    The photograph has the size of `intrinsics`. `positions` is `source_positions(intrinsics, camera)`, or
    None for a lens without distortion. The photograph is first shrunk to the camera's magnification by an
    area-weighted filter, so that the interpolation (cubic spline) that follows neither aliases nor blurs.
    """
    size = camera.width, camera.height
    if positions is not None:
        scale = min(camera.fx / intrinsics.fx, 1.0)
        size = max(1, round(intrinsics.width * scale)), max(1, round(intrinsics.height * scale))
    pixels = np.asarray(photo if photo.size == size else photo.resize(size, Image.Resampling.LANCZOS))
    if positions is None:
        return pixels
    # Array index i holds the pixel whose centre is at i + 0.5.
    rows = positions[..., 1] * (pixels.shape[0] / intrinsics.height) - 0.5
    columns = positions[..., 0] * (pixels.shape[1] / intrinsics.width) - 0.5
    out = np.empty((camera.height, camera.width, 3), np.uint8)
    for channel in range(3):
        values = scipy.ndimage.map_coordinates(
            pixels[..., channel], [rows, columns], output=np.float32, order=3, mode="nearest"
        )
        out[..., channel] = np.clip(np.rint(values), 0, 255)
    return out
