"""Camera paths as plain maths: keyframes joined by a smooth curve, and one turn around a point.

A path passes through its keyframes and is smooth in between: position and orientation have continuous
velocities (Catmull and Rom 1974; for orientations the cumulative Bezier curve of Kim, Kim and Shin 1995, "A
general construction scheme for unit quaternion curves with simple high order derivatives"). Each stretch
depends on its two keyframes and their neighbours only, so that a change stays local. Where two
keyframes are equal, the camera rests between them. Perspective or not is as in the keyframe before.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from langsplat_core.arrays import Array, affine
from langsplat_core.scene import Camera
from langsplat_viewer.camera.controls import (
    Extent,
    OrbitCamera,
    from_camera,
    orbit,
    spanning,
    symmetric_intrinsics,
)

SAME = 1e-9  # steps up to this, of the largest coordinate or in radians, count as none
FOV_LIMITS = (0.01, 179.0)  # degrees
SPAN_LIMITS = (1e-9, 1e9)  # world units
LONGEST = 36_000.0  # seconds of a path
SAME_TIME = 1e-3  # least seconds between two keyframes
TURN = 32  # steps of a turn: its path is within 1e-4 radii of a circle


@dataclass(frozen=True, eq=False)
class Pose:
    """Position, rotation and field of view of a camera."""

    position: Array  # (3,) world units
    rotation: Array  # (3, 3) world to camera, rows are right, down and forward
    fov_degrees: float  # across the image's shorter side, within `FOV_LIMITS`
    span: float | None = None  # world units across that side without perspective, > 0; None: in perspective

    def moved(self, offset: Array) -> "Pose":
        """Return the pose moved by `offset` (3,)."""
        return replace(self, position=self.position + offset)

    def camera(self, width: int, height: int) -> Camera:
        """Return the pinhole camera of an image, its principal point centred; `camera_of` minds `span`."""
        matrix = affine(self.rotation, -self.rotation @ self.position)
        inner = symmetric_intrinsics(self.fov_degrees).fitted(width, height)
        return Camera(width, height, inner.fx, inner.fy, inner.cx, inner.cy, matrix)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A pose at a time."""

    seconds: float  # from the start of the path, 0 to `LONGEST`
    pose: Pose

    def moved(self, offset: Array) -> "Keyframe":
        return replace(self, pose=self.pose.moved(offset))


@dataclass(frozen=True, eq=False)
class Flight:
    """A path through keyframes.

    It lasts from 0 to the time of the last one; before the first one, the camera stands there. ValueError
    without keyframes, or where their times do not rise.
    """

    keyframes: tuple[Keyframe, ...]

    def __post_init__(self) -> None:
        if not self.keyframes:
            raise ValueError("a path needs a keyframe")
        if (np.diff([key.seconds for key in self.keyframes]) <= 0).any():
            raise ValueError("the times of keyframes must rise")

    def moved(self, offset: Array) -> "Flight":
        """Return the path moved by `offset` (3,)."""
        return replace(self, keyframes=tuple(key.moved(offset) for key in self.keyframes))

    @property
    def seconds(self) -> float:
        return self.keyframes[-1].seconds

    @property
    def closed(self) -> bool:
        """True where it ends as it began: repeated, it goes on smoothly."""
        first, last = self.keyframes[0].pose, self.keyframes[-1].pose
        pairs = (first.position, last.position), (first.rotation, last.rotation)
        return len(self.keyframes) > 2 and all(np.array_equal(*pair) for pair in pairs)

    @cached_property
    def _curve(self) -> "_Curve":
        return _Curve(self.keyframes, self.closed)

    def poses(self, seconds: Array) -> tuple[Pose, ...]:
        """Return the poses at (T,) times; before the start and after the end it stands still."""
        if len(self.keyframes) == 1:
            return (self.keyframes[0].pose,) * len(seconds)
        return self._curve.poses(np.asarray(seconds, np.float64))


def turntable(view: OrbitCamera, seconds: float) -> Flight:
    """Return the path of one even turn around the target of `view`, in the direction of a sideways drag."""
    first = Keyframe(0.0, pose_of(view))
    turns = ((step * seconds / TURN, orbit(view, 2 * math.pi * step / TURN, 0)) for step in range(1, TURN))
    return Flight(
        (first, *(Keyframe(at, pose_of(turned)) for at, turned in turns), replace(first, seconds=seconds))
    )


def pose_of(view: OrbitCamera) -> Pose:
    """Return the eye of a view; a principal point that is off the centre moves there."""
    span = view.span if view.orthographic else None
    return Pose(view.eye, view.rotation, view.intrinsics.fov_degrees, span)


def view_of(pose: Pose, extent: Extent) -> OrbitCamera:
    """Return a view from `pose`, turning around the depth at which it sees the scene's middle.

    Without perspective around the depth of which perspective would show as much.
    """
    view = from_camera(pose.camera(1, 1), extent)
    return view if pose.span is None else spanning(view, pose.span)


def camera_of(pose: Pose, extent: Extent, size: tuple[int, int]) -> Camera:
    """Return the camera of an image of `size` (width, height) pixels from `pose`."""
    return pose.camera(*size) if pose.span is None else view_of(pose, extent).camera(*size)


