"""Lines over the pictures of the scene: training cameras, ground grid, ruler; and the clicks on them."""

from dataclasses import dataclass

import numpy as np
from imgui_bundle import ImVec2, imgui

from langsplat_core.arrays import Array
from langsplat_core.display.displays import QUERY_COLOURS
from langsplat_core.scene import Camera
from langsplat_viewer import actions
from langsplat_viewer.camera import overlays
from langsplat_viewer.camera.overlays import Label, placed
from langsplat_viewer.panels.area import Area
from langsplat_viewer.panels.pictures import shade_edge, text_on_shade
from langsplat_viewer.viewer import Viewer

REACH = 7.0  # window units from a line at which a click means it
STILL = 4.0  # a click that moves farther is a drag
CAMERA, CHOSEN, HOVERED = (0.75, 0.82, 0.95, 0.75), (0.98, 0.62, 0.15, 1.0), (1.0, 1.0, 1.0, 1.0)
GRID, RULER = (0.85, 0.85, 0.85, 0.4), (1.0, 0.9, 0.2, 1.0)


@dataclass(frozen=True)
class Named:
    """A thing that has a name in the picture."""

    text: str
    corner: tuple[float, float]  # the highest one of its box, in units of the picture
    colour: tuple[float, float, float, float]


def draw(viewer: Viewer, area: Area) -> None:
    """Over every picture in the area, after they are drawn."""
    state = viewer.state
    if state.scene is None or state.view is None or state.extent is None:
        return
    count = state.settings.split.columns
    width = area.width / count
    paint = imgui.get_background_draw_list()
    for column in range(count):
        part = Area(area.left + column * width, area.top, width, area.height)
        camera = state.view.camera(max(round(part.width), 1), max(round(part.height), 1))
        low = ImVec2(part.left, part.top)
        paint.push_clip_rect(low, ImVec2(part.left + part.width, part.top + part.height), True)
        if "grid" in state.preferences.overlays:
            _grid(viewer, part, camera, is_named=column == 0)
        if "cameras" in state.preferences.overlays:
            _cameras(viewer, part, camera)
        if "things" in state.preferences.overlays:  # after the lines, so that its words are readable
            _things(viewer, part, camera)
        _ruler(viewer, part, camera)
        paint.pop_clip_rect()
    _projection(viewer, area)
    if state.ruler.measures and not imgui.get_io().want_capture_mouse:
        imgui.set_mouse_cursor(imgui.MouseCursor_.resize_all)
        if clicked(area):
            mouse = imgui.get_io().mouse_pos
            actions.measure_at(viewer, *area.fraction(mouse.x, mouse.y))


def _projection(viewer: Viewer, area: Area) -> None:
    """That there is no perspective, and how much the picture shows."""
    view, scene = viewer.state.view, viewer.state.scene
    if view is None or scene is None or not view.back:
        return
    line = imgui.get_text_line_height()
    lines_below = 2 if "grid" in viewer.state.preferences.overlays else 1
    span = overlays.length_text(view.span_in(*viewer.state.size), scene.metres_per_unit)
    text = f"orthographic, {span} across the shorter side"
    text_on_shade(text, area.left + 0.6 * line, area.top + area.height - 1.6 * lines_below * line, area)


def clicked(area: Area) -> bool:
    """Whether the left button was clicked in the area, without modifiers and without a drag."""
    io = imgui.get_io()
    if io.want_capture_mouse or io.key_ctrl or io.key_shift or not imgui.is_mouse_released(0):
        return False
    moved = imgui.get_mouse_drag_delta(0, 0.0)
    u, v = area.fraction(io.mouse_pos.x, io.mouse_pos.y)
    return abs(moved.x) + abs(moved.y) < STILL and 0 <= u <= 1 and 0 <= v <= 1


def _least_depth(viewer: Viewer) -> float:
    """Camera z from which on lines are drawn: a little before the eye."""
    assert viewer.state.extent is not None
    assert viewer.state.view is not None
    return viewer.state.view.back + overlays.LEAST_DEPTH * viewer.state.extent.radius


def _lines(area: Area, segments: Array, colour: tuple[float, float, float, float], thick: float) -> None:
    """(K, 2, 2) segments in units of the picture in `area`."""
    paint, packed = imgui.get_background_draw_list(), imgui.get_color_u32(colour)
    for (x0, y0), (x1, y1) in (segments + (area.left, area.top)).tolist():
        paint.add_line(ImVec2(x0, y0), ImVec2(x1, y1), packed, thick)


def _cameras(viewer: Viewer, area: Area, camera: Camera) -> None:
    """All but the one that one looks through; a click on one stands there."""
    state = viewer.state
    assert state.scene is not None
    assert state.extent is not None
    edges = overlays.frusta(state.scene.cameras, overlays.FRUSTUM_DEPTH * state.extent.radius)
    away = np.linalg.norm(edges[:, 0, 0] - camera.position, axis=1) > _least_depth(viewer)
    edges = edges * away[:, None, None, None]  # all in one point, which is no line
    segments, rows = overlays.clip_segments(camera, edges.reshape(-1, 2, 3), _least_depth(viewer))
    owners = rows // edges.shape[1]
    segments, owners = segments[away[owners]], owners[away[owners]]
    under = -1
    if not (imgui.get_io().want_capture_mouse or state.ruler.measures):
        mouse = imgui.get_io().mouse_pos
        row, distance = overlays.nearest_segment(segments, (mouse.x - area.left, mouse.y - area.top))
        under = int(owners[row]) if distance < REACH else -1
    chosen = -1 if state.camera_index is None else state.camera_index
    _lines(area, segments[(owners != under) & (owners != chosen)], CAMERA, 1.0)
    _lines(area, segments[owners == chosen], CHOSEN, 2.0)
    if under >= 0:
        _lines(area, segments[owners == under], HOVERED, 2.0)
        name = state.scene.cameras[under].name
        text_on_shade(f"camera {under}  {name}", mouse.x + 14, mouse.y + 10, area)
        if clicked(area):
            actions.go_to_camera(viewer, under)


