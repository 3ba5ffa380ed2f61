"""Several pictures of one camera side by side."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.config import PictureConfig
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.scene import Scene
from langsplat_viewer import staging
from langsplat_viewer.actions import queries, settings
from langsplat_viewer.canvas import Canvas
from langsplat_viewer.commands import COMMANDS
from langsplat_viewer.panels.view import compared_name
from langsplat_viewer.rendering.depth import AT_RANGE, Layers, Split
from langsplat_viewer.rendering.renderer import ArraySource, GlRenderer, GlSource
from tests.support.scenes import random_camera, random_gaussians, random_values
from tests.support.windowless import errors, rest, settle

COUNT = 120
SCENE = Scene(random_gaussians(COUNT, sh_degree=1))
CAMERA = random_camera(1, distance=2.0)
LAYERS = (
    Layers(latent_rgb=random_values(COUNT, 3, 1)),
    Layers(latent_rgb=random_values(COUNT, 3, 2)),
    Layers(relevancies=random_values(COUNT, 2, 3)),
    Layers(),
)
LOOKS = ("latent", "latent", "relevancy", "depth")


def ask(viewer, phrase: str) -> None:
    queries.ask(viewer, phrase)
    settle(viewer)


def test_one_picture_is_the_state_itself(opened):
    assert staging.shown_pictures(opened.state) == (opened.state,)
    assert staging.columns(opened.state.settings.split) == 1


def test_the_second_picture_is_what_the_state_would_show(opened):
    ask(opened, "plant")
    settings.set_display(opened, "rgb")
    settings.compare_with(opened, "relevancy")
    first, second = staging.shown_pictures(opened.state)
    assert first is opened.state
    assert (opened.state.picture.display, second.picture.display) == ("rgb", "relevancy")
    settings.show_one(opened)
    settings.set_display(opened, "relevancy")
    assert second.layers_key() == opened.state.layers_key()
    np.testing.assert_array_equal(second.relevancies(), opened.state.relevancies())
    assert second.shown_picture() == opened.state.shown_picture()


def test_three_levels_of_latents(opened):
    settings.toggle_levels(opened)
    shown = staging.shown_pictures(opened.state)
    for level, one in enumerate(shown):
        np.testing.assert_array_equal(one.latent_rgb(), opened.state.latent[level])
    assert staging.labels(opened.state) == ("Latent, subpart", "Latent, part", "Latent, whole")
    opened.state.size = (200, 90)
    assert staging.picture_size(opened.state) == (66, 90)
    settings.toggle_levels(opened)
    assert staging.labels(opened.state) == ("Colours",)


def test_three_levels_of_an_answer_share_one_scale(opened):
    ask(opened, "plant")
    settings.set_display(opened, "segmentation")
    settings.toggle_levels(opened)
    shown = staging.shown_pictures(opened.state)
    result = opened.state.queries[0].result
    for level, one in enumerate(shown):
        np.testing.assert_array_equal(one.relevancies()[:, 0], result.relevancy[level])
    assert len({one.heat_ranges() for one in shown}) == 1
    again = staging.shown_pictures(opened.state)  # the same objects: nothing is drawn anew at rest
    assert [one.layers_key() for one in again] == [one.layers_key() for one in shown]
    assert opened.state.queries[0].result is result


def test_the_line_stays_within_reach(opened):
    for at, kept in ((-3.0, AT_RANGE[0]), (0.3, 0.3), (2.0, AT_RANGE[1])):
        settings.move_line(opened, at)
        assert opened.state.settings.split.at == kept


def test_without_a_field_levels_and_latents_are_refused(viewer):
    viewer.state.scene = Scene(random_gaussians(5))
    settings.toggle_levels(viewer)
    settings.compare_with(viewer, "latent", 1)
    assert viewer.state.settings.split.mode == "off"
    assert len(errors(viewer)) == 1  # the same line is not said twice
    settings.toggle_wipe(viewer)
    assert viewer.state.settings.split.mode == "wipe"


def test_commands_turn_it_on_and_off(opened):
    (wipe,) = (command for command in COMMANDS if "V" in command.keys)
    for mode in ("wipe", "off"):
        wipe.act(opened)
        assert opened.state.settings.split.mode == mode


def test_every_display_has_a_name_of_its_own_beside_another():
    from langsplat_viewer.commands import BUTTONS

    assert len({compared_name(button) for button in BUTTONS}) == len(BUTTONS)


@pytest.mark.parametrize(("u", "inside"), [(0.0, 0.0), (0.2, 0.6), (0.5, 0.5), (1.0, 1.0)])
def test_a_place_in_a_column(u, inside):
    assert staging.within_picture(Split("levels"), u) == pytest.approx(inside)
    assert staging.within_picture(Split("wipe"), u) == u


def test_pictures_are_joined_as_they_are_shown():
    dark, light = np.zeros((2, 10, 3), np.uint8), np.full((2, 10, 3), 9, np.uint8)
    wiped = staging.joined(Split("wipe", at=0.3), [dark, light])
    assert wiped[0, :, 0].tolist() == [0] * 3 + [9] * 7
    assert staging.joined(Split("levels"), [dark, light, dark]).shape == (2, 30, 3)
    assert staging.joined(Split(), [light]) is not None


@pytest.mark.parametrize("backend", ["opengl", "cpu"])
def test_pictures_of_one_camera_share_one_pass(gl, monkeypatch, backend):
    """Any two or three pictures drawn together are those drawn alone, and none drives another out."""
    passes = []
    for source in (GlSource, ArraySource):

        def noting(*arguments, method=source.render):
            passes.append(arguments)
            return method(*arguments)

        monkeypatch.setattr(source, "render", noting)
    renderer = GlRenderer(gl, backend, "single")
    renderer.set_scene(SCENE)
    looks = [(PictureConfig(display=display), layers) for display, layers in zip(LOOKS, LAYERS, strict=True)]
    alone = [renderer.read(CAMERA, picture, (), layers) for picture, layers in looks]
    for chosen in ((0, 1, 2), (0, 3), (2, 3), (1, 2)):
        renderer.prepare(random_camera(7), [looks[0]])
        passes.clear()
        renderer.prepare(CAMERA, [looks[i] for i in chosen])
        for _ in range(2):
            for i in chosen:
                together = renderer.read(CAMERA, looks[i][0], (), looks[i][1])
                assert np.abs(together.astype(int) - alone[i]).max() <= 1
        assert len(passes) == 1
    renderer.release()


def test_the_canvas_draws_both_and_then_rests(gl, opened):
    renderer = GlRenderer(gl, "cpu")
    canvas, state = Canvas(gl, renderer), opened.state
    state.size = (60, 40)
    drawn = []
    original = renderer.draw
    renderer.draw = lambda *args, **kwargs: (drawn.append(args[2].display), original(*args, **kwargs))
    for display in DISPLAYS:
        settings.compare_with(opened, display)
        rest(canvas, state, 1.0)
        assert len(canvas.textures) == 2
        assert canvas.textures[0].size == (60, 40)
    drawn.clear()
    settings.move_line(opened, 0.2)  # only the window is drawn anew
    rest(canvas, state, 2.0)
    assert drawn == []
    both = canvas.capture(state)
    settings.show_one(opened)
    np.testing.assert_array_equal(canvas.capture(state)[:, :12], both[:, :12])
    settings.toggle_levels(opened)
    rest(canvas, state, 3.0)
    assert [texture.size for texture in canvas.textures] == [(20, 40)] * 3
    assert canvas.capture(state).shape == (40, 60, 3)
    renderer.release()


def test_the_surface_is_found_in_every_column(gl, opened):
    canvas, state = Canvas(gl, GlRenderer(gl, "cpu")), opened.state
    state.size = (240, 120)
    settings.toggle_levels(opened)
    rest(canvas, state, 1.0)
    places = [canvas.point_at((column + 0.5) / 3, 0.5) for column in range(3)]
    assert all(place is not None for place in places)
    np.testing.assert_allclose(places[0], places[1])
    np.testing.assert_allclose(places[0], places[2])
    settings.show_one(opened)
    state.picture = replace(state.picture, display="rgb")
    rest(canvas, state, 2.0)
    np.testing.assert_allclose(canvas.point_at(0.5, 0.5), places[0], atol=0.1)
