"""Progress, messages and figures."""

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer import actions
from langsplat_viewer.panels.style import bad, muted, small_wrapped, stoppable
from langsplat_viewer.viewer import Viewer

LEAST_LINES = 2  # of messages, however low the panel is


def draw(viewer: Viewer) -> None:
    """What is being done, what was said (the latest first), and how fast pictures are made."""
    if viewer.worker.current is not None and stoppable(*viewer.worker.current):
        actions.cancel(viewer)
    line = imgui.get_text_line_height_with_spacing()
    height = max(imgui.get_content_region_avail().y - line, LEAST_LINES * line)
    if imgui.begin_child("messages", ImVec2(0, height)):
        for message in reversed(viewer.state.messages):
            small_wrapped(message.text, bad() if message.is_error else muted())
    imgui.end_child()
    idling = hello_imgui.get_runner_params().fps_idling.is_idling
    imgui.text_colored(muted(), figures(viewer, None if idling else imgui.get_io().framerate))


def figures(viewer: Viewer, frames_per_second: float | None) -> str:
    """One line: frames per second (None: the window sleeps until something happens), backend, time and
    size of the last picture."""
    stats = viewer.state.stats
    speed = "idle" if frames_per_second is None else f"{frames_per_second:.0f} fps"
    parts = [speed, viewer.state.backend]
    if stats.width:
        parts += [f"{stats.milliseconds:.0f} ms", f"{stats.width} x {stats.height}"]
    return "   ".join(part for part in parts if part)
