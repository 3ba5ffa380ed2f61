"""The orthographic view through the actions: what keeps it, what leaves it, what it changes elsewhere."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.scene import LEVELS
from langsplat_viewer.actions import filming, settings, viewpoint
from langsplat_viewer.actions.opening import standing_at
from langsplat_viewer.camera.controls import from_side, zoom
from langsplat_viewer.files.projects import Shelf
from langsplat_viewer.panels.overlays import pointed_figures
from langsplat_viewer.state import GLIDE_SECONDS
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import CENTRES
from tests.support.windowless import arrive, ask, open_scene, settle

SIZE = (160, 120)


@pytest.fixture
def flat(opened: Viewer) -> Viewer:
    """Without perspective."""
    settings.resize(opened, *SIZE)
    viewpoint.toggle_orthographic(opened)
    return opened


def pixels(viewer: Viewer, points: np.ndarray) -> np.ndarray:
    return viewer.state.view.camera(*SIZE).project(points)[0]


@pytest.mark.parametrize(
    "go",
    [
        viewpoint.reset_view,
        viewpoint.frame_scene,
        viewpoint.focus_result,
        lambda viewer: viewpoint.look_from(viewer, "top"),
        lambda viewer: settings.turn_to_face(viewer, "left"),
        lambda viewer: viewpoint.focus_pixel(viewer, 0.5, 0.5),
        lambda viewer: viewpoint.zoom_by(viewer, 0.5),
    ],
)
def test_moving_keeps_it(flat, go):
    ask(flat, "plant")
    before = flat.state.view
    go(flat)
    arrive(flat)
    assert flat.state.view is not before
    assert flat.state.view.orthographic


def test_the_opening_view_of_a_scene_without_cameras_holds_all_of_it(viewer):
    open_scene(viewer, "bare.ply")
    settings.resize(viewer, *SIZE)
    viewpoint.toggle_orthographic(viewer)
    viewpoint.move(viewer, lambda view: zoom(view, 0.1, 0.0))
    viewpoint.reset_view(viewer)
    arrive(viewer)
    sample = viewer.state.extent.sample
    places = pixels(viewer, sample.points)
    inside = (places >= 0).all(1) & (places <= SIZE).all(1)
    assert viewer.state.view.orthographic
    assert sample.weights[inside].sum() > 0.98 * sample.weights.sum()


def test_a_training_camera_is_seen_with_perspective(flat):
    viewpoint.go_to_camera(flat, 1)
    arrive(flat)
    assert flat.state.view.orthographic is False
    assert standing_at(flat.state) is not None
    viewpoint.toggle_orthographic(flat)
    assert standing_at(flat.state) is None  # its photograph would not fit


def test_a_double_click_keeps_the_scale(flat):
    span = flat.state.view.span
    viewpoint.focus_pixel(flat, 0.4, 0.6)
    arrive(flat)
    assert_allclose(flat.state.view.target, [-0.1, 0.1, 0.0])
    assert flat.state.view.span == pytest.approx(span)


def test_a_glide_under_way_goes_on(opened):
    viewpoint.look_from(opened, "top")
    viewpoint.tick(opened, opened.clock + 0.5 * GLIDE_SECONDS)
    viewpoint.toggle_orthographic(opened)
    arrive(opened)
    wanted = from_side(opened.state.view, "top")
    assert_allclose(opened.state.view.rotation, wanted.rotation, atol=1e-9)
    assert opened.state.view.orthographic


def test_keyframes_and_bookmarks_bring_their_own(flat, tmp_path):
    flat.shelf = Shelf(tmp_path)
    viewpoint.zoom_by(flat, 0.4)
    marked = flat.state.view
    filming.add_keyframe(flat)
    viewpoint.add_bookmark(flat, "flat")
    viewpoint.toggle_orthographic(flat)
    viewpoint.zoom_by(flat, 2.0)
    filming.add_keyframe(flat)
    viewpoint.add_bookmark(flat, "deep")
    kept = flat.shelf.read(flat.state.path)
    for name, orthographic, go in (
        ("flat", True, lambda: viewpoint.go_to_bookmark(flat, kept[0])),
        ("deep", False, lambda: viewpoint.go_to_bookmark(flat, kept[1])),
        ("first key", True, lambda: filming.choose_keyframe(flat, flat.state.record.keyframes[0])),
        ("second key", False, lambda: filming.choose_keyframe(flat, flat.state.record.keyframes[1])),
        ("played", True, lambda: viewpoint.scrub(flat, 1.0)),
    ):
        go()
        arrive(flat)
        assert flat.state.view.orthographic == orthographic, name
        if orthographic and name != "played":
            assert_allclose(flat.state.view.target, marked.target, atol=1e-9)
            assert flat.state.view.span == pytest.approx(marked.span)


def test_what_is_under_the_cursor_is_said_to_be_as_far_as_from_the_eye(flat):
    x, y = pixels(flat, CENTRES[1:2])[0]
    pixel = (int(x), int(y))
    viewpoint.toggle_pointing(flat)
    viewpoint.hover(flat, pixel)
    flat.clock += 1.0
    viewpoint.hover(flat, pixel)
    settle(flat)  # the first time kernels are compiled
    found = flat.state.hover.found
    assert len(found.words) == len(LEVELS)
    away = float(pointed_figures(flat.state.hover)[-1].split(", ")[1].removesuffix(" away"))
    eye = flat.state.view.eye
    assert away == pytest.approx(float((found.position - eye) @ flat.state.view.rotation[2]), abs=0.006)
    assert np.linalg.norm(found.position - CENTRES[1]) < 0.6
