"""The panels "Selection" and "Transform", and the strokes of tools and the gizmo over the scene."""

from contextlib import suppress
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui, imguizmo

from langsplat_core.arrays import Array
from langsplat_core.display.displays import SELECTED
from langsplat_core.errors import LangSplatError
from langsplat_core.query.selection import of_rows
from langsplat_core.scene import Camera
from langsplat_core.scene.transform import Similarity, moving, scaling, similarity
from langsplat_viewer import marks
from langsplat_viewer.actions import editing, settings
from langsplat_viewer.marks import BRUSHES, MODES, REACHES, TOOLS, Marks, Mode, Tool
from langsplat_viewer.panels import ui
from langsplat_viewer.panels.overlays import say
from langsplat_viewer.session import Point, point_of
from langsplat_viewer.state import Gizmo
from langsplat_viewer.viewer import Viewer

OF_SELECTED = ("None", "Grow", "Shrink", "More like it", "Hide", "Isolate", "Delete", "Export selection ...")


def draw(viewer: Viewer) -> None:
    """Draw the panel "Selection": counts, tools, the search, verbs, files."""
    marks, tools = viewer.state.marks, viewer.state.tools
    ui.small_wrapped(counts(marks))
    disabled = () if marks.selected.any() else OF_SELECTED
    _tools(viewer)
    _found(viewer)
    imgui.separator()
    ui.verbs(viewer, "All", "None", "Invert", "Grow", "Shrink", "More like it", disabled=disabled)
    reach = ui.slider("Reach", tools.reach, REACHES, "%.3f of the scene", logarithmic=True, ems=12)
    editing.set_tools(viewer, reach=reach)
    _name(viewer)
    imgui.separator()
    ui.verbs(viewer, "Hide", "Isolate", "Show all", "Delete", disabled=disabled)
    imgui.separator()
    ui.verbs(viewer, "Export selection ...", "Export scene ...", disabled=disabled)


def counts(marks: Marks) -> str:
    """Return the counts of selected, hidden and deleted Gaussians in words."""
    selected, hidden, deleted = map(np.count_nonzero, (marks.selected, marks.hidden, marks.deleted))
    return f"{selected:,} of {len(marks.selected):,} selected, {hidden:,} hidden, {deleted:,} deleted"


def _tools(viewer: Viewer) -> None:
    tools = viewer.state.tools
    names: dict[Tool | None, str] = {None: "No tool", **{one: f"{one.capitalize()}##tool" for one in TOOLS}}
    tool = ui.choice(names, tools.tool)
    if tool != tools.tool:
        editing.use_tool(viewer, tool)
    mode = ui.choice({mode: mode.capitalize() for mode in MODES}, tools.mode)
    _, only = imgui.checkbox("Only what is visible", tools.only_visible)
    editing.set_tools(viewer, mode=mode, only_visible=only)
    ui.tip("Rectangle, lasso and brush leave out what lies behind something")
    if viewer.state.tools.tool == "brush":
        brush = ui.slider("Brush", tools.brush, BRUSHES, "%.3f of the height", logarithmic=True, ems=12)
        editing.set_tools(viewer, brush=brush)


def _found(viewer: Viewer) -> None:
    query = editing.chosen_query(viewer)
    result = None if query is None else viewer.state.result(query)
    if query is None or result is None:
        return
    name = ui.elided(query.phrase, imgui.get_content_region_avail().x - hello_imgui.em_size(4))
    if ui.button(f"Found: {name}##found", "Select what the search has found"):
        editing.select_query(viewer, query)
    things = viewer.state.answer(query).things
    if result.verdict == "not here" or len(things) < 2:
        return
    for number, thing in enumerate(things, 1):
        share = f"{100 * thing.share:.0f} % of the answer"
        if ui.next_button(f"{number}##thing", f"{thing.count:,} Gaussians, {share}, score {thing.score:.2f}"):
            editing.take(viewer, of_rows(thing.members, len(viewer.state.marks.selected)))


