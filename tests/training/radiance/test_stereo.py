"""Depths by plane sweeping, against a plain reference and surfaces that are known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.datasets.capture import Capture
from langsplat_core.scene import Camera, look_at
from langsplat_core.training.radiance import stereo
from langsplat_core.training.radiance.stereo import (
    PLANES,
    RADIUS,
    find_depths,
    in_free_space,
    inverse_depths,
    neighbouring_views,
    sweep,
    warp,
)

UP = np.array([0.0, 1.0, 0.0])
SIZE = (72, 54)
TILT = 0.3  # of the surface z = TILT x


def cameras() -> list[Camera]:
    """In a row before the surface, some degrees apart; the last looks away."""
    eyes = [np.array([x, 0.2, -4.0]) for x in (-0.9, -0.3, 0.3, 0.9)]
    seeing = [look_at(eye, np.zeros(3), UP, SIZE, 40.0) for eye in eyes]
    return [*seeing, look_at(np.array([0, 0, -4.0]), np.array([0, 0, -9.0]), UP, SIZE, 40.0)]


def true_depth(camera: Camera) -> Array:
    """(H, W) depth of the surface."""
    ray = camera.unproject(camera.pixel_centres(), np.ones((camera.height, camera.width))) - camera.position
    return (TILT * camera.position[0] - camera.position[2]) / (ray[..., 2] - TILT * ray[..., 0])


def picture(camera: Camera) -> Array:
    """The surface with a texture of waves that repeats nowhere."""
    at = camera.unproject(camera.pixel_centres(), true_depth(camera))
    rng = np.random.default_rng(2)
    waves = rng.normal(size=(40, 2)) * 14
    phases, colours = rng.uniform(0, 6, 40), rng.normal(size=(40, 3)) * 0.09
    return (255 * (0.5 + np.sin(at[..., :2] @ waves.T + phases) @ colours).clip(0, 1)).astype(np.uint8)


@cache
def capture() -> Capture:
    rng = np.random.default_rng(0)
    across = rng.uniform(-1, 1, (200, 2))
    points = np.stack([across[:, 0], across[:, 1], TILT * across[:, 0]], -1)
    images = [picture(camera) for camera in cameras()]
    return Capture(tuple(cameras()), tuple(images), points, np.zeros((200, 3), np.uint8))


def correlation(a: Array, b: Array) -> float:
    """Zero-mean normalised cross-correlation of two windows."""
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).mean() / np.sqrt(((a * a).mean() + 1e-5) * ((b * b).mean() + 1e-5)))


def looked_up(other: Array, camera: Camera, to: Camera, depth: float, column: int, row: int) -> float:
    """The other image where a pixel lies at a depth, bilinear; NaN outside."""
    (place,), _ = to.project(camera.unproject((column + 0.5, row + 0.5), depth)[None])
    u, v = place - 0.5
    if not (0 <= u < other.shape[1] - 1 and 0 <= v < other.shape[0] - 1):
        return float("nan")
    i, j = int(u), int(v)
    a, b = u - i, v - j
    above, below = (other[k, i] * (1 - a) + other[k, i + 1] * a for k in (j, j + 1))
    return float(above * (1 - b) + below * b)


def test_sweep_scores_equal_the_reference() -> None:
    one, two = cameras()[1:3]
    greys = [picture(camera).mean(2, dtype=np.float32) / 255 for camera in (one, two)]
    planes = inverse_depths(one, [one, two], capture().points)
    best = np.full((stereo.BEST, PLANES, *greys[0].shape), -1, np.float32)
    stereo.score_planes(0, PLANES, *greys, *warp(one, two), planes, best)
    judged = 0
    for row, column, plane in ((20, 30, 40), (27, 36, 60), (33, 41, 5), (15, 52, 77)):
        rows, columns = range(row - RADIUS, row + RADIUS + 1), range(column - RADIUS, column + RADIUS + 1)
        depth = 1 / planes[plane]
        seen = np.array(
            [[looked_up(greys[1].astype(float), one, two, depth, x, y) for x in columns] for y in rows]
        )
        if np.isfinite(seen).all():
            judged += 1
            window = greys[0][rows.start : rows.stop, columns.start : columns.stop].astype(float)
            assert best[0, plane, row, column] == pytest.approx(correlation(window, seen), abs=2e-4)
    assert judged >= 3
    assert (best[1] == -1).all()  # one neighbour has one score


def test_depths_lie_on_the_true_surface() -> None:
    maps = find_depths(capture(), range(5))
    assert len(maps) == 4  # the view that looks away has none
    for one, camera in zip(maps, cameras(), strict=False):
        known = np.isfinite(one.depth)
        assert known.mean() > 0.5
        error = np.abs(one.depth / true_depth(camera) - 1)[known]
        assert np.quantile(error, 0.95) < 0.01
        points, colours = one.points()
        assert len(points) == len(colours) == known.sum()
        assert np.quantile(np.abs(points[:, 2] - TILT * points[:, 0]), 0.95) < 0.04


def test_space_before_a_surface_is_free() -> None:
    maps = find_depths(capture(), range(4))
    rng = np.random.default_rng(1)
    across = rng.uniform(-0.5, 0.5, (100, 2))
    surface = np.stack([across[:, 0], across[:, 1], TILT * across[:, 0]], -1)
    assert in_free_space(surface - (0, 0, 1.0), maps).mean() > 0.9
    assert in_free_space(surface, maps).mean() < 0.02
    assert not in_free_space(surface + (0, 0, 1.0), maps).any()  # nobody looks there
    assert not in_free_space(surface - (0, 0, 20.0), maps).any()
    assert not in_free_space(surface, []).any()


def test_isolated_depths_are_dropped() -> None:
    rng = np.random.default_rng(5)
    depth = np.where(rng.random(SIZE[::-1]) < 0.6, rng.normal(5, 0.1, SIZE[::-1]), np.nan)
    depth[10, 10] = 9.0
    kept = stereo.shared_depths(depth)
    for (row, column), found in np.ndenumerate(kept):
        window = depth[
            max(row - RADIUS, 0) : row + RADIUS + 1, max(column - RADIUS, 0) : column + RADIUS + 1
        ]  # fmt: skip
        alike = np.abs(window / depth[row, column] - 1) < stereo.ALIKE
        enough = alike.sum() >= stereo.LEAST_ALIKE * (2 * RADIUS + 1) ** 2
        assert found == depth[row, column] if enough else np.isnan(found)
    assert np.isnan(kept[10, 10])
    assert 0.2 < np.isfinite(kept).mean() < 0.6


def test_free_depth_follows_nearby_depths_and_points() -> None:
    rng = np.random.default_rng(4)
    camera = cameras()[1]
    depth = np.where(rng.random(SIZE[::-1]) < 0.01, rng.uniform(2, 9, SIZE[::-1]), np.nan)
    points = camera.unproject((10.5, 40.5), 1.5)[None]
    told = depth.copy()
    told[40, 10] = 1.5
    reach = round(stereo.AROUND * SIZE[0])
    anywhere = (1 - stereo.NEARER_THAN_ALL) * np.quantile(told[np.isfinite(told)], stereo.NEAR_QUANTILE)
    alone = 0
    for (row, column), found in np.ndenumerate(stereo.free_depths(camera, depth, points)):
        window = told[
            max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1
        ]  # fmt: skip
        expected = anywhere
        if np.isfinite(depth[row, column]):
            expected = (1 - stereo.BEFORE) * depth[row, column]
        elif np.isfinite(window).any():
            expected = (1 - stereo.NEARER) * np.nanmin(window)
        else:
            alone += 1
        assert found == pytest.approx(expected, rel=1e-6)
    assert 0 < alone < depth.size / 2


def test_masked_pixels_have_no_depth() -> None:
    mask = np.ones(SIZE[::-1], bool)
    mask[:, :30] = False
    masked = replace(capture(), masks=(mask, None, None, None, None))
    first = find_depths(masked, range(4))[0]
    assert not np.isfinite(first.depth[:, :30]).any()
    assert np.isfinite(first.depth[:, 30:]).any()


def test_single_or_flat_views_have_no_depths() -> None:
    assert find_depths(capture(), [0]) == []
    flat = replace(capture(), images=tuple(np.full((*SIZE[::-1], 3), 120, np.uint8) for _ in range(5)))
    assert not any(np.isfinite(one.depth).any() for one in find_depths(flat, range(4)))


def test_neighbouring_views_see_the_same_from_aside() -> None:
    near = neighbouring_views(cameras(), capture().points)
    assert near[4] == []
    assert all(4 not in others and len(others) == 3 for others in near[:4])
    assert neighbouring_views(cameras()[:2] * 2, np.zeros((0, 3)))[0] == [1, 3]  # none from its own place
    depth, score = sweep(0, [1], cameras(), [np.zeros(SIZE[::-1], np.float32)] * 5, np.zeros((0, 3)))
    assert np.isfinite(depth).all()
    assert score.max() == 0
