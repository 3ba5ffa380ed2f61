"""The layout of the window: the table of panels, docked around the scene, and what lies over it."""

from collections.abc import Callable
from dataclasses import dataclass

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core import registry
from langsplat_viewer.actions import settings
from langsplat_viewer.panels import (
    display,
    files,
    menus,
    notes,
    outline,
    overlays,
    questions,
    scene,
    search,
    select,
    status,
    training,
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
    Panel("Display", MIDDLE, display.draw),
    Panel("Camera", MIDDLE, viewpoint.draw_camera),
    Panel("Scene", MIDDLE, scene.draw),
    Panel("Outline", MIDDLE, outline.draw, is_open=False),
    Panel("Select", MIDDLE, select.draw, is_open=False),
    Panel("Transform", MIDDLE, select.draw_transform, is_open=False),
    Panel("Train", MIDDLE, training.draw, is_open=False),
    Panel("Record", MIDDLE, viewpoint.draw_record, is_open=False),
    Panel("Bookmarks", MIDDLE, viewpoint.draw_bookmarks, is_open=False),
    Panel("Messages", FOOT, status.draw_messages),
    Panel("Overlays", MIDDLE, notes.draw_overlays, is_open=False),
    Panel("Notes", MIDDLE, notes.draw_notes, is_open=False),
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


def show_wanted(viewer: Viewer) -> None:
    """Open the panel that an action wants seen, in front of those it shares its place with."""
    title, docking = (
        settings.take(viewer.state, "wanted_panel"),
        hello_imgui.get_runner_params().docking_params,
    )
    titles = viewer.state.shows_panels
    for window in docking.dockable_windows if any(panel.title in titles for panel in all_panels()) else ():
        window.is_visible = window.label in titles
    settings.put(viewer.state, shows_panels=())
    docking.layout_reset |= settings.take(viewer.state, "resets_panels")
    if title:
        docking.dockable_window_of_name(title).is_visible = True
        docking.focus_dockable_window(title)


class Column:
    """Makes the column beside the scene wider when letters grow, and narrower when they shrink."""

    def __init__(self) -> None:
        self._scale: float | None = None  # of the letters, in the last frame
        self._wanted = self._given = 0.0  # width for these letters, and the one that there was room for

    def apply(self, viewer: Viewer) -> None:
        """Apply the layout and the scale of the interface; called once per frame."""
        scale = viewer.state.preferences.ui_scale
        before, self._scale = self._scale, scale
        node = _column() if before is not None and before != scale else None
        if node is not None and before is not None:
            most = max(MOST_SHARE * imgui.get_main_viewport().size.x, node.size.x)
            dragged = abs(node.size.x - self._given) > 1
            self._wanted = (node.size.x if dragged else self._wanted) * scale / before
            self._given = min(self._wanted, most)
            imgui.internal.dock_builder_set_node_size(node.id_, ImVec2(self._given, node.size.y))


def _column() -> imgui.internal.DockNode | None:
    """Return the node of the docks beside the scene, as long as it lies there."""
    docking = hello_imgui.get_runner_params().docking_params
    root = docking.dock_space_id_from_name(ui.MAIN_DOCK)
    node = imgui.internal.dock_builder_get_node(docking.dock_space_id_from_name(LEFT) or 0)
    while node is not None and node.parent_node is not None and node.parent_node.id_ != root:
        node = node.parent_node
    beside_scene = node is not None and node.parent_node is not None
    return node if beside_scene and node.parent_node.split_axis == imgui.internal.Axis.x else None


class Hiding:
    """Takes all panels away at one key, and brings back those that were there."""

    def __init__(self) -> None:
        self._hidden: list[str] = []

    def apply(self, viewer: Viewer) -> None:
        """Hide the panels or bring them back where that changed, and note which are open; once per frame."""
        docking, shown = hello_imgui.get_runner_params().docking_params, viewer.state.show_panel
        if not shown and not self._hidden:
            self._hidden = [window.label for window in docking.dockable_windows if window.is_visible]
            for window in docking.dockable_windows:
                window.is_visible = False
        elif shown and self._hidden:
            for title in self._hidden:
                docking.dockable_window_of_name(title).is_visible = True
            self._hidden = []
        if shown:
            visible = (window.label for window in docking.dockable_windows if window.is_visible)
            settings.prefer(viewer, panels=tuple(visible))


def draw_over(viewer: Viewer) -> None:
    """Draw what lies over the scene: legends, tools, questions, the file browser, help and palette."""
    area = ui.scene_area()
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
    overlays.draw_axes(viewer, area)
    menus.draw_toolbar(viewer, area)
    questions.draw_changed(viewer, area)
    questions.draw_unsaved(viewer)
    files.draw_browser(viewer)
    menus.draw_help(viewer)
    menus.draw_palette(viewer)


def _said(viewer: Viewer) -> str:
    """Return the words in place of an image; empty while there is one."""
    state = viewer.state
    if state.scene is None:
        return f"opening {state.opening.name} ..." if state.opening else "Drop a scene here, or press Ctrl+O"
    return state.nothing