def _name(viewer: Viewer) -> None:
    """Draw the box for a name by which what is selected is found from now on."""
    if settings.take(viewer.state, "focus_name"):
        imgui.set_keyboard_focus_here()
    if (name := ui.kept_box(viewer, "##name", "a name for what is selected", "Name it")) is not None:
        editing.name_selection(viewer, name)
    ui.tip("Searching for the name finds just this; Like it, below that answer, finds what is like it")


# Strokes: the left button while a tool selects.

HINTS: dict[Tool, str] = {
    "thing": "click a thing",
    "rectangle": "drag from corner to corner",
    "lasso": "draw around it",
    "brush": "paint over it",
    "sphere": "drag from the middle outwards, or click",
    "box": "drag from the middle outwards, or click",
}
TOOL_KEYS = "Shift adds, Ctrl removes, both intersect; X clicks the middle, Esc leaves"
LIGHT, DARK = (1.0, 1.0, 1.0, 0.95), (0.0, 0.0, 0.0, 0.6)  # a line in two colours is seen on every image
PAINT = (*SELECTED, 0.35)


def handle_stroke(viewer: Viewer, area: ui.Area) -> None:
    """Begin a stroke, go on with it, or end it; once per frame."""
    io, tools = imgui.get_io(), viewer.state.tools
    if tools.tool is None:
        return
    place = area.fraction(io.mouse_pos.x, io.mouse_pos.y)
    if tools.stroke is None:
        if imgui.is_mouse_clicked(imgui.MouseButton_.left) and not io.want_capture_mouse:
            editing.begin_stroke(viewer, *place)
        return
    editing.extend_stroke(viewer, *place)
    if not imgui.is_mouse_down(imgui.MouseButton_.left):
        editing.end_stroke(viewer, held_mode())


def held_mode() -> Mode | None:
    """Return the mode that keys ask for; None: the one that is set."""
    io = imgui.get_io()
    if io.key_shift and io.key_ctrl:
        return "intersect"
    return "add" if io.key_shift else "remove" if io.key_ctrl else None


def draw_stroke(viewer: Viewer, area: ui.Area) -> None:
    """Draw the outline of the stroke under way, and the brush."""
    tools = viewer.state.tools
    if tools.tool is None or viewer.state.open is None:
        return
    paint = imgui.get_foreground_draw_list()
    paint.push_clip_rect(*area.corners)
    drawn, radius = editing.drawn_stroke(viewer), tools.brush * area.height
    for line in marks.outlines(drawn) if drawn is not None else []:
        places = (area.left, area.top) + line * (area.width, area.height)
        points: list[Any] = [ImVec2(*place) for place in places.tolist()]
        if tools.tool == "brush" and len(points) == 1:
            paint.add_circle_filled(points[0], radius, imgui.get_color_u32(PAINT))
        elif tools.tool == "brush":
            paint.add_polyline(points, imgui.get_color_u32(PAINT), 2 * radius, 0)
        else:
            paint.add_polyline(points, imgui.get_color_u32(DARK), 3.0, 0)
            paint.add_polyline(points, imgui.get_color_u32(LIGHT), 1.5, 0)
    io = imgui.get_io()
    if tools.tool == "brush" and (drawn is not None or not io.want_capture_mouse):
        paint.add_circle(io.mouse_pos, radius, imgui.get_color_u32(DARK), 0, 3.0)
        paint.add_circle(io.mouse_pos, radius, imgui.get_color_u32(LIGHT), 0, 1.0)
    paint.pop_clip_rect()


def draw_hint(viewer: Viewer, area: ui.Area) -> None:
    """Say what a click on the scene does, while it does not turn the view."""
    state, tool = viewer.state, viewer.state.tools.tool
    if state.session.ruler.measures:
        text = "Ruler: click two points on the surface, or X: the middle; Esc ends it"
        if state.open is not None and state.open.scene.metres_per_unit is None:
            text += ". langsplat scale gives the scene metres"
    elif state.pins_notes:
        text = "Note: click what it is about, or X: the middle; Esc leaves"
    elif tool is not None:
        text = f"{tool.capitalize()}: {HINTS[tool]}. {TOOL_KEYS}"
    else:
        return
    if tool not in marks.ON_SCREEN:  # where X clicks
        low, high = ui.scene_area().corners
        imgui.get_foreground_draw_list().add_circle((low + high) / 2, 4.0, imgui.get_color_u32(LIGHT))
    say(text, area, "tool", hello_imgui.em_size(0.7 if state.session.split.mode == "off" else 3))


