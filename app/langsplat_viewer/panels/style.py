"""Colours and small widgets that the panels share."""

from collections.abc import Callable

from imgui_bundle import ImVec4, imgui

GOOD = ImVec4(0.47, 0.80, 0.52, 1.0)
BAD = ImVec4(0.95, 0.58, 0.45, 1.0)
MUTED = ImVec4(0.62, 0.64, 0.67, 1.0)
PANEL_EM = 23.0  # width of the panel, in heights of a letter


def small_wrapped(text: str, colour: ImVec4) -> None:
    """Text of any length, wrapped at the panel's edge."""
    imgui.push_style_color(imgui.Col_.text, colour)
    imgui.text_wrapped(text.replace("%", "%%"))
    imgui.pop_style_color()


def elided(text: str, room: float, width_of: Callable[[str], float]) -> str:
    """`text` in one line, cut with "..." where it is wider than `room`."""
    text = " ".join(text.split())
    if width_of(text) <= room:
        return text
    low, high = 0, len(text)  # as many letters as fit
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if width_of(text[:middle] + "...") <= room else (low, middle - 1)
    return text[:low].rstrip() + "..."
