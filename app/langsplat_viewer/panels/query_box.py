"""The box to type a search in, and what is offered below it: examples, completions, corrections."""

from imgui_bundle import ImVec2, imgui

from langsplat_viewer import actions
from langsplat_viewer.panels.style import elided, muted, tip, width_of
from langsplat_viewer.viewer import Viewer

HINT = "what to look for"
HINT_EXAMPLES = 2
OFFER_LINES = 2  # more are scrolled to


def draw(viewer: Viewer) -> None:
    """Box, button, offers."""
    actions.prepare_suggestions(viewer)
    button = imgui.calc_text_size("Search").x + 2 * imgui.get_style().frame_padding.x
    imgui.set_next_item_width(-button - imgui.get_style().item_spacing.x)
    if actions.take_search_focus(viewer):
        imgui.set_keyboard_focus_here()
    flags = imgui.InputTextFlags_.enter_returns_true | imgui.InputTextFlags_.callback_history

    def recalled(data: imgui.InputTextCallbackData) -> int:
        text = actions.recall(viewer, -1 if data.event_key == imgui.Key.up_arrow else 1)
        data.delete_chars(0, data.buf_text_len)
        data.insert_chars(0, text)
        return 0

    typed = viewer.state.typed
    entered, typed = imgui.input_text_with_hint("##phrase", hint(viewer), typed, flags, recalled)
    actions.type_phrase(viewer, typed)
    imgui.same_line()
    clicked = imgui.button("Search")
    if entered or clicked:
        actions.ask_typed(viewer)
    _offers(viewer)


def hint(viewer: Viewer) -> str:
    """What stands in the empty box: examples of this scene, once they are known."""
    examples = viewer.state.suggestions.examples[:HINT_EXAMPLES]
    return ", ".join((*examples, "...")) if examples else HINT


def _offers(viewer: Viewer) -> None:
    """Small buttons, as many in a row as fit, where there is anything to offer."""
    title, phrases = actions.offers(viewer)
    if not phrases:
        return
    height = OFFER_LINES * imgui.get_text_line_height_with_spacing()
    if imgui.begin_child("offers", ImVec2(0, height), imgui.ChildFlags_.none):
        _buttons(viewer, title, phrases)
    imgui.end_child()


def _buttons(viewer: Viewer, title: str, phrases: tuple[str, ...]) -> None:
    imgui.text_colored(muted(), title)
    margins = 2 * imgui.get_style().frame_padding.x
    for number, phrase in enumerate(phrases):
        imgui.same_line()
        if imgui.get_content_region_avail().x < width_of(phrase) + margins:
            imgui.new_line()
        shown = elided(phrase, imgui.get_content_region_avail().x - margins, width_of)
        if imgui.small_button(f"{shown}###offer {number}"):
            actions.ask_offered(viewer, phrase)
        if shown != phrase:
            tip(phrase)
