"""Selections drawn on a picture, against plain loops."""

from math import cos, hypot, inf, nan, pi, sin

import numpy as np
import pytest

from langsplat_core.query.selection import Projected, in_polygon, in_rectangle, in_stroke, on_surface, project
from langsplat_core.scene import look_at

SIZE = (80, 60)


@pytest.fixture
def seen() -> Projected:
    """Places all over the picture and beyond it, a few of them behind the camera."""
    rng = np.random.default_rng(3)
    depths = rng.uniform(0.5, 9.0, 700)
    depths[:30] = -1.0
    return Projected(rng.uniform(-10, 95, (700, 2)), depths)


def star(points: int = 7) -> np.ndarray:
    """An outline that crosses itself, with a level edge at its end."""
    turns = [2 * pi * 3 * k / points for k in range(points)]
    return np.array([[40 + 30 * cos(t), 30 + 25 * sin(t)] for t in turns] + [[50.0, 10.0], [60.0, 10.0]])


def plainly_in_polygon(x: float, y: float, outline) -> bool:
    odd, before = False, outline[-1]
    for corner in outline:
        (x0, y0), (x1, y1) = before, corner
        if (y0 > y) != (y1 > y) and x < x0 + (x1 - x0) * (y - y0) / (y1 - y0):
            odd = not odd
        before = corner
    return odd


def plainly_from_segment(x: float, y: float, start, end) -> float:
    (x0, y0), (x1, y1) = start, end
    square = (x1 - x0) ** 2 + (y1 - y0) ** 2
    t = 0.0 if square == 0 else min(max(((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / square, 0.0), 1.0)
    return hypot(x - x0 - t * (x1 - x0), y - y0 - t * (y1 - y0))


def test_an_outline_holds_what_a_walk_around_it_says(seen):
    for outline in (star(), star()[::-1], np.array([[5, 5], [70, 20], [30, 55.0]])):
        wanted = [
            bool(z > 0 and plainly_in_polygon(x, y, outline.tolist()))
            for (x, y), z in zip(seen.pixels, seen.depths, strict=True)
        ]
        assert any(wanted)
        assert in_polygon(seen, outline).tolist() == wanted


def test_an_outline_of_less_than_three_corners_holds_nothing(seen):
    assert not in_polygon(seen, np.zeros((0, 2))).any()
    assert not in_polygon(seen, np.array([[0.0, 0.0], [80.0, 60.0]])).any()


def test_a_stroke_is_as_wide_as_its_brush(seen):
    path = np.array([[10, 10], [60, 15], [60, 15], [62, 50.0]])
    segments = list(zip(path[:-1].tolist(), path[1:].tolist(), strict=True))
    wanted = [
        bool(z > 0 and min(plainly_from_segment(x, y, a, b) for a, b in segments) <= 6.5)
        for (x, y), z in zip(seen.pixels, seen.depths, strict=True)
    ]
    assert 10 < sum(wanted) < 300
    assert in_stroke(seen, path, 6.5).tolist() == wanted


def test_a_brush_that_was_not_moved_is_a_disk(seen):
    near = np.hypot(*(seen.pixels - (40, 30)).T) <= 12
    assert in_stroke(seen, np.array([[40, 30]]), 12.0).tolist() == (near & (seen.depths > 0)).tolist()
    assert not in_stroke(seen, np.zeros((0, 2)), 12.0).any()


def test_a_rectangle_is_the_same_from_every_corner(seen):
    x, y = seen.pixels.T
    wanted = (seen.depths > 0) & (x >= 20) & (x <= 60) & (y >= 5) & (y <= 40)
    for corner, opposite in (((20, 5), (60, 40)), ((60, 5), (20, 40)), ((60, 40), (20, 5))):
        assert in_rectangle(seen, np.array(corner), np.array(opposite)).tolist() == wanted.tolist()


def test_what_has_no_place_in_the_picture_is_nowhere():
    camera = look_at(np.array([0, 0, -5.0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
    means = np.array([[0, 0, 0], [0, 0, -9], [0, 0, -5], [nan, 0, 0], [inf, 0, 0]], np.float32)
    seen = project(means, camera)
    assert seen.depths.tolist() == [5.0, -1.0, -1.0, -1.0, -1.0]
    np.testing.assert_allclose(seen.pixels[0], (40, 30))
    everywhere = np.array([[-1e6, -1e6], [1e6, -1e6], [1e6, 1e6], [-1e6, 1e6]])
    only_the_first = [True, False, False, False, False]
    assert in_polygon(seen, everywhere).tolist() == only_the_first
    assert in_stroke(seen, everywhere, 1e7).tolist() == only_the_first
    assert on_surface(seen, np.zeros((60, 80)), SIZE).tolist() == only_the_first


@pytest.mark.parametrize("coarser", [1, 4])
def test_what_lies_behind_the_surface_is_hidden(seen, coarser):
    depths = np.full((60 // coarser, 80 // coarser), 4.0)
    depths[:, : 40 // coarser] = 0  # nothing is drawn there, and nothing hides
    found = on_surface(seen, depths, SIZE, behind=0.05)
    wanted = []
    for (x, y), z in zip(seen.pixels, seen.depths, strict=True):
        in_picture = z > 0 and 0 <= x < 80 and 0 <= y < 60
        wanted.append(bool(in_picture and (x < 40 or z <= 4.2)))
    assert found.tolist() == wanted
    assert 0 < found.sum() < in_rectangle(seen, np.zeros(2), np.array(SIZE)).sum()
