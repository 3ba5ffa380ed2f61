"""The layout of the window: the inspector with its sections, docked windows, windows over the scene."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from imgui_bundle import ImVec2, hello_imgui, icons_fontawesome_6, imgui, imgui_ctx

from langsplat_core import registry
from langsplat_viewer.actions import queries, settings
from langsplat_viewer.commands import Command, with_key
from langsplat_viewer.jobs import one_line
from langsplat_viewer.panels import (
    dialogs,
    menus,
    outline,
    overlays,
    scene,
    search,
    select,
    theme,
    ui,
    viewpoint,
)
from langsplat_viewer.state import ViewerState
from langsplat_viewer.viewer import Viewer

INSPECTOR, FOOT = "Inspector", "Foot"  # the docks: right of the scene, and below it
TAKE_OUT = icons_fontawesome_6.ICON_FA_UP_RIGHT_FROM_SQUARE
COLUMN = 320.0  # the inspector's width at first, window units
MOST_SHARE, FOOT_SHARE = 0.36, 0.3


@dataclass(frozen=True)
class Panel:
    """A section of the inspector that folds, or a window that can be docked."""

    title: str
    draw: Callable[[Viewer], None]
    is_open: bool = False  # until it is opened or closed
    needs_scene: bool = False  # grey without one
    dock: str = INSPECTOR  # for a section; FOOT for a window; "" for what floats over the scene
    finds: str = ""  # other words that people look for

    @property
    def opens(self) -> Command:
        """The command that opens it."""
        act = partial(settings.open_panel, title=self.title)
        return Command(f"panel: {self.title}", act, finds=self.finds)


CORE_PANELS: tuple[Panel, ...] = (
    Panel(search.TITLE, search.draw, is_open=True, dock=""),
    Panel("Display", scene.draw_display, is_open=True,
          finds="background backdrop settings options preferences brightness colours color map heat"),
    Panel("Camera", viewpoint.draw_camera, needs_scene=True),
    Panel("Outline", outline.draw, finds="tree hierarchy objects things list contents inventory"),
    Panel("Selection", select.draw, needs_scene=True),
    Panel("Transform", select.draw_transform, needs_scene=True, finds="crop clean move rotate scale box"),
    Panel("Record", viewpoint.draw_record, needs_scene=True),
    Panel("Bookmarks", viewpoint.draw_bookmarks, needs_scene=True),
    Panel("Notes", overlays.draw_notes, needs_scene=True),
    Panel("Scene", scene.draw_scene),
    Panel("Train", scene.draw_training),
    Panel("Timeline", viewpoint.draw_timeline, needs_scene=True, dock=FOOT),
    Panel("Messages", scene.draw_messages, dock=FOOT, finds="log errors history console"),
)  # fmt: skip


def all_panels() -> tuple[Panel, ...]:
    """Return the panels of the window, the project's own and then those of extensions."""
    return (*CORE_PANELS, *registry.parts("panels").values())


def opened(state: ViewerState) -> list[str]:
    """Return the titles of the panels that are open."""
    kept = state.preferences.panels
    return [panel.title for panel in all_panels() if (panel.is_open if kept is None else panel.title in kept)]


def is_window(state: ViewerState, panel: Panel) -> bool:
    """Return whether a panel is a window of its own: at the foot, or taken out of the inspector."""
    return panel.dock == FOOT or panel.title in state.preferences.undocked


def params(viewer: Viewer, width: float) -> hello_imgui.DockingParams:
    """Return the docks of a window `width` units wide, and the windows in them, for hello_imgui to draw."""
    docking = hello_imgui.DockingParams()
    docking.layout_name = INSPECTOR  # what was kept of other layouts is not taken for it
    docking.docking_splits = _splits(viewer.state.preferences.ui_scale, width)
    inspector = Panel(INSPECTOR, draw_inspector, dock=INSPECTOR)
    windows = (inspector, *(panel for panel in all_panels() if panel.dock))
    docking.dockable_windows = [_window(viewer, panel) for panel in windows]
    docking.dockable_windows[0].can_be_closed = False
    # The scene itself is no panel: nothing is docked over it.
    docking.main_dock_space_node_flags = (
        imgui.DockNodeFlags_.passthru_central_node | imgui.DockNodeFlags_.no_docking_over_central_node
    )
    return docking


def _share(scale: float, width: float) -> float:
    """Return the part of a window `width` units wide that the inspector takes."""
    return min(COLUMN * scale / width, MOST_SHARE)


def _splits(scale: float, width: float) -> list[hello_imgui.DockingSplit]:
    return [
        hello_imgui.DockingSplit(ui.MAIN_DOCK, INSPECTOR, imgui.Dir.right, _share(scale, width)),
        hello_imgui.DockingSplit(ui.MAIN_DOCK, FOOT, imgui.Dir.down, FOOT_SHARE),
    ]


