"""The camera that the user moves, and the extent of the scene that it is fitted to. Plain maths."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array, affine, quaternions, rotation_matrices, sigmoid
from langsplat_core.scene import Camera, Gaussians, Intrinsics, Scene, look_at


def narrowed(inner: Intrinsics, factor: float) -> Intrinsics:
    """Return the same image size with focal lengths `factor` times as long."""
    return replace(inner, fx=inner.fx * factor, fy=inner.fy * factor)


# Framing: the eye from which a scene fills the image, from a sample of its Gaussians.

SAMPLE = 50_000  # Gaussians looked at; quantiles need no more
SHARE = 0.99  # of the weight that a framing view holds: what is left out are floaters
MARGIN = 0.9  # of the image's width and height that is filled
_BISECTIONS = 12


@dataclass(frozen=True, eq=False)
class Sample:
    """Visible Gaussians as weighted points."""

    points: Array  # (M, 3) float64 world units
    weights: Array  # (M,) float64 > 0: opacity times size


def sample_of(gaussians: Gaussians) -> Sample:
    """Return evenly spaced rows of those that can be drawn.

    The size of a Gaussian is the root of its largest section, a length: areas would let a few huge ones speak
    for all.
    """
    rows = np.flatnonzero(gaussians.valid())
    rows = rows[:: max(len(rows) // SAMPLE, 1)]
    sections = np.sort(gaussians.log_scales[rows].astype(np.float64), axis=1)[:, 1:].mean(1)
    weights = sigmoid(gaussians.opacity_logits[rows].astype(np.float64)) * np.exp(sections)
    seen = weights > 0
    return Sample(gaussians.means[rows][seen].astype(np.float64), weights[seen])


def framing_eye(sample: Sample, rotation: Array, inner: Intrinsics, share: float = SHARE) -> Array | None:
    """Return the (3,) place from which a camera sees `share` of the weight, filling the image to `MARGIN`.

    `rotation` (3, 3) world to camera and `inner` are the camera's; there is no nearer such place. None
    without points.

    A point is inside the right border where x - t z <= ex - t ez, with t the tangent of the angle to that
    border and e the eye: so a border is one number, the quantile of x - t z, and both eye and distance follow
    from four of them. Which share of the weight may lie beyond each border is found by bisection, because
    what is beyond one is often beyond another as well.
    """
    if not len(sample.points):
        return None
    points = sample.points @ rotation.T
    left, right = MARGIN * inner.cx / inner.fx, MARGIN * (inner.width - inner.cx) / inner.fx
    top, bottom = MARGIN * inner.cy / inner.fy, MARGIN * (inner.height - inner.cy) / inner.fy
    x, y, z = points.T
    borders = [x - right * z, -x - left * z, y - bottom * z, -y - top * z]
    ordered = [_ordered(border, sample.weights) for border in borders]

    def eye(beyond: float) -> Array:
        a, b, c, d = (_pick(border, 1 - beyond) for border in ordered)
        ez = min(-(a + b) / (right + left), -(c + d) / (bottom + top))
        # Along the other axis the nearest depth leaves room on both sides: the middle of it.
        return np.array([(a - b + (right - left) * ez) / 2, (c - d + (bottom - top) * ez) / 2, ez])

    low, high = (1 - share) / 4, 1 - share  # beyond each border: surely small enough; all that is allowed
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        e = eye(middle)
        limits = (e[0] - right * e[2], -e[0] - left * e[2], e[1] - bottom * e[2], -e[1] - top * e[2])
        inside = np.logical_and.reduce(
            [border <= limit + 1e-12 for border, limit in zip(borders, limits, strict=True)]
        )
        enough = sample.weights[inside].sum() >= share * sample.weights.sum()
        low, high = (middle, high) if enough else (low, middle)
    return np.asarray(eye(low) @ rotation)


def depth_share(sample: Sample, eye: Array, forward: Array, share: float) -> float:
    """Return the depth from `eye` (3,) along the unit `forward` (3,) before which a `share` of weight lies.

    World units, negative behind the eye.
    """
    return weighted_quantile((sample.points - eye) @ forward, sample.weights, share)


def _ordered(values: Array, weights: Array) -> tuple[Array, Array]:
    """Return (M,) values in rising order and the share of the weight up to each."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return values[order], cumulative / cumulative[-1]


