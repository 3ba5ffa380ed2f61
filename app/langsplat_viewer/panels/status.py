"""The panel "Messages"."""

from imgui_bundle import ImVec2, imgui

from langsplat_viewer.actions import opening
from langsplat_viewer.panels import ui
from langsplat_viewer.viewer import Viewer

LEAST_LINES = 2  # of messages, however low the panel is


def draw_messages(viewer: Viewer) -> None:
    """Draw progress, messages (the latest first) and the speed of images."""
    if viewer.worker.current is not None and ui.stoppable(*viewer.worker.current):
        opening.cancel(viewer)
    line = imgui.get_text_line_height_with_spacing()
    height = max(imgui.get_content_region_avail().y - line, LEAST_LINES * line)
    if imgui.begin_child("messages", ImVec2(0, height)):
        for message in reversed(viewer.state.messages):
            ui.small_wrapped(message.text, ui.bad() if message.is_error else ui.muted())
    imgui.end_child()
    imgui.text_colored(ui.muted(), figures(viewer))


def figures(viewer: Viewer) -> str:
    """Return backend, time and size of the last image, and the count of the selection, as one line."""
    stats, selected = viewer.state.stats, int(viewer.state.marks.selected.sum())
    parts = [viewer.state.backend]
    if stats.width:
        parts += [f"{stats.milliseconds:.0f} ms", f"{stats.width} x {stats.height}"]
    parts += [f"{selected:,} selected"] if selected else []
    return "   ".join(part for part in parts if part)
