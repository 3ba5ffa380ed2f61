"""The scene's part of the window."""

from dataclasses import dataclass

from imgui_bundle import hello_imgui, imgui

MAIN_DOCK = "MainDockSpace"  # hello_imgui's name for the whole window below the menus


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


def scene_area() -> Area:
    """What menus and docked panels leave free, at least one unit wide and high."""
    dock = hello_imgui.get_runner_params().docking_params.dock_space_id_from_name(MAIN_DOCK)
    node = imgui.internal.dock_builder_get_central_node(dock) if dock else None
    if node is None:  # in the first frame
        display = imgui.get_io().display_size
        return Area(0.0, 0.0, max(display.x, 1.0), max(display.y, 1.0))
    return Area(node.pos.x, node.pos.y, max(node.size.x, 1.0), max(node.size.y, 1.0))
