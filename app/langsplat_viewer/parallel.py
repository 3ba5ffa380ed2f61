"""Parallel projection by a pinhole camera that stands far behind the eye: rasterizers need not know of it.

The farther it stands, the more parallel its rays, and the more of a float32 its depths take. Plain maths.
"""

from dataclasses import dataclass, replace

from langsplat_core.scene import Camera, Intrinsics


@dataclass(frozen=True, eq=False)
class FarCamera(Camera):
    """Stands behind the eye, with a lens so narrow that what is as far as the target keeps its size. It has
    before it what lies behind the eye; `looking_settings` leaves that out."""

    back: float = 0.0  # from it to the plane of the eye, world units
    distance: float = 1.0  # from there to the target, world units

    def with_intrinsics(self, intrinsics: Intrinsics) -> "FarCamera":
        """See `Camera`."""
        near = super().with_intrinsics(intrinsics)
        inner = (near.width, near.height, near.fx, near.fy, near.cx, near.cy)
        return FarCamera(*inner, self.world_to_camera, self.name, back=self.back, distance=self.distance)

    @property
    def near_intrinsics(self) -> Intrinsics:
        """Of a camera at the eye that sees the target as large."""
        return narrowed(self.intrinsics, self.distance / (self.distance + self.back))


def eye_depth(camera: Camera) -> float:
    """Camera z of the plane through the eye, world units; 0 in perspective."""
    return camera.back if isinstance(camera, FarCamera) else 0.0


def narrowed(inner: Intrinsics, factor: float) -> Intrinsics:
    """The same picture by a lens that is longer by `factor`."""
    return replace(inner, fx=inner.fx * factor, fy=inner.fy * factor)
