"""Where the panels lie: one column on the left, the scene on the rest."""

from imgui_bundle import ImVec2, imgui

from langsplat_viewer.panels import help, keyboard, legend, palette, query, scene, status, view
from langsplat_viewer.panels.area import Area, scene_area
from langsplat_viewer.panels.scene import OpenDialog
from langsplat_viewer.viewer import Viewer

PANEL = "LangSplat"


def draw(viewer: Viewer, dialog: OpenDialog) -> None:
    """All panels."""
    keyboard.muted_until_clicked(viewer)
    area = scene_area(viewer)
    if viewer.state.show_panel:
        _column(viewer, dialog, area)
    said = _said(viewer)
    if said:
        legend.say(said, area)
    else:
        legend.draw(viewer, area)
    help.draw(viewer)
    palette.draw(viewer)


def _column(viewer: Viewer, dialog: OpenDialog, area: Area) -> None:
    imgui.set_next_window_pos(ImVec2(0, 0))
    imgui.set_next_window_size(ImVec2(area.left, area.height))
    flags = (
        imgui.WindowFlags_.no_title_bar
        | imgui.WindowFlags_.no_resize
        | imgui.WindowFlags_.no_move
        | imgui.WindowFlags_.no_collapse
        | imgui.WindowFlags_.no_saved_settings
        | imgui.WindowFlags_.no_bring_to_front_on_focus
    )
    imgui.begin(PANEL, None, flags)
    if imgui.begin_child("controls", ImVec2(0, -status.foot_height())):
        scene.draw(viewer, dialog)
        query.draw(viewer)
        view.draw_display(viewer)
        view.draw_camera(viewer)
    imgui.end_child()
    status.draw(viewer)
    imgui.end()


def _said(viewer: Viewer) -> str:
    """What there is to say in place of a picture; empty while there is one."""
    state = viewer.state
    if state.scene is None:
        return f"opening {state.opening.name} ..." if state.opening else "Drop a scene here, or use Open ..."
    return state.nothing