def _pick(ordered: tuple[Array, Array], share: float) -> float:
    values, shares = ordered
    return float(values[min(int(np.searchsorted(shares, share - 1e-12)), len(values) - 1)])


def weighted_quantile(values: Array, weights: Array, share: float) -> float:
    """Return the least of (M,) values up to which a `share` of the weight lies; 0 without any."""
    return _pick(_ordered(values, weights), share) if len(values) else 0.0


# Camera controls: the moves of mouse and keys.
#
# An `OrbitCamera` turns around a target point. Every control is a function from one camera to the next,
# so that a test can do and undo it.

MAX_ELEVATION = math.radians(88)  # closer to the pole a small drag would spin the image
DEFAULT_FOV = 50.0  # degrees, of the image's shorter side
FOV_RANGE = (10.0, 120.0)  # degrees
MOST_DISTANCE = 12.0  # of the distance that shows the whole scene: it is still a visible spot
NARROW = 1e4  # factor of the focal length by which a scene is framed without perspective
SURROUNDINGS = 1.8  # size that a view of a thing shows, over the thing's


Side = Literal["front", "back", "left", "right", "top", "bottom"]


def symmetric_intrinsics(fov_degrees: float = DEFAULT_FOV) -> Intrinsics:
    """Return the intrinsics of a square image, `fov_degrees` across, with a centred principal point."""
    focal = 0.5 / math.tan(math.radians(fov_degrees) / 2)
    return Intrinsics(1.0, 1.0, focal, focal, 0.5, 0.5)


