"""How things stand to each other, measured in their own sizes, so that a scene needs no scale."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from langsplat_core.arrays import Array, across, affine
from langsplat_core.query.grammar import Extreme, Side
from langsplat_core.query.instances import axis_aligned_box, told_apart
from langsplat_core.scene import LEVELS, Camera
from langsplat_core.scene.language import Tree
from langsplat_core.scene.surface import Surface

WHOLE = LEVELS.index("whole")
FEWEST, SPECK = 8, 0.1  # Gaussians, and of the largest instance's Gaussians; what has fewer is a speck
SAMPLE = 1500  # points of a thing that distances are measured with
NEAR = 0.75  # of the smaller thing's size: the widest gap that is still near
TOUCH = 0.1  # of the smaller thing's size: the widest gap that is still touching
FOOT = 0.4  # of a thing's height: what it stands on touches it below
FLAT = 0.5  # of a thing's points: what touches so many, it lies or hangs on
HELD = 0.6  # of a thing's points: what holds so many, it is in
SUNK = 0.25  # of a thing's height: what is in another has so much of it below the rim
ASIDE = 0.25  # of the mean size: what is closer than this sideways or in depth is level with the other


@dataclass(frozen=True, eq=False)
class Body:
    """The points of one thing, in axes of which the last is up."""

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
    """Return the tangent of the angle to the right of the viewing direction, and depth; NaN behind."""
    x, _, z = _centre(what, seen_by)
    return (float(x / z), float(z)) if z > 0 else (float("nan"), float("nan"))


def body(positions: Array, frame: Array) -> Body:
    """Return the body, in the axes of `frame`, of a thing's (P, 3) points in the world, P >= 1."""
    points = positions[:: max(1, -(-len(positions) // SAMPLE))] @ frame.T
    low, high = axis_aligned_box(points)
    return Body(points, low, high)


def separate(surface: Surface, inside: Array, tree: Tree | None = None) -> list[Array]:
    """Divide (M,) bool into surface numbers of each thing, by voted wholes, largest first, no specks."""
    wholes = None if tree is None else tree.voted_wholes
    parts = told_apart(surface, np.flatnonzero(inside), wholes, join=True)
    parts.sort(key=len, reverse=True)
    return [part for part in parts if len(part) >= max(FEWEST, SPECK * len(parts[0]))]


def gap(one: Body, other: Body) -> float:
    """Least distance between points of two things, world units."""
    return float(other.tree.query(one.points)[0].min())


def stands(  # noqa: PLR0911  one row of a table each
    kind: Side, what: Body, anchor: Body, seen_by: Array | None
) -> bool:
    """Return whether `what` stands so to `anchor`; a viewpoint says what is left, right, behind, in front."""
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
    """Return whether the middle of `what`, seen from above, lies within `anchor`."""
    return bool(((what.centre >= anchor.low) & (what.centre <= anchor.high))[:2].all())


def _in(what: Body, anchor: Body) -> bool:
    height = what.high[2] - what.low[2]
    head = np.array([0, 0, 0.5 * height])  # it may look out of an open vessel
    sunk = what.low[2] <= anchor.high[2] - SUNK * height  # and does not merely stand on a flat top
    held = ((what.points >= anchor.low) & (what.points <= anchor.high + head)).all(1)
    return bool(what.size < anchor.size and sunk and _over(what, anchor) and held.mean() >= HELD)


def _above(what: Body, anchor: Body) -> bool:
    overlap = ((what.low <= anchor.high) & (anchor.low <= what.high))[:2].all()
    return bool(overlap and what.centre[2] > anchor.high[2] and what.low[2] > anchor.centre[2])


def ranked(kind: Extreme, things: list[Body], anchors: list[Body], seen_by: Array | None) -> list[int]:
    """Return numbers of `things`, what is most so first, as nearest to `anchors`, else the viewpoint."""
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
    return (np.inf if kind == "leftmost" else -np.inf) if np.isnan(aside) else aside
