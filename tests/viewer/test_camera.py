"""The camera as plain maths, with perspective and without."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from langsplat_core.arrays import Array, affine
from langsplat_core.scene import Camera, Intrinsics, Scene
from langsplat_viewer.actions import editing, settings, viewpoint
from langsplat_viewer.camera import controls
from langsplat_viewer.camera.controls import OrbitCamera, from_side, spanning
from langsplat_viewer.camera.flight import Flight, Keyframe, camera_of, pose_at, pose_of
from langsplat_viewer.rendering.request import Clip, depth_range, image_formation, why_nothing
from langsplat_viewer.state import GLIDE_SECONDS, QueryAnswer
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene
from tests.support.scenes import random_camera, random_gaussians
from tests.support.windowless import ask, go, open_scene, result

SIZE = (320, 200)


@pytest.fixture
def view() -> controls.OrbitCamera:
    """A view from the front, 20 degrees above the horizon."""
    scene = blob_scene(with_cameras=False)
    return controls.default_view(scene, controls.extent_of(scene), SIZE)


def assert_same(a: controls.OrbitCamera, b: controls.OrbitCamera, atol: float = 1e-9) -> None:
    assert_allclose(a.rotation, b.rotation, atol=atol)
    assert_allclose(a.target, b.target, atol=atol)
    assert_allclose(a.eye, b.eye, atol=atol)


def pixel(view: controls.OrbitCamera, point: np.ndarray) -> np.ndarray:
    pixels, depth = view.camera(*SIZE).project(point[None])
    assert depth[0] > 0
    return pixels[0]


@pytest.mark.parametrize(
    ("there", "back"),
    [
        (lambda v: controls.orbit(v, 0.7, -0.3), lambda v: controls.orbit(v, -0.7, 0.3)),
        (lambda v: controls.look(v, 0.4, 0.2), lambda v: controls.look(v, -0.4, -0.2)),
        (lambda v: controls.pan(v, 31, -12, SIZE), lambda v: controls.pan(v, -31, 12, SIZE)),
        (lambda v: controls.zoom(v, 0.8, 1e-3), lambda v: controls.zoom(v, 1 / 0.8, 1e-3)),
        (lambda v: controls.fly(v, 0.3, -0.2, 0.9), lambda v: controls.fly(v, -0.3, 0.2, -0.9)),
        (lambda v: controls.roll(v, 0.6), lambda v: controls.roll(v, -0.6)),
        (lambda v: controls.roll(v, 1.0), controls.level),
        (
            lambda v: controls.orbit(controls.roll(v, 0.6), 1.0, 0.2),
            lambda v: controls.roll(controls.orbit(v, -1.0, -0.2), -0.6),
        ),
    ],
)
def test_there_and_back(view, there, back):
    moved = there(view)
    assert np.abs(moved.camera(*SIZE).world_to_camera - view.camera(*SIZE).world_to_camera).max() > 0.01
    assert_same(back(moved), view)


def test_small_drags_and_glides_keep_a_rotation(view):
    rolled = controls.adopt_up(controls.roll(view, math.pi / 2))  # what is up in the picture
    assert_allclose(rolled.up, -rolled.rotation[1])
    assert_same(controls.orbit(controls.orbit(rolled, 0.5, 0.1), -0.5, -0.1), rolled)
    for step in range(1000):
        rolled = controls.orbit(rolled, 0.01, 0.002 * (-1) ** step)
    assert_allclose(rolled.rotation @ rolled.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rolled.rotation) == pytest.approx(1)
    end = controls.focus(controls.orbit(view, 2.0, 0.3), np.array([1.0, 0, 0]), 0.7)
    assert_same(controls.between(view, end, 0.0), view)
    assert controls.between(view, end, 1.0) is end
    half = controls.between(view, end, 0.5)
    assert view.distance > half.distance > end.distance
    assert_allclose(half.rotation @ half.rotation.T, np.eye(3), atol=1e-12)


def test_things_go_where_the_hand_goes_and_zoom_never_sticks(view):
    middle = np.array(SIZE) / 2
    assert_allclose(pixel(controls.orbit(view, 1.1, 0.2), view.target), middle, atol=1e-6)
    assert_allclose(pixel(controls.pan(view, 30, -12, SIZE), view.target), middle + (30, -12), atol=1e-6)
    near = view.target - 0.2 * view.distance * view.rotation[2]
    x, y = pixel(view, near)
    assert pixel(controls.orbit(view, 0.1, 0), near)[0] > x + 1
    assert pixel(controls.orbit(view, 0, 0.1), near)[1] > y + 1
    right = view.target + 0.1 * view.rotation[0]
    assert pixel(controls.roll(view, 0.3), right)[1] > middle[1] + 1  # clockwise
    start = view
    for _ in range(60):
        view = controls.zoom(view, 0.8, 0.1)
    assert view.distance == pytest.approx(0.1)
    gone = (view.eye - start.eye) @ view.rotation[2]
    assert gone > start.distance + 0.5  # on and through where the target was


def test_turning_stops_before_the_pole_and_looking_keeps_the_eye(view):
    for pitch in (10.0, -10.0):
        turned = controls.orbit(view, 0, pitch)
        assert turned.elevation == pytest.approx(-np.sign(pitch) * controls.MAX_ELEVATION)
        assert turned.rotation[1] @ view.up < 0  # the picture never turns over: down stays down
    turned = controls.look(view, 0.2, 0)
    assert_allclose(turned.eye, view.eye, atol=1e-12)
    assert pixel(turned, view.target)[0] < SIZE[0] / 2 - 1  # what was ahead is now to the left
    assert pixel(controls.look(view, 0, 0.1), view.target)[1] < SIZE[1] / 2 - 1


def test_from_camera_is_the_photograph_to_the_pixel():
    camera = random_camera(3)  # principal point off centre, fx differs from fy
    extent = controls.extent_of(Scene(random_gaussians(50)))
    same = controls.from_camera(camera, extent).camera(camera.width, camera.height)
    assert_allclose(same.world_to_camera, camera.world_to_camera, atol=1e-12)
    assert (same.fx, same.fy, same.cx, same.cy) == pytest.approx((camera.fx, camera.fy, camera.cx, camera.cy))
    scene = blob_scene()
    away = scene.cameras[0].world_to_camera.copy()
    away[[0, 2]] *= -1  # turned by 180 degrees about its vertical axis
    camera = Camera(160, 120, 100, 100, 80, 60, away)
    view = controls.from_camera(camera, controls.extent_of(scene))
    assert view.distance > 0
    assert_allclose(view.eye, camera.position, atol=1e-9)
    empty = scene.take(np.zeros(360, bool))
    view = controls.default_view(empty, controls.extent_of(empty), SIZE)
    assert np.isfinite(view.camera(64, 48).world_to_camera).all()


@pytest.mark.parametrize("size", [(400, 100), (100, 400), (37, 23)])
def test_a_window_of_any_shape_holds_the_whole_photograph(size):
    camera = random_camera(5)
    inner = camera.intrinsics.fitted(*size)
    corners = (np.array([[0, 0], [camera.width, camera.height]]) - (camera.cx, camera.cy)) / (
        camera.fx,
        camera.fy,
    )
    low, high = corners * (inner.fx, inner.fy) + (inner.cx, inner.cy)
    assert (low >= -1e-9).all()
    assert (low < high).all()
    assert (high <= np.array(size) + 1e-9).all()
    assert inner.fx / inner.fy == pytest.approx(camera.fx / camera.fy)
    assert_allclose(low, size - high, atol=1e-6)  # centred


def test_default_view_shows_the_scene_upright(view):
    scene = blob_scene(with_cameras=False)
    pixels, depth = view.camera(*SIZE).project(scene.gaussians.means.astype(np.float64))
    assert (depth > 0).all()
    assert ((pixels > 0) & (pixels < SIZE)).all(1).mean() > 0.98
    assert pixel(view, view.target + 0.1 * scene.up())[1] < SIZE[1] / 2
    assert view.elevation < 0  # looks down a little


# Where buttons and keys take the camera.


def share(sample: controls.Sample, camera: Camera) -> float:
    """Of the weight, what the camera sees."""
    pixels, depth = camera.project(sample.points)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels <= (camera.width, camera.height)).all(1)
    return float(sample.weights[inside].sum() / sample.weights.sum())


def share_seen(viewer: Viewer, size: tuple[int, int]) -> float:
    """Of the scene, in a window of that size."""
    return share(viewer.state.open.extent.sample, viewer.state.open.view.camera(*size))


@pytest.mark.parametrize("frame", [viewpoint.frame_scene, viewpoint.focus_result])  # without a result
@pytest.mark.parametrize("size", [(160, 120), (400, 100), (90, 300)])
def test_everything_is_framed_in_a_window_of_any_shape(opened, size, frame):
    settings.resize(opened, *size)
    forward = opened.state.open.view.rotation[2]
    viewpoint.move(opened, lambda view: controls.focus(view, np.array([4.0, 1.0, 2.0]), 0.3))
    go(frame, opened)
    assert_allclose(opened.state.open.view.rotation[2], forward, atol=1e-9)
    assert share_seen(opened, size) >= 0.99
    viewpoint.move(opened, lambda view: controls.focus(view, view.target, 0.8 * view.distance))
    assert share_seen(opened, size) < 0.99


def test_training_cameras_wrap_round(opened):
    go(viewpoint.step_camera, opened, -1)
    last = opened.state.open.scene.cameras[-1]
    assert opened.state.camera_index == 2
    assert_allclose(opened.state.open.view.camera(160, 120).world_to_camera, last.world_to_camera, atol=1e-9)
    viewpoint.step_camera(opened, 1)
    assert opened.state.camera_index == 0


def test_double_click_turns_around_the_surface(opened):
    go(viewpoint.focus_pixel, opened, 0.75, 0.5)
    assert_allclose(opened.state.open.view.target, (0.25, 0.0, 0.0))


def test_the_hand_stops_a_glide(opened):
    viewpoint.reset_view(opened)
    viewpoint.tick(opened, opened.clock + 0.3 * GLIDE_SECONDS)
    here = opened.state.open.view
    viewpoint.move(opened, lambda view: view)
    assert opened.state.glide is None
    viewpoint.tick(opened, opened.clock + 9)
    assert opened.state.open.view is here


@pytest.mark.parametrize(
    ("size", "orthographic"), [((160, 120), False), ((90, 300), False), ((160, 120), True)]
)
def test_scene_without_cameras_opens_with_all_in_view(viewer, size, orthographic):
    settings.resize(viewer, *size)
    open_scene(viewer, "bare.ply")
    assert share_seen(viewer, size) >= 0.99
    settings.resize(viewer, *size[::-1])  # R knows the window's new shape
    if orthographic:
        viewpoint.toggle_orthographic(viewer)
    viewpoint.zoom_by(viewer, 0.1)
    go(viewpoint.reset_view, viewer)
    assert viewer.state.open.view.orthographic == orthographic
    assert share_seen(viewer, size[::-1]) >= (0.98 if orthographic else 0.99)


def test_reset_returns_to_the_opening_view(opened):
    cameras = opened.state.open.scene.cameras
    for index, camera in ((0, cameras[0]), (2, cameras[2])):
        if index:
            viewpoint.open_at(opened, camera.resized(40, 30))  # as --camera asks for it
            assert opened.state.camera_index == index
        viewpoint.go_to_camera(opened, 1)
        viewpoint.zoom_by(opened, 0.3)
        go(viewpoint.reset_view, opened)
        seen = opened.state.open.view.camera(160, 120)
        assert_allclose(seen.world_to_camera, camera.world_to_camera, atol=1e-9)


def test_zooming_out_ends_while_the_scene_is_still_seen(opened):
    for _ in range(200):
        viewpoint.zoom_by(opened, 1 / 0.88)
    view, extent = opened.state.open.view, opened.state.open.extent
    assert view.distance == pytest.approx(extent.farthest)
    pixels, _ = view.camera(1000, 1000).project(extent.sample.points)
    assert np.ptp(pixels, axis=0).max() > 30
    viewpoint.zoom_by(opened, 0.88)
    assert opened.state.open.view.distance < extent.farthest


def test_focus_distance_follows_the_size_of_the_thing(opened):
    ask(opened, "mug", "sofa")  # which is not here
    found, distances = result(opened, 0), []
    place, box = found.place, found.box
    for size in (1.0, 0.1, 0.01):
        smaller = replace(found, box=place + size * (box - place))
        opened.state.answers["mug"] = QueryAnswer(smaller)
        go(viewpoint.focus_result, opened)
        distances.append(opened.state.open.view.distance)
    assert_allclose(distances, distances[0] * np.array([1, 0.1, 0.01]), rtol=1e-6)
    assert_allclose(opened.state.open.view.target, place)
    pixels, _ = opened.state.open.view.camera(100, 100).project(smaller.box)
    assert 10 < np.ptp(pixels, axis=0).max() < 100
    huge = replace(found, box=1e3 * np.array([[-1.0] * 3, [1.0] * 3]))
    opened.state.answers["mug"] = QueryAnswer(huge)
    before = np.linalg.norm(opened.state.open.view.eye - place)
    go(viewpoint.focus_result, opened)
    room = max(before, opened.state.open.extent.radius * 5)
    assert opened.state.open.view.distance <= room  # stays in it


# Standing where everything is seen, and not farther.

ROTATION = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
ROTATION *= np.sign(np.linalg.det(ROTATION))


@pytest.fixture
def sample() -> controls.Sample:
    """A cloud with a dense end, a long tail and very different weights, far from the origin."""
    rng = np.random.default_rng(7)
    points = rng.exponential(1.0, (3000, 3)) * (3.0, 1.0, 0.4) + (50.0, -20.0, 8.0)
    return controls.Sample(points, rng.lognormal(0, 1.5, 3000))


WIDE = Intrinsics(640, 360, 500, 500, 320, 180)
TALL = Intrinsics(300, 700, 400, 400, 150, 350)
ODD = Intrinsics(500, 400, 450, 300, 180, 260)  # a principal point off the centre, pixels not square


@pytest.mark.parametrize("inner", [WIDE, TALL, ODD])
def test_the_share_is_held_and_a_step_nearer_loses_it(sample, inner):
    def held(eye: Array) -> float:
        matrix = affine(ROTATION, -ROTATION @ eye)
        size = int(inner.width), int(inner.height)
        return share(sample, Camera(*size, inner.fx, inner.fy, inner.cx, inner.cy, matrix))

    eye = controls.framing_eye(sample, ROTATION, inner)
    assert held(eye) >= controls.SHARE
    depth = controls.depth_share(sample, eye, ROTATION[2], 0.5)
    assert held(eye + 0.25 * depth * ROTATION[2]) < controls.SHARE
    assert held(controls.framing_eye(sample, ROTATION, inner, share=1.0)) == 1.0


def test_a_few_faint_floaters_do_not_count(sample):
    far = np.concatenate([sample.points, [[1e6, 0, 0], [0, -1e6, 0]]])
    with_floaters = controls.Sample(far, np.append(sample.weights, [1e-3, 1e-3]))
    eyes = [controls.framing_eye(one, ROTATION, WIDE) for one in (with_floaters, sample)]
    assert_allclose(*eyes, atol=0.5)


def test_weights_are_opacity_times_size_and_faults_have_none():
    gaussians = random_gaussians(50)
    gaussians.means[3] = np.nan
    gaussians.opacity_logits[5] = -np.inf
    gaussians.log_scales[7] += np.log(2)
    plain = controls.sample_of(random_gaussians(50))
    sample = controls.sample_of(gaussians)
    assert len(sample.points) == 48
    assert_allclose(sample.weights[5], 2 * plain.weights[7], rtol=1e-5)  # two rows fewer before it
    nothing = controls.Sample(np.zeros((0, 3)), np.zeros(0))
    assert controls.framing_eye(nothing, ROTATION, WIDE) is None
    assert controls.depth_share(nothing, np.zeros(3), ROTATION[2], 0.5) == 0


# Views with names, and the six sides.


def names(viewer) -> list[str]:
    return [bookmark.name for bookmark in viewer.state.session.bookmarks]


def test_a_bookmark_leads_back_and_is_undone(opened):
    viewpoint.move(opened, lambda view: controls.orbit(view, 0.4, 0.1))
    marked = opened.state.open.view
    viewpoint.add_bookmark(opened, "  the  mug ")
    assert opened.state.is_changed
    viewpoint.add_bookmark(opened)
    assert names(opened) == ["the mug", "view 2"]
    settings.take_off(opened, "bookmarks", opened.state.session.bookmarks[0])
    assert names(opened) == ["view 2"]
    editing.undo(opened)
    go(
        viewpoint.glide_to,
        opened,
        viewpoint.bookmarked_view(opened.state.session.bookmarks[0], opened.state.open.extent),
    )
    assert_same(opened.state.open.view, marked)
    open_scene(opened, "plain.ply")
    assert names(opened) == []


SIDES = ("front", "back", "left", "right", "top", "bottom")


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0), (0.6, -0.8, 0)])
def test_the_six_sides(up):
    inner = controls.symmetric_intrinsics()
    view = controls.OrbitCamera(np.eye(3), np.array([1.0, 2, 3]), 4.0, np.array(up, float), inner)
    seen = {side: controls.from_side(view, side) for side in SIDES}
    for side in seen.values():
        assert_allclose(side.rotation @ side.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(side.rotation) == pytest.approx(1)
        assert_allclose(side.target, view.target)
        assert side.distance == 4.0
    up = np.array(up, float)
    ahead = {name: side.rotation[2] for name, side in seen.items()}
    for side, wanted in (("back", -ahead["front"]), ("left", -ahead["right"]), ("top", -up), ("bottom", up)):
        assert_allclose(ahead[side], wanted, atol=1e-12)
    # From the right one stands where the front view has its right; the horizon is level everywhere.
    assert_allclose(seen["right"].eye - view.target, 4 * seen["front"].rotation[0], atol=1e-12)
    for name in SIDES[:4]:
        assert_allclose(seen[name].rotation[1], -up, atol=1e-12)
    # From above, what is away from the front is up in the picture; from below it is down.
    assert_allclose(-seen["top"].rotation[1], ahead["front"], atol=1e-12)
    assert_allclose(seen["bottom"].rotation[1], ahead["front"], atol=1e-12)


FULL = (1280, 720)
BLOBS = blob_scene()
EXTENT = controls.extent_of(BLOBS)
VIEW = controls.default_view(BLOBS, EXTENT, FULL)
FLAT = replace(VIEW, orthographic=True)
MEANS = BLOBS.gaussians.means.astype(np.float64)


def exact(view: OrbitCamera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 2) pixels in an orthographic picture of the target's scale, and depths from the eye."""
    x, y, z = view.rotation @ (points - view.eye).T
    inner = view.intrinsics.fitted(*FULL)
    pixels = [inner.fx / view.distance * x + inner.cx, inner.fy / view.distance * y + inner.cy]
    return np.stack(pixels, 1), z


