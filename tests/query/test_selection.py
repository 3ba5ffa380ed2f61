"""Selections: along the surface against plain walks, and drawn on an image against plain loops."""

import heapq
from math import cos, hypot, inf, nan, pi, sin

import numpy as np
import pytest

from langsplat_core.errors import InputError
from langsplat_core.query import selection
from langsplat_core.query.selection import Projected, in_polygon, in_rectangle, in_stroke, on_surface, project
from langsplat_core.query.surface import Surface, build_regions, build_surface
from langsplat_core.scene import Gaussians, look_at
from tests.support.query_scenes import two_blob_scene
from tests.support.scenes import random_gaussians


def sheet(side: int = 20, spacing: float = 0.1) -> Gaussians:
    """A square of opaque Gaussians in the plane z = 0, and one faint one above each."""
    x, y = np.meshgrid(np.arange(side) * spacing, np.arange(side) * spacing)
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], -1)
    n = 2 * len(flat)
    return Gaussians(
        means=np.concatenate([flat, flat + [0, 0, 0.3 * spacing]]),
        log_scales=np.full((n, 3), np.log(spacing / 2)),
        quats_wxyz=np.tile([1.0, 0, 0, 0], (n, 1)),
        opacity_logits=np.repeat([3.0, -4.0], n // 2),
        sh=np.zeros((n, 1, 3)),
    )


def walked(surface: Surface, seeds: np.ndarray) -> np.ndarray:
    """(M,) lengths of the shortest ways along links, by Dijkstra's book, in float64."""
    lengths = np.where(seeds, 0.0, inf)
    waiting = [(0.0, int(i)) for i in np.flatnonzero(seeds)]
    while waiting:
        so_far, here = heapq.heappop(waiting)
        for there in surface.links[here].indices:
            step = so_far + np.linalg.norm(surface.positions[here] - surface.positions[there])
            if step < lengths[there]:
                lengths[there] = step
                heapq.heappush(waiting, (float(step), int(there)))
    return lengths


def random_selection(n: int, seed: int = 0, share: float = 0.1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=n) < share


def test_spheres_and_boxes_hold_their_faces_and_nothing_without_a_place():
    means = np.array([[0, 0, 0], [1, 0, 0], [1.001, 0, 0], [nan, 0, 0], [0, -1, 1]], np.float32)
    assert selection.in_sphere(means, np.zeros(3), 1.0).tolist() == [True, True, False, False, False]
    inside = selection.in_box(means, np.array([0, -1, 0]), np.array([1, 0, 1]))
    assert inside.tolist() == [True, True, False, False, True]


@pytest.mark.parametrize("distance", [0.0, 0.15, 0.4, 100.0])
def test_growing_by_a_distance_is_the_shortest_way(distance):
    gaussians = random_gaussians(300)
    surface = build_surface(gaussians)
    selected = random_selection(300, share=0.03)
    lengths = walked(surface, selected[surface.rows])
    grown = selection.grow(surface, selected, distance)
    assert grown[surface.rows].tolist() == (lengths <= distance).tolist()
    assert (grown >= selected).all()


def test_shrinking_undoes_growing_on_a_sheet_and_faint_ones_follow():
    gaussians = sheet()
    surface = build_surface(gaussians)
    assert (surface.anchors >= 0).all()
    start = selection.in_box(gaussians.means, np.array([0.7, 0.7, -1]), np.array([1.2, 1.2, 1]))
    grown = selection.grow(surface, start, 0.25)
    assert grown.sum() > start.sum()
    opaque, faint = grown[:400], grown[400:]
    assert opaque.tolist() == faint.tolist()
    assert (selection.shrink(surface, grown, 0.25) >= start).all()  # closing
    opened = selection.shrink(surface, start, 0.11)
    assert 0 < opened.sum() < start.sum()
    assert (opened <= start).all()
    assert not selection.shrink(surface, start, 1.0).any()


def test_a_faint_gaussian_that_is_not_selected_shrinks_nothing():
    gaussians = sheet()
    surface = build_surface(gaussians)
    selected = np.ones(len(gaussians), bool)
    selected[400:] = random_selection(400)
    assert selection.shrink(surface, selected, 0.2).tolist() == selected.tolist()


def test_shrinking_keeps_where_the_surface_ends():
    gaussians = sheet(10)
    surface = build_surface(gaussians)
    everything = np.ones(len(gaussians), bool)
    assert selection.shrink(surface, everything, 5.0).all()


def test_what_lies_nearest_to_a_point_is_selected_as_a_region():
    scene, left, right = two_blob_scene()
    surface = build_surface(scene.gaussians)
    regions = build_regions(surface, scene.language)
    for level in (1, 2):  # at which the two mean something
        first = selection.at_point(surface, regions, level, left.mean(0))
        assert first.tolist() == [True] * len(left) + [False] * len(right)
        second = selection.at_point(surface, regions, level, right.mean(0) + [9.0, 0, 0])
        assert (second == ~first).all()
    nothing = scene.take(np.zeros(len(scene.gaussians), bool))
    surface = build_surface(nothing.gaussians)
    assert len(selection.at_point(surface, regions, 2, np.zeros(3))) == 0


@pytest.mark.parametrize("wrong", [-1, inf, nan])
def test_a_distance_that_cannot_be_walked(wrong):
    surface = build_surface(sheet(5))
    nothing = np.zeros(50, bool)
    with pytest.raises(InputError, match="give 0 or more"):
        selection.grow(surface, nothing, wrong)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_scenes_of_almost_nothing(count):
    surface = build_surface(random_gaussians(count), min_opacity=0.0)
    for selected in (np.zeros(count, bool), np.ones(count, bool)):
        assert selection.grow(surface, selected, 1.0).tolist() == selected.tolist()


# Selections drawn on a picture, against plain loops.

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
    for few in (np.zeros((0, 2)), np.array([[0.0, 0.0], [80.0, 60.0]])):
        assert not in_polygon(seen, few).any()


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