# The panel "Transform": gizmo, numbers, crop box; and the gizmo over the scene.

gizmo = imguizmo.im_guizmo
OPERATIONS = {
    "move": gizmo.OPERATION.translate,
    "rotate": gizmo.OPERATION.rotate,
    "scale": gizmo.OPERATION.scale,
}
GIZMOS: dict[Gizmo, str] = {
    kind: f"{'No gizmo' if kind == 'off' else kind.capitalize()}##gizmo" for kind in get_args(Gizmo)
}
NEAR, FAR = 1e-3, 1e3  # depths that the gizmo's camera sees, of the distance to what it turns around


def draw_transform(viewer: Viewer) -> None:
    """Draw the panel "Transform": what is transformed, gizmo, numbers, box."""
    state = viewer.state
    chosen = np.count_nonzero(state.marks.selected)
    ui.small_wrapped(f"{chosen:,} selected Gaussians" if chosen else "The whole scene, with its cameras")
    kind = ui.choice(GIZMOS, state.edit_form.gizmo)
    if kind != state.edit_form.gizmo:
        editing.set_gizmo(viewer, kind)
    form = state.edit_form
    step = NEAR * (1.0 if state.open is None else state.open.extent.radius)  # per pixel that is dragged
    move = _three("Move", form.move, step, "World units along x, y and z")
    rotate = _three("Rotate", form.rotate, 0.5, "Degrees about x, then y, then z, right-handed")
    ui.leave_room("Scale", 12)
    _, scale = imgui.drag_float("Scale", form.scale, 0.005, format="%.5g")
    settings.put(state, edit_form=replace(form, move=move, rotate=rotate, scale=scale))
    if ui.button("Apply", "Scale and rotate about the middle of what is transformed, then move"):
        editing.apply_form(viewer)
    imgui.separator()
    low = _three("From", form.low, step, "A corner of the box, world units from the scene's origin")
    high = _three("To", form.high, step, "The opposite corner")
    if (low, high) != (form.low, form.high):
        editing.set_box(viewer, low, high)
    if ui.button("Fit", "The box around the selection, or around everything"):
        editing.fill_box(viewer)
    if ui.next_button("Crop"):
        editing.crop(viewer)
    if imgui.is_item_hovered():
        outside = int((state.marks.kept & ~editing.in_crop_box(viewer)).sum())
        ui.tip(f"Delete the {outside:,} Gaussians outside the box; the file stays as it is")


def _three(label: str, values: Point, step: float, what: str) -> Point:
    ui.leave_room(label, 16)
    _, (x, y, z) = imgui.drag_float3(label, list(values), step, format="%.5g")
    ui.tip(what)
    return x, y, z


# The gizmo over the scene. ImGuizmo edits a matrix that lies in the middle of what is transformed.


def _is_shown(viewer: Viewer) -> bool:
    """Return whether the gizmo is drawn: not under what lies over the scene."""
    state = viewer.state
    covered = state.show_help or state.show_palette or imgui.is_popup_open("", imgui.PopupFlags_.any_popup)
    return state.edit_form.gizmo != "off" and state.open is not None and not covered


def holds_mouse(viewer: Viewer) -> bool:
    """Return whether the mouse is on a gizmo, or drags it."""
    return _is_shown(viewer) and bool(gizmo.is_using() or gizmo.is_over())


