"""What photographs say: losses, exposures, what moves, and depths, against references and plain loops."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from langsplat_core.arrays import Array
from langsplat_core.datasets.capture import Capture
from langsplat_core.scene import Camera, look_at
from langsplat_core.training.radiance.losses import (
    GRID,
    MOST,
    SAME_SURFACE,
    connected_patches,
    count_agreeing,
    fit_exposure,
    no_transients,
    patch_means,
    radiance_loss,
    ssim_map,
    with_exposure,
)
from langsplat_core.training.radiance.stereo import (
    RADIUS,
    find_depths,
    in_free_space,
    inverse_depths,
    neighbouring_views,
    plane_scores,
    sweep,
)


def pictures(seed: int, shape: tuple[int, int, int] = (31, 40, 3)) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    target = rng.random(shape)
    return torch.tensor(np.clip(target + 0.2 * rng.standard_normal(shape), 0, 1)), torch.tensor(target)


def test_ssim_agrees_with_scikit_image_away_from_the_border() -> None:
    a, b = pictures(0)
    _, want = structural_similarity(
        a.numpy(),
        b.numpy(),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    inside = np.s_[5:-5, 5:-5]  # the border differs: zeros here, reflection there
    np.testing.assert_allclose(ssim_map(a, b).numpy()[inside], want[inside], atol=1e-10)


def test_gradient_of_the_loss_is_its_derivative() -> None:
    a, b = pictures(3, (9, 8, 2))
    assert torch.autograd.gradcheck(lambda x: radiance_loss(x, b, 0.2), a.clone().requires_grad_(), atol=1e-8)


@pytest.mark.parametrize("shape", [(31, 40, 3), (1, 1, 3), (3, 2, 1), (64, 7, 3), (5, 90, 2)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_compiled_loss_equals_the_formula(shape: tuple[int, int, int], weight: float) -> None:
    a, b = pictures(5, shape)
    a[0, 0] = b[0, 0]  # equal pixels have no L1 gradient
    results = []
    for dtype in (torch.float32, torch.float64):
        # float64 copies of the float32 pictures, so that both see the same signs of a - b
        picture = a.float().to(dtype).requires_grad_()
        loss = radiance_loss(picture, b.float().to(dtype), weight)
        loss.backward()
        results.append((float(loss.detach()), picture.grad.double().numpy()))
    (ours, gradient), (want, want_gradient) = results
    assert ours == pytest.approx(want, abs=1e-6)
    # 1e-7: of equal pictures the gradient is a difference of equal numbers, not exactly 0 in float32
    np.testing.assert_allclose(gradient, want_gradient, atol=2e-6 * np.abs(want_gradient).max() + 1e-7)


def test_exposure_is_a_ridge_regression() -> None:
    image = torch.tensor(np.random.default_rng(4).random((30, 40, 3)), dtype=torch.float32)
    change = torch.tensor([[1.2, 0.0, 0.1], [0.0, 0.8, 0.0], [0.0, 0.1, 1.0], [0.05, -0.02, 0.0]])
    target = with_exposure(image, change)
    found = fit_exposure([(image[:10], target[:10]), (image[10:], target[10:])], ridge=0.0)
    torch.testing.assert_close(found, change, rtol=1e-4, atol=1e-5)
    x = np.pad(image.reshape(-1, 3).numpy().astype(np.float64), ((0, 0), (0, 1)), constant_values=1.0)
    y, none = target.reshape(-1, 3).numpy().astype(np.float64), np.eye(4, 3)
    hold = 0.5 * (x[:, :3] ** 2).mean() * np.eye(4)
    held = none + np.linalg.solve(x.T @ x / len(x) + hold, x.T @ (y - x @ none) / len(x))
    np.testing.assert_allclose(fit_exposure([(image, target)], ridge=0.5), held, atol=1e-5)
    nothing = torch.zeros((0, 3))
    torch.testing.assert_close(fit_exposure([(nothing, nothing)]), torch.eye(4, 3))


# Transients.

SIZE = (64, 48)


def cameras() -> list[Camera]:
    """Three before the wall z = 0."""
    eyes = [np.array([x, 0.1 * x, -3.0 - 0.1 * x]) for x in (-0.5, 0.0, 0.6)]
    return [look_at(eye, np.zeros(3), np.array([0.0, 1, 0]), SIZE, 40.0) for eye in eyes]


def wall(camera: Camera) -> Array:
    patches = camera.resized(GRID, GRID)
    ray = patches.unproject(patches.pixel_centres(), np.ones((GRID, GRID))) - camera.position
    return -camera.position[2] / ray[..., 2]


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
    """A patch moves while its view alone differs there, beyond an exposure; once all differ it counts."""
    colours = np.random.default_rng(2).uniform(0.2, 0.8, (GRID, GRID, 3)).astype(np.float32)
    apart, masked = 0.8 * colours + np.float32(0.05), colours.copy()
    apart[12:18, 12:18, 0] += 0.3
    masked[20] = np.nan
    found, depths = no_transients(3), [wall(camera) for camera in cameras()]
    for index, seen in ((0, colours), (2, colours), (1, apart), (1, apart)):
        found.observe(index, cameras(), masked, seen, depths[index])
    assert np.isnan(found.differences[1][20]).all()
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


# Depths by plane sweeping, against a plain reference and surfaces that are known.

UP = np.array([0.0, 1.0, 0.0])
SIDES = (72, 54)
TILT = 0.3  # of the surface z = TILT x


def row_of_cameras() -> list[Camera]:
    """In a row before the surface, some degrees apart; the last looks away."""
    eyes = [np.array([x, 0.2, -4.0]) for x in (-0.9, -0.3, 0.3, 0.9)]
    seeing = [look_at(eye, np.zeros(3), UP, SIDES, 40.0) for eye in eyes]
    return [*seeing, look_at(np.array([0, 0, -4.0]), np.array([0, 0, -9.0]), UP, SIDES, 40.0)]


def true_depth(camera: Camera) -> Array:
    """Return (H, W) depth of the surface."""
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
    across = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    points = np.stack([across[:, 0], across[:, 1], TILT * across[:, 0]], -1)
    images = [picture(camera) for camera in row_of_cameras()]
    return Capture(tuple(row_of_cameras()), tuple(images), points, np.zeros((200, 3), np.uint8))


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
    one, two = row_of_cameras()[1:3]
    greys = [picture(camera).mean(2, dtype=np.float32) / 255 for camera in (one, two)]
    planes = inverse_depths(one, [one, two], capture().points)
    scores = plane_scores(one, greys[0], [(two, greys[1])], planes)
    judged = 0
    for row, column, plane in ((20, 30, 40), (27, 36, 60), (33, 41, 5), (15, 52, 77)):
        rows, columns = range(row - RADIUS, row + RADIUS + 1), range(column - RADIUS, column + RADIUS + 1)
        sources = greys[1].astype(float), one, two, 1 / planes[plane]
        seen = np.array([[looked_up(*sources, x, y) for x in columns] for y in rows])
        if np.isfinite(seen).all():
            judged += 1
            window = greys[0][rows.start : rows.stop, columns.start : columns.stop].astype(float)
            assert scores[plane, row, column] == pytest.approx(correlation(window, seen), abs=2e-4)
    assert judged >= 3
    twice = plane_scores(one, greys[0], [(two, greys[1]), (row_of_cameras()[4], greys[1])], planes)
    np.testing.assert_array_equal(twice, (scores - 1) / 2)  # a view that sees nothing of it


def test_depths_lie_on_the_true_surface() -> None:
    maps = find_depths(capture(), range(5))
    assert len(maps) == 4  # the view that looks away has none
    for one, camera in zip(maps, row_of_cameras(), strict=False):
        known = np.isfinite(one.depth)
        assert known.mean() > 0.5
        error = np.abs(one.depth / true_depth(camera) - 1)[known]
        assert np.quantile(error, 0.95) < 0.01
        points, colours = one.points()
        assert len(points) == len(colours) == known.sum()
        assert np.quantile(np.abs(points[:, 2] - TILT * points[:, 0]), 0.95) < 0.04


def test_space_before_a_surface_is_free() -> None:
    maps = find_depths(capture(), range(4))
    across = np.random.default_rng(1).uniform(-0.5, 0.5, (100, 2))
    surface = np.stack([across[:, 0], across[:, 1], TILT * across[:, 0]], -1)
    assert in_free_space(surface - (0, 0, 1.0), maps).mean() > 0.9
    assert in_free_space(surface, maps).mean() < 0.02
    assert not in_free_space(surface + (0, 0, 1.0), maps).any()  # nobody looks there
    assert not in_free_space(surface - (0, 0, 20.0), maps).any()
    assert not in_free_space(surface, []).any()


def test_masked_pixels_have_no_depth() -> None:
    mask = np.ones(SIDES[::-1], bool)
    mask[:, :30] = False
    first = find_depths(replace(capture(), masks=(mask, None, None, None, None)), range(4))[0]
    assert not np.isfinite(first.depth[:, :30]).any()
    assert np.isfinite(first.depth[:, 30:]).any()


def test_single_or_flat_views_have_no_depths() -> None:
    assert find_depths(capture(), [0]) == []
    flat = replace(capture(), images=tuple(np.full((*SIDES[::-1], 3), 120, np.uint8) for _ in range(5)))
    assert not any(np.isfinite(one.depth).any() for one in find_depths(flat, range(4)))


def test_neighbouring_views_see_the_same_from_aside() -> None:
    near = neighbouring_views(row_of_cameras(), capture().points)
    assert near[4] == []
    assert all(4 not in others and len(others) == 3 for others in near[:4])
    at_one_place = row_of_cameras()[:2] * 2
    assert neighbouring_views(at_one_place, np.zeros((0, 3)))[0] == [1, 3]
    depth, score = sweep(0, [1], row_of_cameras(), [np.zeros(SIDES[::-1], np.float32)] * 5, np.zeros((0, 3)))
    assert np.isfinite(depth).all()
    assert score.max() == 0
