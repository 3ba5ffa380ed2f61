"""The menus: the commands by the menu that each names, and which panels are open."""

from pathlib import Path

from imgui_bundle import hello_imgui, imgui

from langsplat_viewer import actions
from langsplat_viewer.commands import MENUS, in_menu
from langsplat_viewer.files.preferences import SCALES, THEMES
from langsplat_viewer.viewer import Viewer

UI_SCALES = (0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)


def draw(viewer: Viewer) -> None:
    """Inside the menu bar."""
    for menu in MENUS:
        if imgui.begin_menu(menu):
            for command in in_menu(menu):
                title = command.does[0].upper() + command.does[1:]
                if imgui.menu_item(title, ", ".join(command.keys[:1]), False)[0]:
                    command.act(viewer)
            if menu == "File":
                _recent(viewer)
            if menu == "Window":
                _panels()
                _looks(viewer)
            imgui.end_menu()


def _recent(viewer: Viewer) -> None:
    recent = viewer.state.preferences.recent
    if imgui.begin_menu("Open recent", bool(recent)):
        for number, path in enumerate(recent):
            name = Path(path)
            if imgui.menu_item(f"{name.parent.name}/{name.name}##{number}", "", False)[0]:
                actions.open_recent(viewer, path)
            if imgui.is_item_hovered():
                imgui.set_tooltip(path)
        imgui.end_menu()
    imgui.separator()
    if imgui.menu_item("Quit", "", False)[0]:
        actions.quit_viewer(viewer)


def _panels() -> None:
    imgui.separator()
    docking = hello_imgui.get_runner_params().docking_params
    for window in docking.dockable_windows:
        _, window.is_visible = imgui.menu_item(window.label, "", window.is_visible)
    if imgui.menu_item("Panels as at first", "", False)[0]:
        docking.layout_reset = True
    imgui.separator()


def _looks(viewer: Viewer) -> None:
    preferences = viewer.state.preferences
    for theme in THEMES:
        if imgui.menu_item(f"{theme.capitalize()} theme", "", preferences.theme == theme)[0]:
            actions.set_theme(viewer, theme)
    if imgui.begin_menu("Size of letters"):
        for scale in UI_SCALES:
            if SCALES[0] <= scale <= SCALES[1]:
                chosen = abs(preferences.ui_scale - scale) < 1e-6
                if imgui.menu_item(f"{100 * scale:.0f} %", "", chosen)[0]:
                    actions.set_ui_scale(viewer, scale)
        imgui.end_menu()
