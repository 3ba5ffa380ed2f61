"""Intrinsics of photographs: where a photograph's pixels look, in the conventions of COLMAP and OpenCV.

A point in the camera's frame has *normalised* coordinates (x/z, y/z). A distortion maps normalised to
distorted coordinates, and the pixel position is ``(fx * x_d + cx, fy * y_d + cy)``, with pixel centres
at +0.5. Formulas: OpenCV's "Camera Calibration and 3D Reconstruction" and "Fisheye camera model".
Everything here is float64; it is the reference that resampling follows.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import Intrinsics

# What no photograph exceeds; numbers of damaged files would overflow in what is computed from them.
MOST_SIDE = 1 << 20  # pixels
FOCAL_RANGE = (1e-3, 1e5)  # in lengths of the longer side; a telescope of 100 m on a 36 mm sensor has 3000
MOST_SHIFT = 1e3  # of the principal point, in lengths of the longer side


class Distortion(Protocol):
    """Maps (N, 2) normalised to (N, 2) distorted coordinates, float64. Hashable, so that photographs
    taken with one lens share what is computed from it."""

    def __call__(self, xy: Array) -> Array: ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class BrownDistortion:
    """Radial (rational, k1 to k6) and decentring (p1, p2) distortion of ordinary lenses; COLMAP's
    SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __call__(self, xy: Array) -> Array:
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        radial = radial / (1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6)))
        dx = 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        dy = self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([x * radial + dx, y * radial + dy], -1)


@dataclass(frozen=True)
class FisheyeDistortion:
    """Equidistant projection with a polynomial in the angle from the axis; COLMAP's OPENCV_FISHEYE,
    SIMPLE_RADIAL_FISHEYE and RADIAL_FISHEYE."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def __call__(self, xy: Array) -> Array:
        r = np.linalg.norm(xy, axis=-1)
        theta = np.arctan(r)
        t2 = theta * theta
        distorted = theta * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))
        scale = np.divide(distorted, r, out=np.ones_like(r), where=r > 1e-12)
        return xy * scale[:, None]


@dataclass(frozen=True)
class ColmapDistortion:
    """Any other of COLMAP's models, evaluated by pycolmap itself."""

    model: str  # COLMAP's name, e.g. THIN_PRISM_FISHEYE
    params: tuple[float, ...]  # as in the model file; the first four are fx, fy, cx, cy or two/three thereof
    fx: float
    fy: float
    cx: float
    cy: float

    def __call__(self, xy: Array) -> Array:
        from langsplat_core.datasets.colmap_library import pycolmap

        # The size plays no part in these models, but pycolmap asks for one.
        camera = pycolmap.Camera(model=self.model, width=1, height=1, params=np.array(self.params))
        rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        return (np.asarray(camera.img_from_cam(rays)) - (self.cx, self.cy)) / (self.fx, self.fy)


@dataclass(frozen=True)
class PhotoIntrinsics(Intrinsics):
    """Intrinsics of a photograph as it lies on disk, of whole pixels."""

    width: int
    height: int
    distortion: Distortion | None = None  # None: a pinhole

    def __post_init__(self) -> None:
        super().__post_init__()
        side = max(self.width, self.height)
        least, most = FOCAL_RANGE
        if side > MOST_SIDE:
            raise ValueError(f"a photograph of more than {MOST_SIDE} pixels a side")
        if not least * side <= min(self.fx, self.fy) <= max(self.fx, self.fy) <= most * side:
            raise ValueError(
                f"focal lengths {self.fx:g} and {self.fy:g} for {side} pixels; none has such a lens"
            )
        if max(abs(self.cx), abs(self.cy)) > MOST_SHIFT * side:
            raise ValueError(
                f"the principal point ({self.cx:g}, {self.cy:g}) is far outside of the photograph"
            )
        if self.distortion == BrownDistortion():  # all zero, as many files write a pinhole
            object.__setattr__(self, "distortion", None)

    def regridded(self, width: int, height: int) -> "PhotoIntrinsics":
        """The same lens on another pixel grid over the same picture."""
        inner = self.resized(width, height)
        return PhotoIntrinsics(width, height, inner.fx, inner.fy, inner.cx, inner.cy, self.distortion)

    def pixels(self, xy: Array) -> Array:
        """(N, 2) normalised coordinates -> (N, 2) pixel positions in the photograph."""
        distorted = xy if self.distortion is None else self.distortion(xy)
        return distorted * (self.fx, self.fy) + (self.cx, self.cy)
