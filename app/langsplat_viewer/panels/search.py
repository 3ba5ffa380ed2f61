"""The search over the scene: the box with its suggestions, the answers, and details of the chosen one."""

from functools import lru_cache
from typing import get_args

import numpy as np
from imgui_bundle import ImVec2, ImVec4, hello_imgui, icons_fontawesome_6, imgui, imgui_ctx

from langsplat_core.arrays import Array, length_text
from langsplat_core.config import LevelChoice
from langsplat_core.display.displays import QUERY_COLOURS, STRENGTH, painted
from langsplat_core.query.answers import QueryResult
from langsplat_core.scene import LEVELS
from langsplat_viewer import disk
from langsplat_viewer.actions import opening, queries, settings, viewpoint
from langsplat_viewer.panels import theme, ui
from langsplat_viewer.panels.overlays import bar_colours, draw_bar
from langsplat_viewer.session import Query
from langsplat_viewer.state import QueryAnswer
from langsplat_viewer.viewer import Viewer

TITLE = "Search"
HINT = "what to look for"
HINT_EXAMPLES = 2
OFFER_LINES = 2  # that are seen
FOLD = f"{icons_fontawesome_6.ICON_FA_CHEVRON_UP}##fold"


def _box(viewer: Viewer) -> None:
    queries.prepare_suggestions(viewer)
    imgui.set_next_item_width(ui.beside_button(FOLD))
    if settings.take(viewer.state, "focus_input"):
        imgui.set_keyboard_focus_here()
    flags = imgui.InputTextFlags_.enter_returns_true | imgui.InputTextFlags_.callback_history
    drafts, label = viewer.state.drafts, "##phrase"
    typed = drafts.get(label, "")
    completion = next(iter(queries.offers(viewer, typed)[1]), "") if typed.strip() else ""
    if completion:
        flags |= imgui.InputTextFlags_.callback_completion  # else Tab goes on to the next widget

    def recalled(data: imgui.InputTextCallbackData) -> int:
        text = completion
        if data.event_flag == imgui.InputTextFlags_.callback_history:
            text = queries.recall(viewer, -1 if data.event_key == imgui.Key.up_arrow else 1)
        data.delete_chars(0, data.buf_text_len)
        data.insert_chars(0, text)
        return 0

    entered, drafts[label] = imgui.input_text_with_hint(label, hint(viewer), typed, flags, recalled)
    imgui.same_line()
    if ui.button(FOLD, "Fold the search; Ctrl + F opens it again"):
        settings.turn_panel(viewer, TITLE, is_open=False)
    if entered:
        settings.put(viewer.state, focus_input=True, awaits_keyboard=True)  # for the next phrase
        if drafts[label].strip():
            queries.ask(viewer, drafts.pop(label))
    padding, spacing = hello_imgui.em_to_vec2(0.65, 0.15), hello_imgui.em_to_vec2(0.4, 0.4)
    with theme.styled(frame_rounding=theme.PILL, frame_padding=padding, item_spacing=spacing):
        height = OFFER_LINES * imgui.get_frame_height_with_spacing() - spacing.y  # with or without offers
        hidden = imgui.WindowFlags_.no_scrollbar
        if imgui.begin_child("offers", ImVec2(0, height), imgui.ChildFlags_.nav_flattened, hidden):
            is_pointed_at = imgui.is_window_hovered(imgui.HoveredFlags_.allow_when_blocked_by_active_item)
            title, phrases = queries.offered(viewer, drafts.get(label, ""), is_pointed_at)
            if phrases:
                _offer_buttons(viewer, title, phrases)
        imgui.end_child()


def hint(viewer: Viewer) -> str:
    """Return the hint of the empty box: examples of this scene, once they are known."""
    examples = viewer.state.suggestions.examples[:HINT_EXAMPLES]
    return ", ".join((*examples, "...")) if examples else HINT


def _offer_buttons(viewer: Viewer, title: str, phrases: tuple[str, ...]) -> None:
    if title:
        ui.coloured(title)
    for number, phrase in enumerate(phrases):
        if title or number:
            ui.beside(phrase)
        shown = ui.elided(phrase, imgui.get_content_region_avail().x - ui.button_width(""))
        if imgui.button(f"{shown}###offer {number}"):
            viewer.state.drafts.pop("##phrase", None)
            queries.ask_offered(viewer, phrase)
        if shown != phrase:
            ui.tip(phrase)


# The threshold of an answer: a histogram of its relevancies, and a slider over it.

HISTOGRAM_EM, BINS = 3.0, 64


