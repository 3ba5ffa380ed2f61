"""Instances of an answer: its Gaussians, taken apart where the surface is, with boxes, scores and hulls."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.compiled import plain
from langsplat_core.errors import InputError
from langsplat_core.scene import Gaussians
from langsplat_core.scene.language import NO_NODE
from langsplat_core.scene.surface import Surface

INNER = (0.02, 0.98)  # a box holds the points between these quantiles of each coordinate: strays do not count
TURNED = 256  # points, at most, that the box is turned by
ROUNDS = 2  # of turns about each axis
COARSE = np.radians(np.arange(0.0, 90.0, 10.0))  # beginning with 0: of equal areas the principal axes stay
FINE = np.radians([0.0, -2.0, 2.0, -4.0, 4.0])


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box in any orientation, its longest side first."""

    centre: Array  # (3,) world units
    axes: Array  # (3, 3) rotation, right-handed; column k is the direction of side k
    half_extents: Array  # (3,) world units, half the sides, descending, >= 0

    @property
    def corners(self) -> Array:
        """(8, 3) corners of the box, world units."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
        return self.centre + (signs * self.half_extents) @ self.axes.T

    def contains(self, points: Array) -> Array:
        """(N, 3) points -> (N,) bool, True inside the box or on a face."""
        return (np.abs((points - self.centre) @ self.axes) <= self.half_extents * (1 + 1e-9)).all(1)


def axis_aligned_box(points: Array) -> Array:
    """(M, 3), M >= 1 -> (2, 3) float64 lower and upper corner between the `INNER` quantiles."""
    return _inner(np.ascontiguousarray(points.T, np.float64))


def oriented_box(points: Array) -> OrientedBox:
    """Box around (M, 3) points, M >= 1, between the `INNER` quantiles along each of its axes.

    The axes begin as the principal ones of the points that are no strays, and are then turned about one
    another to the least area of the box's faces: principal axes alone say nothing about how a square, a cube
    or a round table top with something on it lies. Where the points leave axes open (a single point, a line)
    they are some that fit.
    """
    columns = np.ascontiguousarray(points.T, np.float64)
    low, high = axis_aligned_box(points)[..., None]
    core = columns[:, ((columns >= low) & (columns <= high)).all(0)]
    if core.shape[1] < 2:  # of few points the quantiles cut away all but the middle
        core = columns
    middle = core.mean(1, keepdims=True)
    spread = core - middle
    axes = np.linalg.eigh(spread @ spread.T)[1]
    axes = _turned(spread[:, :: -(-spread.shape[1] // TURNED)], axes)
    low, high = _inner(axes.T @ (columns - middle))
    order = np.argsort(low - high, kind="stable")
    axes, low, high = axes[:, order], low[order], high[order]
    return OrientedBox(middle[:, 0] + axes @ ((low + high) / 2), _right_handed(axes), (high - low) / 2)


def _inner(columns: Array) -> Array:
    """(3, M) -> (2, 3) the `INNER` quantiles of each row."""
    return np.quantile(columns, INNER, axis=1)


def _turned(columns: Array, axes: Array) -> Array:
    """`axes` turned about each of them in turn, the shortest side's first; columns: (3, M) points."""
    axes = axes.copy()
    for one, other in ((1, 2), (0, 2), (0, 1)) * ROUNDS:
        pair = axes[:, [one, other]]
        for angles in (COARSE, FINE):
            along, across = pair.T @ columns
            cos, sin = np.cos(angles), np.sin(angles)
            areas = _widths(np.outer(cos, along) + np.outer(sin, across))
            areas = areas * _widths(np.outer(cos, across) - np.outer(sin, along))
            best = areas.argmin()
            pair = pair @ np.array([[cos[best], -sin[best]], [sin[best], cos[best]]])
        axes[:, [one, other]] = pair
    return axes


def _widths(rows: Array) -> Array:
    """Return (A, M) -> (A,) between the `INNER` quantiles of each row, to the nearest point."""
    low, high = (round(q * (rows.shape[1] - 1)) for q in INNER)
    rows.partition((low, high), axis=1)
    return rows[:, high] - rows[:, low]


