"""The panel "Display"."""

from dataclasses import replace
from itertools import groupby

from imgui_bundle import imgui

from langsplat_core.display.displays import COLOUR_MAPS, DISPLAYS, DisplayRow
from langsplat_core.query.answers import FLOOR
from langsplat_core.scene import LEVELS
from langsplat_viewer.actions import opening, settings
from langsplat_viewer.commands import BUTTONS, Button, buttons_of, is_shown
from langsplat_viewer.panels import ui
from langsplat_viewer.viewer import Viewer

WIDTH_EM = 11.0  # of lists and of sliders of `ui`, where there is room
LEAST_SPAN = 1e-3  # of a heat scale
BACKDROPS = {(grey, grey, grey): name for name, grey in (("Black", 0.0), ("Grey", 0.5), ("White", 1.0))}


def draw(viewer: Viewer) -> None:
    """Draw the panel "Display": what is shown, and how."""
    for _, group in groupby(DISPLAYS.values(), lambda row: row.name if row.by_level else row.needs_query):
        _display_line(viewer, tuple(group))
    _compared(viewer)
    picture = viewer.state.session.picture
    needs_query = DISPLAYS[picture.display].needs_query
    if needs_query and not viewer.state.shown():
        ui.small_wrapped("search for something to see where it is", ui.muted())
    if picture.display == "relevancy":
        picture = replace(picture, heat_opacity=ui.slider("Heat opacity", picture.heat_opacity, (0.0, 1.0)))
        picture = replace(picture, heat_scale=_heat_scale(viewer))
    if needs_query:
        picture = replace(picture, dim=ui.slider("Background brightness", picture.dim, (0.0, 1.0)))
    if any(pane.row.uses_map for pane in viewer.state.panes()):
        names = list(COLOUR_MAPS)
        ui.leave_room("Colour map", WIDTH_EM)
        changed, chosen = imgui.combo("Colour map", names.index(picture.colour_map), list(names))
        if changed:
            picture = replace(picture, colour_map=names[chosen])
    picture = replace(picture, background=_backdrop(picture.background))
    ui.tip("What shows where the scene is not")
    picture = replace(picture, transparent=imgui.checkbox("Save without backdrop", picture.transparent)[1])
    ui.tip("Pictures are saved transparent where the scene is not")
    settings.set_picture(viewer, picture)
    viewer.change("settings", **ui.draw_fields(viewer.state.session, "Display"))
    splats = viewer.state.session.splats
    viewer.change("splats", splats=replace(splats, **ui.draw_fields(splats, "Display")))


def _heat_scale(viewer: Viewer) -> tuple[float, float] | None:
    """Relevancies at the ends of the colour bar: each answer's own, or the same for all."""
    scale = viewer.state.session.picture.heat_scale
    changed, fixed = imgui.checkbox("Fixed heat scale", scale is not None)
    ui.tip("The same colour means the same relevancy in every answer, image and scene")
    if changed:
        own = [result.heat_range for result in viewer.state.shown_results() if result is not None]
        lows, highs = zip(*own, strict=True) if own else ((FLOOR,), (1.0,))
        return (min(lows), max(highs)) if fixed else None
    if scale is None:
        return None
    ui.leave_room("From, to", WIDTH_EM)
    flags = imgui.SliderFlags_.always_clamp
    changed, low, high = imgui.drag_float_range2("From, to", *scale, 0.002, 0.0, 1.0, "%.3f", "%.3f", flags)
    return (low, high) if changed and high - low > LEAST_SPAN else scale


def _backdrop(background: tuple[float, float, float]) -> tuple[float, float, float]:
    background = ui.radio(BACKDROPS, background)
    ui.beside_boxed("Backdrop")
    flags = imgui.ColorEditFlags_.no_inputs | imgui.ColorEditFlags_.uint8
    changed, colour = imgui.color_edit3("Backdrop", list(background), flags)
    red, green, blue = (min(max(float(part), 0.0), 1.0) for part in colour)
    return (red, green, blue) if changed else background


def _display_line(viewer: Viewer, rows: tuple[DisplayRow, ...]) -> None:
    """Draw displays that need the same beside each other, named first where one has several buttons."""
    state = viewer.state
    buttons = [button for row in rows for button in buttons_of(row)]
    if len(buttons) > len(rows):
        imgui.align_text_to_frame_padding()
        imgui.text(rows[0].label)
        imgui.same_line()
    for place, button in enumerate(buttons):
        if place:
            ui.beside_boxed(button.label)
        imgui.begin_disabled(not state.has_field and DISPLAYS[button.display].needs_field)
        if imgui.radio_button(button.label, is_shown(state, button)):
            settings.set_display(viewer, button.display, button.latent_level)
        imgui.end_disabled()


def _compared(viewer: Viewer) -> None:
    """Draw the choice of what is shown beside it."""
    state, split = viewer.state, viewer.state.session.split
    second = Button("", split.second, split.second_level if DISPLAYS[split.second].by_level else None)
    shown = {"off": "nothing", "levels": "three levels", "wipe": compared_name(second)}.get(split.mode, "")
    if viewer.beside is not None and viewer.beside.state.path is not None:
        shown = viewer.beside.state.path.name
    ui.leave_room("Compare with", WIDTH_EM)
    if not imgui.begin_combo("Compare with", shown):
        return
    if imgui.selectable("nothing", split.mode == "off")[0]:
        settings.set_split(viewer, "off")
    for button in BUTTONS:
        imgui.begin_disabled(not state.has_field and DISPLAYS[button.display].needs_field)
        if imgui.selectable(compared_name(button), shown == compared_name(button))[0]:
            settings.compare_with(viewer, button.display, button.latent_level)
        imgui.end_disabled()
    imgui.begin_disabled(not state.has_field)
    if imgui.selectable("three levels", split.mode == "levels")[0]:
        settings.set_split(viewer, "levels")
    imgui.end_disabled()
    if imgui.selectable("another scene ...", split.mode == "scenes")[0]:
        opening.ask_for_beside(viewer)
    imgui.end_combo()


def compared_name(button: Button) -> str:
    """Return the name of a display in the list of those that can be beside another."""
    row = DISPLAYS[button.display]
    return row.label if button.latent_level is None else f"{row.label}, {LEVELS[button.latent_level]}"