def pose_at(flight: Flight, seconds: float) -> Pose:
    """Return the pose at a time, seconds."""
    return flight.poses(np.array([seconds]))[0]


def frame_times(flight: Flight, fps: float) -> Array:
    """Return the (T,) times at which a film of `fps` images a second is taken, seconds.

    A path that ends where it began leaves its last image out: it would be there twice when the film is
    repeated.
    """
    closed = flight.closed
    count = round(flight.seconds * fps) if closed else math.floor(flight.seconds * fps + 1e-6) + 1
    return np.arange(max(count, 1)) / fps


def stretched(keyframes: tuple[Keyframe, ...], seconds: float) -> tuple[Keyframe, ...]:
    """Return the path with its times scaled to `seconds` > 0 in all; one of no duration stays."""
    if not keyframes or keyframes[-1].seconds <= 0:
        return keyframes
    factor = seconds / keyframes[-1].seconds
    return tuple(replace(key, seconds=key.seconds * factor) for key in keyframes)


class _Curve:
    """The curve through two or more keyframes."""

    def __init__(self, keyframes: tuple[Keyframe, ...], closed: bool) -> None:
        self._times = np.array([key.seconds for key in keyframes], np.float64)
        positions = np.array([key.pose.position for key in keyframes], np.float64)
        least = SAME * np.abs(positions).max()
        slopes = tangents(self._times, np.diff(positions, axis=0), least, closed)
        self._positions = scipy.interpolate.CubicHermiteSpline(self._times, positions, slopes)
        # Camera to world: a product from the right is then a turn as the camera feels it.
        rotation = scipy.spatial.transform.Rotation
        self._rotations = rotation.from_matrix(np.array([key.pose.rotation.T for key in keyframes]))
        steps = (self._rotations[:-1].inv() * self._rotations[1:]).as_rotvec()
        rates = tangents(self._times, steps, SAME, closed)
        thirds = np.diff(self._times)[:, None] / 3
        self._first, self._last = rates[:-1] * thirds, rates[1:] * thirds
        ends = rotation.from_rotvec(-self._first), rotation.from_rotvec(-self._last)
        self._middle = (ends[0] * rotation.from_rotvec(steps) * ends[1]).as_rotvec()
        # The focal length, which grows evenly when one zooms; its curve stays within the keyframes.
        focal = [-math.log(math.tan(math.radians(key.pose.fov_degrees) / 2)) for key in keyframes]
        self._focal = scipy.interpolate.PchipInterpolator(self._times, focal)
        spans = np.array([key.pose.span or np.nan for key in keyframes], np.float64)
        self._parallel = flat = np.isfinite(spans)
        if flat.any():  # a gap has the last one before it, at the start the next one
            spans = spans[np.flatnonzero(flat)[np.maximum(np.cumsum(flat) - 1, 0)]]
        self._span = scipy.interpolate.PchipInterpolator(self._times, np.log(np.nan_to_num(spans, nan=1.0)))

    def poses(self, seconds: Array) -> tuple[Pose, ...]:
        times = np.clip(seconds, self._times[0], self._times[-1])
        row = np.clip(np.searchsorted(self._times, times, "right") - 1, 0, len(self._times) - 2)
        u = ((times - self._times[row]) / np.diff(self._times)[row])[:, None]
        turn = scipy.spatial.transform.Rotation.from_rotvec
        turned = (
            self._rotations[row]
            * turn((1 - (1 - u) ** 3) * self._first[row])
            * turn((3 * u**2 - 2 * u**3) * self._middle[row])
            * turn(u**3 * self._last[row])
        )
        fov = np.degrees(2 * np.arctan(np.exp(-self._focal(times))))
        parallel = self._parallel[np.searchsorted(self._times, times, "right") - 1]  # till the next keyframe
        spans = [
            float(span) if flat else None
            for span, flat in zip(np.exp(self._span(times)), parallel, strict=True)
        ]
        found = zip(self._positions(times), turned.inv().as_matrix(), fov.tolist(), spans, strict=True)
        return tuple(Pose(*parts) for parts in found)


def tangents(times: Array, steps: Array, least: float, closed: bool = False) -> Array:
    """Return the (K, 3) velocities at K >= 2 keyframes of rising `times` (K,).

    The keyframes differ by `steps` (K - 1, 3). Velocities are those of the parabola through a keyframe and
    its two neighbours, and none beside a step shorter than `least`. At the ends those of the straight line
    to the one neighbour; the ends of a `closed` path are one keyframe.
    """
    spans, rests = np.diff(times)[:, None], np.linalg.norm(steps, axis=1) <= least
    if closed:
        spans, steps = (np.concatenate([part[-1:], part, part[:1]]) for part in (spans, steps))
    slopes = steps / spans
    inner = (spans[:-1] * slopes[1:] + spans[1:] * slopes[:-1]) / (spans[:-1] + spans[1:])
    found = inner if closed else np.concatenate([slopes[:1], inner, slopes[-1:]])
    found[:-1][rests] = 0
    found[1:][rests] = 0
    return np.asarray(found)