def _cut(viewer: Viewer, query: Query, result: QueryResult) -> None:
    """Draw histogram, slider, and a button that restores the answer's own threshold."""
    low, high, counts = histogram(viewer.state.answer(query).result or result)
    height = hello_imgui.em_size(HISTOGRAM_EM)
    imgui.plot_histogram("##relevancies", counts, graph_size=ImVec2(-1, height))
    corner, size = imgui.get_item_rect_min(), imgui.get_item_rect_size()
    ui.tip("Gaussians by relevancy, on a logarithmic scale; the line is where the answer ends")
    x = corner.x + size.x * (min(max(result.cut, low), high) - low) / (high - low)
    colour = imgui.get_color_u32(imgui.Col_.text)
    imgui.get_window_draw_list().add_line(ImVec2(x, corner.y), ImVec2(x, corner.y + size.y), colour, 2.0)
    own = result.own_cut is not None
    imgui.set_next_item_width(ui.beside_button("Auto") if own else -1)
    changed, value = imgui.slider_float("##cut", result.cut, low, high, "threshold %.3f")
    ui.tip(
        "What is less relevant than this is no part of the answer; one set by hand stays, whatever the level"
    )
    if changed:
        queries.set_cut(viewer, query.phrase, value)
    if own:
        imgui.same_line()
        if imgui.button("Auto##cut"):  # another is the level
            queries.set_cut(viewer, query.phrase, None)
    ui.coloured(f"{np.count_nonzero(result.members):,} Gaussians")


