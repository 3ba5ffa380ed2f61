"""Looking without perspective: pixels, depths, framing, what is left out; and which actions keep it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from langsplat_core.config import PictureConfig
from langsplat_core.scene import LEVELS
from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.camera import controls
from langsplat_viewer.camera.controls import OrbitCamera, from_side, spanning, with_projection
from langsplat_viewer.camera.flight import Flight, Keyframe, camera_of, pose_at, pose_of
from langsplat_viewer.files.projects import Shelf
from langsplat_viewer.panels.overlays import pointed_figures
from langsplat_viewer.rendering.renderer import renderer_for
from langsplat_viewer.rendering.request import Clip, depth_range, image_formation, plain_request, why_nothing
from langsplat_viewer.state import GLIDE_SECONDS
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import CENTRES, blob_scene
from tests.support.windowless import ask, go, settle

SIZE = (1280, 720)
BLOBS = blob_scene()
EXTENT = controls.extent_of(BLOBS)
VIEW = controls.default_view(BLOBS, EXTENT, SIZE)
FLAT = with_projection(VIEW, orthographic=True)
MEANS = BLOBS.gaussians.means.astype(np.float64)


def exact(view: OrbitCamera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) pixels in an orthographic picture of the target's scale, and depths from the eye."""
    x, y, z = view.rotation @ (points - view.eye).T
    inner = view.intrinsics.fitted(*SIZE)
    pixels = [inner.fx / view.distance * x + inner.cx, inner.fy / view.distance * y + inner.cy]
    return np.stack(pixels, 1), z


def test_the_camera_is_orthographic():
    wanted, depths = exact(FLAT, MEANS)
    found, z = FLAT.camera(*SIZE).project(MEANS)
    assert_allclose(found, wanted, atol=1e-9)
    assert_allclose(z, depths, atol=1e-12)


@pytest.mark.parametrize("backend", ["opengl", "cpu"])
def test_clicked_point_lies_on_the_surface(gl, backend):
    """By the depth of one pixel, and by that of all of them."""
    camera = FLAT.camera(320, 240)
    renderer, request = renderer_for(gl, backend), plain_request(BLOBS, camera, PictureConfig())
    for centre in CENTRES:
        x, y = np.floor(camera.project(centre[None])[0][0]) + 0.5
        for depth in (renderer.depth_at(request, x, y), renderer.depth_map(request)[int(y), int(x)]):
            found = camera.unproject((x, y), float(depth)) - centre
            assert -0.5 < found @ FLAT.rotation[2] < 0.1  # the front of the blob
            assert np.linalg.norm(found[:2]) < 0.3
    assert renderer.depth_at(request, 2.5, 2.5) is None
    renderer.release()


def test_the_plane_through_the_target_keeps_its_scale():
    across = VIEW.target + 0.3 * VIEW.rotation[0] - 0.7 * VIEW.rotation[1]
    points = np.stack([VIEW.target, across])
    assert_allclose(FLAT.camera(*SIZE).project(points)[0], VIEW.camera(*SIZE).project(points)[0], atol=1e-9)
    assert with_projection(FLAT, orthographic=False).camera(*SIZE).intrinsics == VIEW.camera(*SIZE).intrinsics
    assert FLAT.span == pytest.approx(2 * np.tan(np.radians(VIEW.intrinsics.fov_degrees / 2)) * VIEW.distance)


def test_a_span_is_what_the_shorter_side_shows():
    view = spanning(VIEW, 2.5)
    assert view.span == pytest.approx(2.5)
    assert_allclose(view.eye, VIEW.eye, atol=1e-12)
    ends = [view.target - 1.25 * view.rotation[1], view.target + 1.25 * view.rotation[1]]
    (_, low), (_, high) = view.camera(*SIZE).project(np.stack(ends))[0]
    assert abs(low - high) == pytest.approx(SIZE[1])
    assert view.span_in(*SIZE) == pytest.approx(2.5)
    assert view.span_in(120, 720) == pytest.approx(2.5 * 160 / 120)  # the photograph's whole width is seen
    camera = view.camera(320, 240).resized(640, 480)  # gives its view back at any size
    assert camera.orthographic
    again = controls.from_camera(camera, EXTENT)
    assert_allclose(again.target, view.target, atol=1e-9)
    assert again.span == pytest.approx(2.5)
    assert_allclose(again.camera(640, 480).world_to_camera, camera.world_to_camera, atol=1e-9)


