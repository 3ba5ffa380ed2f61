"""Boxes around points whose box is known."""

import numpy as np
import pytest

from langsplat_core.arrays import Array, rotation_matrices
from langsplat_core.query.instances import INNER, OrientedBox, axis_aligned_box, oriented_box

INSIDE = INNER[1] - INNER[0]  # of a side, where points are spread evenly over it


def turned(seed: int) -> Array:
    return rotation_matrices(np.random.default_rng(seed).normal(size=(1, 4)))[0]


def filled(sides: tuple[float, float, float], count: int = 2000, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-0.5, 0.5, size=(count, 3)) * sides


def check(box: OrientedBox) -> None:
    np.testing.assert_allclose(box.axes.T @ box.axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(box.axes) == pytest.approx(1)
    assert (np.diff(box.half_extents) <= 0).all()
    assert (box.half_extents >= 0).all()
    assert np.isfinite(box.centre).all()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("sides", [(3, 2, 1), (1, 1, 0.3), (2, 0.5, 0.5), (1, 1, 1), (4, 3, 0)])
def test_a_turned_box_is_found_again(sides, seed, measured):
    rotation, shift = turned(seed), np.array([5.0, -2, 9])
    box = oriented_box(filled(sides, seed=seed) @ rotation.T + shift)
    check(box)
    np.testing.assert_allclose(box.centre, shift, atol=0.03 * max(sides))
    found = 2 * box.half_extents
    error = np.abs(found - INSIDE * np.array(sides)).max() / max(sides)
    measured(f"oriented box of {sides}", "error of a side, share of the longest", error)
    assert error < 0.08


def test_axes_turn_with_the_points_and_the_sides_stay():
    points = filled((3, 2, 1))
    plain, rotation = oriented_box(points), turned(1)
    box = oriented_box(points @ rotation.T + 3)
    np.testing.assert_allclose(box.half_extents, plain.half_extents, rtol=0.05)
    assert (np.abs(np.sum(box.axes * (rotation @ plain.axes), axis=0)) > np.cos(np.radians(8))).all()


def test_strays_do_not_count():
    points = filled((3, 2, 1))
    before = oriented_box(points)
    points[:20] = np.random.default_rng(1).normal(scale=50, size=(20, 3))
    after = oriented_box(points)
    np.testing.assert_allclose(after.half_extents, before.half_extents, rtol=0.1)
    box = axis_aligned_box(points)
    assert (np.abs(box) < 1.6).all()


def test_no_more_than_the_quantiles_lie_outside():
    points = filled((1, 2, 3)) @ turned(2).T
    box = oriented_box(points)
    low, high = axis_aligned_box(points)
    per_axis = 1 - INSIDE
    assert 1 - 3 * per_axis - 0.01 <= box.contains(points).mean() < 1
    assert ((points >= low) & (points <= high)).all(1).mean() >= 1 - 3 * per_axis - 0.01
    assert box.contains(box.corners).all()
    np.testing.assert_allclose(
        np.sort(box.corners @ box.axes, axis=0)[-1] - box.centre @ box.axes, box.half_extents
    )


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 3)),
        np.full((7, 3), 4.0),
        np.array([[0.0, 0, 0], [1, 2, 3]]),
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
        np.linspace(0, 1, 50)[:, None] * [1.0, 1, 0],
        filled((2, 1, 0)),
        filled((1, 1, 1)) * 1e-20,
        filled((1, 1, 1)) * 1e20,
        filled((1, 1, 1)).astype(np.float32),
    ],
    ids=["one", "coincident", "two", "three", "line", "plane", "tiny", "huge", "float32"],
)
def test_degenerate_points(points):
    check(oriented_box(points))
    assert np.isfinite(axis_aligned_box(points)).all()


def test_a_line_has_a_length():
    box = oriented_box(np.linspace(0, 1, 101)[:, None] * [3.0, 4, 0])
    np.testing.assert_allclose(2 * box.half_extents, [5 * INSIDE, 0, 0], atol=1e-9)
    np.testing.assert_allclose(np.abs(box.axes[:, 0]), [0.6, 0.8, 0], atol=1e-9)
