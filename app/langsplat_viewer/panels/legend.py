"""Over the scene: the scale of the heat, and what there is to say instead of a picture."""

from typing import Any

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.arrays import Array
from langsplat_core.config import ColourMap
from langsplat_core.display.displays import QUERY_COLOURS, STRENGTH, mapped, painted
from langsplat_core.query.answers import QueryResult
from langsplat_viewer.panels.area import Area
from langsplat_viewer.panels.style import elided, width_of
from langsplat_viewer.viewer import Viewer

STEPS = 32  # of a colour bar
BAR_EM, HEIGHT_EM = 11.0, 0.8
QUIET = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_inputs
    | imgui.WindowFlags_.always_auto_resize
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_bring_to_front_on_focus
)


def draw(viewer: Viewer, area: Area) -> None:
    """A colour bar with numbers for every query that is painted."""
    state = viewer.state
    shown = state.shown_results()
    slots = painted(shown)
    if state.scene is None or not slots or not any(pane.row.legend for pane in state.panes()):
        return
    corner = ImVec2(
        area.left + area.width - hello_imgui.em_size(0.7), area.top + area.height - hello_imgui.em_size(0.7)
    )
    imgui.set_next_window_pos(corner, imgui.Cond_.always, ImVec2(1, 1))
    imgui.set_next_window_bg_alpha(0.75)
    imgui.begin("relevancy", None, QUIET)
    for slot in slots:
        result = shown[slot]
        if result is not None:
            strength = STRENGTH[result.verdict]
            _bar(result, bar_colours(slot, strength, len(slots) == 1, state.picture.colour_map))
    imgui.end()


def say(text: str, area: Area) -> None:
    """A line in the middle of the scene's area."""
    centre = ImVec2(area.left + area.width / 2, area.top + area.height / 2)
    imgui.set_next_window_pos(centre, imgui.Cond_.always, ImVec2(0.5, 0.5))
    imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(0.9 * area.width, area.height))
    imgui.set_next_window_bg_alpha(0.75)
    imgui.begin("said over the scene", None, QUIET)
    imgui.push_text_wrap_pos(0.85 * area.width)
    imgui.text_unformatted(text)
    imgui.pop_text_wrap_pos()
    imgui.end()


def bar_colours(slot: int, strength: float, alone: bool, colour_map: ColourMap = "turbo") -> Array:
    """(STEPS, 3) colours of a bar from its coldest to its hottest end, as the picture has them: the colour
    map for a query that is painted alone, else black to its own colour; what is half as strong ends there."""
    heat = np.linspace(0, strength, STEPS)
    if alone:
        return mapped(heat, colour_map)
    return (heat * heat * (3 - 2 * heat))[:, None] * QUERY_COLOURS[slot]


def _bar(result: QueryResult, colours: Array) -> None:
    """Phrase, bar, and the relevancies at its ends and in its middle."""
    width, height = hello_imgui.em_size(BAR_EM), hello_imgui.em_size(HEIGHT_EM)
    imgui.text_unformatted(elided(result.phrase, width, width_of))
    start, paint = imgui.get_cursor_screen_pos(), imgui.get_window_draw_list()
    for step, colour in enumerate(colours):
        left, right = (round(start.x + width * edge / STEPS) for edge in (step, step + 1))  # no seams
        paint.add_rect_filled(ImVec2(left, start.y), ImVec2(right, start.y + height), _packed(colour))
    imgui.dummy(ImVec2(width, height))
    low, high = result.heat_range
    x = imgui.get_cursor_pos_x()
    for place, value in ((0.0, low), (0.5, (low + high) / 2), (1.0, high)):
        text = f"{value:.2f}"
        if place:
            imgui.same_line(x + place * (width - imgui.calc_text_size(text).x))
        imgui.text_unformatted(text)


def _packed(colour: Array) -> Any:
    return imgui.get_color_u32((float(colour[0]), float(colour[1]), float(colour[2]), 1.0))
