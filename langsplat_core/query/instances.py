"""The instances of an answer: its Gaussians, taken apart where the surface is, with place, size and score.

Two members belong to one instance when a walk over linked members of the surface leads from one to the
other. What is too faint to be on the surface belongs where the surface Gaussian nearest to it belongs.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.compiled import kernel, plain
from langsplat_core.query.boxes import OrientedBox, axis_aligned_box, oriented_box
from langsplat_core.query.surface import Surface
from langsplat_core.scene import Gaussians

CRUMB_COUNT = 8  # half of the neighbourhood that relevancy is smoothed over
CRUMB_SHARE = 0.01  # of the largest instance's extent on the surface
EQUAL_SCORES = 1e-3  # of relevancy: instances this close are as good, and the larger comes first
BOXED = 2048  # members, at most, that a box is taken from
_FLAT = -100.0  # logarithm of a scale, instead of -infinity
_OUTSIDE, _WAITING = -1, -2  # labels that are no part


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
        """How many Gaussians it has."""
        return len(self.members)

    @cached_property
    def box(self) -> Array:
        """(2, 3) lower and upper corner along the world's axes, world units, between 2 % and 98 %."""
        return axis_aligned_box(self.points)

    @cached_property
    def oriented(self) -> OrientedBox:
        """Along its own axes, likewise."""
        return oriented_box(self.points)

    @property
    def size(self) -> Array:
        """(3,) sides of the oriented box, longest first, world units."""
        size: Array = 2 * self.oriented.half_extents
        return size


@dataclass(frozen=True, eq=False)
class Parts:
    """The C connected parts of some members of a surface, with the members part by part."""

    order: Array  # (K,) int32 numbers on the surface
    starts: Array  # (C,) int32 where each part begins in `order`
    labels: Array  # (M,) int32 part of every Gaussian of the surface; -1 for those that are no members

    def each(self) -> list[Array]:
        """The numbers of every part, ascending."""
        return [np.sort(part) for part in np.split(self.order, self.starts[1:])] if len(self.starts) else []


def find_instances(
    surface: Surface, gaussians: Gaussians, members: Array, relevancy: Array, at_most: int | None = None
) -> tuple[Instance, ...]:
    """The instances among `members` (N,) bool, best first by score, of equal ones the larger first.

    relevancy: (N,) in [0, 1], at the level of the answer. at_most: only so many of the best. Crumbs are left
    out: parts of fewer than `CRUMB_COUNT` Gaussians on the surface, or of less than `CRUMB_SHARE` of the
    largest part's extent. Where all are crumbs, the largest alone is kept.
    """
    every = np.flatnonzero(members)
    numbers = surface.anchors[every]
    near = numbers >= 0
    rows, numbers = every[near], numbers[near]
    visible = surface.rows[numbers] == rows
    if not visible.any():
        return ()
    parts = connected_parts(surface, numbers[visible])
    values = plain(relevancy)
    smoothed = np.empty(len(parts.order), np.float32)
    _smooth_some(parts.order, surface.neighbours, surface.rows, surface.weights, values, smoothed)
    scores = np.maximum.reduceat(smoothed, parts.starts)
    labels = parts.labels[numbers]  # -1: faint ones beside something else
    sizes = _extent(gaussians, every)
    extents = np.bincount(labels + 1, sizes[near], len(parts.starts) + 1)[1:]
    counts = np.diff(parts.starts, append=len(parts.order))
    found = []
    for part in _ranked(scores, extents, counts)[:at_most]:
        own = parts.order[parts.starts[part] :][: counts[part]]
        share = extents[part] / max(sizes.sum(), 1e-300)
        found.append(_instance(surface, own, rows[labels == part], values, float(scores[part]), share))
    return tuple(found)


def connected_parts(surface: Surface, numbers: Array) -> Parts:
    """Of some Gaussians of the surface, given by their numbers (K,), in [0, M), each once."""
    labels = np.full(len(surface.rows), _OUTSIDE, np.int32)
    labels[numbers] = _WAITING
    order, starts = np.empty(len(numbers), np.int32), np.empty(len(numbers), np.int32)
    links = surface.links
    count = _label(links.indptr, links.indices, numbers, labels, order, starts)
    return Parts(order, starts[:count].copy(), labels)


def _ranked(scores: Array, extents: Array, counts: Array) -> Array:
    """Numbers of the parts that are no crumbs, best first."""
    kept = np.flatnonzero((counts >= CRUMB_COUNT) & (extents >= CRUMB_SHARE * extents.max()))
    if len(kept) == 0:
        return np.array([int(extents.argmax())])
    steps = np.round(scores[kept] / EQUAL_SCORES)
    return kept[np.lexsort((-extents[kept], -steps))]


def _instance(
    surface: Surface, own: Array, members: Array, relevancy: Array, score: float, share: float
) -> Instance:
    """own: its numbers on the surface; members: its rows, these and faint ones."""
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
    """(K,) float64: opacity times the largest cross-section. A volume would count flat Gaussians, which
    surfaces are made of, as nothing."""
    x, y, z = np.maximum(gaussians.log_scales[rows].astype(np.float64), _FLAT).T
    opacity = sigmoid(gaussians.opacity_logits[rows].astype(np.float64))
    return opacity * np.exp(x + y + z - np.minimum(np.minimum(x, y), z))


@kernel
def _label(indptr: Array, indices: Array, numbers: Array, labels: Array, order: Array, starts: Array) -> int:
    """Number the parts of `numbers`, which are `_WAITING` in `labels`, breadth first; how many parts."""
    parts = found = done = 0
    for seed in numbers:
        if labels[seed] != _WAITING:
            continue
        starts[parts] = found
        labels[seed] = parts
        order[found] = seed
        found += 1
        while done < found:
            here = order[done]
            done += 1
            for entry in range(indptr[here], indptr[here + 1]):
                there = indices[entry]
                if labels[there] == _WAITING:
                    labels[there] = parts
                    order[found] = there
                    found += 1
        parts += 1
    return parts


@kernel
def _smooth_some(
    chosen: Array, neighbours: Array, rows: Array, weights: Array, values: Array, smoothed: Array
) -> None:
    """What `Surface.smooth` gives for `chosen` numbers and one level."""
    for i in range(len(chosen)):
        value = total = np.float32(0)
        for k in range(neighbours.shape[1]):
            j = neighbours[chosen[i], k]
            value += weights[j] * values[rows[j]]
            total += weights[j]
        smoothed[i] = value / total
