"""What is shown, and from where."""

from dataclasses import replace
from itertools import groupby

from imgui_bundle import hello_imgui, imgui

from langsplat_core.display.displays import DISPLAYS, DisplayRow
from langsplat_viewer import actions
from langsplat_viewer.commands import Button, buttons_of
from langsplat_viewer.controls import FOV_RANGE, adopt_up, level, with_fov
from langsplat_viewer.panels.style import muted, small_wrapped
from langsplat_viewer.viewer import Viewer


def draw_display(viewer: Viewer) -> None:
    """Which channel, and how strong the heat."""
    for _, group in groupby(DISPLAYS.values(), lambda row: (row.needs_field, row.needs_query)):
        _display_line(viewer, tuple(group))
    picture = viewer.state.picture
    needs_query = DISPLAYS[picture.display].needs_query
    if needs_query and not viewer.state.shown():
        small_wrapped("search for something to see where it is", muted())
    if picture.display == "relevancy":
        picture = replace(picture, heat_opacity=_slider("Heat opacity", picture.heat_opacity, 0.0, 1.0))
    if needs_query:
        picture = replace(picture, dim=_slider("Background", picture.dim, 0.0, 1.0))
    actions.set_picture(viewer, picture)


def _display_line(viewer: Viewer, rows: tuple[DisplayRow, ...]) -> None:
    """Displays that need the same, beside each other; one that has several buttons is named before them."""
    buttons = [button for row in rows for button in buttons_of(row)]
    if len(buttons) > len(rows):
        imgui.align_text_to_frame_padding()
        imgui.text(rows[0].label)
        imgui.same_line()
    for place, button in enumerate(buttons):
        if place:
            imgui.same_line()
        _display_button(viewer, button)


def _display_button(viewer: Viewer, button: Button) -> None:
    state = viewer.state
    without_field = state.scene is not None and state.scene.language is None
    chosen = state.picture.display == button.display and button.latent_level in (None, state.latent_level)
    imgui.begin_disabled(without_field and DISPLAYS[button.display].needs_field)
    if imgui.radio_button(button.label, chosen):
        actions.set_display(viewer, button.display, button.latent_level)
    imgui.end_disabled()


def draw_camera(viewer: Viewer) -> None:
    """Training cameras, reset, lens, speed."""
    state = viewer.state
    imgui.begin_disabled(state.view is None)
    if state.scene is not None and state.scene.cameras:
        _training_cameras(viewer)
    if imgui.button("Reset (R)"):
        actions.reset_view(viewer)
    _tip("Return to the opening view")
    imgui.same_line()
    if imgui.button("Focus (F)"):
        actions.focus_result(viewer)
    imgui.same_line()
    if imgui.button("Frame all"):
        actions.frame_scene(viewer)
    _tip("Show the whole scene from this side (Shift + F)")
    if imgui.button("Horizon"):
        actions.move(viewer, level)
    _tip("Turn the picture until the horizon is level")
    imgui.same_line()
    if imgui.button("Up is up"):
        actions.move(viewer, adopt_up)
    _tip("Take what is up in the picture as the world's up")
    if state.view is not None:
        before = state.view.intrinsics.fov_degrees
        fov = _slider("Field of view", before, *FOV_RANGE, "%.0f deg")
        if abs(fov - before) > 1e-3:
            actions.move(viewer, lambda view: with_fov(view, fov))
    speed = _slider("Fly speed", state.fly_speed, 0.05, 4.0, "%.2f", logarithmic=True)
    actions.set_fly_speed(viewer, speed)
    _, walks = imgui.checkbox("Walk", state.walks)
    actions.set_walking(viewer, walks)
    _tip("W A S D keep the height of the eye")
    imgui.same_line()
    _, coarse = imgui.checkbox("Coarse while moving", state.coarse_while_moving)
    actions.set_coarse_while_moving(viewer, coarse)
    _tip("Draw fewer pixels while the camera moves, where drawing is slow")
    imgui.end_disabled()


def _training_cameras(viewer: Viewer) -> None:
    state = viewer.state
    assert state.scene is not None
    if imgui.arrow_button("##previous", imgui.Dir.left):
        actions.step_camera(viewer, -1)
    imgui.same_line()
    if imgui.arrow_button("##next", imgui.Dir.right):
        actions.step_camera(viewer, 1)
    imgui.same_line()
    index = state.camera_index or 0
    imgui.set_next_item_width(-1)
    name = state.scene.cameras[index].name.replace("%", "%%")
    changed, index = imgui.slider_int(
        "##camera", index, 0, len(state.scene.cameras) - 1, f"camera %d  {name}"
    )
    _tip("Training cameras: stand where a photograph was taken")
    if changed and index != state.camera_index:
        actions.go_to_camera(viewer, index)


def _slider(
    label: str, value: float, low: float, high: float, text: str = "%.2f", *, logarithmic: bool = False
) -> float:
    imgui.set_next_item_width(hello_imgui.em_size(11))
    flags = imgui.SliderFlags_.always_clamp
    if logarithmic:
        flags |= imgui.SliderFlags_.logarithmic
    _, value = imgui.slider_float(label, value, low, high, text, flags)
    return value


def _tip(text: str) -> None:
    if imgui.is_item_hovered():
        imgui.set_tooltip(text)
