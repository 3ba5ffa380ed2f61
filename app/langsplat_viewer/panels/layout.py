"""Where the panels lie: one column on the left, the scene on the rest."""

from dataclasses import dataclass

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer.panels import help, query, scene, status, view
from langsplat_viewer.panels.scene import OpenDialog
from langsplat_viewer.panels.style import MUTED, PANEL_EM
from langsplat_viewer.viewer import Viewer

PANEL = "LangSplat"


@dataclass(frozen=True)
class Area:
    """The scene's part of the window, in window units (not pixels on a high-density screen)."""

    left: float
    top: float
    width: float
    height: float

    def fraction(self, x: float, y: float) -> tuple[float, float]:
        """A window position as fractions of the area; outside [0, 1] beyond its edges."""
        return (x - self.left) / self.width, (y - self.top) / self.height


def scene_area(viewer: Viewer) -> Area:
    """What the panel leaves free, at least one unit wide."""
    display = imgui.get_io().display_size
    left = min(hello_imgui.em_size(PANEL_EM), 0.6 * display.x) if viewer.state.show_panel else 0.0
    return Area(left, 0.0, max(display.x - left, 1.0), max(display.y, 1.0))


def draw(viewer: Viewer, dialog: OpenDialog) -> None:
    """All panels."""
    area = scene_area(viewer)
    if viewer.state.show_panel:
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
    help.draw(viewer)
    if viewer.state.scene is None:
        _hint(viewer, area)


def _hint(viewer: Viewer, area: Area) -> None:
    """Says in the empty scene area what to do."""
    opening = viewer.state.opening
    text = f"opening {opening.name} ..." if opening else "Drop a scene (.ply) here, or use Open ..."
    size = imgui.calc_text_size(text)
    x = area.left + (area.width - size.x) / 2
    y = area.top + (area.height - size.y) / 2
    imgui.get_background_draw_list().add_text(ImVec2(x, y), imgui.get_color_u32(MUTED), text)