def _things(viewer: Viewer, area: Area, camera: Camera) -> None:
    """A box around each thing that a query shown has found, and the phrase beside it."""
    named: list[Named] = []
    for query in viewer.state.shown():
        if query is None or query.slot is None:
            continue
        red, green, blue = QUERY_COLOURS[query.slot]
        for number, thing in enumerate(query.things, start=1):
            edges = overlays.box_edges(thing.oriented.corners)
            segments, _ = overlays.clip_segments(camera, edges, _least_depth(viewer))
            _lines(area, segments, (0.0, 0.0, 0.0, 0.5), 3.0)
            _lines(area, segments, (red, green, blue, 1.0), 1.5)
            if len(segments):
                x, y = segments.reshape(-1, 2)[segments.reshape(-1, 2)[:, 1].argmin()].tolist()
                text = query.phrase if len(query.things) == 1 else f"{query.phrase} {number}"
                named.append(Named(text, (x, y), (red, green, blue, 1.0)))
    _names(named, area)


def _names(named: list[Named], area: Area) -> None:
    """The phrases, above the highest corners of their boxes; a line leads to those that had to make room."""
    line, edge, paint = imgui.get_text_line_height(), shade_edge(), imgui.get_background_draw_list()
    room = (area.width, area.height)
    wanted = []
    for name in named:
        (x, y), size = name.corner, imgui.calc_text_size(name.text)
        wanted.append(Label(x + 4 - edge, y - 1.4 * line - edge, size.x + 2 * edge, size.y + 2 * edge))
    found = placed(wanted, room)
    for name, alone, label in zip(named, wanted, found, strict=True):
        if abs(label.y - placed([alone], room)[0].y) > label.height / 2:
            start = ImVec2(area.left + name.corner[0], area.top + name.corner[1])
            end = ImVec2(area.left + label.x, area.top + label.y + label.height / 2)
            paint.add_line(start, end, imgui.get_color_u32(name.colour), 1.5)
    for name, label in zip(named, found, strict=True):
        text_on_shade(name.text, area.left + label.x + edge, area.top + label.y + edge, area)


def _grid(viewer: Viewer, area: Area, camera: Camera, is_named: bool) -> None:
    """On the ground, with the distance of its lines from the world's origin; named in the corner, or not."""
    state = viewer.state
    assert state.scene is not None
    assert state.extent is not None
    assert state.view is not None
    scale = state.scene.metres_per_unit
    grid = overlays.ground_grid(state.extent, state.view.up, scale)
    segments, _ = overlays.clip_segments(camera, grid.segments, _least_depth(viewer))
    _lines(area, segments, GRID, 1.0)
    paint, packed = imgui.get_background_draw_list(), imgui.get_color_u32((*GRID[:3], 1.0))
    for text, point in grid.marks:
        place = _place(camera, point, _least_depth(viewer))
        if place is not None:
            paint.add_text(ImVec2(area.left + place[0] + 3, area.top + place[1]), packed, text)
    if not is_named:
        return
    spacing = overlays.length_text(grid.spacing, scale)
    line = imgui.get_text_line_height()
    text_on_shade(f"grid {spacing}", area.left + 0.6 * line, area.top + area.height - 1.6 * line, area)


def _ruler(viewer: Viewer, area: Area, camera: Camera) -> None:
    """The points that were clicked, and what lies between them."""
    ruler, scene = viewer.state.ruler, viewer.state.scene
    assert scene is not None
    paint, least = imgui.get_background_draw_list(), _least_depth(viewer)
    for point in ruler.points:
        place = _place(camera, np.array(point), least)
        if place is not None:
            middle = ImVec2(area.left + place[0], area.top + place[1])
            paint.add_circle_filled(middle, 4.0, imgui.get_color_u32(RULER))
            paint.add_circle(middle, 5.0, imgui.get_color_u32((0.0, 0.0, 0.0, 0.8)))
    if ruler.length is None:
        return
    segments, _ = overlays.clip_segments(camera, np.array([ruler.points]), least)
    _lines(area, segments, (0.0, 0.0, 0.0, 0.6), 4.0)
    _lines(area, segments, RULER, 2.0)
    for start, end in segments:
        x, y = (start + end) / 2
        text = overlays.length_text(ruler.length, scene.metres_per_unit)
        text_on_shade(text, area.left + float(x) + 8, area.top + float(y) + 8, area)


def _place(camera: Camera, point: Array, least_depth: float) -> tuple[float, float] | None:
    """Where a world point (3,) is in the picture; None where that is nowhere."""
    pixels, depths = camera.project(point[None].astype(np.float64))
    x, y = (float(part) for part in pixels[0])
    inside = depths[0] > least_depth and 0 <= x <= camera.width and 0 <= y <= camera.height
    return (x, y) if inside else None