def test_orthographic_view_leaves_out_what_is_behind_the_eye():
    inside = replace(FLAT, target=FLAT.target - 0.2 * FLAT.rotation[2], distance=0.2)  # among the blobs
    camera = inside.camera(*SIZE)
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
    assert "behind the camera" in why_nothing(BLOBS.gaussians, beyond.camera(*SIZE))


@pytest.mark.parametrize("side", ["front", "back", "left", "right", "top", "bottom"])
def test_framing_holds_the_scene_and_nothing_of_it_is_behind_the_eye(side):
    view = controls.frame_all(from_side(FLAT, side), EXTENT, SIZE)
    pixels, z = exact(view, EXTENT.sample.points)
    inside = (pixels >= 0).all(1) & (pixels <= SIZE).all(1) & (z > 0)
    assert EXTENT.sample.weights[inside].sum() > 0.979 * EXTENT.sample.weights.sum()
    filled = (np.ptp(pixels, axis=0) / SIZE).max()
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
        found, wanted = camera_of(pose_at(flight, at), EXTENT, SIZE), view.camera(*SIZE)
        assert_allclose(found.world_to_camera, wanted.world_to_camera, atol=1e-7)
        assert (found.orthographic, found.fx) == (view.orthographic, pytest.approx(wanted.fx))
    assert pose_at(flight_of(*flat), 0.5).span == pytest.approx(2.0)
    assert pose_at(flight, 1.5).span == pytest.approx(4.0)  # till the next keyframe
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
    before = flat.state.view
    go(move, flat)
    assert flat.state.view is not before
    assert flat.state.view.orthographic


def test_a_training_camera_is_seen_with_perspective(flat):
    go(viewpoint.go_to_camera, flat, 1)
    assert flat.state.view.orthographic is False


def test_a_double_click_keeps_the_scale(flat):
    span = flat.state.view.span
    go(viewpoint.focus_pixel, flat, 0.4, 0.6)
    assert_allclose(flat.state.view.target, [-0.1, 0.1, 0.0])
    assert flat.state.view.span == pytest.approx(span)


def test_a_glide_under_way_goes_on_and_has_the_projection_of_its_end(opened):
    assert controls.between(VIEW, FLAT, 0.3).orthographic
    assert not controls.between(FLAT, VIEW, 0.3).orthographic
    viewpoint.look_from(opened, "top")
    viewpoint.tick(opened, opened.clock + 0.5 * GLIDE_SECONDS)
    go(viewpoint.toggle_orthographic, opened)
    wanted = from_side(opened.state.view, "top")
    assert_allclose(opened.state.view.rotation, wanted.rotation, atol=1e-9)
    assert opened.state.view.orthographic


def test_keyframes_and_bookmarks_bring_their_own(flat, tmp_path):
    flat.shelf = Shelf(tmp_path)
    viewpoint.zoom_by(flat, 0.4)
    first = flat.state.view
    for name in ("flat", "deep"):
        viewpoint.add_keyframe(flat)
        viewpoint.add_bookmark(flat, name)
        viewpoint.toggle_orthographic(flat)
        viewpoint.zoom_by(flat, 2.0)
    for back, kept in (
        (viewpoint.go_to_bookmark, flat.shelf.read(flat.state.path)),
        (viewpoint.choose_keyframe, flat.state.session.keyframes),
    ):
        go(back, flat, kept[0])
        assert flat.state.view.orthographic
        assert_allclose(flat.state.view.target, first.target, atol=1e-9)
        assert flat.state.view.span == pytest.approx(first.span)
        go(back, flat, kept[1])
        assert not flat.state.view.orthographic
    go(viewpoint.scrub, flat, 1.0)  # between the two
    assert flat.state.view.orthographic


def test_distance_under_the_cursor_counts_from_the_eye(flat):
    x, y = flat.state.view.camera(160, 120).project(CENTRES[1:2])[0][0]
    viewpoint.toggle_pointing(flat)
    for _ in range(2):
        viewpoint.hover(flat, (int(x), int(y)))
        flat.clock += 1.0
    settle(flat)  # the first time kernels are compiled
    found = flat.state.hover.found
    assert len(found.words) == len(LEVELS)
    away = float(pointed_figures(flat.state.hover)[-1].split(", ")[1].removesuffix(" away"))
    depth = float((found.position - flat.state.view.eye) @ flat.state.view.rotation[2])
    assert away == pytest.approx(depth, abs=0.006)
    assert np.linalg.norm(found.position - CENTRES[1]) < 0.6
