"""Where buttons and keys take the camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_viewer.actions import opening, queries, settings, viewpoint
from langsplat_viewer.camera.controls import focus
from langsplat_viewer.state import GLIDE_SECONDS
from langsplat_viewer.viewer import Viewer
from tests.support.windowless import arrive, errors, settle


def share_in_picture(viewer: Viewer, size: tuple[int, int]) -> float:
    """Of the weight of the scene, as seen now in a window of that size."""
    sample = viewer.state.extent.sample
    pixels, depth = viewer.state.view.camera(*size).project(sample.points)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels <= size).all(1)
    return float(sample.weights[inside].sum() / sample.weights.sum())


def test_focus_brings_the_latest_result_found_to_the_centre(opened):
    for word in ("mug", "plant", "sofa"):
        queries.ask(opened, word)
    settle(opened)
    viewpoint.focus_result(opened)
    arrive(opened)
    place = opened.state.queries[1].result.place
    pixels, depth = opened.state.view.camera(160, 120).project(place[None])
    assert_allclose(pixels[0], (80, 60), atol=1e-6)
    assert 0 < depth[0] < 5


def test_focus_on_one_of_several_results(opened):
    for word in ("mug", "plant"):
        queries.ask(opened, word)
    settle(opened)
    viewpoint.focus_result(opened, opened.state.queries[0])
    arrive(opened)
    assert_allclose(opened.state.view.target, opened.state.queries[0].result.place)


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


def test_a_scene_without_cameras_says_so(viewer):
    opening.open_scene(viewer, Path("bare.ply"))
    settle(viewer)
    viewpoint.step_camera(viewer, 1)
    assert "no training cameras" in errors(viewer)[0]


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


def test_camera_actions_before_a_scene_is_open_do_nothing(viewer):
    for act in (viewpoint.reset_view, viewpoint.focus_result):
        act(viewer)
    viewpoint.go_to_camera(viewer, 0)
    viewpoint.focus_pixel(viewer, 0.5, 0.5)
    viewpoint.move(viewer, lambda view: pytest.fail("there is no view to move"))
    assert viewer.state.view is None


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
    opening.open_scene(viewer, Path("bare.ply"))
    settle(viewer)
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


def test_a_view_from_beyond_the_end_is_not_pulled_in(opened):
    far = 5 * opened.state.extent.farthest
    viewpoint.move(opened, lambda view: focus(view, view.target, far))
    viewpoint.zoom_by(opened, 1.2)
    assert opened.state.view.distance == far


def test_focus_goes_as_near_as_the_thing_is_small(opened):
    queries.ask(opened, "mug")
    settle(opened)
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
    queries.ask(opened, "mug")
    settle(opened)
    query = opened.state.queries[0]
    query.result = replace(query.result, box=1e3 * np.array([[-1.0] * 3, [1.0] * 3]))
    before = np.linalg.norm(opened.state.view.eye - query.result.place)
    viewpoint.focus_result(opened)
    arrive(opened)
    assert opened.state.view.distance <= max(before, opened.state.extent.radius * 5)
