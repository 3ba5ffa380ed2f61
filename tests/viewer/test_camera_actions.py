"""Where buttons and keys take the camera."""

from pathlib import Path

import pytest
from numpy.testing import assert_allclose

from langsplat_viewer import actions
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
        actions.ask(opened, word)
    settle(opened)
    actions.focus_result(opened)
    arrive(opened)
    place = opened.state.queries[1].result.place
    pixels, depth = opened.state.view.camera(160, 120).project(place[None])
    assert_allclose(pixels[0], (80, 60), atol=1e-6)
    assert 0 < depth[0] < 5


def test_focus_on_one_of_several_results(opened):
    for word in ("mug", "plant"):
        actions.ask(opened, word)
    settle(opened)
    actions.focus_result(opened, opened.state.queries[0])
    arrive(opened)
    assert_allclose(opened.state.view.target, opened.state.queries[0].result.place)


def test_focus_without_a_result_is_the_whole_scene(opened):
    actions.resize(opened, 160, 120)
    actions.focus_result(opened)
    arrive(opened)
    assert share_in_picture(opened, (160, 120)) >= 0.99


def test_training_cameras_wrap_round(opened):
    actions.step_camera(opened, -1)
    arrive(opened)
    last = opened.state.scene.cameras[-1]
    assert opened.state.camera_index == 2
    assert_allclose(opened.state.view.camera(160, 120).world_to_camera, last.world_to_camera, atol=1e-9)
    actions.step_camera(opened, 1)
    assert opened.state.camera_index == 0


def test_a_scene_without_cameras_says_so(viewer):
    actions.open_scene(viewer, Path("bare.ply"))
    settle(viewer)
    actions.step_camera(viewer, 1)
    assert "no training cameras" in errors(viewer)[0]


def test_double_click_turns_around_the_surface(opened):
    actions.focus_pixel(opened, 0.75, 0.5)
    arrive(opened)
    assert_allclose(opened.state.view.target, (0.25, 0.0, 0.0))
    actions.focus_pixel(opened, 0.95, 0.5)
    assert "nothing under the cursor" in opened.state.messages[-1].text


def test_the_hand_stops_a_glide(opened):
    actions.reset_view(opened)
    actions.tick(opened, opened.clock + 0.3 * GLIDE_SECONDS)
    here = opened.state.view
    actions.move(opened, lambda view: view)
    assert opened.state.glide is None
    actions.tick(opened, opened.clock + 9)
    assert opened.state.view is here


def test_camera_actions_before_a_scene_is_open_do_nothing(viewer):
    for act in (actions.reset_view, actions.focus_result):
        act(viewer)
    actions.go_to_camera(viewer, 0)
    actions.focus_pixel(viewer, 0.5, 0.5)
    actions.move(viewer, lambda view: pytest.fail("there is no view to move"))
    assert viewer.state.view is None
