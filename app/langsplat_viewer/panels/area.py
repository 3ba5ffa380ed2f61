"""The scene's part of the window."""

from dataclasses import dataclass

from imgui_bundle import hello_imgui, imgui

from langsplat_viewer.panels.style import PANEL_EM
from langsplat_viewer.viewer import Viewer


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
