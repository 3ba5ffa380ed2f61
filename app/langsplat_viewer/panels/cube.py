"""The view cube in the corner of the scene: a click on a face turns the view there."""

from typing import Any

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.arrays import Array
from langsplat_viewer import actions
from langsplat_viewer.camera.controls import OrbitCamera
from langsplat_viewer.camera.overlays import Face, face_at, visible_faces, world_axes
from langsplat_viewer.panels.area import Area
from langsplat_viewer.panels.pictures import UNMOVED
from langsplat_viewer.viewer import Viewer

SIDE_EM = 7.0  # of the corner that it takes
EDGE = 0.24  # of that side, half the cube's edge: its corners reach 1.73 times as far
AXIS = 1.62  # length of the world's axes in the cube's units
AXES = (("x", (0.93, 0.33, 0.31)), ("y", (0.45, 0.78, 0.30)), ("z", (0.36, 0.60, 0.98)))
LIT, DARK, HOVERED = 0.80, 0.45, (0.98, 0.78, 0.35)
INK = (0.08, 0.08, 0.10)


def draw(viewer: Viewer, area: Area) -> None:
    """Over everything in the picture."""
    view = viewer.state.view
    if view is None or "cube" not in viewer.state.preferences.overlays:
        return
    side = min(hello_imgui.em_size(SIDE_EM), area.width, area.height)
    corner = ImVec2(area.left + area.width - side, area.top)
    imgui.push_style_var(imgui.StyleVar_.window_padding, ImVec2(0, 0))
    imgui.set_next_window_pos(corner)
    imgui.set_next_window_size(ImVec2(side, side))
    imgui.begin("view cube", None, UNMOVED)
    pressed = imgui.invisible_button("cube", ImVec2(side, side))
    middle, scale = (corner.x + side / 2, corner.y + side / 2), EDGE * side
    mouse, faces = imgui.get_io().mouse_pos, visible_faces(view)
    place = ((mouse.x - middle[0]) / scale, (mouse.y - middle[1]) / scale)
    under = face_at(faces, place) if imgui.is_item_hovered() else ""
    _axes(view, middle, scale, behind=True)
    for face in faces:
        _face(face, middle, scale, face.name == under)
    _axes(view, middle, scale, behind=False)
    imgui.end()
    imgui.pop_style_var()
    if pressed and under:
        actions.turn_to_face(viewer, under)


def _face(face: Face, middle: tuple[float, float], scale: float, hovered: bool) -> None:
    paint = imgui.get_window_draw_list()
    corners: list[Any] = [_at(corner, middle, scale) for corner in face.corners]  # of imgui's own union
    grey = DARK + (LIT - DARK) * face.towards
    paint.add_convex_poly_filled(corners, _packed(HOVERED if hovered else (grey, grey, grey), 0.92))
    paint.add_polyline(corners, _packed(INK, 0.7), 1.0, imgui.ImDrawFlags_.closed)
    if face.towards > 0.45:
        size, centre = imgui.calc_text_size(face.name), _at(face.centre, middle, scale)
        paint.add_text(ImVec2(centre.x - size.x / 2, centre.y - size.y / 2), _packed(INK, 1.0), face.name)


def _axes(view: OrbitCamera, middle: tuple[float, float], scale: float, *, behind: bool) -> None:
    """The world's own axes, from the middle of the cube; those that point away lie behind it."""
    paint = imgui.get_window_draw_list()
    for (name, colour), axis in zip(AXES, world_axes(view), strict=True):
        if (axis[2] > 0) == behind:
            start, end = (_at(reach * axis[:2], middle, scale) for reach in (0.0 if behind else 1.0, AXIS))
            paint.add_line(start, end, _packed(colour, 1.0), 2.0)
            paint.add_text(ImVec2(end.x + 2, end.y - 8), _packed(colour, 1.0), name)


def _at(place: Array, middle: tuple[float, float], scale: float) -> ImVec2:
    return ImVec2(middle[0] + scale * float(place[0]), middle[1] + scale * float(place[1]))


def _packed(colour: tuple[float, float, float], alpha: float) -> int:
    return int(imgui.get_color_u32((*colour, alpha)))
