"""Boxes around points: along the world's axes, and along the points' own."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array

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
        """(8, 3) world units."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
        corners: Array = self.centre + (signs * self.half_extents) @ self.axes.T
        return corners

    def contains(self, points: Array) -> Array:
        """(N, 3) -> (N,) bool; a point on a face is inside."""
        inside: Array = (np.abs((points - self.centre) @ self.axes) <= self.half_extents * (1 + 1e-9)).all(1)
        return inside


def axis_aligned_box(points: Array) -> Array:
    """(M, 3), M >= 1 -> (2, 3) float64 lower and upper corner between the `INNER` quantiles."""
    return _inner(np.ascontiguousarray(points.T, np.float64))


def oriented_box(points: Array) -> OrientedBox:
    """Around (M, 3) points, M >= 1, between the `INNER` quantiles along each of its axes.

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
    inner: Array = np.quantile(columns, INNER, axis=1)
    return inner


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
    """(A, M) -> (A,) between the `INNER` quantiles of each row, to the nearest point."""
    low, high = (round(q * (rows.shape[1] - 1)) for q in INNER)
    rows.partition((low, high), axis=1)
    widths: Array = rows[:, high] - rows[:, low]
    return widths


def _right_handed(axes: Array) -> Array:
    """The same axes with settled signs: the largest entry of the first two is positive."""
    signs = np.sign(axes[np.abs(axes).argmax(0), range(3)])
    signs[2] = signs[0] * signs[1] * np.sign(np.linalg.det(axes))
    return axes * signs
