"""The search panel: a box to type in, and the list of what was searched."""

from typing import get_args

from imgui_bundle import ImVec2, ImVec4, hello_imgui, imgui

from langsplat_core.config import LevelChoice
from langsplat_core.display.colour_maps import QUERY_COLOURS
from langsplat_core.query.engine import no_field
from langsplat_core.scene import LEVELS
from langsplat_viewer import actions
from langsplat_viewer.panels import query_box
from langsplat_viewer.panels.style import BAD, GOOD, MUTED, small_wrapped
from langsplat_viewer.state import Query
from langsplat_viewer.viewer import Viewer

CHOICES: tuple[LevelChoice, ...] = get_args(LevelChoice)


def draw(viewer: Viewer) -> None:
    """Box, level, list."""
    imgui.separator_text("Search")
    scene = viewer.state.scene
    if scene is not None and scene.language is None:
        small_wrapped(no_field(scene), MUTED)
        return
    imgui.begin_disabled(scene is None)
    query_box.draw(viewer)
    _level(viewer)
    imgui.end_disabled()
    for index, query in enumerate(list(viewer.state.queries)):
        imgui.push_id(f"query {index}")
        _entry(viewer, query)
        imgui.pop_id()


def _level(viewer: Viewer) -> None:
    imgui.align_text_to_frame_padding()
    imgui.text("Level")
    for choice in CHOICES:
        imgui.same_line()
        if imgui.radio_button(choice, viewer.state.level == choice):
            actions.set_level(viewer, choice)
    if imgui.is_item_hovered():
        imgui.set_tooltip("auto: the level that answers best")


def _entry(viewer: Viewer, query: Query) -> None:
    """One query: colour and verdict, scores per level, place."""
    _swatch(viewer, query)
    imgui.same_line()
    imgui.align_text_to_frame_padding()
    imgui.text(query.phrase)
    imgui.same_line()
    _verdict(query)
    close = imgui.get_frame_height()
    imgui.same_line()
    imgui.set_cursor_pos_x(imgui.get_cursor_pos_x() + imgui.get_content_region_avail().x - close)
    if imgui.button("x", ImVec2(close, 0)):
        actions.remove(viewer, query)
    if imgui.is_item_hovered():
        imgui.set_tooltip("Take it off the list")
    if query.problem:
        small_wrapped(query.problem, BAD)
    if query.result is not None:
        _answer(viewer, query)
    imgui.dummy(hello_imgui.em_to_vec2(0, 0.15))


def _swatch(viewer: Viewer, query: Query) -> None:
    shown = query.slot is not None
    red, green, blue = QUERY_COLOURS[query.slot] if query.slot is not None else (0.25, 0.25, 0.25)
    side = imgui.get_frame_height()
    flags = imgui.ColorEditFlags_.no_tooltip
    if imgui.color_button("##shown", ImVec4(red, green, blue, 1.0), flags, ImVec2(side, side)):
        if shown:
            actions.hide(viewer, query)
        else:
            actions.show(viewer, query)
    if imgui.is_item_hovered():
        imgui.set_tooltip("Click to hide" if shown else "Click to show")


def _verdict(query: Query) -> None:
    if query.pending:
        imgui.text_colored(MUTED, "...")
    elif query.result is not None:
        imgui.text_colored(GOOD if query.result.found else MUTED, query.result.verdict)
        probability = query.result.probability
        if imgui.is_item_hovered() and probability is not None:
            imgui.set_tooltip(f"{100 * probability:.0f} % likely to be there")


def _answer(viewer: Viewer, query: Query) -> None:
    result = query.result
    assert result is not None
    imgui.indent(imgui.get_frame_height())
    if query.reading:
        small_wrapped(f"read as: {query.reading}", MUTED)
    for index, (name, score) in enumerate(zip(LEVELS, result.scores, strict=True)):
        if index:
            imgui.same_line()
        text = f"{name} {score:.2f}"
        if index == result.level:
            imgui.text(text)
        else:
            imgui.text_colored(MUTED, text)
    if result.place is not None:
        imgui.align_text_to_frame_padding()
        imgui.text_colored(MUTED, "at " + "  ".join(f"{v:.2f}" for v in result.place))
        imgui.same_line()
        if imgui.button("Focus"):
            actions.focus_result(viewer, query)
    imgui.unindent(imgui.get_frame_height())