@dataclass(frozen=True, eq=False)
class OrbitCamera:
    """A view that turns around a target."""

    rotation: Array  # (3, 3) world-to-camera, rows are right, down and forward
    target: Array  # (3,) world units, on the optical axis
    distance: float  # world units from the eye to the target, > 0
    up: Array  # (3,) unit, the world's up: the axis that a sideways drag turns about
    intrinsics: Intrinsics  # of an image that any window shows whole, uncropped
    orthographic: bool = False  # everything has the size that it has at the target

    def moved(self, offset: Array) -> "OrbitCamera":
        """Return the view moved by `offset` (3,)."""
        return replace(self, target=self.target + offset) if offset.any() else self

    @property
    def eye(self) -> Array:
        """(3,) position of the camera, world units."""
        return self.target - self.distance * self.rotation[2]

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera for an image of `width` x `height` pixels."""
        matrix = affine(self.rotation, -self.rotation @ self.eye)
        inner = self.intrinsics.fitted(width, height)
        if self.orthographic:
            inner = narrowed(inner, 1 / self.distance)
        pinhole = (width, height, inner.fx, inner.fy, inner.cx, inner.cy, matrix)
        return Camera(*pinhole, orthographic=self.orthographic)

    @property
    def span(self) -> float:
        """World units across the shorter side of the uncropped image, as far away as the target."""
        return self.span_in(self.intrinsics.width, self.intrinsics.height)

    def span_in(self, width: float, height: float) -> float:
        """Return the `span` of an image of `width` x `height` pixels."""
        inner = self.intrinsics.fitted(width, height)
        return self.distance * min(width, height) / min(inner.fx, inner.fy)

    @property
    def elevation(self) -> float:
        """Angle of the line of sight above the horizon, radians."""
        return math.asin(float(np.clip(self.rotation[2] @ self.up, -1, 1)))


def _about(axis: Array, angle: float) -> Array:
    """Return (3, 3) right-handed rotation by `angle` radians about a unit axis."""
    return rotation_matrices(np.append(math.cos(angle / 2), math.sin(angle / 2) * np.asarray(axis)))


def orbit(view: OrbitCamera, yaw: float, pitch: float) -> OrbitCamera:
    """Turn the world under the hand: near things follow a drag right by `yaw` and down by `pitch` (radians).

    Yaw turns about the world's up and multiplies from the right, pitch about the camera's right axis
    and multiplies from the left; they commute, so a drag there and back returns exactly.
    """
    limit = max(MAX_ELEVATION, abs(view.elevation))
    pitch = float(np.clip(pitch, view.elevation - limit, view.elevation + limit))
    rotation = _about(np.array([1.0, 0, 0]), pitch) @ view.rotation @ _about(view.up, yaw)
    u, _, vt = np.linalg.svd(rotation)  # thousands of small drags must not let the axes drift apart
    return replace(view, rotation=u @ vt)


def look(view: OrbitCamera, yaw: float, pitch: float) -> OrbitCamera:
    """Turn the head: right by `yaw`, down by `pitch` (radians), without moving the eye."""
    turned = orbit(view, yaw, pitch)
    return replace(turned, target=view.eye + view.distance * turned.rotation[2])


def roll(view: OrbitCamera, angle: float) -> OrbitCamera:
    """Turn the image clockwise by `angle` radians about the line of sight."""
    return replace(view, rotation=_about(np.array([0, 0, 1.0]), angle) @ view.rotation)


def pan(view: OrbitCamera, dx: float, dy: float, size: tuple[int, int]) -> OrbitCamera:
    """Move sideways so that the target follows a drag of (dx, dy) pixels in a window of `size` pixels."""
    inner = view.intrinsics.fitted(*size)
    right, down, _ = view.rotation
    return replace(view, target=view.target - view.distance * (dx / inner.fx * right + dy / inner.fy * down))


def zoom(
    view: OrbitCamera, factor: float, min_distance: float, max_distance: float = math.inf
) -> OrbitCamera:
    """Multiply the distance by `factor`.

    At `min_distance` the target is pushed on, so it never sticks, and at `max_distance` the way back ends (a
    view from farther away stays where it is). Without perspective pushing on would make nothing larger.
    """
    wanted = view.distance * factor
    distance = min(max(wanted, min_distance), max(max_distance, view.distance))
    push = distance - wanted if factor < 1 and not view.orthographic else 0.0
    return replace(view, distance=distance, target=view.target + push * view.rotation[2])


def fly(view: OrbitCamera, right: float, up: float, forward: float) -> OrbitCamera:
    """Move eye and target together: along the camera's right and forward axes and the world's up."""
    step = right * view.rotation[0] + up * view.up + forward * view.rotation[2]
    return replace(view, target=view.target + step)


def frame_of(up: Array) -> Array:
    """Return the (3, 3) rows right, up and front of a world whose up is `up` (3,) unit.

    The view of the front is along the world's z axis, made level, or along y where z is up.
    """
    forward = np.eye(3)[2 if abs(up[2]) < 0.9 else 1]
    forward = forward - (forward @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(forward, up), up, -forward])


def from_side(view: OrbitCamera, side: Side) -> OrbitCamera:
    """Return the same target from the same distance, along an axis of `frame_of`.

    From the top and from below the image's foot is the front.
    """
    right, up, front = frame_of(view.up)
    forward, down = {
        "front": (-front, -up),
        "back": (front, -up),
        "left": (right, -up),
        "right": (-right, -up),
        "top": (-up, front),
        "bottom": (up, -front),
    }[side]
    return replace(view, rotation=np.array([np.cross(down, forward), down, forward]))


def focus(view: OrbitCamera, point: Array, distance: float | None = None) -> OrbitCamera:
    """Bring `point` (3,) to the centre and turn around it from now on; the direction of view is kept."""
    distance = view.distance if distance is None else max(distance, 1e-9)
    return replace(view, target=np.asarray(point, np.float64), distance=distance)


def level(view: OrbitCamera) -> OrbitCamera:
    """Return the view with a level horizon."""
    upright = look_at(view.eye, view.target, view.up, (1, 1))
    return replace(view, rotation=upright.rotation)


def adopt_up(view: OrbitCamera) -> OrbitCamera:
    """Take the image's up as the world's up, for scenes whose file says nothing about it."""
    return replace(view, up=-view.rotation[1])


def with_fov(view: OrbitCamera, fov_degrees: float) -> OrbitCamera:
    """Return the same view with `fov_degrees` across the shorter side and the principal point centred."""
    return replace(view, intrinsics=symmetric_intrinsics(float(np.clip(fov_degrees, *FOV_RANGE))))


def between(start: OrbitCamera, end: OrbitCamera, t: float) -> OrbitCamera:
    """Return a view on the way from `start` (t = 0) to `end` (t = 1).

    Intrinsics and projection are the end's.
    """
    if t >= 1:
        return end
    ease = t * t * (3 - 2 * t)
    w, *axis = quaternions(end.rotation @ start.rotation.T)
    length = float(np.linalg.norm(axis))
    turn = _about(np.array(axis) / max(length, 1e-30), 2 * math.atan2(length, w) * ease)
    return replace(
        end,
        rotation=turn @ start.rotation,
        target=start.target + ease * (end.target - start.target),
        distance=start.distance * (end.distance / start.distance) ** ease,
    )


@dataclass(frozen=True, eq=False)
class Extent:
    """Centre, size and up of a scene, for the camera; computed once, because it looks at every Gaussian."""

    centre: Array  # (3,) robust middle, world units
    radius: float  # robust, world units, > 0
    up: Array  # (3,) unit
    sample: Sample  # points that a view of everything is fitted to
    farthest: float  # largest distance of the camera from its target, world units


def extent_of(scene: Scene) -> Extent:
    """Return the extent of a scene's Gaussians."""
    centre, radius = scene.bounds()
    sample = sample_of(scene.gaussians)
    distances = np.linalg.norm(sample.points - centre, axis=1)
    reach = max(weighted_quantile(distances, sample.weights, SHARE), radius)
    return Extent(centre, radius, scene.up(), sample, MOST_DISTANCE * reach)


