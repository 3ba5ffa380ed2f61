"""The layout of the window: menus, toolbar, command palette, help, docked panels, messages and timing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from imgui_bundle import ImVec2, ImVec4, hello_imgui, icons_fontawesome_6, imgui

from langsplat_core import __version__, registry
from langsplat_viewer.actions import browsing, opening, settings
from langsplat_viewer.commands import COMMANDS, HELD, LETTERS_MENU, MENUS, Command, in_menu, matching
from langsplat_viewer.panels import layout, outline, overlays, scene, search, select, ui, view
from langsplat_viewer.panels.scene import in_words
from langsplat_viewer.state import memory_bytes
from langsplat_viewer.viewer import Viewer


def draw_menus(viewer: Viewer) -> None:
    for menu in MENUS:
        if imgui.begin_menu(menu):
            first, *others = in_menu(menu)
            _items(viewer, [first])
            if menu == "File":
                _recent(viewer)
            _items(viewer, others)
            if menu == "Window":
                _panels()
                if imgui.begin_menu(LETTERS_MENU):
                    _items(viewer, in_menu(LETTERS_MENU))
                    imgui.end_menu()
            imgui.end_menu()


def _items(viewer: Viewer, commands: list[Command]) -> None:
    for command in commands:
        if command.apart:
            imgui.separator()
        title = command.does[0].upper() + command.does[1:]
        is_on = command.is_on is not None and command.is_on(viewer)
        if imgui.menu_item(title, ", ".join(command.keys[:1]), is_on)[0]:
            command.act(viewer)


def _recent(viewer: Viewer) -> None:
    recent = viewer.state.preferences.recent
    if imgui.begin_menu("Open recent", bool(recent)):
        for number, path in enumerate(recent):
            name = Path(path)
            if imgui.menu_item(f"{name.parent.name}/{name.name}##{number}", "", False)[0]:
                browsing.open_recent(viewer, path)
            if imgui.is_item_hovered():
                imgui.set_tooltip(path)
        imgui.end_menu()


def _panels() -> None:
    imgui.separator()
    docking = hello_imgui.get_runner_params().docking_params
    for window in docking.dockable_windows:
        _, window.is_visible = imgui.menu_item(window.label, "", window.is_visible)
    imgui.separator()


# The command palette.

WIDTH_EM, HEIGHT_EM = 26.0, 20.0
GAP_EM = 0.6  # from the keys to the scrollbar


def draw_palette(viewer: Viewer) -> None:
    """Draw the palette: a box and the commands that match; Enter does the first, Esc closes."""
    if not viewer.state.show_palette:
        return
    top = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(ImVec2(top.x, 0.15 * top.y), imgui.Cond_.always, ImVec2(0.5, 0))
    imgui.set_next_window_size(ui.fitting(WIDTH_EM, HEIGHT_EM))
    imgui.set_next_window_bg_alpha(1.0)
    flags = imgui.WindowFlags_.no_title_bar | imgui.WindowFlags_.no_resize | imgui.WindowFlags_.no_collapse
    imgui.begin("Commands", None, flags)
    if imgui.is_window_appearing():
        viewer.state.drafts.pop("##command", None)
        imgui.set_keyboard_focus_here()
    drafts = viewer.state.drafts
    entered, typed = ui.box("##command", "what to do", drafts.get("##command", ""))
    typing, drafts["##command"] = imgui.is_item_active(), typed
    found = matching(typed, viewer.state.preferences.recent)
    chosen = found[0] if entered and found else _clicked(found, typing)
    left = not imgui.is_window_focused(imgui.FocusedFlags_.root_and_child_windows)
    escaped = imgui.is_key_pressed(imgui.Key.escape)
    imgui.end()
    if chosen is not None or escaped or (left and not imgui.is_window_appearing()):
        settings.show_palette(viewer, False)
    if chosen is not None:
        chosen.act(viewer)


def _clicked(found: list[Command], typing: bool) -> Command | None:
    """The list; the command that was clicked, or chosen by the arrows and Enter."""
    chosen = None
    if imgui.begin_child("found", child_flags=imgui.ChildFlags_.nav_flattened):
        if not found:
            imgui.text_colored(ui.muted(), "no command has these words")
        right = imgui.get_content_region_avail().x - hello_imgui.em_size(GAP_EM)
        for place, command in enumerate(found):  # Enter does the one that is lit
            if imgui.selectable(command.does, place == 0 and typing)[0]:
                chosen = command
            keys = ", ".join(command.keys)
            imgui.same_line(right - imgui.calc_text_size(keys).x)
            imgui.text_colored(ui.muted(), keys)
    imgui.end_child()
    return chosen


# Help: first steps, and the list of keys.

KEYS_EM, DOES_EM = 13.0, 26.0  # widths of the columns
FIRST_STEPS = (
    ("Look", "Drag turns the view, the right button moves it, the wheel goes nearer; double click what to "
     "turn around. R leads back."),
    ("Search", "Type into the box and press Enter: 'red mug', 'handle of the mug', 'book on the table', "
     "'three books', 'toy, not teddy bear'. Tab completes, arrow up recalls."),
    ("What is here", "The panel Outline, in the menu Window, lists what the scene holds; a right click on a "
     "thing names it, hides it, or finds more like it."),
    ("Found, weak match, not here", "What the scene says of a phrase. Only what may be there is painted, "
     "and a weak match no hotter than half."),
    ("Relevancy", "From 0 to 1: how much nearer a place is to the phrase than to the everyday words under "
     "'Compared with'; 0.5 is neither. The answer 'ends at' a relevancy: what has less is no part of it. The "
     "slider moves that end, Auto gives the answer's own back."),
    ("Subpart, part, whole", "How finely things are divided: the handle, the cup, the cup with its saucer. "
     "'auto' takes the level that answers best."),
    ("Displays", "The strip at the left edge: colours, depth, heat map, segmentation, the latent language "
     "field as colours, the tree of parts; two side by side."),
    ("Select", "Click a thing with the pointing hand, draw around it, or take what the search found; then "
     "hide, name, measure, move or save it."),
    ("Everything else", "Ctrl + Shift + P finds every command by its words. Without a mouse: Ctrl + Tab goes "
     "to the next panel, Tab and arrows travel in it."),
)  # fmt: skip


def draw_help(viewer: Viewer) -> None:
    if not viewer.state.show_help:
        return
    flags = imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_collapse
    area, room = ui.scene_area(), imgui.get_main_viewport().work_size
    half = hello_imgui.em_size(KEYS_EM + DOES_EM + 4) / 2
    centre = ImVec2(min(area.left + area.width / 2, room.x - half), area.top + area.height / 2)
    imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(room.x, ui.MOST_OVER * room.y))
    imgui.set_next_window_pos(centre, imgui.Cond_.always, ImVec2(0.5, 0.5))
    imgui.set_next_window_bg_alpha(1.0)
    _, still_open = imgui.begin("Help", True, flags)
    settings.put(viewer.state, show_help=bool(still_open))
    imgui.text_disabled(f"LangSplat viewer {__version__}; documentation: docs/README.md of its source")
    if imgui.begin_tab_bar("pages"):
        keys = [(", ".join(command.keys), command.does) for command in COMMANDS if command.keys]
        for title, rows in (("First steps", FIRST_STEPS), ("Keys", (*HELD, *keys))):
            if imgui.begin_tab_item(title)[0]:
                _table(rows)
                imgui.end_tab_item()
        imgui.end_tab_bar()
    imgui.end()


def _table(rows: Sequence[tuple[str, str]]) -> None:
    if imgui.begin_table("rows", 2):
        imgui.table_setup_column("what", imgui.TableColumnFlags_.width_fixed, hello_imgui.em_size(KEYS_EM))
        imgui.table_setup_column("does", imgui.TableColumnFlags_.width_fixed, hello_imgui.em_size(DOES_EM))
        for what, does in rows:
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text_unformatted(what)
            imgui.table_next_column()
            ui.small_wrapped(does, ui.muted())
        imgui.end_table()


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
        rows.append(("Memory", in_words(memory)))
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


# Panels, docked around the scene, each where its user left it.

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
    Panel("Display", MIDDLE, view.draw_display),
    Panel("Camera", MIDDLE, view.draw_camera),
    Panel("Scene", MIDDLE, scene.draw),
    Panel("Outline", MIDDLE, outline.draw, is_open=False),
    Panel("Select", MIDDLE, select.draw, is_open=False),
    Panel("Transform", MIDDLE, select.draw_transform, is_open=False),
    Panel("Train", MIDDLE, scene.draw_training, is_open=False),
    Panel("Record", MIDDLE, view.draw_record, is_open=False),
    Panel("Bookmarks", MIDDLE, view.draw_bookmarks, is_open=False),
    Panel("Messages", FOOT, draw_messages),
    Panel("Overlays", MIDDLE, view.draw_overlays, is_open=False),
    Panel("Notes", MIDDLE, view.draw_notes, is_open=False),
    Panel("Timing", MIDDLE, draw_timing, is_open=False),
)


def all_panels() -> tuple[Panel, ...]:
    """Return the panels of the window, the project's own and then those of extensions."""
    return (*CORE_PANELS, *registry.parts("panels").values())


