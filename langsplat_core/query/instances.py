"""Instances of an answer: its Gaussians, separated along the surface, with boxes and scores."""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.compiled import plain
from langsplat_core.scene import Gaussians
from langsplat_core.scene.language import NO_NODE
from langsplat_core.scene.surface import FAINTEST, Surface, cross_sections, surface_weights

INNER = (0.02, 0.98)  # a box holds the points between these quantiles of each coordinate, without outliers
COARSE = np.radians(np.arange(0.0, 90.0, 10.0))  # 0 first, so that equal areas keep the principal axes
FINE = np.radians([0.0, -2.0, 2.0, -4.0, 4.0])


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box in any orientation, its longest side first."""

    centre: Array  # (3,) world units
    axes: Array  # (3, 3) rotation, right-handed; column k is the direction of side k
    half_extents: Array  # (3,) world units, half the sides, descending, >= 0

    @property
    def corners(self) -> Array:
        """The (8, 3) corners of the box, world units."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
        return self.centre + (signs * self.half_extents) @ self.axes.T


def axis_aligned_box(points: Array) -> Array:
    """Return (2, 3) float64 corners of the box between the `INNER` quantiles of (M, 3) points, M >= 1."""
    return np.quantile(np.ascontiguousarray(points.T, np.float64), INNER, axis=1)


