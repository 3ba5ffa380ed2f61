"""Colours and small widgets that the panels share."""

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
