"""Cameras: their intrinsics on a pixel grid, their pose, and what they project where."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from langsplat_core.arrays import Array, across, check_array


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths and principal point. Sizes may be fractions where no image is meant."""

    width: float  # pixels, > 0
    height: float
    fx: float  # pixels, > 0
    fy: float
    cx: float  # pixels from the left edge; the first pixel's centre is at 0.5
    cy: float  # pixels from the top edge

    def __post_init__(self) -> None:
        if not (self.width > 0 and self.height > 0):
            raise ValueError(f"a picture of {self.width}x{self.height} pixels")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and min(self.fx, self.fy) > 0):
            raise ValueError("focal lengths must be positive and the principal point finite")

    def resized(self, width: float, height: float) -> "Intrinsics":
        """Return the same camera on another pixel grid over the same image."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    def fitted(self, width: float, height: float) -> "Intrinsics":
        """Return the same camera in a window that holds its whole image, centred, as large as it goes.

        Square pixels are kept square.
        """
        scale = min(width / self.width, height / self.height)
        cx = (self.cx - self.width / 2) * scale + width / 2
        cy = (self.cy - self.height / 2) * scale + height / 2
        return Intrinsics(width, height, self.fx * scale, self.fy * scale, cx, cy)

    @property
    def fov_degrees(self) -> float:
        """Angle of view across the shorter side."""
        return math.degrees(2 * math.atan(0.5 * min(self.width, self.height) / min(self.fx, self.fy)))


# Pinhole and orthographic cameras, in OpenCV's frame: x right, y down, z forward.

FARTHEST = 1e9  # world units along an axis, of cameras in files: there, float32 positions are 64 units apart


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion, or an orthographic one.

    Pixel (0, 0) is the top left one and its centre lies at (0.5, 0.5). An orthographic camera looks along its
    z axis everywhere; its focal lengths are pixels per world unit, and what lies behind it is not drawn.
    """

    width: int  # pixels, >= 1
    height: int  # pixels, >= 1
    fx: float  # pixels, > 0; orthographic: pixels per world unit
    fy: float
    cx: float  # pixels, principal point measured from the left edge
    cy: float  # pixels, principal point measured from the top edge
    world_to_camera: Array  # (4, 4) float64, rigid
    name: str = ""  # file stem of the photograph it belongs to, if any
    orthographic: bool = False

    def __post_init__(self) -> None:
        matrix = np.ascontiguousarray(self.world_to_camera, dtype=np.float64)
        check_array("world_to_camera", matrix, (4, 4))
        if not np.isfinite(matrix).all():
            raise ValueError("world_to_camera: every entry must be finite")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera size must be at least 1x1, got {self.width}x{self.height}")
        if not (self.fx > 0 and self.fy > 0 and np.isfinite([self.fx, self.fy, self.cx, self.cy]).all()):
            raise ValueError("camera: fx and fy must be positive and all intrinsics finite")
        object.__setattr__(self, "world_to_camera", matrix)

    @property
    def position(self) -> Array:
        """(3,) centre of projection, or the point of the principal pixel in the plane z = 0; world units."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def rotation(self) -> Array:
        """(3, 3) world-to-camera rotation; its rows are the camera's right, down and forward axes."""
        return self.world_to_camera[:3, :3]

    @property
    def intrinsics(self) -> Intrinsics:
        """Focal lengths and principal point on the camera's own pixel grid."""
        return Intrinsics(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def with_intrinsics(self, intrinsics: Intrinsics) -> "Camera":
        """Another camera in the same pose; its size must be whole pixels."""
        inner = {name: getattr(intrinsics, name) for name in ("fx", "fy", "cx", "cy")}
        return replace(self, width=int(intrinsics.width), height=int(intrinsics.height), **inner)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the same view on another pixel grid."""
        return self.with_intrinsics(self.intrinsics.resized(width, height))

    def within(self, side: int) -> "Camera":
        """Return the same view, no side of whose image is longer than `side` pixels."""
        share = min(side / max(self.width, self.height), 1.0)
        return self.resized(max(round(share * self.width), 1), max(round(share * self.height), 1))

    def project(self, points_world: Array) -> tuple[Array, Array]:
        """(N, 3) world points -> (N, 2) pixel positions and (N,) depths along z (may be <= 0)."""
        in_camera = points_world @ self.rotation.T + self.world_to_camera[:3, 3]
        depth = in_camera[:, 2]
        safe = 1.0 if self.orthographic else np.where(np.abs(depth) < 1e-12, 1e-12, depth)[:, None]
        return in_camera[:, :2] / safe * (self.fx, self.fy) + (self.cx, self.cy), depth

    def unproject(self, pixels: ArrayLike, depths: ArrayLike) -> Array:
        """(..., 2) pixel positions and (...) depths along z, or one for all -> (..., 3) world points."""
        places, z = np.asarray(pixels, np.float64), np.asarray(depths, np.float64)[..., None]
        offsets = (places - (self.cx, self.cy)) / (self.fx, self.fy) * (1.0 if self.orthographic else z)
        in_camera = np.concatenate([offsets, np.broadcast_to(z, (*offsets.shape[:-1], 1))], -1)
        points: Array = (in_camera - self.world_to_camera[:3, 3]) @ self.rotation
        return points

    def pixel_centres(self) -> Array:
        """(H, W, 2) positions x, y of the centres of all pixels."""
        x, y = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([x, y], -1) + 0.5

    def in_image(self, pixels: Array, depths: Array) -> Array:
        """(N,) bool, which points, as `project` returns them, lie before the camera and inside its image."""
        with np.errstate(invalid="ignore"):
            inside: Array = (depths > 0) & ((pixels >= 0) & (pixels < (self.width, self.height))).all(1)
        return inside


def look_at(
    eye: Array, target: Array, up: Array, size: tuple[int, int], fov_y_degrees: float = 50.0
) -> Camera:
    """Return a camera at `eye` that sees `target` in its centre; `up` (world) points up in the image.

    `size` is (width, height) in pixels. An `up` parallel to the view is replaced by a world axis.
    """
    eye = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - eye
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-9:
        right = across(forward)
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ eye
    width, height = size
    focal = 0.5 * height / np.tan(np.radians(fov_y_degrees) / 2)
    return Camera(width, height, focal, focal, width / 2, height / 2, matrix)
