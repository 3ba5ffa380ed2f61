"""The list of keys."""

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer import actions
from langsplat_viewer.commands import COMMANDS, HELD
from langsplat_viewer.viewer import Viewer

KEYS_EM, DOES_EM = 14.0, 20.0  # widths of the columns
HELP_SHARE = 0.94  # of the window's height


def rows() -> tuple[tuple[str, str], ...]:
    """(keys, what they do)."""
    commands = ((", ".join(command.keys), command.does) for command in COMMANDS)
    return (*HELD, *(row for row in commands if row[0]))


def draw(viewer: Viewer) -> None:
    """A small window that can be closed."""
    if not viewer.state.show_help:
        return
    flags = imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_collapse
    centre = imgui.get_main_viewport().get_center()
    room = imgui.get_main_viewport().work_size
    imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(room.x, HELP_SHARE * room.y))
    imgui.set_next_window_pos(centre, imgui.Cond_.appearing, ImVec2(0.5, 0.5))
    imgui.set_next_window_bg_alpha(1.0)
    _, still_open = imgui.begin("Keys", True, flags)
    actions.show_help(viewer, bool(still_open))
    _table()
    imgui.end()


def _table() -> None:
    if imgui.begin_table("keys", 2):
        imgui.table_setup_column("key", imgui.TableColumnFlags_.width_fixed, hello_imgui.em_size(KEYS_EM))
        imgui.table_setup_column("does", imgui.TableColumnFlags_.width_fixed, hello_imgui.em_size(DOES_EM))
        for key, what in rows():
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text_unformatted(key)
            imgui.table_next_column()
            imgui.text_disabled(what)
        imgui.end_table()
