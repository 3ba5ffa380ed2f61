"""The list of keys."""

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer import actions
from langsplat_viewer.panels.view import BUTTONS
from langsplat_viewer.viewer import Viewer

KEYS = (
    ("left drag", "turn around the centre"),
    ("right drag, Shift + left drag", "move sideways"),
    ("Ctrl + left drag", "look around from here"),
    ("wheel", "nearer, farther"),
    ("double click", "turn around the surface under the cursor"),
    ("W A S D, Q E", "fly ahead, left, back, right, down, up"),
    ("Shift, Alt", "fly faster, slower"),
    ("[ ]", "roll"),
    ("R", "whole scene"),
    ("F", "focus on the latest result found"),
    (", .", "previous, next training camera"),
    (f"1 ... {len(BUTTONS)}", "display, in the panel's order"),
    ("/", "type a search"),
    ("Tab", "hide or show the panel"),
    ("P", "save a picture"),
    ("F1", "this list"),
)


def draw(viewer: Viewer) -> None:
    """A small window that can be closed."""
    if not viewer.state.show_help:
        return
    flags = imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_collapse
    centre = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(centre, imgui.Cond_.appearing, ImVec2(0.35, 0.5))
    imgui.set_next_window_bg_alpha(1.0)
    _, still_open = imgui.begin("Keys", True, flags)
    actions.show_help(viewer, bool(still_open))
    if imgui.begin_table("keys", 2):
        imgui.table_setup_column("key", imgui.TableColumnFlags_.width_fixed, hello_imgui.em_size(14))
        imgui.table_setup_column("does", imgui.TableColumnFlags_.width_fixed, hello_imgui.em_size(17))
        for key, what in KEYS:
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text(key)
            imgui.table_next_column()
            imgui.text_disabled(what)
        imgui.end_table()
    imgui.end()
