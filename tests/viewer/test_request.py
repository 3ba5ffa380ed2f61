"""Render requests: what they depend on, their panes, the edited scene; and that every image is one."""

from dataclasses import MISSING, fields, replace

import numpy as np
import pytest

from langsplat_core.config import PictureConfig
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Scene
from langsplat_viewer.actions import editing, queries, saving, settings, viewpoint
from langsplat_viewer.actions.editing import mark
from langsplat_viewer.canvas import Canvas
from langsplat_viewer.commands import BUTTONS, COMMANDS
from langsplat_viewer.marks import Marks
from langsplat_viewer.projects import load_preferences, save_preferences
from langsplat_viewer.rendering.renderer import ArrayRenderer, Inputs, renderer_for
from langsplat_viewer.rendering.request import (
    AT_RANGE,
    Clip,
    RenderRequest,
    Splats,
    Split,
    edited_scene,
    plain_request,
    with_splats,
)
from langsplat_viewer.session import OVERLAYS, Ruler
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene
from tests.support.scenes import random_gaussians
from tests.support.windowless import (
    CHANGES,
    ask,
    blob,
    errors,
    go,
    on_screen,
    open_scene,
    picture,
    put_scene,
    recorded,
    rest,
    result,
)

SCENE = blob_scene()
NOTHING = np.zeros(360, bool)


# Every image is of the same request.


def edit_everything(viewer: Viewer, mode: str) -> None:
    """Every setting off its default: one blob hidden in part, one selected, one deleted in part."""
    odd = np.arange(360) % 2 == 1
    settings.resize(viewer, 160, 120)
    go(viewpoint.look_from, viewer, "left")
    ask(viewer, "mug", "plant")
    mark(viewer, Marks(blob("book") & odd, blob("mug") & odd, blob("plant") & odd))
    viewer.change(splats=Splats(0.8, 0))
    settings.set_clip(viewer, Clip(0.5, 6.5))
    heat = {"heat_opacity": 0.6, "dim": 0.5, "heat": "own", "threshold": 0.3, "heat_scale": (0.1, 0.8)}
    settings.set_picture(viewer, PictureConfig(**heat, alpha_gate=0.2, background=(0.1, 0.6, 0.3)))
    settings.set_picture(viewer, replace(viewer.state.session.picture, colour_map="viridis"))
    settings.set_display(viewer, "relevancy", 1)
    viewer.change(split=Split(mode, second="segmentation", second_level=0, at=0.4))


@pytest.mark.parametrize("mode", ["wipe", "levels"])
@pytest.mark.parametrize("backend", ["cpu", "opengl"])
def test_screen_file_film_and_reference_agree(gl, opened, tmp_path, mode, backend):
    """Nothing that is hidden or deleted comes back, in whatever way an image is made."""
    edit_everything(opened, mode)
    state, renderer = opened.state, renderer_for(gl, backend)
    opened.surface = canvas = Canvas(gl, renderer)
    state.backend = renderer.backend
    request = state.request()
    plain = plain_request(state.open.scene, request.camera, PictureConfig())
    for field in fields(RenderRequest):
        if field.name not in ("scene", "camera", "pose", "width", "merged"):  # merged: only while moving
            assert field.default is not MISSING or field.default_factory is not MISSING, field.name
            assert getattr(request, field.name) != getattr(plain, field.name), field.name
    for field in fields(PictureConfig):
        if field.name not in ("own_colours", "transparent"):  # follow from queries, and from the file
            assert getattr(request.picture, field.name) != field.default, field.name

    rest(canvas, state, 1.0)
    screen = state.session.split.joined(on_screen(canvas), state.size[0]).astype(int)
    images = {"screen": screen, "saved": picture(saving.save_picture(opened, tmp_path))}
    settings.put(opened.state.record, size=state.size)
    saving.save_sized_picture(opened, tmp_path)
    recorded(opened)
    images["sized"] = picture(next(tmp_path.glob("*-160x120*.png")))
    viewpoint.turn_around(opened)
    viewpoint.set_path_seconds(opened, 1.0)
    opened.state.record.fps = 2.0
    opened.state.record.film_file = "film"
    saving.save_film(opened, tmp_path)
    recorded(opened)
    images["film"] = picture(tmp_path / "film" / "frame-00000.png")
    expected = ArrayRenderer(ReferenceRasterizer()).read(request).astype(int)
    bare = ArrayRenderer(ReferenceRasterizer()).read(replace(request, scene=edited_scene(state.open.scene)))
    assert np.abs(bare - expected).max() > 60  # the edits are seen
    for name, got in images.items():
        assert got.shape == expected.shape == (120, 160, 3), name
        assert (np.abs(got - expected).max(-1) > 2).mean() <= 2e-3, name
    assert errors(opened) == []
    renderer.release()


