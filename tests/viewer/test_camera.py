"""Camera control: every move can be undone, and goes where the hand goes."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera, Gaussians, Intrinsics, Scene
from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.camera.controls import (
    MAX_ELEVATION,
    SHARE,
    OrbitCamera,
    Sample,
    adopt_up,
    between,
    default_view,
    extent_of,
    fly,
    focus,
    framing_eye,
    from_camera,
    from_side,
    level,
    look,
    median_depth,
    orbit,
    pan,
    reach,
    roll,
    sample_of,
    symmetric_intrinsics,
    walk,
    zoom,
)
from langsplat_viewer.files.projects import BOOKMARKS, MOST_VIEWS, Shelf
from langsplat_viewer.state import GLIDE_SECONDS
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene
from tests.support.scenes import random_camera, random_gaussians
from tests.support.windowless import arrive, ask, errors, open_scene

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


def test_default_view_shows_the_scene_upright():
    scene = blob_scene(with_cameras=False)
    view = default_view(scene, extent_of(scene), SIZE)
    pixels, depth = view.camera(*SIZE).project(scene.gaussians.means.astype(np.float64))
    assert (depth > 0).all()
    assert ((pixels > 0) & (pixels < SIZE)).all(1).mean() > 0.98
    above = pixel(view, view.target + 0.1 * scene.up())
    assert above[1] < SIZE[1] / 2
    assert view.elevation < 0  # looks down a little


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


# Where buttons and keys take the camera.


def share_in_picture(viewer: Viewer, size: tuple[int, int]) -> float:
    """Of the weight of the scene, as seen now in a window of that size."""
    sample = viewer.state.extent.sample
    pixels, depth = viewer.state.view.camera(*size).project(sample.points)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels <= size).all(1)
    return float(sample.weights[inside].sum() / sample.weights.sum())


def test_focus_brings_the_latest_result_found_to_the_centre(opened):
    ask(opened, "mug", "plant", "sofa")
    viewpoint.focus_result(opened)
    arrive(opened)
    place = opened.state.queries[1].result.place
    pixels, depth = opened.state.view.camera(160, 120).project(place[None])
    assert_allclose(pixels[0], (80, 60), atol=1e-6)
    assert 0 < depth[0] < 5


def test_focus_without_a_result_is_the_whole_scene(opened):
    settings.resize(opened, 160, 120)
    viewpoint.focus_result(opened)
    arrive(opened)
    assert share_in_picture(opened, (160, 120)) >= 0.99


def test_training_cameras_wrap_round(opened):
    viewpoint.step_camera(opened, -1)
    arrive(opened)
    last = opened.state.scene.cameras[-1]
    assert opened.state.camera_index == 2
    assert_allclose(opened.state.view.camera(160, 120).world_to_camera, last.world_to_camera, atol=1e-9)
    viewpoint.step_camera(opened, 1)
    assert opened.state.camera_index == 0


def test_double_click_turns_around_the_surface(opened):
    viewpoint.focus_pixel(opened, 0.75, 0.5)
    arrive(opened)
    assert_allclose(opened.state.view.target, (0.25, 0.0, 0.0))
    viewpoint.focus_pixel(opened, 0.95, 0.5)
    assert "nothing under the cursor" in opened.state.messages[-1].text


def test_the_hand_stops_a_glide(opened):
    viewpoint.reset_view(opened)
    viewpoint.tick(opened, opened.clock + 0.3 * GLIDE_SECONDS)
    here = opened.state.view
    viewpoint.move(opened, lambda view: view)
    assert opened.state.glide is None
    viewpoint.tick(opened, opened.clock + 9)
    assert opened.state.view is here


@pytest.mark.parametrize("size", [(160, 120), (400, 100), (90, 300)])
def test_everything_is_framed_in_a_window_of_any_shape(opened, size):
    settings.resize(opened, *size)
    forward = opened.state.view.rotation[2]
    viewpoint.move(opened, lambda view: focus(view, np.array([4.0, 1.0, 2.0]), 0.3))
    viewpoint.frame_scene(opened)
    arrive(opened)
    assert_allclose(opened.state.view.rotation[2], forward, atol=1e-9)
    assert share_in_picture(opened, size) >= 0.99
    viewpoint.move(opened, lambda view: focus(view, view.target, 0.8 * view.distance))
    assert share_in_picture(opened, size) < 0.99


@pytest.mark.parametrize("size", [(160, 120), (90, 300)])
def test_a_scene_without_cameras_opens_and_returns_to_a_view_of_everything(viewer, size):
    settings.resize(viewer, *size)
    open_scene(viewer, "bare.ply")
    assert share_in_picture(viewer, size) >= 0.99
    settings.resize(viewer, size[1], size[0])  # R knows the window's new shape
    viewpoint.zoom_by(viewer, 0.1)
    viewpoint.reset_view(viewer)
    arrive(viewer)
    assert share_in_picture(viewer, (size[1], size[0])) >= 0.99


def test_reset_returns_to_the_opening_view(opened):
    for camera in (opened.state.scene.cameras[0], opened.state.scene.cameras[2]):
        if camera is not opened.state.scene.cameras[0]:
            viewpoint.open_at(opened, camera.resized(40, 30))  # as --camera asks for it
            assert opened.state.camera_index == 2
        viewpoint.go_to_camera(opened, 1)
        viewpoint.zoom_by(opened, 0.3)
        viewpoint.reset_view(opened)
        arrive(opened)
        assert_allclose(opened.state.view.camera(160, 120).world_to_camera, camera.world_to_camera, atol=1e-9)


def test_zooming_out_ends_while_the_scene_is_still_seen(opened):
    for _ in range(200):
        viewpoint.zoom_by(opened, 1 / 0.88)
    view, extent = opened.state.view, opened.state.extent
    assert view.distance == pytest.approx(extent.farthest)
    pixels, _ = view.camera(1000, 1000).project(extent.sample.points)
    assert np.ptp(pixels, axis=0).max() > 30
    viewpoint.zoom_by(opened, 0.88)
    assert opened.state.view.distance < extent.farthest


def test_focus_goes_as_near_as_the_thing_is_small(opened):
    ask(opened, "mug")
    query, distances = opened.state.queries[0], []
    place, box = query.result.place, query.result.box
    for size in (1.0, 0.1, 0.01):
        query.result = replace(query.result, box=place + size * (box - place))
        viewpoint.focus_result(opened)
        arrive(opened)
        distances.append(opened.state.view.distance)
    assert_allclose(distances, distances[0] * np.array([1, 0.1, 0.01]), rtol=1e-6)
    pixels, _ = opened.state.view.camera(100, 100).project(query.result.box)
    assert 10 < np.ptp(pixels, axis=0).max() < 100


def test_focus_on_something_huge_stays_in_the_room(opened):
    ask(opened, "mug")
    query = opened.state.queries[0]
    query.result = replace(query.result, box=1e3 * np.array([[-1.0] * 3, [1.0] * 3]))
    before = np.linalg.norm(opened.state.view.eye - query.result.place)
    viewpoint.focus_result(opened)
    arrive(opened)
    assert opened.state.view.distance <= max(before, opened.state.extent.radius * 5)


# Standing where everything is seen, and not farther.

ROTATION = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
ROTATION *= np.sign(np.linalg.det(ROTATION))


def share_inside(sample: Sample, inner: Intrinsics, eye: Array) -> float:
    """Of the weight, by projecting every point."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = ROTATION, -ROTATION @ eye
    size = int(inner.width), int(inner.height)
    camera = Camera(*size, inner.fx, inner.fy, inner.cx, inner.cy, matrix)
    pixels, depth = camera.project(sample.points)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels <= size).all(1)
    return float(sample.weights[inside].sum() / sample.weights.sum())


