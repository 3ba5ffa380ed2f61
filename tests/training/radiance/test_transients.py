"""What moves, against plain loops in float64 and by what is known to move."""

import math

import numpy as np
import pytest
import torch

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera, look_at
from langsplat_core.training.radiance.transients import (
    GRID,
    MOST,
    SAME_SURFACE,
    colour_difference,
    connected_patches,
    count_agreeing,
    no_transients,
    patch_means,
)

SIZE = (64, 48)


def cameras() -> list[Camera]:
    """Three before the wall z = 0."""
    eyes = [np.array([x, 0.1 * x, -3.0 - 0.1 * x]) for x in (-0.5, 0.0, 0.6)]
    return [look_at(eye, np.zeros(3), np.array([0.0, 1, 0]), SIZE, 40.0) for eye in eyes]


def wall(camera: Camera) -> Array:
    """(GRID, GRID) depths of the wall."""
    y, x = (np.mgrid[:GRID, :GRID] + 0.5) / GRID
    local = [(x * SIZE[0] - camera.cx) / camera.fx, (y * SIZE[1] - camera.cy) / camera.fy, np.ones_like(x)]
    return -camera.position[2] / (np.stack(local, -1) @ camera.rotation)[..., 2]


def counted_slowly(index: int, depths: Array, alike: Array) -> Array:
    """`count_agreeing` by one patch after the other."""
    counts, camera = np.zeros((2, GRID, GRID), int), cameras()[index]
    for row in range(GRID):
        for column in range(GRID):
            pixel = (column + 0.5) * SIZE[0] / GRID, (row + 0.5) * SIZE[1] / GRID
            point = camera.unproject(pixel, float(depths[index, row, column]))
            for other, at in enumerate(cameras()):
                if other == index or not np.isfinite(point).all():
                    continue
                (x, y), z = (part[0] for part in at.project(point[None]))
                r, c = math.floor(y * GRID / SIZE[1]), math.floor(x * GRID / SIZE[0])
                if (
                    z > 0
                    and 0 <= r < GRID
                    and 0 <= c < GRID
                    and abs(z / depths[other, r, c] - 1) < SAME_SURFACE
                ):
                    counts[:, row, column] += bool(alike[other, r, c]), 1
    return counts


def test_views_agree_on_the_surface_that_both_see() -> None:
    rng = np.random.default_rng(0)
    depths = np.stack([wall(camera) for camera in cameras()])
    depths *= rng.uniform(0.9, 1.1, depths.shape)
    depths[rng.random(depths.shape) < 0.1] = np.nan
    alike = rng.random(depths.shape) < 0.6
    for index in range(3):
        found = count_agreeing(index, cameras(), depths, alike)
        np.testing.assert_array_equal(found, counted_slowly(index, depths, alike))
        assert found.max() == 2


def test_colour_difference_ignores_exposure() -> None:
    rng = np.random.default_rng(1)
    drawn = rng.random((GRID, GRID, 3)).astype(np.float32)
    seen = 0.8 * drawn + np.float32(0.05)
    seen[4:10, 4:10] += 0.3
    drawn[20, :] = np.nan  # masked
    found = colour_difference(drawn, seen)
    moved = np.zeros((GRID, GRID), bool)
    moved[4:10, 4:10] = True
    assert np.abs(found[~moved & (np.arange(GRID) != 20)[:, None]]).max() < 0.02  # what the ridge holds
    np.testing.assert_allclose(found[moved], -0.3, atol=0.02)
    assert np.isnan(found[20]).all()


def test_transients_are_connected_patches() -> None:
    differs, sizes = np.zeros((GRID, GRID), bool), np.zeros((GRID, GRID))
    differs[3:5, 3:5], differs[10:13, 10], differs[20:23, 20:23] = True, True, True
    sizes[3, 3], sizes[11, 10] = 0.2, 0.2  # the second piece is too small, the third nowhere sure
    found = connected_patches(differs, sizes, 0.1)
    want = np.zeros_like(found)
    want[2:6, 2:6] = True
    np.testing.assert_array_equal(found, want)
    everything = connected_patches(np.ones_like(differs), np.random.default_rng(0).random(differs.shape), 0.1)
    assert everything.mean() == pytest.approx(MOST, abs=0.01)


def test_patches_that_other_views_contradict_are_transient() -> None:
    """A patch counts as moving while its view alone differs there; once all differ it counts again."""
    rng = np.random.default_rng(2)
    colours = rng.uniform(0.2, 0.8, (GRID, GRID, 3)).astype(np.float32)
    apart = colours.copy()
    apart[12:18, 12:18, 0] += 0.3
    found, depths = no_transients(3), [wall(camera) for camera in cameras()]
    for index, seen in ((0, colours), (2, colours), (1, apart), (1, apart)):
        found.observe(index, cameras(), colours, seen, depths[index])
    inside = np.zeros((GRID, GRID), bool)
    inside[12:18, 12:18] = True
    assert found.moving[1][inside].all()
    assert found.moving[1].sum() <= 8 * 8
    assert not found.moving[[0, 2]].any()
    assert found.explained() > 0.9
    for _ in range(3):
        for index in range(3):
            everywhere = colours.copy()
            everywhere[8:24, 6:26, 0] += 0.3
            found.observe(index, cameras(), colours, everywhere, depths[index])
    assert not found.moving[1][14:16, 14:16].any()


def test_patches_map_to_their_pixels() -> None:
    picture = torch.arange(64 * 96, dtype=torch.float32).reshape(64, 96, 1)
    want = picture.numpy().reshape(GRID, 2, GRID, 3).mean((1, 3))
    np.testing.assert_allclose(patch_means(picture)[..., 0], want, rtol=1e-6)
    moving = np.random.default_rng(3).random((GRID, GRID)) < 0.5
    transients = no_transients(1)
    transients.moving[0] = moving
    still = transients.still_pixels(0, (64, 96), torch.device("cpu")).numpy()
    np.testing.assert_array_equal(still, ~moving.repeat(2, 0).repeat(3, 1))