def _right_handed(axes: Array) -> Array:
    """Return the same axes with settled signs: the largest entry of the first two is positive."""
    signs = np.sign(axes[np.abs(axes).argmax(0), range(3)])
    signs[2] = signs[0] * signs[1] * np.sign(np.linalg.det(axes))
    return axes * signs


# Two members belong to one instance when they are of one whole that masks voted for, in an answer of wholes,
# or when a walk over linked members of the surface, of the same such whole or of none, leads from one to the
# other. What is too faint to be on the surface belongs where the surface Gaussian nearest to it belongs.

CRUMB_COUNT = 8  # half of the neighbourhood that relevancy is smoothed over
CRUMB_SHARE = 0.01  # of the largest instance's extent on the surface
EQUAL_SCORES = 1e-3  # of relevancy: instances this close are as good, and the larger comes first
BOXED = 2048  # members, at most, that a box is taken from
_FLAT = -100.0  # logarithm of a scale, instead of -infinity


@dataclass(frozen=True, eq=False)
class Instance:
    """One connected thing among the Gaussians that answer a phrase."""

    members: Array  # (K,) int64 rows of the scene's N Gaussians, ascending; faint ones beside it included
    score: float  # in [0, 1], its peak of the smoothed relevancy: the best one's is the answer's own
    mean: float  # in [0, 1], mean relevancy of its members on the surface, weighted by opacity
    centre: Array  # (3,) world units, mean position of these, weighted by opacity
    points: Array  # (P, 3) of these, at most `BOXED` evenly over the surface: what its boxes hold
    share: float  # in [0, 1], of the answer's extent: opacity times cross-section, summed over members

    @property
    def count(self) -> int:
        """Number of its Gaussians."""
        return len(self.members)

    @cached_property
    def box(self) -> Array:
        """(2, 3) lower and upper corner along the world's axes, world units, between 2 % and 98 %."""
        return axis_aligned_box(self.points)

    @cached_property
    def oriented(self) -> OrientedBox:
        """Box along its own axes, between the same quantiles."""
        return oriented_box(self.points)

    @property
    def size(self) -> Array:
        """(3,) sides of the oriented box, longest first, world units."""
        return 2 * self.oriented.half_extents


def told_apart(surface: Surface, numbers: Array, wholes: Array | None, join: bool) -> list[Array]:
    """Divide the Gaussians `numbers` (K,) of a surface into single things.

    wholes: (N,) voted wholes, see `Tree.voted`, which tell apart things that touch; join: what is of one
    whole is one, connected or not.
    """
    if wholes is None:
        return surface.parts(numbers)
    owner = wholes[surface.rows[numbers]]
    found: list[Array] = []
    for whole in np.unique(owner):
        own = numbers[owner == whole]
        found += [own] if join and whole != NO_NODE else surface.parts(own)
    return found


def find_instances(
    surface: Surface,
    gaussians: Gaussians,
    members: Array,
    relevancy: Array,
    at_most: int | None = None,
    wholes: Array | None = None,
    join: bool = False,
) -> tuple[Instance, ...]:
    """Return the instances among `members` (N,) bool, best first by score, of equal ones the larger first.

    relevancy: (N,) in [0, 1], at the level of the answer. wholes, join: see `told_apart`. at_most: only so
    many of the best. Crumbs are left out: parts of fewer than `CRUMB_COUNT` Gaussians on the surface, or of
    less than `CRUMB_SHARE` of the largest part's extent. Where all are crumbs, the largest alone is kept.
    """
    every = np.flatnonzero(members)
    numbers = surface.anchors[every]
    near = numbers >= 0
    rows, numbers = every[near], numbers[near]
    visible = surface.rows[numbers] == rows
    if not visible.any():
        return ()
    parts = told_apart(surface, numbers[visible], wholes, join)
    counts, values = np.array(list(map(len, parts))), plain(relevancy)
    starts = np.cumsum(counts) - counts
    scores = np.maximum.reduceat(surface.smooth(values, np.concatenate(parts)), starts)
    label_of = np.full(len(surface.rows), -1)
    label_of[np.concatenate(parts)] = np.repeat(np.arange(len(parts)), counts)
    labels = label_of[numbers]  # -1: faint ones beside something else
    sizes = _extent(gaussians, every)
    extents = np.bincount(labels + 1, sizes[near], len(parts) + 1)[1:]
    found = []
    for part in _ranked(scores, extents, counts)[:at_most]:
        share = extents[part] / max(sizes.sum(), 1e-300)
        own = rows[labels == part]
        found.append(_instance(surface, parts[part], own, values, float(scores[part]), share))
    return tuple(found)


