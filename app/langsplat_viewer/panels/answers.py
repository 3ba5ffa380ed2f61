"""What was searched: one line each in an area of its own, and the details of the one that was chosen."""

import math

from imgui_bundle import ImVec2, ImVec4, imgui

from langsplat_core.display.displays import QUERY_COLOURS
from langsplat_core.scene import LEVELS
from langsplat_viewer import actions
from langsplat_viewer.panels import cut
from langsplat_viewer.panels.style import bad, elided, good, muted, small_wrapped, width_of
from langsplat_viewer.state import Query
from langsplat_viewer.viewer import Viewer

ROWS = 3.5  # that the list shows at least: the half one says that there are more
BELOW = 10  # rows that the details of a query take, and what follows them in the panel
HIDDEN = (0.25, 0.25, 0.25)


def draw(viewer: Viewer) -> None:
    """The list, newest first, which grows when something is asked and not when an answer arrives; and below
    it the chosen query."""
    row = imgui.get_frame_height_with_spacing()
    rows = rows_shown(len(viewer.state.queries), imgui.get_content_region_avail().y / row)
    if imgui.begin_child("queries", ImVec2(0, rows * row), imgui.ChildFlags_.none):
        if not viewer.state.queries:
            imgui.text_colored(muted(), "what you search is listed here")
        for query in reversed(viewer.state.queries):
            imgui.push_id(query.phrase)
            _line(viewer, query)
            imgui.pop_id()
    imgui.end_child()
    chosen = viewer.state.selected
    if chosen is not None:
        _details(viewer, chosen)


def rows_shown(count: int, room: float) -> float:
    """Of `count` queries in a panel that has `room` for so many rows: all where the details fit below."""
    return min(count or 1, max(ROWS, math.floor(room - BELOW) + 0.5))


def _line(viewer: Viewer, query: Query) -> None:
    """Colour, phrase, verdict and a button to take it off; the phrase gets what the others leave."""
    spacing, side = imgui.get_style().item_spacing.x, imgui.get_frame_height()
    verdict_width = imgui.calc_text_size("weak match").x
    left, right = imgui.get_cursor_pos_x(), imgui.get_content_region_avail().x
    room = right - 2 * side - verdict_width - 3 * spacing
    _swatch(viewer, query, side)
    imgui.same_line()
    chosen = viewer.state.selected is query
    name = elided(query.phrase, room, width_of)
    if imgui.selectable(f"{name}##phrase of list", chosen, size=ImVec2(room, 0))[0]:
        actions.select(viewer, query)
    if name != query.phrase and imgui.is_item_hovered():
        imgui.set_tooltip(query.phrase)
    imgui.same_line(left + right - side - spacing - verdict_width)
    imgui.align_text_to_frame_padding()
    _verdict(query)
    imgui.same_line(left + right - side)
    if imgui.button("x", ImVec2(side, 0)):
        actions.remove(viewer, query)
    if imgui.is_item_hovered():
        imgui.set_tooltip("Take it off the list")


def _swatch(viewer: Viewer, query: Query, side: float) -> None:
    shown = query.slot is not None
    red, green, blue = HIDDEN if query.slot is None else QUERY_COLOURS[query.slot]
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
        imgui.text_colored(muted(), "...")
    elif query.problem:
        imgui.text_colored(bad(), "not asked")
    elif query.result is not None:
        imgui.text_colored(good() if query.result.found else muted(), query.result.verdict)
        probability = query.result.probability
        if imgui.is_item_hovered() and probability is not None:
            imgui.set_tooltip(f"{100 * probability:.0f} % likely to be there")


def _details(viewer: Viewer, query: Query) -> None:
    """Place and a button to go there, scores per level, how it was read or why it was not answered."""
    result = query.result
    place = None if result is None or result.verdict == "not here" else result.place
    imgui.begin_disabled(place is None)
    if imgui.button("Focus"):
        actions.focus_result(viewer, query)
    imgui.end_disabled()
    if place is not None:
        imgui.same_line()
        imgui.align_text_to_frame_padding()
        imgui.text_colored(muted(), "at " + "  ".join(f"{v:.2f}" for v in place))
    if query.problem:
        small_wrapped(query.problem, bad())
    if result is not None:
        for index, (name, score) in enumerate(zip(LEVELS, result.scores, strict=True)):
            if index:
                imgui.same_line()
            text = f"{name} {score:.2f}"
            if index == result.level:
                imgui.text(text)
            else:
                imgui.text_colored(muted(), text)
        cut.draw(viewer, query, result)
    if query.reading:
        small_wrapped(f"read as: {query.reading}", muted())