def params(viewer: Viewer, width: float) -> hello_imgui.DockingParams:
    """The docks of a window `width` units wide, and the panels in them, for hello_imgui to draw."""
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
    """The node of the docks beside the scene, as long as it lies there."""
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
    overlays.draw_cube(viewer, area)
    layout.draw_toolbar(viewer, area)
    scene.draw_changed(viewer, area)
    scene.draw_unsaved(viewer)
    copied = settings.take(viewer.state.record, "clipboard")
    if copied:
        imgui.set_clipboard_text(copied)
    scene.draw_browser(viewer)
    draw_help(viewer)
    draw_palette(viewer)


def _said(viewer: Viewer) -> str:
    """Return the words in place of an image; empty while there is one."""
    state = viewer.state
    if state.scene is None:
        return f"opening {state.opening.name} ..." if state.opening else "Drop a scene here, or press Ctrl+O"
    return state.nothing


# The toolbar: commands that have an icon, in a strip at the left edge of the scene.

GROUPS = [list(group) for _, group in groupby((c for c in COMMANDS if c.icon), lambda c: c.menu)]
SIDE_EM, GROUP_GAP_EM, MARGIN_EM = 1.75, 0.3, 0.3  # of a button, between groups, around them
OPACITY = 0.95  # of a button
MOST_OF_SCENE = 0.4  # of the scene's width


