"""Everything that can be done, found by typing."""

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer import actions
from langsplat_viewer.commands import Command, matching
from langsplat_viewer.panels.style import muted
from langsplat_viewer.viewer import Viewer

WIDTH_EM, HEIGHT_EM = 26.0, 20.0
GAP_EM = 0.6  # from the keys to the scrollbar


def draw(viewer: Viewer) -> None:
    """A box and the commands that match; Enter does the first, Esc closes."""
    if not viewer.state.show_palette:
        return
    top = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(ImVec2(top.x, 0.15 * top.y), imgui.Cond_.appearing, ImVec2(0.5, 0))
    imgui.set_next_window_size(hello_imgui.em_to_vec2(WIDTH_EM, HEIGHT_EM))
    imgui.set_next_window_bg_alpha(1.0)
    flags = imgui.WindowFlags_.no_title_bar | imgui.WindowFlags_.no_resize | imgui.WindowFlags_.no_collapse
    imgui.begin("Commands", None, flags)
    if imgui.is_window_appearing():
        imgui.set_keyboard_focus_here()
    imgui.set_next_item_width(-1)
    entered, typed = imgui.input_text_with_hint(
        "##command", "what to do", viewer.state.palette_typed, imgui.InputTextFlags_.enter_returns_true
    )
    actions.type_command(viewer, typed)
    found = matching(typed)
    chosen = found[0] if entered and found else _clicked(found)
    left = not imgui.is_window_focused(imgui.FocusedFlags_.root_and_child_windows)
    escaped = imgui.is_key_pressed(imgui.Key.escape)
    imgui.end()
    if chosen is not None or escaped or (left and not imgui.is_window_appearing()):
        actions.show_palette(viewer, False)
    if chosen is not None:
        chosen.act(viewer)


def _clicked(found: list[Command]) -> Command | None:
    """The list; the command that was clicked."""
    chosen = None
    if imgui.begin_child("found"):
        right = imgui.get_content_region_avail().x - hello_imgui.em_size(GAP_EM)
        for command in found:
            if imgui.selectable(command.does, False)[0]:
                chosen = command
            keys = ", ".join(command.keys)
            imgui.same_line(right - imgui.calc_text_size(keys).x)
            imgui.text_colored(muted(), keys)
    imgui.end_child()
    return chosen