# Requests are equal where the image is.

SEEN = {
    **CHANGES,
    "slider": lambda v: settings.set_picture(v, replace(v.state.session.picture, dim=0.1)),
    "cut": lambda v: queries.set_cut(v, "mug", 0.7),
    "split": settings.toggle_wipe,
}
UNSEEN = {
    "line": lambda v: settings.move_line(v, 0.3),  # the window draws it
    "ruler": settings.toggle_measuring,
    "tool": lambda v: editing.use_tool(v, "brush"),
    "chosen query": lambda v: v.put(chosen=""),
    "saved without background": lambda v: settings.set_picture(
        v, replace(v.state.session.picture, transparent=True)
    ),
}


@pytest.mark.parametrize("name", UNSEEN)
def test_requests_ignore_what_is_not_seen(asked, name):
    before = asked.state.request().without_line()
    UNSEEN[name](asked)
    assert asked.state.request().without_line() == before


def test_equal_requests_have_the_same_channels(asked):
    settings.set_display(asked, "relevancy")
    first, again, inputs = asked.state.request(), asked.state.request(), Inputs()
    assert (first, first.projection) == (again, again.projection)
    assert inputs.channels(first)[0] is inputs.channels(again)[0]
    coarse = first.reduced(0.5)
    assert (coarse.camera.width, coarse.camera.height, coarse.size) == (60, 45, (60, 45))
    assert coarse.projection != first.projection
    assert inputs.channels(coarse)[0] is inputs.channels(first)[0]


@pytest.mark.parametrize("backend", ["opengl", "cpu"])
@pytest.mark.parametrize("name", SEEN)
def test_kept_layers_give_the_image_of_a_new_renderer(gl, asked, name, backend):
    kept, fresh = renderer_for(gl, backend), renderer_for(gl, backend)
    canvas, before = Canvas(gl, kept), asked.state.request()
    assert asked.state.request() == before
    canvas.update(asked.state, 0.0)
    go(SEEN[name], asked)
    assert asked.state.request() != before
    canvas.update(asked.state, 20.0)
    canvas.update(asked.state, 30.0)
    expected = fresh.read(asked.state.request())
    np.testing.assert_array_equal(canvas.capture(asked.state.request()), expected)
    kept.release()
    fresh.release()


# Panes.


def test_the_second_pane_is_what_the_display_would_show_alone(opened):
    ask(opened, "plant")
    settings.set_display(opened, "rgb")
    settings.compare(opened, "wipe", "relevancy")
    first, second = opened.state.panes()
    assert (first.picture.display, second.picture.display) == ("rgb", "relevancy")
    settings.compare(opened, "off")
    settings.set_display(opened, "relevancy")
    assert opened.state.panes() == (second,)


def test_three_levels_of_latents_or_of_answers(opened):
    settings.toggle_levels(opened)
    assert "Search" not in opened.state.preferences.panels
    labels = [pane.label for pane in opened.state.panes()]
    assert labels == ["Latent, subpart", "Latent, part", "Latent, whole"]
    opened.state.size = (200, 90)
    request = opened.state.request()
    assert (request.camera.width, request.camera.height, request.size) == (66, 90, (200, 90))
    ask(opened, "plant")
    settings.set_display(opened, "segmentation")
    relevancy = result(opened).relevancy
    panes, found = opened.state.panes(), Inputs().channels(opened.state.request())
    assert [pane.picture.display for pane in panes] == ["relevancy"] * 3
    for level, channel in enumerate(found[:3]):
        np.testing.assert_array_equal(channel[:, 0], -relevancy[level])  # of everything
    assert len({pane.ranges for pane in panes}) == 1  # they share one scale
    settings.toggle_levels(opened)
    assert [pane.label for pane in opened.state.panes()] == ["Segmentation"]
    assert "Search" in opened.state.preferences.panels


def test_without_a_field_levels_and_latents_are_refused(viewer):
    put_scene(viewer, Scene(random_gaussians(5)))
    settings.toggle_levels(viewer)
    settings.compare(viewer, "wipe", "latent", 1)
    assert viewer.state.session.split.mode == "off"
    assert len(errors(viewer)) == 1  # the same line is not said twice
    (wipe,) = (command for command in COMMANDS if "V" in command.keys)
    for mode in ("wipe", "off"):
        wipe.act(viewer)
        assert viewer.state.session.split.mode == mode
    assert len({button.name for button in BUTTONS}) == len(BUTTONS)