@pytest.fixture
def sample() -> Sample:
    """A cloud with a dense end, a long tail and very different weights, far from the origin."""
    rng = np.random.default_rng(7)
    points = rng.exponential(1.0, (3000, 3)) * (3.0, 1.0, 0.4) + (50.0, -20.0, 8.0)
    return Sample(points, rng.lognormal(0, 1.5, 3000))


@pytest.mark.parametrize(
    "inner",
    [
        Intrinsics(640, 360, 500, 500, 320, 180),
        Intrinsics(300, 700, 400, 400, 150, 350),
        Intrinsics(500, 400, 450, 300, 180, 260),  # a principal point off the centre, pixels not square
    ],
)
def test_the_share_is_held_and_a_step_nearer_loses_it(sample, inner):
    eye = framing_eye(sample, ROTATION, inner)
    assert share_inside(sample, inner, eye) >= SHARE
    depth = median_depth(sample, eye, ROTATION[2])
    assert share_inside(sample, inner, eye + 0.25 * depth * ROTATION[2]) < SHARE


def test_a_share_of_one_holds_every_point(sample):
    inner = Intrinsics(640, 360, 500, 500, 320, 180)
    assert share_inside(sample, inner, framing_eye(sample, ROTATION, inner, share=1.0)) == 1.0


