"""The toolbar: commands that have an icon, in a strip at the left edge of the scene."""

from itertools import groupby

from imgui_bundle import ImVec2, ImVec4, hello_imgui, icons_fontawesome_6, imgui

from langsplat_viewer.commands import COMMANDS, Command
from langsplat_viewer.panels.style import Area, tip
from langsplat_viewer.viewer import Viewer

GROUPS = [list(group) for _, group in groupby((c for c in COMMANDS if c.icon), lambda c: c.menu)]
SIDE_EM, GAP_EM, MARGIN_EM = 1.75, 0.3, 0.3  # of a button, between groups, around them
OPACITY = 0.95  # of a button
MOST_SHARE = 0.4  # of the scene's width
FLAGS = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_bring_to_front_on_focus
)


def draw(viewer: Viewer, area: Area) -> None:
    """A column of buttons between the titles of images and what is written at their foot, further ones where
    the scene is low; none where it is too narrow for them."""
    if viewer.state.scene is None or not viewer.state.show_panel:
        return
    side, gap, margin = (float(hello_imgui.em_size(size)) for size in (SIDE_EM, GAP_EM, MARGIN_EM))
    top = area.top + side
    places = layout([len(group) for group in GROUPS], area.height - 2 * side - 2 * margin, side, gap)
    width, height = (max(place[axis] for place in places) + side + 2 * margin for axis in (0, 1))
    if width > MOST_SHARE * area.width:
        return
    imgui.set_next_window_pos(ImVec2(area.left, top))
    imgui.set_next_window_size(ImVec2(width, height))
    imgui.set_next_window_bg_alpha(0.0)
    imgui.push_style_var(imgui.StyleVar_.window_padding, ImVec2(margin, margin))
    imgui.begin("toolbar", None, FLAGS)
    for command, (x, y) in zip((c for group in GROUPS for c in group), places, strict=True):
        imgui.set_cursor_pos(ImVec2(margin + x, margin + y))
        _button(viewer, command, side)
    imgui.end()
    imgui.pop_style_var()


def layout(sizes: list[int], room: float, side: float, gap: float) -> list[tuple[float, float]]:
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


def _button(viewer: Viewer, command: Command, side: float) -> None:
    lit = command.is_on is not None and command.is_on(viewer)
    colour = imgui.get_style_color_vec4(imgui.Col_.button_active if lit else imgui.Col_.window_bg)
    imgui.push_style_color(imgui.Col_.button, ImVec4(colour.x, colour.y, colour.z, OPACITY))
    if imgui.button(button_label(command), ImVec2(side, side)):
        command.act(viewer)
    imgui.pop_style_color()
    keys = f" ({command.keys[0]})" if command.keys else ""
    tip(command.does[0].upper() + command.does[1:] + keys)


def button_label(command: Command) -> str:
    """Return the label of a command's button: its icon, and an id that no other command has."""
    return f"{getattr(icons_fontawesome_6, f'ICON_FA_{command.icon}')}##{command.does}"