def draw_gizmo(viewer: Viewer, area: ui.Area) -> None:
    """Draw the chosen gizmo where it was dragged to; a drag is previewed, and applied on release."""
    state = viewer.state
    kind = state.edit_form.gizmo
    if state.open is None or not _is_shown(viewer) or state.session.split.columns > 1:
        return
    centre, camera = editing.pivot(viewer, state.open), state.open.view.camera(*area.size)
    view, projection = gl_matrices(camera, state.open.view.distance)
    paint = imgui.get_foreground_draw_list()
    paint.push_clip_rect(*area.corners)
    gizmo.begin_frame()
    gizmo.set_drawlist(paint)
    gizmo.set_rect(area.left, area.top, area.width, area.height)
    gizmo.set_orthographic(camera.orthographic)
    seen = gizmo.Matrix16(_columns(view)), gizmo.Matrix16(_columns(projection))
    if kind == "box":
        _box_handles(viewer, seen)
    else:
        _handles(viewer, seen, kind, centre)
    paint.pop_clip_rect()


def _handles(viewer: Viewer, seen: tuple[Any, Any], kind: str, centre: Array) -> None:
    """Draw arrows, rings or knobs; a drag is previewed, and applied on release."""
    start, held = moving(centre).matrix, viewer.state.moving
    edited = gizmo.Matrix16(_columns(start if held is None else held[0].to.matrix @ start))
    changed = gizmo.manipulate(*seen, OPERATIONS[kind], gizmo.MODE.world, edited)
    if gizmo.is_using():
        if changed:
            with suppress(LangSplatError):  # turned inside out: what it was before stays
                editing.preview(viewer, dragged(start, np.array(edited.values).reshape(4, 4).T))
    elif held is not None:
        editing.transform(viewer, held[0].to)


def _box_handles(viewer: Viewer, seen: tuple[Any, Any]) -> None:
    """Draw the box of the panel with handles on its corners and edges."""
    form, unit = viewer.state.edit_form, gizmo.Matrix6([-0.5, -0.5, -0.5, 0.5, 0.5, 0.5])
    corners = np.array([form.low, form.high])
    sides = np.ptp(corners, axis=0)
    matrix = np.diag([*np.maximum(sides, max(1e-6 * sides.max(), 1e-30)), 1.0])
    matrix[:3, 3] = corners.mean(0)
    edited = gizmo.Matrix16(_columns(matrix))
    operation, mode = gizmo.OPERATION.bounds, gizmo.MODE.local
    if gizmo.manipulate(*seen, operation, mode, edited, local_bounds=unit):
        low, high = box_of(np.array(edited.values).reshape(4, 4).T)
        editing.set_box(viewer, low, high)


def box_of(matrix: Array) -> tuple[Point, Point]:
    """Return the lowest and highest corner of the unit cube under a (4, 4) matrix without rotation."""
    half = np.abs(np.diag(matrix)[:3]) / 2
    return point_of(matrix[:3, 3] - half), point_of(matrix[:3, 3] + half)


def dragged(start: Array, now: Array) -> Similarity:
    """Return the similarity that leads from one (4, 4) matrix to another.

    Of different scales the one that changed most counts. Raises InputError where there is no similarity.
    """
    change = now @ np.linalg.inv(start)
    scales = np.linalg.norm(now[:3, :3], axis=0) / np.linalg.norm(start[:3, :3], axis=0)
    if np.ptp(scales) < 1e-5:
        return similarity(change)
    factor = float(scales[np.argmax(np.abs(np.log(np.maximum(scales, 1e-12))))])
    return scaling(factor).about(start[:3, 3])


def gl_matrices(camera: Camera, distance: float) -> tuple[Array, Array]:
    """Return a camera's (4, 4) view and projection in OpenGL's frame: y up, z to the eye, depths -1 to 1."""
    view = np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.world_to_camera
    near, far = NEAR * distance, FAR * distance
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = 2 * camera.fx / camera.width, 2 * camera.fy / camera.height
    off = np.array([2 * camera.cx / camera.width - 1, 1 - 2 * camera.cy / camera.height])
    if camera.orthographic:
        projection[:2, 3], projection[2, 2], projection[3, 3] = off, -2 / (far - near), 1
        projection[2, 3] = -(far + near) / (far - near)
    else:
        projection[:2, 2], projection[2, 2], projection[3, 2] = -off, -(far + near) / (far - near), -1
        projection[2, 3] = -2 * far * near / (far - near)
    return view, projection


def _columns(matrix: Array) -> list[float]:
    return [float(number) for number in matrix.T.ravel()]