def test_a_few_faint_floaters_do_not_count(sample):
    inner = Intrinsics(640, 360, 500, 500, 320, 180)
    far = np.concatenate([sample.points, [[1e6, 0, 0], [0, -1e6, 0]]])
    with_floaters = Sample(far, np.append(sample.weights, [1e-3, 1e-3]))
    assert_allclose(
        framing_eye(with_floaters, ROTATION, inner), framing_eye(sample, ROTATION, inner), atol=0.5
    )


def test_weights_are_opacity_times_size_and_faults_have_none():
    gaussians = random_gaussians(50)
    gaussians.means[3] = np.nan
    gaussians.opacity_logits[5] = -np.inf
    gaussians.log_scales[7] += np.log(2)
    plain = sample_of(random_gaussians(50))
    sample = sample_of(gaussians)
    assert len(sample.points) == 48
    assert_allclose(sample.weights[5], 2 * plain.weights[7], rtol=1e-5)  # two rows fewer before it


def test_nothing_has_no_view():
    nothing = Sample(np.zeros((0, 3)), np.zeros(0))
    assert framing_eye(nothing, ROTATION, Intrinsics(4, 3, 4, 4, 2, 1.5)) is None
    assert reach(nothing, np.zeros(3)) == 0


# Views with names, the six sides, walking.


def names(viewer) -> list[str]:
    return [bookmark.name for bookmark in viewer.state.bookmarks]


def test_a_bookmark_leads_back_and_is_there_the_next_time(opened, tmp_path):
    opened.shelf = Shelf(tmp_path / "settings")
    viewpoint.move(opened, lambda view: orbit(view, 0.4, 0.1))
    marked = opened.state.view
    viewpoint.add_bookmark(opened, "  the  mug ")
    open_scene(opened, "plain.ply")
    assert names(opened) == []
    viewpoint.add_bookmark(opened)
    open_scene(opened, "blobs.ply")
    assert names(opened) == ["the mug"]
    viewpoint.go_to_bookmark(opened, opened.state.bookmarks[0])
    arrive(opened)
    assert_allclose(opened.state.view.eye, marked.eye, atol=1e-9)
    assert_allclose(opened.state.view.rotation, marked.rotation, atol=1e-9)
    assert_allclose(opened.state.view.target, marked.target, atol=1e-9)
    viewpoint.delete_bookmark(opened, opened.state.bookmarks[0])
    open_scene(opened, "blobs.ply")
    assert names(opened) == []
    open_scene(opened, "plain.ply")
    assert names(opened) == ["view 1"]


