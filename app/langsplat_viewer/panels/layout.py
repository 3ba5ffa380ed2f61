"""The layout of the window: the table of panels, docked around the scene, and what lies over it."""

from collections.abc import Callable
from dataclasses import dataclass

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core import registry
from langsplat_viewer.actions import settings
from langsplat_viewer.panels import (
    dialogs,
    menus,
    outline,
    overlays,
    scene,
    search,
    select,
    ui,
    viewpoint,
)
from langsplat_viewer.viewer import Viewer

LEFT, MIDDLE, FOOT = "Left", "Middle", "Foot"  # docks of the column beside the scene; Search has its own
COLUMN = 345.0  # its width at first, window units
MOST_SHARE, MIDDLE_SHARE, FOOT_SHARE = 0.4, 0.44, 0.15


@dataclass(frozen=True)
class Panel:
    """A window that can be docked, resized and closed."""

    title: str
    dock: str  # where it lies until it is moved
    draw: Callable[[Viewer], None]
    is_open: bool = True  # until it is opened or closed


CORE_PANELS: tuple[Panel, ...] = (
    Panel("Search", LEFT, search.draw),
    Panel("Display", MIDDLE, scene.draw_display),
    Panel("Camera", MIDDLE, viewpoint.draw_camera),
    Panel("Scene", MIDDLE, scene.draw_scene),
    Panel("Outline", MIDDLE, outline.draw, is_open=False),
    Panel("Select", MIDDLE, select.draw, is_open=False),
    Panel("Transform", MIDDLE, select.draw_transform, is_open=False),
    Panel("Train", MIDDLE, scene.draw_training, is_open=False),
    Panel("Record", MIDDLE, viewpoint.draw_record, is_open=False),
    Panel("Bookmarks", MIDDLE, viewpoint.draw_bookmarks, is_open=False),
    Panel("Messages", FOOT, scene.draw_messages),
    Panel("Notes", MIDDLE, overlays.draw_notes, is_open=False),
)


def all_panels() -> tuple[Panel, ...]:
    """Return the panels of the window, the project's own and then those of extensions."""
    return (*CORE_PANELS, *registry.parts("panels").values())


def params(viewer: Viewer, width: float) -> hello_imgui.DockingParams:
    """Return the docks of a window `width` units wide, and the panels in them, for hello_imgui to draw."""
    docking = hello_imgui.DockingParams()
    share = min(COLUMN * viewer.state.preferences.ui_scale / width, MOST_SHARE)
    docking.docking_splits = [
        hello_imgui.DockingSplit(ui.MAIN_DOCK, LEFT, imgui.Dir.left, share),
        hello_imgui.DockingSplit(LEFT, FOOT, imgui.Dir.down, FOOT_SHARE),
        hello_imgui.DockingSplit(LEFT, MIDDLE, imgui.Dir.down, MIDDLE_SHARE),
    ]
    docking.dockable_windows = [_window(viewer, panel) for panel in all_panels()]
    # The scene itself is no panel: nothing is docked over it.
    docking.main_dock_space_node_flags = (
        imgui.DockNodeFlags_.passthru_central_node | imgui.DockNodeFlags_.no_docking_over_central_node
    )
    return docking


def _window(viewer: Viewer, panel: Panel) -> hello_imgui.DockableWindow:
    remembered = viewer.state.preferences.panels
    is_open = panel.is_open if remembered is None else panel.title in remembered
    window = hello_imgui.DockableWindow(panel.title, panel.dock, lambda: panel.draw(viewer), is_open)
    window.remember_is_visible = False  # the preferences do
    window.window_size = ImVec2(360, 330)
    return window


class Docks:
    """Keeps the panels as the state wants them."""

    def __init__(self) -> None:
        self._scale = 0.0  # of the letters, in the last frame
        self._hidden: list[str] = []  # panels that were taken away at one key

    def apply(self, viewer: Viewer) -> None:
        """Open, hide and bring back panels, and make their column as wide as letters want; once per frame."""
        docking, state = hello_imgui.get_runner_params().docking_params, viewer.state
        windows, scale = docking.dockable_windows, state.preferences.ui_scale
        if self._scale not in (0.0, scale):
            _widen(COLUMN * scale)
        self._scale = scale
        shown = state.show_panel and not state.show_start
        if not shown and not self._hidden:
            self._hidden = [window.label for window in windows if window.is_visible]
            for window in windows:
                window.is_visible = False
        elif shown and self._hidden:
            for title in self._hidden:
                docking.dockable_window_of_name(title).is_visible = True
            self._hidden = []
        if shown:
            visible = (window.label for window in windows if window.is_visible)
            settings.prefer(viewer, panels=tuple(visible))
        alone = settings.take(state, "shows_panels")
        if any(window.label in alone for window in windows):
            for window in windows:
                window.is_visible = window.label in alone
        docking.layout_reset |= settings.take(state, "resets_panels")
        title = settings.take(state, "wanted_panel") if shown else ""
        if title:  # in front of those that it shares its place with
            docking.dockable_window_of_name(title).is_visible = True
            docking.focus_dockable_window(title)


def _widen(width: float) -> None:
    """Make the column beside the scene `width` units wide, as long as it lies there."""
    docking = hello_imgui.get_runner_params().docking_params
    root = docking.dock_space_id_from_name(ui.MAIN_DOCK)
    node = imgui.internal.dock_builder_get_node(docking.dock_space_id_from_name(LEFT) or 0)
    while node is not None and node.parent_node is not None and node.parent_node.id_ != root:
        node = node.parent_node
    above = None if node is None else node.parent_node
    if node is not None and above is not None and above.split_axis == imgui.internal.Axis.x:
        width = min(width, MOST_SHARE * imgui.get_main_viewport().size.x)
        imgui.internal.dock_builder_set_node_size(node.id_, ImVec2(width, node.size.y))


def draw_over(
    viewer: Viewer, start: dialogs.StartPage, toasts: dialogs.Toasts, files: dialogs.FileDialogs
) -> None:
    """Draw what lies over the scene: legends, tools, questions, dialogs, help and palette."""
    area = ui.scene_area()
    start.draw(viewer, area)
    said = _said(viewer)
    if said:
        overlays.say(said, area)
    else:
        overlays.draw_legends(viewer, area)
        outline.draw_legend(viewer, area)
        overlays.draw_pointing(viewer)
        select.draw_stroke(viewer, area)
        select.draw_hint(viewer, area)
        select.draw_gizmo(viewer, area)
    overlays.draw_grip(viewer, area)
    menus.draw_toolbar(viewer, area)
    toasts.draw(viewer, area)
    dialogs.draw_changed(viewer, area)
    dialogs.draw_unsaved(viewer)
    dialogs.draw_export(viewer)
    files.draw(viewer)
    menus.draw_help(viewer)
    menus.draw_palette(viewer)


def _said(viewer: Viewer) -> str:
    """Return the words in place of an image; empty while there is one."""
    state = viewer.state
    if state.scene is None:
        return (
            ""
            if state.show_start
            else f"opening {state.opening.name} ..."
            if state.opening
            else "Drop a scene here, or press Ctrl+O"
        )
    return state.nothing