def _draw(viewer: Viewer, panel: Panel) -> None:
    """Draw a panel; close it where it, or the extension that it is of, fails, and say why."""
    before, io, alpha = imgui.internal.ErrorRecoveryState(), imgui.get_io(), imgui.get_style().alpha
    imgui.internal.error_recovery_store_state(before)
    try:
        with ui.disabled(panel.needs_scene and viewer.state.open is None):
            panel.draw(viewer)
    except Exception as error:  # noqa: BLE001  it would take the whole window down
        io.config_error_recovery_enable_assert = io.config_error_recovery_enable_tooltip = False
        imgui.internal.error_recovery_try_to_recover_state(before)  # ends what was begun, of any kind
        io.config_error_recovery_enable_assert = io.config_error_recovery_enable_tooltip = True
        imgui.get_style().alpha = alpha  # which it takes for 0
        settings.turn_panel(viewer, panel.title, is_open=False)
        viewer.say_error(f"the panel {panel.title} was closed: {one_line(error)}")


def _window(viewer: Viewer, panel: Panel) -> hello_imgui.DockableWindow:
    window = hello_imgui.DockableWindow(panel.title, panel.dock, lambda: _draw(viewer, panel), False)
    window.remember_is_visible = False  # the preferences do
    window.window_size = ImVec2(360, 330)
    return window


def draw_inspector(viewer: Viewer) -> None:
    """Draw the sections, each below its header, and scroll to the one that is wanted."""
    are_open, kept = opened(viewer.state), viewer.state.preferences.undocked
    right = imgui.get_cursor_pos_x() + imgui.get_content_region_avail().x
    for panel in all_panels():
        if panel.dock != INSPECTOR or panel.title in kept:
            continue
        was_open = panel.title in are_open
        imgui.set_next_item_open(was_open)
        with theme.styled(frame_border_size=0.0):
            is_open = imgui.collapsing_header(panel.title, imgui.TreeNodeFlags_.allow_overlap)
            if viewer.state.wanted_panel == panel.title:
                settings.take(viewer.state, "wanted_panel")
                imgui.set_scroll_here_y(0.0)
                window = imgui.internal.get_current_window()
                imgui.internal.set_focus_id(imgui.get_item_id(), window)  # Tab goes on from it
            left = right - ui.button_width(TAKE_OUT)
            if left > ui.width_of(f"mmm {panel.title}"):
                imgui.same_line(left)
                if imgui.small_button(f"{TAKE_OUT}##{panel.title}"):
                    settings.prefer(viewer, undocked=(*kept, panel.title))
                    settings.open_panel(viewer, panel.title)
                ui.tip("As a panel of its own, whose title drags it anywhere; its cross puts it back here")
        if is_open != was_open:
            settings.turn_panel(viewer, panel.title, is_open=not was_open)
        if was_open:
            with imgui_ctx.push_id(panel.title):
                _draw(viewer, panel)
                imgui.dummy(ImVec2(0, imgui.get_style().item_spacing.y))


def _widen(before: tuple[float, float], now: tuple[float, float]) -> None:
    """Keep the inspector's column fit for letters and window, (scale, width); by hand up to half of it."""
    window = imgui.internal.find_window_by_name(INSPECTOR)
    node = None if window is None else window.dock_node
    while node is not None and node.parent_node is not None:
        if node.parent_node.split_axis == imgui.internal.Axis.x:
            own, most = abs(node.size.x - _share(*before) * before[1]) < 2, node.size.x > now[1] / 2
            if own or most or before[0] != now[0]:
                size = ImVec2(_share(*now) * now[1], node.size.y)
                imgui.internal.dock_builder_set_node_size(node.id_, size)
            return
        node = node.parent_node


class Docks:
    """Keeps the docked windows as the state wants them."""

    def __init__(self) -> None:
        self._fit = 0.0, 0.0  # scale of the letters, and the window's width, in the last frame
        self._shown: list[str] = []  # the windows of the last frame

    def apply(self, viewer: Viewer) -> None:
        """Open, hide and raise windows, and make their column as wide as letters want; once per frame."""
        params, state = hello_imgui.get_runner_params(), viewer.state
        docking, now = params.docking_params, (state.preferences.ui_scale, imgui.get_main_viewport().size.x)
        if self._fit[0] and self._fit != now:
            _widen(self._fit, now)
        self._fit = now
        if settings.take(state, "resets_panels"):
            settings.prefer(viewer, panels=None, undocked=())
            docking.docking_splits = _splits(*now)
            docking.layout_reset = True
        settings.prefer(viewer, panels=tuple(opened(state)))
        for window in docking.dockable_windows:
            if window.label in self._shown and not window.is_visible:  # its cross was clicked
                kept = tuple(title for title in state.preferences.undocked if title != window.label)
                settings.turn_panel(viewer, window.label, is_open=kept != state.preferences.undocked)
                settings.prefer(viewer, undocked=kept)  # a section goes back, and stays open
        wanted, shown = state.wanted_panel, state.show_panel and not state.show_start
        if wanted and shown:
            settings.turn_panel(viewer, wanted, is_open=True)
        windows = {panel.title for panel in all_panels() if is_window(state, panel)} & {*opened(state)}
        for window in docking.dockable_windows:
            window.is_visible = shown and window.label in (INSPECTOR, *windows)
        self._shown = [window.label for window in docking.dockable_windows if window.is_visible]
        foot = ImVec2(0, menus.STATUS_EM if shown else 0)  # room for the status line
        params.imgui_window_params.full_screen_window_margin_bottom_right = foot
        if wanted and shown:  # in front of those that it shares its place with
            if docked := wanted in self._shown:  # the others take it when they are drawn
                settings.take(state, "wanted_panel")
            if wanted != search.TITLE:
                docking.focus_dockable_window(wanted if docked else INSPECTOR)