def test_names_are_numbers_or_replaced_and_end_somewhere(opened):
    viewpoint.add_bookmark(opened)
    viewpoint.add_bookmark(opened, "view 2")
    viewpoint.add_bookmark(opened)
    viewpoint.add_bookmark(opened, "view 2")
    assert names(opened) == ["view 1", "view 3", "view 2"]
    for _ in range(MOST_VIEWS):
        viewpoint.add_bookmark(opened)
    assert len(names(opened)) == MOST_VIEWS
    assert "at most" in errors(opened)[-1]


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"version": 2, "scenes": {}}',
        '{"version": 1, "scenes": 3}',
        "SCENE 3",
        'SCENE [{"name": 1}]',
    ],
)
def test_a_file_that_makes_no_sense_is_said_and_kept(opened, tmp_path, text):
    if text.startswith("SCENE "):
        entries = json.loads(text.removeprefix("SCENE "))
        text = json.dumps({"version": 1, "scenes": {str(Path("blobs.ply").absolute()): entries}})
    (tmp_path / BOOKMARKS).write_text(text)
    opened.shelf = Shelf(tmp_path)
    open_scene(opened, "blobs.ply")
    assert names(opened) == []
    assert BOOKMARKS in errors(opened)[0]
    if '"scenes": {"' not in text:
        viewpoint.add_bookmark(opened, "here")
        assert "not kept" in errors(opened)[-1]
        assert (tmp_path / BOOKMARKS).read_text() == text


def view_with_up(up) -> OrbitCamera:
    return OrbitCamera(np.eye(3), np.array([1.0, 2, 3]), 4.0, np.array(up, float), symmetric_intrinsics())


UPS = [(0, -1, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0), (0.6, -0.8, 0)]


@pytest.mark.parametrize("up", UPS)
def test_the_six_sides(up):
    view = view_with_up(up)
    seen = {side: from_side(view, side) for side in ("front", "back", "left", "right", "top", "bottom")}
    for side in seen.values():
        assert_allclose(side.rotation @ side.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(side.rotation) == pytest.approx(1)
        assert_allclose(side.target, view.target)
        assert side.distance == 4.0
    up = np.array(up, float)
    ahead = {name: side.rotation[2] for name, side in seen.items()}
    assert_allclose(ahead["back"], -ahead["front"], atol=1e-12)
    assert_allclose(ahead["left"], -ahead["right"], atol=1e-12)
    assert_allclose(ahead["top"], -up, atol=1e-12)
    assert_allclose(ahead["bottom"], up, atol=1e-12)
    # From the right one stands where the front view has its right; the horizon is level everywhere.
    assert_allclose(seen["right"].eye - view.target, 4 * seen["front"].rotation[0], atol=1e-12)
    for name in ("front", "back", "left", "right"):
        assert_allclose(seen[name].rotation[1], -up, atol=1e-12)
    # From above, what is away from the front is up in the picture; from below it is down.
    assert_allclose(-seen["top"].rotation[1], ahead["front"], atol=1e-12)
    assert_allclose(seen["bottom"].rotation[1], ahead["front"], atol=1e-12)


@pytest.mark.parametrize("pitch", [0.0, 0.7, -1.2])
def test_walking_keeps_the_height_of_the_eye(pitch):
    view = look(view_with_up((0, -1, 0)), 0.5, pitch)
    ahead = walk(view, 0, 0, 2.0)
    step = ahead.eye - view.eye
    assert step @ view.up == pytest.approx(0, abs=1e-12)
    assert np.linalg.norm(step) == pytest.approx(2)
    assert step @ view.rotation[2] > 0
    assert_allclose(walk(view, 1, 0, 0).eye - view.eye, view.rotation[0], atol=1e-9)
    assert_allclose(walk(view, 0, 3, 0).eye - view.eye, 3 * view.up, atol=1e-12)


@pytest.mark.parametrize("side", ["top", "bottom"])
def test_walking_while_looking_down_goes_where_the_pictures_top_points(side):
    view = from_side(view_with_up((0, -1, 0)), side)
    step = walk(view, 0, 0, 1.0).eye - view.eye
    assert_allclose(step, from_side(view, "front").rotation[2], atol=1e-9)
