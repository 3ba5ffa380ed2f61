"""What lies over the scene, and the ruler."""

import numpy as np
import pytest

from langsplat_core.errors import InputError
from langsplat_core.scene import Scene
from langsplat_viewer.actions import opening, settings
from langsplat_viewer.canvas import Canvas
from langsplat_viewer.commands import OVERLAY_TITLES, matching
from langsplat_viewer.files.preferences import FILE_NAME, load_preferences, save_preferences
from langsplat_viewer.output import saving
from langsplat_viewer.rendering.depth import OVERLAYS, Ruler, Splats, drawn_scene
from langsplat_viewer.rendering.renderer import GlRenderer
from tests.support.scenes import random_gaussians
from tests.support.windowless import rest, settle


def test_overlays_are_shown_and_remembered(opened, tmp_path):
    for name in reversed(OVERLAYS):
        settings.toggle_overlay(opened, name)
    assert opened.state.preferences.overlays == OVERLAYS
    save_preferences(tmp_path, opened.state.preferences)
    assert load_preferences(tmp_path).overlays == OVERLAYS
    settings.show_overlay(opened, "cube", False)
    settings.show_overlay(opened, "cube", False)
    assert opened.state.preferences.overlays == tuple(name for name in OVERLAYS if name != "cube")


def test_every_overlay_has_a_command(opened):
    for name, title in OVERLAY_TITLES.items():
        (command,) = matching(title)
        command.act(opened)
        assert name in opened.state.preferences.overlays


def test_the_colour_map_is_remembered(opened, tmp_path):
    settings.set_colour_map(opened, "cividis")
    assert opened.state.shown_picture().colour_map == "cividis"
    save_preferences(tmp_path, opened.state.preferences)
    assert load_preferences(tmp_path).colour_map == "cividis"
    (tmp_path / FILE_NAME).write_text('{"colour_map": "rainbow"}')
    with pytest.raises(InputError, match=r"rainbow.*viridis"):
        load_preferences(tmp_path)


def test_pictures_are_saved_without_background_if_so_chosen(opened, tmp_path):
    asked = []
    capture = opened.surface.capture
    opened.surface.capture = lambda state: asked.append(state.picture.transparent) or capture(state)
    saving.save_picture(opened, tmp_path)
    settings.save_transparent(opened, True)
    saving.save_picture(opened, tmp_path)
    assert asked == [False, True]
    assert not opened.state.picture.transparent  # on screen there is a background


def test_splats_are_drawn_smaller_and_of_one_colour():
    scene = Scene(random_gaussians(40, sh_degree=3))
    assert drawn_scene(scene, Splats()) is scene
    drawn = drawn_scene(scene, Splats(0.25, 1)).gaussians
    np.testing.assert_allclose(np.exp(drawn.log_scales), 0.25 * np.exp(scene.gaussians.log_scales), rtol=1e-5)
    np.testing.assert_array_equal(drawn.sh, scene.gaussians.sh[:, :4])
    assert drawn_scene(Scene(drawn), Splats(sh_degree=2)).gaussians is drawn  # it has no more


def test_splats_stay_within_their_range(opened):
    settings.set_splats(opened, Splats(7.0, 9))
    assert opened.state.settings.splats == Splats()
    settings.set_splats(opened, Splats(0.0, -1))
    assert opened.state.settings.splats == Splats(0.1, 0)


def test_the_canvas_takes_other_splats_once(gl, opened):
    renderer = GlRenderer(gl, "cpu")
    given = []
    original = renderer.set_scene
    renderer.set_scene = lambda scene: (given.append(scene), original(scene))
    canvas, state = Canvas(gl, renderer), opened.state
    state.size = (240, 180)
    rest(canvas, state, 1.0)
    whole = canvas.capture(state)
    settings.set_splats(opened, Splats(0.1))
    for now in (2.0, 3.0, 4.0):
        rest(canvas, state, now)
    assert len(given) == 2
    assert 0 < (canvas.capture(state) > 20).sum() < 0.7 * (whole > 20).sum()
    settings.set_splats(opened, Splats())
    np.testing.assert_array_equal(canvas.capture(state), whole)
    assert given[-1] is state.scene
    renderer.release()


def test_two_clicks_measure_and_a_third_begins_anew(opened):
    settings.toggle_measuring(opened)
    assert opened.state.ruler.length is None
    settings.measure_at(opened, 0.5, 0.5)
    settings.measure_at(opened, 0.8, 0.1)  # the fake surface: (u - 0.5, v - 0.5, 0)
    assert opened.state.ruler.length == pytest.approx(0.5)
    settings.measure_at(opened, 0.6, 0.6)
    assert opened.state.ruler.length is None
    assert len(opened.state.ruler.points) == 1


def test_a_click_beside_everything_is_said(opened):
    settings.measure(opened, True)
    settings.measure_at(opened, 0.95, 0.5)
    assert opened.state.ruler.points == ()
    assert "nothing under the cursor" in opened.state.messages[-1].text


def test_measuring_ends_with_esc_and_with_another_scene(opened):
    from pathlib import Path

    for end in (settings.escape, lambda viewer: opening.open_scene(viewer, Path("plain.ply"))):
        settings.measure(opened, True)
        settings.measure_at(opened, 0.5, 0.5)
        end(opened)
        settle(opened)
        assert opened.state.ruler == Ruler()