def oriented_box(points: Array) -> OrientedBox:
    """Return the box around (M, 3) points, M >= 1, between the `INNER` quantiles along each of its axes.

    The axes are the principal ones of the points without outliers, rotated about one another to the least
    area of the box's faces: principal axes alone do not define the orientation of a square or a cube.
    """
    columns = np.ascontiguousarray(points.T, np.float64)
    low, high = axis_aligned_box(points)[..., None]
    core = columns[:, ((columns >= low) & (columns <= high)).all(0)]
    if core.shape[1] < 2:  # the quantiles cut away all but the middle of few points
        core = columns
    middle = core.mean(1, keepdims=True)
    spread = core - middle
    axes = np.linalg.eigh(spread @ spread.T)[1]
    axes = _least_area(spread[:, :: -(-spread.shape[1] // 256)], axes)  # by 256 points at most
    low, high = np.quantile(axes.T @ (columns - middle), INNER, axis=1)
    order = np.argsort(low - high, kind="stable")
    axes, low, high = axes[:, order], low[order], high[order]
    centre = middle[:, 0] + axes @ ((low + high) / 2)
    # Sign convention: the largest entry of the first two axes is positive, and the axes are right-handed.
    signs = np.sign(axes[np.abs(axes).argmax(0), range(3)])
    signs[2] = signs[0] * signs[1] * np.sign(np.linalg.det(axes))
    return OrientedBox(centre, axes * signs, (high - low) / 2)


@lru_cache(512)  # many phrases are answered by the same instances; at most 25 MB
def _oriented_box(points: bytes) -> OrientedBox:
    return oriented_box(np.frombuffer(points).reshape(-1, 3))


def _least_area(columns: Array, axes: Array) -> Array:
    """Return `axes` after a rotation about each, the shortest side's first; columns: (3, M) points."""
    axes = axes.copy()
    for one, other in ((1, 2), (0, 2), (0, 1)) * 2:  # a cube needs a second round
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
    """Return the (A,) widths of (A, M) rows between their `INNER` quantiles, to the nearest point."""
    low, high = (round(q * (rows.shape[1] - 1)) for q in INNER)
    rows.partition((low, high), axis=1)
    return rows[:, high] - rows[:, low]


# Two members belong to one instance if they are of one whole that masks voted for (in an answer at level
# whole), or if linked members of the surface, of the same voted whole or of none, connect them. A Gaussian
# too faint to be on the surface belongs to the instance of the nearest one that is.

CRUMB_COUNT = 8  # least Gaussians of an instance: half of the neighbourhood that relevancy is smoothed over
CRUMB_SHARE = 0.01  # least extent of an instance on the surface, as a share of the largest one's
EQUAL_SCORES = 1e-3  # of relevancy: scores this close are equal, and the larger instance comes first
BOXED = 2048  # members, at most, that a box is computed from


@dataclass(frozen=True, eq=False)
class Instance:
    """One connected instance among the Gaussians that answer a phrase."""

    members: Array = field(repr=False)  # (K,) int64 rows of the scene, ascending; faint ones included
    score: float  # in [0, 1], peak of its smoothed relevancy
    mean: float  # in [0, 1], mean relevancy of its members on the surface, weighted by opacity
    centre: Array  # (3,) world units, mean position of the same, weighted by opacity
    points: Array = field(repr=False)  # (P, 3) positions of at most `BOXED` of the same, for its boxes
    share: float  # in [0, 1], of the answer's extent: opacity times cross-section, summed over members

    @property
    def count(self) -> int:
        return len(self.members)

    @cached_property
    def box(self) -> Array:
        """The (2, 3) lower and upper corner of its axis-aligned box, world units, from 2 % to 98 %."""
        return axis_aligned_box(self.points)

    @cached_property
    def oriented(self) -> OrientedBox:
        """Its oriented box, between the same quantiles."""
        return _oriented_box(self.points.tobytes())

    @property
    def size(self) -> Array:
        """The (3,) sides of the oriented box, longest first, world units."""
        return 2 * self.oriented.half_extents


def split_instances(surface: Surface, numbers: Array, wholes: Array | None, join: bool) -> list[Array]:
    """Divide surface Gaussians `numbers` (K,) into instances by voted `wholes` (N,); join: one per whole."""
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
    """Return the instances among `members` (N,) bool, best score first, of equal ones the larger first.

    relevancy: (N,) at the answer's level; wholes, join: see `split_instances`. Of crumbs alone one stays.
    """
    every = np.flatnonzero(members)
    numbers, labels = surface.anchors[every], np.full(len(every), -1)
    near = numbers >= 0
    rows, numbers = every[near], numbers[near]
    visible = surface.rows[numbers] == rows
    if not visible.any():
        return ()
    parts = split_instances(surface, numbers[visible], wholes, join)
    counts = np.array(list(map(len, parts)))
    smoothed = surface.smooth(plain(relevancy), np.concatenate(parts))
    label_of = np.full(len(surface.rows), -1)
    label_of[np.concatenate(parts)] = np.repeat(np.arange(len(parts)), counts)
    labels[near] = label_of[numbers]  # -1: faint ones whose nearest is no member
    scores = np.maximum.reduceat(smoothed, np.cumsum(counts) - counts)
    own = [surface.rows[np.sort(part)] for part in parts]
    return _ranked(gaussians, every, labels, own, scores, relevancy, at_most)


def find_wholes(
    gaussians: Gaussians, members: Array, even: Array, wholes: Array, at_most: int | None = None
) -> tuple[Instance, ...] | None:
    """Return the instances among `members` as `find_instances` does, each one a voted whole.

    even: (N,) relevancy in [0, 1], constant over a region. None if a visible member is in no voted whole.
    """
    every = np.flatnonzero(members)
    seen, owner = surface_weights(gaussians)[every] > 0, wholes[every]
    if (owner[seen] == NO_NODE).any():
        return None
    if not (own := [every[seen & (owner == whole)] for whole in np.unique(owner[seen])]):
        return ()
    label_of = np.full(int(wholes.max()) + 2, -1)  # the last entry is what -1, no whole, indexes
    label_of[[wholes[rows[0]] for rows in own]] = np.arange(len(own))
    labels = np.where(gaussians.valid()[every], label_of[owner], -1)
    return _ranked(gaussians, every, labels, own, np.array([even[rows].max() for rows in own]), even, at_most)


def _ranked(
    gaussians: Gaussians,
    every: Array,
    labels: Array,
    parts: list[Array],
    scores: Array,
    relevancy: Array,
    at_most: int | None,
) -> tuple[Instance, ...]:
    """Return the instances of P parts, given by their rows on the surface, in the order of `find_instances`.

    every: (K,) rows of all members; labels: (K,) part of each, -1 for none; scores: (P,).
    """
    counts = np.array(list(map(len, parts)))
    sizes = cross_sections(gaussians.log_scales[every], gaussians.opacity_logits[every])
    extents = np.bincount(labels + 1, sizes, len(parts) + 1)[1:]
    found = []
    kept = np.flatnonzero((counts >= CRUMB_COUNT) & (extents >= CRUMB_SHARE * extents.max()))
    kept = kept if len(kept) else np.array([int(extents.argmax())])
    ranked = kept[np.lexsort((-extents[kept], -np.round(scores[kept] / EQUAL_SCORES)))]
    for part in ranked[:at_most]:
        own = parts[part]
        weights = np.maximum(sigmoid(gaussians.opacity_logits[own].astype(np.float64)), FAINTEST)
        weights /= weights.sum()
        points = gaussians.means[own].astype(np.float64)
        instance = Instance(
            members=every[labels == part],
            score=float(scores[part]),
            mean=float(weights @ relevancy[own]),
            centre=weights @ points,
            points=points[:: -(-len(own) // BOXED)],
            share=float(extents[part] / max(sizes.sum(), 1e-300)),
        )
        found.append(instance)
    return tuple(found)