def draw_toolbar(viewer: Viewer, area: ui.Area) -> None:
    """A column of buttons between the titles of images and what is written at their foot, further ones where
    the scene is low; none where it is too narrow for them."""
    if viewer.state.scene is None or not viewer.state.show_panel:
        return
    side, gap, margin = (float(hello_imgui.em_size(size)) for size in (SIDE_EM, GROUP_GAP_EM, MARGIN_EM))
    top = area.top + side
    places = toolbar_places([len(group) for group in GROUPS], area.height - 2 * side - 2 * margin, side, gap)
    width, height = (max(place[axis] for place in places) + side + 2 * margin for axis in (0, 1))
    if width > MOST_OF_SCENE * area.width:
        return
    imgui.set_next_window_pos(ImVec2(area.left, top))
    imgui.set_next_window_size(ImVec2(width, height))
    imgui.set_next_window_bg_alpha(0.0)
    imgui.push_style_var(imgui.StyleVar_.window_padding, ImVec2(margin, margin))
    imgui.begin("toolbar", None, ui.OVER | ui.FIXED)
    for command, (x, y) in zip((c for group in GROUPS for c in group), places, strict=True):
        imgui.set_cursor_pos(ImVec2(margin + x, margin + y))
        _tool_button(viewer, command, side)
    imgui.end()
    imgui.pop_style_var()


def toolbar_places(sizes: list[int], room: float, side: float, gap: float) -> list[tuple[float, float]]:
    """Places (x, y) of the buttons of groups of `sizes`, in columns not higher than `room`; a group begins a
    new column where it does not fit into the rest of the last one."""
    places: list[tuple[float, float]] = []
    x = y = 0.0
    for size in sizes:
        if places and y + size * side > room:
            x, y = x + side, 0.0
        for _ in range(size):
            if y and y + side > room:
                x, y = x + side, 0.0
            places.append((x, y))
            y += side
        y += gap
    return places


def _tool_button(viewer: Viewer, command: Command, side: float) -> None:
    lit = command.is_on is not None and command.is_on(viewer)
    colour = imgui.get_style_color_vec4(imgui.Col_.button_active if lit else imgui.Col_.window_bg)
    imgui.push_style_color(imgui.Col_.button, ImVec4(colour.x, colour.y, colour.z, OPACITY))
    if imgui.button(button_label(command), ImVec2(side, side)):
        command.act(viewer)
    imgui.pop_style_color()
    keys = f" ({command.keys[0]})" if command.keys else ""
    ui.tip(command.does[0].upper() + command.does[1:] + keys)


def button_label(command: Command) -> str:
    """Return the label of a command's button: its icon, and an id that no other command has."""
    return f"{getattr(icons_fontawesome_6, f'ICON_FA_{command.icon}')}##{command.does}"
