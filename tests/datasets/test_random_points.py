"""Random points lie where the cameras look, whatever the cameras do."""

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.datasets.known_poses import inside, look_distance, random_points
from langsplat_core.scene import Camera, look_at

UP = np.array([0.0, -1.0, 0.0])
NONE = np.zeros((0, 3))


def ring(count: int, radius: float = 4.0) -> list[Camera]:
    """Cameras on a circle that look at its centre."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = [radius * np.array([np.cos(a), 0.1, np.sin(a)]) for a in angles]
    return [look_at(eye, np.zeros(3), UP, (32, 24)) for eye in eyes]


def pictures(count: int) -> list[Array]:
    """Uniform pictures of different greys."""
    return [np.full((24, 32, 3), 10 * index, np.uint8) for index in range(count)]


def drawn(cameras: list[Camera], known: Array = NONE, seed: int = 0) -> tuple[Array, Array]:
    generator = np.random.default_rng(seed)
    return random_points(500, known, cameras, pictures(len(cameras)), generator)


def test_points_lie_where_half_of_the_cameras_look():
    cameras = ring(8)
    points, colours = drawn(cameras)
    assert points.shape == colours.shape == (500, 3)
    assert colours.dtype == np.uint8
    seen = np.sum([inside(camera, points) for camera in cameras], axis=0)
    assert (seen >= 4).mean() > 0.9
    np.testing.assert_array_equal(points, drawn(cameras)[0])
    assert not np.array_equal(points, drawn(cameras, seed=1)[0])


def test_colours_are_those_of_the_pixels():
    _, colours = drawn(ring(3))
    assert set(np.unique(colours)) <= {0, 10, 20}


def test_depths_follow_known_points():
    cameras = ring(6)
    known = np.random.default_rng(3).uniform(-0.1, 0.1, (200, 3))
    points, _ = drawn(cameras, known)
    assert np.linalg.norm(points, axis=1).max() < 3
    assert np.linalg.norm(drawn(cameras)[0], axis=1).max() > 3  # without them depths reach to three times 4


def test_the_look_distance_is_that_of_the_centre():
    assert look_distance(ring(7)) == pytest.approx(4.02, abs=0.05)


@pytest.mark.parametrize("count", [1, 3])
def test_axes_that_do_not_meet(count: int) -> None:
    eyes = [np.array([float(i), 0, 0]) for i in range(count)]
    cameras = [look_at(eye, eye + (0, 0, 1), UP, (32, 24)) for eye in eyes]
    assert 0 < look_distance(cameras) < 1e6
    points, _ = drawn(cameras)
    assert len(points) == 500
    assert np.isfinite(points).all()
    assert (points[:, 2] > 0).all()