def joined(extent: Extent, other: Sample) -> Extent:
    """Return the extent of two samples together, each with the same total weight."""
    weights = np.concatenate([each.weights / each.weights.sum() for each in (extent.sample, other)])
    return replace(extent, sample=Sample(np.concatenate([extent.sample.points, other.points]), weights))


def from_camera(camera: Camera, extent: Extent) -> OrbitCamera:
    """Return the exact view of `camera`, turning around the depth at which it sees the scene's middle.

    Of an orthographic one, around that at which a lens of the default angle shows as much.
    """
    forward, inner = camera.rotation[2], camera.intrinsics
    if camera.orthographic:
        distance = symmetric_intrinsics().fitted(camera.width, camera.height).fx / camera.fx
        inner = narrowed(inner, distance)
    else:
        distance = max(float((extent.centre - camera.position) @ forward), 0.3 * extent.radius)
    target = camera.position + distance * forward
    return OrbitCamera(camera.rotation, target, distance, extent.up, inner, camera.orthographic)


def spanning(view: OrbitCamera, span: float) -> OrbitCamera:
    """Return the orthographic view from the same eye, `span` world units across the uncropped image."""
    distance = view.distance * span / view.span
    return replace(focus(view, view.eye + distance * view.rotation[2], distance), orthographic=True)


def frame_all(view: OrbitCamera, extent: Extent, size: tuple[int, int]) -> OrbitCamera:
    """Stand back, or come nearer, until a window of `size` pixels holds the scene; the direction is kept."""
    narrow = NARROW if view.orthographic else 1.0
    eye = framing_eye(extent.sample, view.rotation, narrowed(view.intrinsics.fitted(*size), narrow))
    forward = view.rotation[2]
    if eye is None:
        return focus(view, extent.centre, 2.6 * extent.radius)
    depth = max(depth_share(extent.sample, eye, forward, 0.5), 1e-3 * extent.radius)
    target, distance = eye + depth * forward, depth / narrow
    if view.orthographic:  # however thin the scene is along the view, none of it may be behind the eye
        distance = max(distance, -depth_share(extent.sample, target, forward, 1 - SHARE))
    return replace(view, target=target, distance=distance)


def default_view(scene: Scene, extent: Extent, size: tuple[int, int]) -> OrbitCamera:
    """Return the first training camera, else a view of the whole scene in a window of `size` pixels."""
    if scene.cameras:
        return from_camera(scene.cameras[0], extent)
    rotation = scene.framing_camera((1000, 1000), (extent.centre, extent.radius)).rotation  # from above
    anywhere = OrbitCamera(rotation, extent.centre, extent.radius, extent.up, symmetric_intrinsics())
    return frame_all(anywhere, extent, size)