def _ranked(scores: Array, extents: Array, counts: Array) -> Array:
    """Return the indices of the parts that are not crumbs, best first."""
    kept = np.flatnonzero((counts >= CRUMB_COUNT) & (extents >= CRUMB_SHARE * extents.max()))
    if len(kept) == 0:
        return np.array([int(extents.argmax())])
    steps = np.round(scores[kept] / EQUAL_SCORES)
    return kept[np.lexsort((-extents[kept], -steps))]


def _instance(
    surface: Surface, own: Array, members: Array, relevancy: Array, score: float, share: float
) -> Instance:
    """Return the thing with the Gaussians `own` on the surface; members: rows of these and of faint ones."""
    points, weights = surface.positions[own], surface.weights[own].astype(np.float64)
    weights /= weights.sum()
    return Instance(
        members=members,
        score=score,
        mean=float(weights @ relevancy[surface.rows[own]]),
        centre=weights @ points,
        points=surface.positions[np.sort(own)[:: -(-len(own) // BOXED)]],  # near ones have near numbers
        share=float(share),
    )


def _extent(gaussians: Gaussians, rows: Array) -> Array:
    """(K,) float64: opacity times the largest cross-section.

    A volume would count flat Gaussians, which surfaces are made of, as nothing.
    """
    x, y, z = np.maximum(gaussians.log_scales[rows].astype(np.float64), _FLAT).T
    opacity = sigmoid(gaussians.opacity_logits[rows].astype(np.float64))
    return opacity * np.exp(x + y + z - np.minimum(np.minimum(x, y), z))


# The convex hull of an instance, as a closed mesh.

FEW = 8  # Gaussians in the box: of so few none is a stray
THICKNESS = 1e-3  # of the longest side: what is flatter than this is given it, since a hull needs a volume


@dataclass(frozen=True, eq=False)
class Hull:
    """Triangles that close around something."""

    name: str
    vertices: Array  # (V, 3) float64 world units
    triangles: Array  # (T, 3) int32 numbers of vertices, counter-clockwise seen from outside
    colour: Array  # (3,) display values in [0, 1], of the whole


def hull(instance: Instance, gaussians: Gaussians, colours: Array, name: str) -> Hull:
    """Hull around the instance's Gaussians that lie in its oriented box: strays would stretch it.

    colours: (N, 3) of the scene's Gaussians, in [0, 1]; the mesh has the mean of its own. Raises InputError
    where all lie at one point.
    """
    box, rows = instance.oriented, instance.members
    means = gaussians.means[rows].astype(np.float64)
    inside = box.contains(means)
    if inside.sum() < FEW:
        inside[:] = True
    own = (means[inside] - box.centre) @ box.axes
    longest = 2 * float(box.half_extents[0])
    if longest <= 0:
        raise InputError(f"{name} is a single point, which has no hull; write it with --as points")
    flat = 2 * box.half_extents < THICKNESS * longest
    if flat.any():  # both sides of a sheet, all four of a line
        for axis in np.flatnonzero(flat):
            offset = np.eye(3)[axis] * THICKNESS * longest / 2
            own = np.concatenate([own - offset, own + offset])
    try:
        found = ConvexHull(own)
    except QhullError:
        raise InputError(f"{name} has too few points for a hull; write it with --as points") from None
    number = np.full(len(own), -1, np.int32)
    number[found.vertices] = np.arange(len(found.vertices))
    vertices = own[found.vertices]
    triangles = _outward(vertices, number[found.simplices], found.equations[:, :3])
    return Hull(name, box.centre + vertices @ box.axes.T, triangles, colours[rows[inside]].mean(0))


def _outward(vertices: Array, triangles: Array, normals: Array) -> Array:
    """Return the triangles, turned where they run against their outward `normals` (T, 3)."""
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * normals).sum(1) < 0
    return np.where(inward[:, None], triangles[:, [0, 2, 1]], triangles)
