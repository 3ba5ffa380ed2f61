"""What is shown, and from where."""

from dataclasses import replace

from imgui_bundle import hello_imgui, imgui

from langsplat_core.config import Display
from langsplat_viewer import actions
from langsplat_viewer.actions import Viewer
from langsplat_viewer.controls import FOV_RANGE, adopt_up, level, with_fov
from langsplat_viewer.panels.style import MUTED, small_wrapped

# (label, display, latent level), in the order of the keys 1 to 8; labels of radio buttons
DISPLAYS: tuple[tuple[str, Display, int | None], ...] = (
    ("Colours", "rgb", None),
    ("Depth", "depth", None),
    ("Alpha", "alpha", None),
    ("Relevancy", "relevancy", None),
    ("Segmentation", "segmentation", None),
    ("subpart##latent", "latent", 0),
    ("part##latent", "latent", 1),
    ("whole##latent", "latent", 2),
)
ROWS = ((0, 1, 2), (3, 4), (5, 6, 7))


def draw_display(viewer: Viewer) -> None:
    """Which channel, and how strong the heat."""
    imgui.separator_text("Display")
    for row in ROWS:
        if DISPLAYS[row[0]][1] == "latent":
            imgui.align_text_to_frame_padding()
            imgui.text("Latent")
            imgui.same_line()
        for place, index in enumerate(row):
            if place:
                imgui.same_line()
            _display_button(viewer, *DISPLAYS[index])
    picture = viewer.state.picture
    if picture.display in ("relevancy", "segmentation") and not viewer.state.shown():
        small_wrapped("search for something to see where it is", MUTED)
    if picture.display == "relevancy":
        picture = replace(picture, heat_opacity=_slider("Heat opacity", picture.heat_opacity, 0.0, 1.0))
    if picture.display == "segmentation":
        picture = replace(picture, threshold=_slider("Threshold", picture.threshold, 0.4, 1.0))
    if picture.display in ("relevancy", "segmentation"):
        picture = replace(picture, dim=_slider("Background", picture.dim, 0.0, 1.0))
    viewer.state.picture = picture


def _display_button(viewer: Viewer, label: str, display: Display, latent_level: int | None) -> None:
    state = viewer.state
    without_field = state.scene is not None and state.scene.language is None
    chosen = state.picture.display == display and latent_level in (None, state.latent_level)
    imgui.begin_disabled(without_field and display in actions.NEEDS_FIELD)
    if imgui.radio_button(label, chosen):
        actions.set_display(viewer, display, latent_level)
    imgui.end_disabled()


def draw_camera(viewer: Viewer) -> None:
    """Training cameras, reset, lens, speed."""
    imgui.separator_text("Camera")
    state = viewer.state
    imgui.begin_disabled(state.view is None)
    if state.scene is not None and state.scene.cameras:
        _training_cameras(viewer)
    if imgui.button("Reset (R)"):
        actions.reset_view(viewer)
    imgui.same_line()
    if imgui.button("Focus (F)"):
        actions.focus_result(viewer)
    imgui.same_line()
    if imgui.button("Horizon"):
        actions.move(viewer, level)
    _tip("Turn the picture until the horizon is level")
    imgui.same_line()
    if imgui.button("Up is up"):
        actions.move(viewer, adopt_up)
    _tip("Take what is up in the picture as the world's up")
    if state.view is not None:
        before = state.view.lens.fov_degrees
        fov = _slider("Field of view", before, *FOV_RANGE, "%.0f deg")
        if abs(fov - before) > 1e-3:
            actions.move(viewer, lambda view: with_fov(view, fov))
    state.fly_speed = _slider("Fly speed", state.fly_speed, 0.05, 4.0, "%.2f", logarithmic=True)
    _, state.coarse_while_moving = imgui.checkbox("Coarse while moving", state.coarse_while_moving)
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
