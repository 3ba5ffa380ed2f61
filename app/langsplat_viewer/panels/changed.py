"""A bar over the scene, while its file is another than the one that is shown."""

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer import actions
from langsplat_viewer.panels.area import Area
from langsplat_viewer.panels.style import tip
from langsplat_viewer.viewer import Viewer

BAR = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.always_auto_resize
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_nav
)


def draw(viewer: Viewer, area: Area) -> None:
    """What has changed, and what can be done about it."""
    state = viewer.state
    if not viewer.watch.changed or state.path is None or state.opening is not None:
        return
    top = ImVec2(area.left + area.width / 2, area.top + hello_imgui.em_size(3))  # below what a tool says
    imgui.set_next_window_pos(top, imgui.Cond_.always, ImVec2(0.5, 0))
    imgui.begin("changed", None, BAR)
    imgui.align_text_to_frame_padding()
    imgui.text_unformatted(f"{state.path.name} has changed on disk")
    imgui.same_line()
    if imgui.button("Reload"):
        actions.reload(viewer)
    tip("Read it again; camera, queries and view settings stay")
    imgui.same_line()
    if imgui.button("Not now"):
        actions.keep_old(viewer)
    imgui.end()
