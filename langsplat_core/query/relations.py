"""Spatial relations between instances, measured in their own sizes, so that a scene needs no scale."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from langsplat_core.arrays import Array, across, affine
from langsplat_core.query.grammar import Extreme, Side
from langsplat_core.query.instances import axis_aligned_box, split_instances
from langsplat_core.scene import Camera
from langsplat_core.scene.language import Tree
from langsplat_core.scene.surface import Surface

FEWEST, SPECK = 8, 0.1  # least Gaussians of an instance, and least share of the largest one's
SAMPLE = 1500  # points of an instance, at most, between which distances are measured
NEAR = 0.75  # largest gap that is near, as a share of the smaller size
TOUCH = 0.1  # largest gap that touches, likewise
FOOT = 0.4  # share of an instance's height below which it touches what it stands on
FLAT = 0.5  # share of an instance's points that touch what it lies or hangs on
HELD = 0.6  # share of an instance's points within the box of what it is in
SUNK = 0.25  # share of an instance's height below the rim of what it is in
ASIDE = 0.25  # least offset to a side or in depth, as a share of the mean size


@dataclass(frozen=True, eq=False)
class Body:
    """The points of one instance, in axes of which the last is up."""

    points: Array  # (P, 3) world units
    low: Array  # (3,) 2 % quantiles
    high: Array  # (3,) 98 % quantiles

    @property
    def centre(self) -> Array:
        """The (3,) centre of its bounding box."""
        return (self.low + self.high) / 2

    @property
    def size(self) -> float:
        """Diagonal of its bounding box, world units."""
        return float(np.linalg.norm(self.high - self.low))

    @cached_property
    def tree(self) -> "scipy.spatial.cKDTree":
        """A k-d tree of its points."""
        return scipy.spatial.cKDTree(self.points)

    @cached_property
    def spacing(self) -> float:
        """Median distance of a point to the nearest other, world units."""
        return float(np.median(self.tree.query(self.points, k=2)[0][:, 1]))


def upright(up: Array) -> Array:
    """Return the (3, 3) rotation of world points into axes of which the last is `up`, (3,), a unit vector."""
    first = across(up)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def viewpoint(camera: Camera, frame: Array) -> Array:
    """Return the (4, 4) matrix from the axes of `frame` (3, 3), see `upright`, to those of `camera`."""
    return camera.world_to_camera @ affine(frame.T, np.zeros(3))


def _centre(what: Body, seen_by: Array) -> Array:
    return np.asarray(seen_by[:3, :3] @ what.centre + seen_by[:3, 3])


def _seen(what: Body, seen_by: Array) -> tuple[float, float]:
    """Return the tangent of the angle to the right of the viewing direction, and the depth; NaN if behind."""
    x, _, z = _centre(what, seen_by)
    return (float(x / z), float(z)) if z > 0 else (float("nan"), float("nan"))


def body(positions: Array, frame: Array) -> Body:
    """Return the body, in the axes of `frame`, of an instance's (P, 3) points in the world, P >= 1."""
    points = positions[:: max(1, -(-len(positions) // SAMPLE))] @ frame.T
    low, high = axis_aligned_box(points)
    return Body(points, low, high)


def separate(surface: Surface, inside: Array, tree: Tree | None = None) -> list[Array]:
    """Divide (M,) bool of the surface into the numbers of each instance, largest first, without specks."""
    wholes = None if tree is None else tree.voted_wholes
    parts = split_instances(surface, np.flatnonzero(inside), wholes, join=True)
    parts.sort(key=len, reverse=True)
    return [part for part in parts if len(part) >= max(FEWEST, SPECK * len(parts[0]))]


def gap(one: Body, other: Body) -> float:
    """Return the least distance between points of two instances, world units."""
    return float(other.tree.query(one.points)[0].min())


def stands(  # noqa: PLR0911  one row of a table each
    kind: Side, what: Body, anchor: Body, seen_by: Array | None
) -> bool:
    """Return True if `what` is in relation `kind` to `anchor`; seen_by: viewpoint of "left of", "behind"."""
    match kind:
        case "on":
            return _on(what, anchor)
        case "in":
            return _in(what, anchor)
        case "near":
            return gap(what, anchor) <= NEAR * min(what.size, anchor.size)
        case "above":
            return _above(what, anchor)
        case "below":
            return _above(anchor, what)
    assert seen_by is not None
    (x, z), (anchor_x, anchor_z) = _seen(what, seen_by), _seen(anchor, seen_by)
    mean = (what.size + anchor.size) / 2
    aside = (x - anchor_x) * anchor_z  # world units at the anchor's depth
    if kind in ("left of", "right of"):
        return (aside if kind == "right of" else -aside) > ASIDE * mean
    return abs(aside) <= mean and (z - anchor_z if kind == "behind" else anchor_z - z) > ASIDE * mean


def _on(what: Body, anchor: Body) -> bool:
    reach = TOUCH * min(what.size, anchor.size) + anchor.spacing
    touching = anchor.tree.query(what.points, distance_upper_bound=reach)[0] < np.inf
    if not touching.any() or what.size > anchor.size:
        return False
    above = what.centre[2] > anchor.low[2] and _over(what, anchor)
    foot = what.points[touching, 2].mean() <= what.low[2] + FOOT * (what.high[2] - what.low[2])
    return bool((above and foot) or touching.mean() >= FLAT)


def _over(what: Body, anchor: Body) -> bool:
    """Return True if the centre of `what`, seen from above, lies within `anchor`."""
    return bool(((what.centre >= anchor.low) & (what.centre <= anchor.high))[:2].all())


def _in(what: Body, anchor: Body) -> bool:
    height = what.high[2] - what.low[2]
    head = np.array([0, 0, 0.5 * height])  # it may stick out of an open vessel
    sunk = what.low[2] <= anchor.high[2] - SUNK * height  # not merely standing on a flat top
    held = ((what.points >= anchor.low) & (what.points <= anchor.high + head)).all(1)
    return bool(what.size < anchor.size and sunk and _over(what, anchor) and held.mean() >= HELD)


def _above(what: Body, anchor: Body) -> bool:
    overlap = ((what.low <= anchor.high) & (anchor.low <= what.high))[:2].all()
    return bool(overlap and what.centre[2] > anchor.high[2] and what.low[2] > anchor.centre[2])


def ranked(kind: Extreme, things: list[Body], anchors: list[Body], seen_by: Array | None) -> list[int]:
    """Return indices of `things` by a superlative, best first; distances: to `anchors`, else to a camera."""
    sign = 1 if kind in ("smallest", "nearest", "lowest", "leftmost") else -1
    measured = [sign * _measure(kind, thing, anchors, seen_by) for thing in things]
    return [int(number) for number in np.argsort(measured, kind="stable")]


def _measure(kind: Extreme, thing: Body, anchors: list[Body], seen_by: Array | None) -> float:
    if kind in ("biggest", "smallest"):
        return thing.size
    if kind in ("highest", "lowest"):
        return float(thing.centre[2])
    if kind in ("nearest", "farthest") and anchors:
        return min(gap(thing, anchor) for anchor in anchors)
    assert seen_by is not None
    if kind in ("nearest", "farthest"):
        return float(np.linalg.norm(_centre(thing, seen_by)))
    aside = _seen(thing, seen_by)[0]
    if np.isnan(aside):  # behind the camera: the last of either ranking
        return np.inf if kind == "leftmost" else -np.inf
    return aside
