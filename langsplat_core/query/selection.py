"""Selections of Gaussians, (N,) bool arrays, and what can be made of them.

Growing and shrinking walk along the surface and never jump to a thing behind or above. Gaussians too faint to
be on it go where the one goes that they are nearest to (`Surface.anchors`); those near none never change.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.query.boxes import OrientedBox
from langsplat_core.query.regions import Regions
from langsplat_core.query.surface import Surface


def of_rows(rows: Array, count: int) -> Array:
    """(K,) rows of `count` Gaussians -> (count,) bool."""
    selected = np.zeros(count, bool)
    selected[rows] = True
    return selected


def union(selections: Sequence[Array]) -> Array:
    """What is in any of them, one or more."""
    return np.logical_or.reduce(selections)


def intersection(selections: Sequence[Array]) -> Array:
    """What is in all of them, one or more."""
    return np.logical_and.reduce(selections)


def difference(selections: Sequence[Array]) -> Array:
    """What is in the first and in none of the others."""
    first, *others = selections
    return first & ~union(others) if others else first.copy()


def invert(selected: Array) -> Array:
    """What is not selected."""
    return ~selected


def in_sphere(means: Array, centre: Array, radius: float) -> Array:
    """(N, 3) -> (N,) bool: at most `radius` from `centre` (3,), world units. A mean that is not finite is
    nowhere."""
    offsets = np.asarray(means, np.float64) - centre
    with np.errstate(invalid="ignore"):
        squares: Array = (offsets**2).sum(1)
        return squares <= radius**2


def in_box(means: Array, low: Array, high: Array) -> Array:
    """(N, 3) -> (N,) bool: between two corners (3,) along the world's axes, faces included."""
    inside: Array = np.all((means >= np.asarray(low)) & (means <= np.asarray(high)), axis=1)
    return inside


def in_oriented_box(means: Array, box: OrientedBox) -> Array:
    """(N, 3) -> (N,) bool: inside `box`, faces included."""
    with np.errstate(invalid="ignore"):
        return box.contains(np.asarray(means, np.float64))


def at_point(surface: Surface, regions: Regions, level: int, point: Array) -> Array:
    """(N,) bool: the whole region, at a level (index into LEVELS), of what lies nearest to `point` (3,),
    world units, with the faint ones beside it. Nothing where the scene has no surface."""
    if len(surface.rows) == 0:
        return np.zeros(len(surface.anchors), bool)
    nearest = int(((surface.positions - point) ** 2).sum(1).argmin())
    same: Array = regions.everywhere[level] == regions.of[level][nearest]
    return same


def grow_steps(surface: Surface, selected: Array, steps: int = 1) -> Array:
    """And all that `steps` links along the surface lead to."""
    _check("number of steps", steps)
    reached: Array = selected[surface.rows]
    for _ in range(steps):
        linked: Array = surface.links @ reached
        wider = reached | linked
        if np.array_equal(wider, reached):
            break
        reached = wider
    return _spread(surface, selected, reached)


def grow(surface: Surface, selected: Array, distance: float) -> Array:
    """And all that lies within `distance` along the surface, world units, from its nearest selected point."""
    _check("distance", distance)
    reached = selected[surface.rows]
    if not reached.any() or reached.all():
        return _spread(surface, selected, reached)
    lengths = dijkstra(
        _lengths(surface), directed=False, indices=np.flatnonzero(reached), limit=distance, min_only=True
    )
    return _spread(surface, selected, np.isfinite(lengths))


def shrink_steps(surface: Surface, selected: Array, steps: int = 1) -> Array:
    """Without what is at most `steps` links from what is not selected. Where the surface itself ends,
    nothing is lost."""
    return ~grow_steps(surface, ~selected, steps)


def shrink(surface: Surface, selected: Array, distance: float) -> Array:
    """Without what lies within `distance` of what is not selected, along the surface, world units."""
    return ~grow(surface, ~selected, distance)


def _spread(surface: Surface, selected: Array, reached: Array) -> Array:
    """`selected` and every Gaussian at a `reached` (M,) point of the surface."""
    if len(reached) == 0:
        return selected.copy()
    at_reached: Array = selected | (reached[surface.anchors] & (surface.anchors >= 0))
    return at_reached


def _lengths(surface: Surface) -> csr_matrix:
    """The links with their lengths, world units."""
    links = surface.links
    source = np.repeat(np.arange(len(surface.rows)), np.diff(links.indptr))
    gaps = np.linalg.norm(surface.positions[source] - surface.positions[links.indices], axis=1)
    # A stored zero is no link to the sparse format's walkers: coincident points are at the least distance.
    return csr_matrix((np.maximum(gaps, 1e-12), links.indices, links.indptr), shape=links.shape)


def _check(name: str, value: float) -> None:
    if not 0 <= value < float("inf"):
        raise InputError(f"a {name} of {value:g} cannot be walked along the surface; give 0 or more")