def test_a_span_is_what_the_shorter_side_shows():
    view = spanning(VIEW, 2.5)
    assert view.span == pytest.approx(2.5)
    assert_allclose(view.eye, VIEW.eye, atol=1e-12)
    ends = [view.target - 1.25 * view.rotation[1], view.target + 1.25 * view.rotation[1]]
    (_, low), (_, high) = view.camera(*FULL).project(np.stack(ends))[0]
    assert abs(low - high) == pytest.approx(FULL[1])
    assert view.span_in(*FULL) == pytest.approx(2.5)
    assert view.span_in(120, 720) == pytest.approx(2.5 * 160 / 120)  # the photograph's whole width is seen
    camera = view.camera(320, 240).resized(640, 480)  # gives its view back at any size
    assert camera.orthographic
    again = controls.from_camera(camera, EXTENT)
    assert_allclose(again.target, view.target, atol=1e-9)
    assert again.span == pytest.approx(2.5)
    assert_allclose(again.camera(640, 480).world_to_camera, camera.world_to_camera, atol=1e-9)


def test_orthographic_view_leaves_out_what_is_behind_the_eye():
    inside = replace(FLAT, target=FLAT.target - 0.2 * FLAT.rotation[2], distance=0.2)  # among the blobs
    camera = inside.camera(*FULL)
    _, z = exact(inside, MEANS)
    _, depths = camera.project(MEANS)
    for clip in (Clip(), Clip(0.1, 0.3)):
        settings = image_formation(BLOBS, camera, clip)
        shown = (depths > settings.near) & (depths <= (np.inf if settings.far is None else settings.far))
        assert_array_equal(shown, (z > clip.near) & (z <= clip.far))
        assert 0 < shown.sum() < len(shown)
        low, high = depth_range(BLOBS.gaussians, camera, clip)
        assert clip.near <= low < high <= min(clip.far, 3.0)
    beyond = replace(inside, target=inside.target + 50 * inside.rotation[2])
    assert "behind the camera" in why_nothing(BLOBS.gaussians, beyond.camera(*FULL))