def draw_titles(viewer: Viewer) -> None:
    """Draw the panels in the menu Window: a click opens one, raises it from behind a tab, or closes it."""
    imgui.separator()
    are_open = opened(viewer.state)
    for panel in all_panels():
        if imgui.menu_item(panel.title, "", panel.title in are_open)[0]:
            name = panel.title if is_window(viewer.state, panel) else INSPECTOR
            window = imgui.internal.find_window_by_name(name)
            is_seen = not panel.dock or (window is not None and not window.hidden)  # not behind a tab
            if panel.title in are_open and viewer.state.show_panel and is_seen:
                settings.turn_panel(viewer, panel.title, is_open=False)
            else:
                settings.open_panel(viewer, panel.title)


# Windows over the scene.

CARD_EM, CARD_SHARE, MARGIN_EM = 22.0, 0.55, 0.8  # width of the search, its least share; around it


def draw_over(
    viewer: Viewer, start: dialogs.StartPage, toasts: dialogs.Toasts, files: dialogs.FileDialogs
) -> None:
    """Draw what lies over the scene: search, legends, tools, questions, dialogs, help and palette."""
    area = ui.scene_area()
    start.draw(viewer, area)
    menus.draw_status(viewer, [panel.title for panel in all_panels() if panel.dock == FOOT])
    free = _float_search(viewer, area, menus.draw_toolbar(viewer, area))
    state, said = viewer.state, viewer.state.nothing  # in place of an image
    if state.open is None and not state.show_start:
        work = viewer.worker.current  # which may compile for half a minute
        said = f"{work[0]} ..." if state.opening and work else "Drop a scene here, or press Ctrl+O"
    if said:
        overlays.say(said, free)
    elif not state.show_start:
        overlays.draw_legends(viewer, area, free)
        outline.draw_legend(viewer, area, free)
        overlays.draw_pointing(viewer)
        select.draw_stroke(viewer, area)
        select.draw_hint(viewer, free)
        select.draw_gizmo(viewer, area)
    overlays.draw_grip(viewer, area)
    read = search.why(viewer) if search.TITLE in opened(state) and state.show_panel else ""
    toasts.draw(viewer, area, read)
    dialogs.draw_changed(viewer, free)
    dialogs.draw_unsaved(viewer)
    dialogs.draw_export(viewer)
    files.draw(viewer)
    menus.draw_help(viewer)
    menus.draw_palette(viewer, [panel.opens for panel in all_panels()])


def _float_search(viewer: Viewer, area: ui.Area, left: float) -> ui.Area:
    """Draw the search `left` window units from the scene's edge; return what is free beside it."""
    if not viewer.state.show_panel or viewer.state.show_start:
        return area
    margin = hello_imgui.em_size(MARGIN_EM)
    room = area.width - left - margin - hello_imgui.em_size(overlays.LEAST_EM + overlays.AROUND_EM)
    width = min(hello_imgui.em_size(CARD_EM), max(CARD_SHARE * area.width, room))  # a legend fits beside it
    at = ImVec2(area.left + left + margin, area.top + margin)
    if search.TITLE not in opened(viewer.state):
        with ui.floating("Folded search", at, padding_em=0.3):
            if imgui.button(f"{icons_fontawesome_6.ICON_FA_MAGNIFYING_GLASS}##search"):
                queries.focus_search(viewer)
            ui.tip(with_key("Search", queries.focus_search))
            width = imgui.get_window_width()
        return area.right_of(left + margin + width)
    imgui.set_next_window_size_constraints(ImVec2(width, 0), ImVec2(width, area.height - 2 * margin))
    if viewer.state.wanted_panel == search.TITLE:
        settings.take(viewer.state, "wanted_panel")
        imgui.set_next_window_focus()  # for Tab and arrows
    with ui.floating(search.TITLE, at, padding_em=0.9):
        search.draw(viewer)
    return area.right_of(left + margin + width)
