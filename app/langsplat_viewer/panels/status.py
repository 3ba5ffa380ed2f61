"""The panels "Messages" and "Timing"."""

from imgui_bundle import ImVec2, imgui

from langsplat_viewer.actions import opening, settings
from langsplat_viewer.panels import ui
from langsplat_viewer.state import memory_bytes
from langsplat_viewer.viewer import Viewer

# The panel "Messages".

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


# The panel "Timing".


def draw_timing(viewer: Viewer) -> None:
    """Draw the panel "Timing": medians of the last images, and memory."""
    settings.put(viewer.state.timing, wanted=True)
    rows = [(title, f"{milliseconds:.1f} ms") for title, milliseconds in viewer.state.timing.medians()]
    memory = memory_bytes()
    if memory is not None:
        rows.append(("Memory", ui.in_words(memory)))
    if imgui.begin_table("timing", 2):
        imgui.table_setup_column("step", imgui.TableColumnFlags_.width_stretch, 5)
        imgui.table_setup_column("time", imgui.TableColumnFlags_.width_stretch, 4)
        for title, text in rows:
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text(title)
            imgui.table_next_column()
            imgui.text_colored(ui.muted(), text)
        imgui.end_table()
