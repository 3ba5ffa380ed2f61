"""Menus, toolbar, command palette and help, all from the table of commands; and the status line."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, icons_fontawesome_6, imgui

from langsplat_core import __version__
from langsplat_viewer.actions import editing, opening, saving, settings
from langsplat_viewer.commands import BY_MENU, COMMANDS, EXPORT_MENU, HELD, Command, matching, with_key
from langsplat_viewer.panels import theme, ui
from langsplat_viewer.viewer import Viewer


def draw_menus(viewer: Viewer, draw_titles: Callable[[Viewer], None]) -> None:
    """Draw the menus, for hello_imgui; `draw_titles` draws those of the panels."""
    for menu, commands in BY_MENU.items():
        if imgui.begin_menu(menu):
            _items(viewer, commands)
            if menu == "Window":
                draw_titles(viewer)
            imgui.end_menu()


def _items(viewer: Viewer, commands: Sequence[Command]) -> None:
    submenus = {opening.ask_for_file: _recent, saving.save_path: _exports}  # by the row above them
    for command in commands:
        if command.apart:
            imgui.separator()
        does = command.now(viewer) or command.does
        title = does[0].upper() + does[1:]
        if imgui.menu_item(title, ", ".join(command.keys[:1]), command.is_on(viewer))[0]:
            command.act(viewer)
        if command.act in submenus:
            submenus[command.act](viewer)


def _exports(viewer: Viewer) -> None:
    if imgui.begin_menu("Export", viewer.state.open is not None):
        _items(viewer, EXPORT_MENU)
        imgui.end_menu()


def _recent(viewer: Viewer) -> None:
    recent = viewer.state.preferences.recent
    if imgui.begin_menu("Open recent", bool(recent)):
        for number, path in enumerate(recent):
            name = Path(path)
            if imgui.menu_item(f"{name.parent.name}/{name.name}##{number}", "", False)[0]:
                opening.open_file(viewer, name)
            ui.tip(path)
        imgui.end_menu()


# The toolbar: commands that have an icon, in a strip at the left edge of the scene.

GROUPS = list(filter(None, ([one for one in commands if one.icon] for commands in BY_MENU.values())))
SIDE_EM, GAP_EM, EDGE_EM = 1.8, 0.4, 0.3  # of a button, between menus, within the strip
LEAST = 0.8  # of a button's side; a strip that is lower has more columns


def draw_toolbar(viewer: Viewer, area: ui.Area) -> float:
    """Draw the buttons over the scene's left edge; return how far they reach into the scene."""
    if viewer.state.open is None or not viewer.state.show_panel or viewer.state.show_start:
        return 0.0
    side, gap, edge = (float(hello_imgui.em_size(size)) for size in (SIDE_EM, GAP_EM, EDGE_EM))
    margin, rest = 2 * gap, (len(GROUPS) - 1) * gap + 2 * edge
    room, most = area.height - 2 * margin, max(map(len, GROUPS))
    rows = [sum(-(-len(group) // columns) for group in GROUPS) for columns in range(1, most + 1)]
    columns = next((c for c, high in enumerate(rows, 1) if LEAST * side * high + rest <= room), most)
    count = rows[columns - 1]
    side = max(min(side, (room - rest) / count), LEAST * side)
    at = ImVec2(area.left + margin, area.top + margin)
    wide, high = columns * side + 2 * edge, count * side + rest
    imgui.set_next_window_size(ImVec2(wide, min(high, room)))
    with ui.floating("Tools", at, flags=ui.OVER | ui.FIXED, padding_em=EDGE_EM):
        none = ImVec2(0, 0)
        with theme.styled(item_spacing=none, frame_padding=none, frame_border_size=0.0):
            for group in GROUPS:
                if group is not GROUPS[0]:
                    imgui.dummy(ImVec2(side, gap))
                for place, command in enumerate(group):
                    if place % columns:
                        imgui.same_line()
                    _tool_button(viewer, command, side)
    return margin + wide


def _tool_button(viewer: Viewer, command: Command, side: float) -> None:
    lit = command.is_on(viewer)
    with theme.styled(button="pressed" if lit else theme.CLEAR, text="accent" if lit else "ink"):
        clicked = imgui.button(button_label(command), ImVec2(side, side))
    if clicked:
        command.act(viewer)
    ui.tip(with_key(command.does[0].upper() + command.does[1:], command.act))


def button_label(command: Command) -> str:
    """Return the label of a command's button: its icon, and an id that no other command has."""
    return f"{getattr(icons_fontawesome_6, f'ICON_FA_{command.icon}')}##{command.does}"


# The status line.

STATUS_EM, BAR_EM = 2.2, 18.0
DRAWN_BY = {"cpu": "the processor", "opengl": "OpenGL", "cuda": "CUDA", "": "nothing yet"}


def draw_status(viewer: Viewer, foot: Sequence[str]) -> None:
    """Draw the work under way with its Cancel, the figures, and buttons of the panels titled `foot`."""
    if not viewer.state.show_panel or viewer.state.show_start:
        return
    flags = imgui.WindowFlags_.no_scrollbar | imgui.WindowFlags_.no_saved_settings
    window, high = imgui.get_main_viewport(), hello_imgui.em_size(STATUS_EM)
    imgui.internal.begin_viewport_side_bar("Status line", window, imgui.Dir.down, high, flags)
    imgui.push_style_var(imgui.StyleVar_.frame_padding, hello_imgui.em_to_vec2(0.6, 0.1))
    imgui.set_cursor_pos_y((imgui.get_window_height() - imgui.get_frame_height()) / 2)
    right = imgui.get_cursor_pos_x() + imgui.get_content_region_avail().x
    right -= sum(ui.button_width(title) + imgui.get_style().item_spacing.x for title in foot)
    imgui.align_text_to_frame_padding()
    work = viewer.worker.current
    if work is not None:
        if ui.stoppable(*work, BAR_EM):
            opening.cancel(viewer)
        imgui.same_line()
    for text, about in figures(viewer):
        if imgui.get_cursor_pos_x() + ui.width_of(text) > right:
            break
        ui.coloured(text)
        ui.tip(about)
        imgui.same_line(0, hello_imgui.em_size(1.4))
    imgui.same_line(right)
    for title in foot:
        is_open = title in (viewer.state.preferences.panels or ())
        with theme.styled(text="accent" if is_open else "ink"):
            clicked = imgui.button(f"{title}##status")
        if clicked:
            settings.turn_panel(viewer, title, is_open=not is_open)
        imgui.same_line()
    imgui.pop_style_var()
    imgui.end()


def figures(viewer: Viewer) -> Iterator[tuple[str, str]]:
    """Yield figures of a training, the scene, the selection and the image: words and their tip."""
    state, stats = viewer.state, viewer.state.stats
    if viewer.training is not None:
        progress = viewer.training.progress
        name, done = viewer.training.out.name, 100 * progress.stages.get(progress.stage, 0)
        yield f"training {name}: {progress.stage or 'starting'}, {done:.0f} %", "Stop is in the panel Train"
    if state.path is not None:
        yield f"{state.path.name}: {state.count:,} Gaussians", str(state.path)
    selected = np.count_nonzero(state.marks.selected)
    if selected:
        yield f"{selected:,} selected", with_key("Selected Gaussians; none", editing.select_none)
    if stats.width:
        size = f"{stats.width} x {stats.height} pixels in {stats.milliseconds:.0f} ms"
        yield size, "Size of the last image of the scene, and the time that it took to draw"
        yield f"drawn by {DRAWN_BY[state.backend]}", "Another is chosen on the command line: --backend"


# The command palette: the project's own, since that of imgui-bundle shows no keys, sorts by name and does not
# grow with the text.

WIDTH_EM, HEIGHT_EM = 26.0, 20.0


def draw_palette(viewer: Viewer, panels: Sequence[Command]) -> None:
    """Draw the palette: a box and the commands that match; Enter does the first.

    `panels`: the commands that open them.
    """
    if not viewer.state.show_palette:
        return
    top = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(ImVec2(top.x, 0.15 * top.y), imgui.Cond_.always, ImVec2(0.5, 0))
    imgui.set_next_window_size(ui.fitting(WIDTH_EM, HEIGHT_EM))
    flags = imgui.WindowFlags_.no_title_bar | imgui.WindowFlags_.no_resize | imgui.WindowFlags_.no_collapse
    with theme.styled(window_border_size=1.0):
        imgui.begin("Commands", None, flags)
    if imgui.is_window_appearing():
        viewer.state.drafts.pop("##command", None)
        imgui.set_keyboard_focus_here()
    drafts = viewer.state.drafts
    entered, typed = ui.box("##command", "what to do", drafts.get("##command", ""))
    typing, drafts["##command"] = imgui.is_item_active(), typed
    found = matching(typed, panels, viewer.state.preferences.recent)
    chosen = found[0] if entered and found else _clicked(found, typing)
    left = not imgui.is_window_focused(imgui.FocusedFlags_.root_and_child_windows)
    imgui.end()
    if chosen is not None or left:
        settings.put(viewer.state, show_palette=False)
    if chosen is not None:
        chosen.act(viewer)


def _clicked(found: list[Command], typing: bool) -> Command | None:
    """Draw the list; return the command that was clicked, or chosen by the arrows and Enter."""
    chosen = None
    if imgui.begin_child("found", child_flags=imgui.ChildFlags_.nav_flattened):
        if not found:
            ui.coloured("no command has these words")
        right = imgui.get_content_region_avail().x - hello_imgui.em_size(0.6)  # to the scrollbar
        for place, command in enumerate(found):  # Enter does the one that is lit
            if imgui.selectable(command.does, place == 0 and typing)[0]:
                chosen = command
            keys = ", ".join(command.keys)
            imgui.same_line(right - ui.width_of(keys))
            ui.coloured(keys)
    imgui.end_child()
    return chosen


# Help: first steps, and the list of keys.

KEYS_EM, DOES_EM = 13.0, 26.0  # widths of the columns
FIRST_STEPS = (
    ("Look", "Drag turns the view, the right button moves it, the wheel goes nearer; double click what to "
     "turn around. R leads back."),
    ("Search", "Type into the box and press Enter{examples}. Tab completes, arrow up recalls."),
    ("Found, weak match, not here", "What the scene says of a phrase. Only what may be there is painted, "
     "and a weak match no hotter than half."),
    ("Relevancy", "From 0 to 1: how much nearer a place is to the phrase than to everyday words; "
     "0.5 is neither. What has less than the threshold is no part of the answer."),
    ("Subpart, part, whole", "How finely things are divided: the knob, the lid, the teapot."),
    ("Displays, tools", "The strip at the left edge. The section Outline lists what the scene holds."),
    ("Everything else", "Ctrl + Shift + P finds every command by its words. Without a mouse: Ctrl + Tab goes "
     "to the next panel, Tab and arrows travel in it."),
)  # fmt: skip


def draw_help(viewer: Viewer) -> None:
    """Draw the help: first steps, and the list of keys."""
    if not viewer.state.show_help:
        return
    flags = imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_collapse
    centre, room = imgui.get_main_viewport().get_work_center(), imgui.get_main_viewport().work_size
    imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(room.x, ui.MOST_OVER * room.y))
    imgui.set_next_window_pos(centre, imgui.Cond_.always, ImVec2(0.5, 0.5))
    with theme.styled(window_border_size=1.0):
        _, still_open = imgui.begin("Help", True, flags)
    settings.put(viewer.state, show_help=bool(still_open))
    pages = imgui.is_key_pressed(imgui.Key.page_down) - imgui.is_key_pressed(imgui.Key.page_up)
    imgui.set_scroll_y(imgui.get_scroll_y() + pages * imgui.get_window_height() / 2)
    if imgui.begin_tab_bar("pages"):
        keys = [(", ".join(command.keys), command.does) for command in COMMANDS if command.keys]
        examples = ", ".join(f"'{phrase}'" for phrase in viewer.state.suggestions.examples)
        for title, rows in (("First steps", FIRST_STEPS), ("Keys", (*HELD, *keys))):
            if imgui.begin_tab_item(title)[0]:
                _table(rows, f": {examples}" if examples else "")
                imgui.end_tab_item()
        imgui.end_tab_bar()
    ui.small_wrapped(f"LangSplat viewer {__version__}; documentation: docs/README.md of its source")
    imgui.end()


def _table(rows: Sequence[tuple[str, str]], examples: str) -> None:
    """Draw two columns or, in a window too narrow for them, one below the other."""
    style, left, right = imgui.get_style(), hello_imgui.em_size(KEYS_EM), hello_imgui.em_size(DOES_EM)
    room = imgui.get_main_viewport().work_size.x - 4 * style.window_padding.x - style.scrollbar_size
    widths = (left, min(right, room - left)) if room > 2 * left else (min(right, room),)
    if imgui.begin_table("rows", len(widths)):
        for width in widths:
            imgui.table_setup_column("", imgui.TableColumnFlags_.width_fixed, width)
        for what, does in rows:
            imgui.table_next_column()
            imgui.text_wrapped(what)
            imgui.table_next_column()
            ui.small_wrapped(does.replace("{examples}", examples))
        imgui.end_table()