@lru_cache(maxsize=1)  # of the answer that is shown; what is kept holds all arrays of its scene
def histogram(result: QueryResult) -> tuple[float, float, Array]:
    """Return lowest and highest relevancy of an answer, and (BINS,) float32 log(1 + n) of those between."""
    values = result.even[np.isfinite(result.even)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    high = max(high, low + 1e-3)
    return low, high, np.log1p(np.histogram(values, BINS, (low, high))[0]).astype(np.float32)


# The list of queries.

LEAST_EM = 4.0  # of a phrase beside a long verdict
MOST_ROWS = 5.5  # that are seen at a time: the half one says that there are more
HIDDEN = (0.25, 0.25, 0.25)


def _answers(viewer: Viewer) -> None:
    """Draw the list, newest first, and below it the chosen query."""
    if listed := viewer.state.session.queries:
        if ui.begin_list("queries", MOST_ROWS):
            for query in reversed(listed):
                with imgui_ctx.push_id(query.phrase):
                    _line(viewer, query)
        imgui.end_child()
    if (chosen := viewer.state.session.query(viewer.state.session.chosen)) is not None:
        _details(viewer, chosen)


def _line(viewer: Viewer, query: Query) -> None:
    """Draw colour, phrase, verdict and a button that takes it off; the phrase gets the remaining width."""
    spacing, side = imgui.get_style().item_spacing.x, imgui.get_frame_height()
    result, left = viewer.state.result(query), imgui.get_cursor_pos_x()
    right = imgui.get_content_region_avail().x
    room = right - 2 * side - 3 * spacing
    least = min(ui.width_of(query.phrase), hello_imgui.em_size(LEAST_EM))
    verdict_width = min(ui.width_of(result.said if result else "unknown"), room - least)
    room -= verdict_width
    _swatch(viewer, query, side)
    imgui.same_line()
    chosen = viewer.state.session.chosen == query.phrase
    name = ui.elided(query.phrase, room)
    if imgui.selectable(f"{name}##phrase of list", chosen, size=ImVec2(room, 0))[0]:
        viewer.put(chosen=query.phrase)
    ui.tip(query.phrase if name != query.phrase else "")
    imgui.same_line(left + right - side - spacing - verdict_width)
    imgui.align_text_to_frame_padding()
    _verdict(viewer, query, verdict_width)
    imgui.same_line(left + right - side)
    if ui.small("x", side):
        queries.remove(viewer, query.phrase)
    ui.tip("Take it off the list")


def _swatch(viewer: Viewer, query: Query, side: float) -> None:
    shown = query.slot is not None
    red, green, blue = HIDDEN if query.slot is None else QUERY_COLOURS[query.slot]
    flags = imgui.ColorEditFlags_.no_tooltip
    if imgui.color_button("##shown", ImVec4(red, green, blue, 1.0), flags, ImVec2(side, side)):
        queries.show(viewer, query.phrase, shown=not shown)
    ui.tip("Click to hide" if shown else "Click to show")
    state, result = viewer.state, viewer.state.result(query)
    alone = state.session.picture.display == "relevancy" and len(painted(state.shown_results())) == 1
    if shown and alone and result is not None:  # painted by the colour map
        colours = bar_colours(STRENGTH[result.verdict], state.session.picture.colour_map)
        draw_bar(imgui.get_item_rect_min(), side, side, colours)


def _verdict(viewer: Viewer, query: Query, width: float) -> None:
    answer, result = viewer.state.answer(query), viewer.state.result(query)
    if answer.pending:
        ui.coloured("...")
    elif answer.problem:
        ui.coloured("unknown", "bad")
    elif result is not None:
        ui.coloured(ui.elided(result.said, width), "good" if result.found else "soft")
        ui.tip(f"{result.phrase}: {result.said}")


def _details(viewer: Viewer, query: Query) -> None:
    """Draw how a query was understood or why it was not answered, and actions on a positive answer."""
    answer, result = viewer.state.answer(query), viewer.state.result(query)
    if answer.problem:
        ui.small_wrapped(answer.problem, "bad")
    if answer.reading:
        ui.small_wrapped(f"read as: {answer.reading}")
    if result is None or result.verdict == "not here":
        return
    if ui.button("Focus", enabled=result.place is not None):
        viewpoint.focus_result(viewer, query)
    if answer.has_evidence and ui.next_button(
        "Why?", "The photographs and masks that the answer stands on, the best and the worst"
    ):
        queries.explain(viewer, query)
    if answer.like is not None and ui.next_button("Like it", "Find what is like it, too"):
        queries.answer(viewer, query.phrase, shown_with=[query.phrase], alike=True)
    _uncover(viewer, answer)
    if imgui.tree_node_ex("Threshold, scores, place", imgui.TreeNodeFlags_.no_tree_push_on_open):
        _cut(viewer, query, result)
        _scores(result)
        if result.place is not None:
            ui.coloured("at " + length_text(result.place, "  ", 2, viewer.state.origin))
            ui.tip("Where it is relevant most; world units")
        if not answer.has_evidence:
            ui.small_wrapped(NO_EVIDENCE)


def _uncover(viewer: Viewer, answer: QueryAnswer) -> None:
    """Move the view aside if a panel covers what was found: once, and not during a drag; else say so."""
    state, area = viewer.state, ui.scene_area()
    if state.open is None or state.glide is not None or not answer.things:
        return
    is_new = state.uncovered is not answer.things
    settings.put(state, uncovered=answer.things)
    corners = np.concatenate([thing.oriented.corners for thing in answer.things])
    pixels, depths = state.open.view.camera(*area.size).project(corners)
    pixels, gap = pixels + (area.left, area.top), hello_imgui.em_size(1)
    for low, high in ui.lying_over(TITLE):
        under = ((pixels >= tuple(low)) & (pixels <= tuple(high))).all(1) & (depths > 0)
        if under.mean() < 0.5:  # of the corners of boxes
            continue
        if is_new and not imgui.is_any_mouse_down():
            ends = (area.fraction(low.x - gap, 0)[0], area.fraction(high.x + gap, 0)[0])
            viewpoint.move_aside(viewer, corners, *ends)
        else:
            ui.small_wrapped("It lies below a panel: Focus goes there", "weak")


def _scores(result: QueryResult) -> None:
    for index, (name, score) in enumerate(zip(LEVELS, result.scores, strict=True)):
        if index:
            imgui.same_line()
        ui.coloured(f"{name} {score:.2f}", "ink" if index == result.level else "soft")
        ui.tip(f"The best relevancy at the level '{name}'; the brighter one answers")


# The panel.

NO_EVIDENCE = "Why? needs the masks that Train keeps beside a scene"
NEW = {False: "Replace", True: "Add"}  # what a new answer does to those that are shown
NEW_TIPS = {
    False: "The picture of the answer before goes; its row stays in the list",
    True: "Answers are painted beside those before, each in its colour",
}
LEVEL_TIPS: dict[LevelChoice, str] = {
    name: "The level that answers best" if name == "auto" else "How finely things are divided"
    for name in get_args(LevelChoice)
}


def why(viewer: Viewer) -> str:
    """Return why nothing can be searched, or why the chosen query was not answered, in one line."""
    state, query = viewer.state, viewer.state.session.query(viewer.state.session.chosen)
    problem = "" if query is None else state.answer(query).problem
    return " ".join((state.why_no_field or problem).split())


def draw(viewer: Viewer) -> None:
    """Draw the search box, the level and the list of queries."""
    state = viewer.state
    if disk.is_preview(state.path):
        ui.small_wrapped("a training so far: the scene opens when Train has finished its language field")
        return
    if state.why_no_field:
        ui.small_wrapped(state.why_no_field)
        if ui.button("Train one ...", "From the photographs of this scene, which stays as it is"):
            opening.train_language(viewer)
        return
    with ui.disabled(state.open is None):
        _box(viewer)
        _level(viewer)
    _answers(viewer)
    if viewer.engine is not None:
        basis = viewer.engine.basis
        ui.small_wrapped(basis.short, "bad" if basis.guesses else "soft")
        ui.tip(basis.long)


def _level(viewer: Viewer) -> None:
    levels = {name: name.capitalize() for name in LEVEL_TIPS}
    queries.set_level(viewer, ui.choice(levels, viewer.state.session.level, LEVEL_TIPS))
    if viewer.state.session.queries:
        ui.row("New answers")
        viewer.change("adds", adds=ui.choice(NEW, viewer.state.session.adds, NEW_TIPS))