def test_panes_are_joined_at_the_line(opened):
    for at, kept in ((-3.0, AT_RANGE[0]), (0.3, 0.3), (2.0, AT_RANGE[1])):
        settings.move_line(opened, at)
        assert opened.state.session.split.at == kept
    for u, inside in ((0.0, 0.0), (0.2, 0.6), (0.5, 0.5), (1.0, 1.0)):
        assert Split("levels").within_pane(u) == pytest.approx(inside)
        assert Split("wipe").within_pane(u) == u
    dark, light = np.zeros((2, 10, 3), np.uint8), np.full((2, 10, 3), 9, np.uint8)
    assert Split("wipe", at=0.3).joined([dark, light], 10)[0, :, 0].tolist() == [0] * 3 + [9] * 7
    wide = Split("levels").joined([dark, dark, light], 32)  # two pixels are left over
    assert wide[0, :, 0].tolist() == [0] * 20 + [9] * 12


# The edited scene.


def test_edited_scenes_leave_out_what_is_hidden_and_share_the_rest():
    edited = edited_scene(SCENE, Marks(NOTHING, blob("mug"), blob("plant")))
    np.testing.assert_array_equal(edited.rows, np.flatnonzero(blob("book")))
    np.testing.assert_array_equal(edited.scene.gaussians.means, SCENE.gaussians.means[blob("book")])
    values = np.arange(720).reshape(360, 2)
    np.testing.assert_array_equal(edited.values(values), values[blob("book")])
    everything = np.ones(360, bool)
    assert len(edited_scene(SCENE, Marks(NOTHING, everything, NOTHING)).scene.gaussians) == 0
    for other in (everything[:0], everything[:-1]):  # marks of another scene count as none
        assert edited_scene(SCENE, Marks(other, other, other)).scene is SCENE
    marks = Marks(NOTHING, blob("mug"), NOTHING)
    first = edited_scene(SCENE, marks)
    assert edited_scene(SCENE, marks, first) is first
    selected = edited_scene(SCENE, replace(marks, selected=blob("book")), first)
    assert selected.scene is first.scene  # so that nothing is projected anew
    assert (selected != first, first.selected) == (True, None)
    np.testing.assert_array_equal(selected.selected[:, 0], blob("book")[first.rows])
    other = edited_scene(blob_scene(), marks, first)
    assert other.source is not SCENE
    assert other.scene is not first.scene


def test_splats_are_drawn_smaller_and_of_one_colour():
    scene = Scene(random_gaussians(40, sh_degree=3))
    assert with_splats(scene, Splats()) is scene
    drawn = with_splats(scene, Splats(0.25, 1)).gaussians
    np.testing.assert_allclose(np.exp(drawn.log_scales), 0.25 * np.exp(scene.gaussians.log_scales), rtol=1e-5)
    np.testing.assert_array_equal(drawn.sh, scene.gaussians.sh[:, :4])
    assert with_splats(Scene(drawn), Splats(sh_degree=2)).gaussians is drawn  # it has no more


# Over the image: overlays and the ruler.


def test_overlays_and_colour_map_have_commands_and_are_remembered(opened, tmp_path):
    for command in reversed(COMMANDS):
        if command.does.startswith("show or hide") and not command.is_on(opened):
            command.act(opened)
    assert opened.state.session.overlays == OVERLAYS
    settings.set_picture(opened, replace(opened.state.session.picture, colour_map="cividis"))
    assert opened.state.request().picture.colour_map == "cividis"
    settings.keep_preferences(opened)
    save_preferences(tmp_path, opened.state.preferences)
    assert load_preferences(tmp_path) == opened.state.preferences


def test_two_clicks_measure_and_a_third_begins_anew(opened):
    settings.toggle_measuring(opened)
    assert opened.state.session.ruler.length is None
    settings.measure_at(opened, 0.95, 0.5)
    assert opened.state.session.ruler.points == ()
    assert "nothing under the cursor" in opened.state.messages[-1].text
    settings.measure_at(opened, 0.5, 0.5)
    settings.measure_at(opened, 0.8, 0.1)  # the fake surface: (u - 0.5, v - 0.5, 0)
    assert opened.state.session.ruler.length == pytest.approx(0.5)
    settings.measure_at(opened, 0.6, 0.6)
    assert opened.state.session.ruler.length is None
    assert len(opened.state.session.ruler.points) == 1
    settings.escape(opened)
    for end in (settings.escape, lambda viewer: open_scene(viewer, "plain.ply")):
        settings.toggle_measuring(opened)
        settings.measure_at(opened, 0.5, 0.5)
        end(opened)
        assert opened.state.session.ruler == Ruler()