@pytest.mark.parametrize("side", SIDES)
def test_framing_holds_the_scene_and_nothing_of_it_is_behind_the_eye(side):
    view = controls.frame_all(from_side(FLAT, side), EXTENT, FULL)
    pixels, z = exact(view, EXTENT.sample.points)
    inside = (pixels >= 0).all(1) & (pixels <= FULL).all(1) & (z > 0)
    assert EXTENT.sample.weights[inside].sum() > 0.979 * EXTENT.sample.weights.sum()
    filled = (np.ptp(pixels, axis=0) / FULL).max()
    assert 0.8 < filled < 1.2 or side in ("left", "right")  # along the row they look small


def test_zooming_in_ends_where_nothing_gets_larger():
    assert controls.zoom(FLAT, 0.5, 0.1).span == pytest.approx(0.5 * FLAT.span)
    nearest = controls.zoom(replace(FLAT, distance=0.1), 0.5, 0.1)
    assert nearest.distance == 0.1
    assert_allclose(nearest.target, FLAT.target)


def flight_of(*views: OrbitCamera) -> Flight:
    return Flight(tuple(Keyframe(float(at), pose_of(view)) for at, view in enumerate(views)))


def test_keyframes_keep_projection_and_scale():
    flat = [spanning(from_side(VIEW, side), span) for side, span in (("front", 1.0), ("top", 4.0))]
    flight = flight_of(*flat, VIEW)
    for at, view in enumerate((*flat, VIEW)):
        found, wanted = camera_of(pose_at(flight, at), EXTENT, FULL), view.camera(*FULL)
        assert_allclose(found.world_to_camera, wanted.world_to_camera, atol=1e-7)
        assert (found.orthographic, found.fx) == (view.orthographic, pytest.approx(wanted.fx))
    assert pose_at(flight_of(*flat), 0.5).span == pytest.approx(2.0)
    assert pose_at(flight, 1.5).span == pytest.approx(4.0)  # till the next keyframe
    there_and_back = flight_of(flat[0], VIEW, flat[1])
    assert pose_at(there_and_back, 0.5).span == pytest.approx(1.0)  # whatever comes later
    assert pose_at(flight_of(VIEW, VIEW, flat[0]), 0.5).span is None


# Through the actions.


@pytest.fixture
def flat(opened: Viewer) -> Viewer:
    """Without perspective."""
    settings.resize(opened, 160, 120)
    viewpoint.toggle_orthographic(opened)
    return opened


@pytest.mark.parametrize(
    "move",
    [
        viewpoint.reset_view,
        viewpoint.frame_scene,
        viewpoint.focus_result,
        lambda viewer: viewpoint.look_from(viewer, "top"),
        lambda viewer: viewpoint.look_from(viewer, "left"),
        lambda viewer: viewpoint.focus_pixel(viewer, 0.5, 0.5),
        lambda viewer: viewpoint.zoom_by(viewer, 0.5),
    ],
)
def test_moving_keeps_it(flat, move):
    ask(flat, "plant")
    before = flat.state.open.view
    go(move, flat)
    assert flat.state.open.view is not before
    assert flat.state.open.view.orthographic
