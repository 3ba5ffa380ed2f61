"""The left button while a tool selects: what it draws over the scene, and what is selected as it goes up."""

from typing import Any

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.arrays import Array
from langsplat_viewer import actions, marks
from langsplat_viewer.marks import Mode, Tool
from langsplat_viewer.panels.area import Area
from langsplat_viewer.panels.legend import QUIET
from langsplat_viewer.rendering.request import TINT
from langsplat_viewer.viewer import Viewer

HINTS: dict[Tool, str] = {
    "thing": "click a thing",
    "rectangle": "drag from corner to corner",
    "lasso": "draw around it",
    "brush": "paint over it",
    "sphere": "drag from the middle outwards, or click",
    "box": "drag from the middle outwards, or click",
}
KEYS = "Shift adds, Ctrl removes, both intersect; Esc leaves"
LIGHT, DARK = (1.0, 1.0, 1.0, 0.95), (0.0, 0.0, 0.0, 0.6)  # a line in two colours is seen on every picture
PAINT = (float(TINT[0]), float(TINT[1]), float(TINT[2]), 0.35)


def handle(viewer: Viewer, area: Area) -> None:
    """Once per frame: begin, go on with, or end a stroke."""
    io, selection = imgui.get_io(), viewer.state.selection
    if selection.tool is None:
        return
    place = area.fraction(io.mouse_pos.x, io.mouse_pos.y)
    if selection.stroke is None:
        if imgui.is_mouse_clicked(imgui.MouseButton_.left) and not io.want_capture_mouse:
            actions.begin_stroke(viewer, *place)
    elif imgui.is_mouse_down(imgui.MouseButton_.left):
        actions.extend_stroke(viewer, *place)
    else:
        actions.extend_stroke(viewer, *place)
        actions.end_stroke(viewer, held_mode())


def held_mode() -> Mode | None:
    """The mode that keys ask for; None: the one that is set."""
    io = imgui.get_io()
    if io.key_shift and io.key_ctrl:
        return "intersect"
    return "add" if io.key_shift else "remove" if io.key_ctrl else None


def draw(viewer: Viewer, area: Area) -> None:
    """The outline of what is being enclosed, the brush, and how the tool works."""
    selection = viewer.state.selection
    if selection.tool is None or viewer.state.scene is None:
        return
    paint = imgui.get_foreground_draw_list()
    paint.push_clip_rect(ImVec2(area.left, area.top), ImVec2(area.left + area.width, area.top + area.height))
    drawn, radius = actions.drawn_stroke(viewer), selection.brush * area.height
    for line in marks.outlines(drawn) if drawn is not None else []:
        points = _on_screen(line, area)
        if selection.tool == "brush":
            _stripe(paint, points, radius)
        else:
            _line(paint, points)
    io = imgui.get_io()
    if selection.tool == "brush" and (drawn is not None or not io.want_capture_mouse):
        paint.add_circle(io.mouse_pos, radius, _packed(DARK), 0, 3.0)
        paint.add_circle(io.mouse_pos, radius, _packed(LIGHT), 0, 1.0)
    paint.pop_clip_rect()
    _hint(selection.tool, area)


def _on_screen(line: Array, area: Area) -> list[Any]:
    """(K, 2) fractions of the area -> window units."""
    return [ImVec2(area.left + u * area.width, area.top + v * area.height) for u, v in line.tolist()]


def _line(paint: Any, points: list[Any]) -> None:
    paint.add_polyline(points, _packed(DARK), 3.0, 0)
    paint.add_polyline(points, _packed(LIGHT), 1.5, 0)


def _stripe(paint: Any, points: list[Any], radius: float) -> None:
    """The way of the brush, as wide as it is; of a click a disk."""
    if len(points) == 1:
        paint.add_circle_filled(points[0], radius, _packed(PAINT))
    else:
        paint.add_polyline(points, _packed(PAINT), 2 * radius, 0)


def _hint(tool: Tool, area: Area) -> None:
    top = ImVec2(area.left + area.width / 2, area.top + hello_imgui.em_size(0.7))
    imgui.set_next_window_pos(top, imgui.Cond_.always, ImVec2(0.5, 0))
    imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(0.95 * area.width, area.height))
    imgui.set_next_window_bg_alpha(0.75)
    imgui.begin("tool", None, QUIET)
    imgui.push_text_wrap_pos(0.9 * area.width)
    imgui.text_unformatted(f"{tool.capitalize()}: {HINTS[tool]}. {KEYS}")
    imgui.pop_text_wrap_pos()
    imgui.end()


def _packed(colour: tuple[float, float, float, float]) -> Any:
    return imgui.get_color_u32(colour)
