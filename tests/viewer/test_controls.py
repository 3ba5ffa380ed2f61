"""Camera control: every move can be undone, and goes where the hand goes."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.scene import Camera, Gaussians, Intrinsics, Scene
from langsplat_viewer.camera.controls import (
    FOV_RANGE,
    MAX_ELEVATION,
    OrbitCamera,
    adopt_up,
    between,
    default_view,
    extent_of,
    fly,
    focus,
    from_camera,
    level,
    look,
    orbit,
    pan,
    roll,
    symmetric_intrinsics,
    with_fov,
    zoom,
)
from tests.support.fakes import blob_scene
from tests.support.scenes import random_camera, random_gaussians

SIZE = (320, 200)


@pytest.fixture
def view() -> OrbitCamera:
    """A view from the front, 20 degrees above the horizon."""
    scene = blob_scene(with_cameras=False)
    return default_view(scene, extent_of(scene), SIZE)


def assert_same(a: OrbitCamera, b: OrbitCamera, atol: float = 1e-9) -> None:
    assert_allclose(a.rotation, b.rotation, atol=atol)
    assert_allclose(a.target, b.target, atol=atol)
    assert_allclose(a.eye, b.eye, atol=atol)


def pixel(view: OrbitCamera, point: np.ndarray) -> np.ndarray:
    pixels, depth = view.camera(*SIZE).project(point[None])
    assert depth[0] > 0
    return pixels[0]


@pytest.mark.parametrize(
    ("there", "back"),
    [
        (lambda v: orbit(v, 0.7, -0.3), lambda v: orbit(v, -0.7, 0.3)),
        (lambda v: look(v, 0.4, 0.2), lambda v: look(v, -0.4, -0.2)),
        (lambda v: pan(v, 31, -12, SIZE), lambda v: pan(v, -31, 12, SIZE)),
        (lambda v: zoom(v, 0.8, 1e-3), lambda v: zoom(v, 1 / 0.8, 1e-3)),
        (lambda v: fly(v, 0.3, -0.2, 0.9), lambda v: fly(v, -0.3, 0.2, -0.9)),
        (lambda v: roll(v, 0.6), lambda v: roll(v, -0.6)),
        (lambda v: orbit(roll(v, 0.6), 1.0, 0.2), lambda v: roll(orbit(v, -1.0, -0.2), -0.6)),
    ],
)
def test_there_and_back(view, there, back):
    moved = there(view)
    assert np.abs(moved.camera(*SIZE).world_to_camera - view.camera(*SIZE).world_to_camera).max() > 0.01
    assert_same(back(moved), view)


def test_a_thousand_small_drags_keep_a_rotation(view):
    for step in range(1000):
        view = orbit(view, 0.01, 0.002 * (-1) ** step)
    assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.rotation) == pytest.approx(1)


def test_orbit_keeps_the_target_in_the_centre(view):
    assert_allclose(pixel(orbit(view, 1.1, 0.2), view.target), (SIZE[0] / 2, SIZE[1] / 2), atol=1e-6)


def test_near_things_follow_the_drag(view):
    near = view.target - 0.2 * view.distance * view.rotation[2]
    x, y = pixel(view, near)
    assert pixel(orbit(view, 0.1, 0), near)[0] > x + 1
    assert pixel(orbit(view, 0, 0.1), near)[1] > y + 1


def test_orbit_stops_before_the_pole(view):
    from_above = orbit(view, 0, 10.0)
    assert from_above.elevation == pytest.approx(-MAX_ELEVATION)
    from_below = orbit(view, 0, -10.0)
    assert from_below.elevation == pytest.approx(MAX_ELEVATION)
    assert from_above.rotation[1] @ view.up < 0  # the picture never turns over: down stays down


def test_look_keeps_the_eye_and_turns_right(view):
    turned = look(view, 0.2, 0)
    assert_allclose(turned.eye, view.eye, atol=1e-12)
    assert pixel(turned, view.target)[0] < SIZE[0] / 2 - 1  # what was ahead is now to the left
    assert pixel(look(view, 0, 0.1), view.target)[1] < SIZE[1] / 2 - 1


def test_pan_moves_the_target_with_the_cursor(view):
    assert_allclose(pixel(pan(view, 30, -12, SIZE), view.target), (160 + 30, 100 - 12), atol=1e-6)


def test_zoom_never_sticks(view):
    start = view
    for _ in range(60):
        view = zoom(view, 0.8, 0.1)
    assert view.distance == pytest.approx(0.1)
    gone = (view.eye - start.eye) @ view.rotation[2]
    assert gone > start.distance + 0.5  # on and through where the target was


def test_roll_turns_the_picture_clockwise(view):
    right = view.target + 0.1 * view.rotation[0]
    assert pixel(roll(view, 0.3), right)[1] > SIZE[1] / 2 + 1


def test_level_undoes_a_roll(view):
    assert_same(level(roll(view, 1.0)), view)


def test_adopted_up_is_what_was_up_in_the_picture(view):
    rolled = adopt_up(roll(view, math.pi / 2))
    assert_allclose(rolled.up, -rolled.rotation[1])
    assert_same(orbit(orbit(rolled, 0.5, 0.1), -0.5, -0.1), rolled)


def test_focus_keeps_the_direction_of_view(view):
    point = np.array([0.3, -0.4, 0.2])
    focused = focus(view, point, 1.5)
    assert_allclose(pixel(focused, point), (160, 100), atol=1e-6)
    assert_allclose(focused.rotation, view.rotation)
    assert np.linalg.norm(focused.eye - point) == pytest.approx(1.5)


def test_between_starts_and_ends_at_its_ends(view):
    end = focus(orbit(view, 2.0, 0.3), np.array([1.0, 0, 0]), 0.7)
    assert_same(between(view, end, 0.0), view)
    assert between(view, end, 1.0) is end
    half = between(view, end, 0.5)
    assert view.distance > half.distance > end.distance
    assert_allclose(half.rotation @ half.rotation.T, np.eye(3), atol=1e-12)


def test_from_camera_is_the_photograph_to_the_pixel():
    camera = random_camera(3)  # principal point off centre, fx differs from fy
    scene = Scene(random_gaussians(50))
    same = from_camera(camera, extent_of(scene)).camera(camera.width, camera.height)
    assert_allclose(same.world_to_camera, camera.world_to_camera, atol=1e-12)
    assert (same.fx, same.fy, same.cx, same.cy) == pytest.approx((camera.fx, camera.fy, camera.cx, camera.cy))


@pytest.mark.parametrize("size", [(400, 100), (100, 400), (37, 23)])
def test_a_window_of_any_shape_holds_the_whole_photograph(size):
    camera = random_camera(5)
    inner = camera.intrinsics.fitted(*size)
    fx, fy, cx, cy = inner.fx, inner.fy, inner.cx, inner.cy
    corners = np.array([[0, 0], [camera.width, camera.height]])
    x, y = ((corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy) * (fx, fy) + (cx, cy)).T
    assert -1e-9 <= x[0] < x[1] <= size[0] + 1e-9
    assert -1e-9 <= y[0] < y[1] <= size[1] + 1e-9
    assert fx / fy == pytest.approx(camera.fx / camera.fy)
    assert (x[0], y[0]) == pytest.approx((size[0] - x[1], size[1] - y[1]))  # centred


def test_fov_is_kept_and_bounded(view):
    assert with_fov(view, 65.0).intrinsics.fov_degrees == pytest.approx(65.0)
    assert with_fov(view, 500.0).intrinsics.fov_degrees == pytest.approx(FOV_RANGE[1])
    assert symmetric_intrinsics(40.0).fov_degrees == pytest.approx(40.0)
    assert Intrinsics(640, 480, 240, 240, 320, 240).fov_degrees == pytest.approx(90.0)


def test_default_view_shows_the_scene_upright():
    scene = blob_scene(with_cameras=False)
    view = default_view(scene, extent_of(scene), SIZE)
    pixels, depth = view.camera(*SIZE).project(scene.gaussians.means.astype(np.float64))
    assert (depth > 0).all()
    assert ((pixels > 0) & (pixels < SIZE)).all(1).mean() > 0.98
    above = pixel(view, view.target + 0.1 * scene.up())
    assert above[1] < SIZE[1] / 2
    assert view.elevation < 0  # looks down a little


def test_default_view_is_the_first_training_camera():
    scene = blob_scene()
    view = default_view(scene, extent_of(scene), SIZE)
    assert_allclose(view.camera(160, 120).world_to_camera, scene.cameras[0].world_to_camera, atol=1e-12)


def test_a_camera_that_looks_away_still_has_a_target_ahead():
    scene = blob_scene()
    away = scene.cameras[0].world_to_camera.copy()
    away[[0, 2]] *= -1  # turned by 180 degrees about its vertical axis
    camera = Camera(160, 120, 100, 100, 80, 60, away)
    view = from_camera(camera, extent_of(scene))
    assert view.distance > 0
    assert_allclose(view.eye, camera.position, atol=1e-9)


def test_an_empty_scene_has_a_view():
    empty = Scene(
        Gaussians(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0), np.zeros((0, 1, 3)))
    )
    assert np.isfinite(default_view(empty, extent_of(empty), SIZE).camera(64, 48).world_to_camera).all()
