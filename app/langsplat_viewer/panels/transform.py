"""The panel "Transform": gizmo, numbers, crop box; and the gizmo over the scene."""

from contextlib import suppress
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from imgui_bundle import imgui, imguizmo

from langsplat_core.arrays import Array
from langsplat_core.errors import LangSplatError
from langsplat_core.scene import Camera
from langsplat_core.scene.transform import Similarity, moving, scaling, similarity
from langsplat_viewer.actions import transforming
from langsplat_viewer.panels.style import (
    Area,
    beside_boxed,
    leave_room,
    muted,
    next_button,
    small_wrapped,
    tip,
)
from langsplat_viewer.state import EditForm, Gizmo, Point
from langsplat_viewer.viewer import Viewer

gizmo = imguizmo.im_guizmo
OPERATIONS = {
    "move": gizmo.OPERATION.translate,
    "rotate": gizmo.OPERATION.rotate,
    "scale": gizmo.OPERATION.scale,
}
NEAR, FAR = 1e-3, 1e3  # depths that the gizmo's camera sees, of the distance to what it turns around


def draw(viewer: Viewer) -> None:
    """Draw the panel "Transform": what is transformed, gizmo, numbers, box."""
    state = viewer.state
    imgui.begin_disabled(state.scene is None)
    chosen = int(state.selection.marks.selected.sum())
    what = f"{chosen:,} selected Gaussians" if chosen else "The whole scene, with its cameras"
    small_wrapped(what, muted())
    transforming.fill_form(viewer, _numbers(_gizmos(state.edit_form)))
    if imgui.button("Apply"):
        transforming.apply_form(viewer)
    tip("Scale and rotate about the middle of what is transformed, then move")
    imgui.separator()
    _box(viewer)
    if imgui.button("Fit"):
        transforming.fill_box(viewer)
    tip("The box around the selection, or around everything")
    if next_button("Crop"):
        transforming.crop(viewer)
    tip("Delete what lies outside the box; the file stays as it is")
    beside_boxed("Clip")
    changed, clips = imgui.checkbox("Clip", state.edit_form.clips)
    if changed:
        transforming.clip(viewer, clips)
    tip("Hide what lies outside the box, and follow its handles")
    imgui.end_disabled()


def _gizmos(form: EditForm) -> EditForm:
    kinds: tuple[Gizmo, ...] = get_args(Gizmo)
    for place, kind in enumerate(kinds):
        title = "No gizmo" if kind == "off" else kind.capitalize()
        if place:
            beside_boxed(title)
        if imgui.radio_button(f"{title}##gizmo", form.gizmo == kind):
            form = replace(form, gizmo=kind)
    return form


def _numbers(form: EditForm) -> EditForm:
    move = _three("Move", form.move, "World units along x, y and z")
    rotate = _three("Rotate", form.rotate, "Degrees about x, then y, then z, right-handed")
    leave_room("Scale", 12)
    _, scale = imgui.input_float("Scale", form.scale, 0, 0, "%.5g")
    return replace(form, move=move, rotate=rotate, scale=scale)


def _box(viewer: Viewer) -> None:
    form = viewer.state.edit_form
    low = _three("From", form.low, "A corner of the box, world units")
    high = _three("To", form.high, "The opposite corner")
    if (low, high) != (form.low, form.high):
        transforming.set_box(viewer, low, high)
        transforming.follow_box(viewer)


def _three(label: str, values: Point, what: str) -> Point:
    leave_room(label, 16)
    _, (x, y, z) = imgui.input_float3(label, list(values), "%.5g")
    tip(what)
    return x, y, z


# The gizmo over the scene. ImGuizmo edits a matrix that lies in the middle of what is transformed.


def _is_shown(viewer: Viewer) -> bool:
    """Whether there is a gizmo: none under what lies over the scene."""
    state = viewer.state
    covered = state.show_help or state.show_palette or imgui.is_popup_open("", imgui.PopupFlags_.any_popup)
    return state.edit_form.gizmo != "off" and state.scene is not None and not covered


def holds_mouse(viewer: Viewer) -> bool:
    """Return whether the mouse is on a gizmo, or drags it."""
    return _is_shown(viewer) and bool(gizmo.is_using() or gizmo.is_over())


def draw_gizmo(viewer: Viewer, area: Area) -> None:
    """Draw the chosen gizmo where it was dragged to; what it moves follows, and stays on release."""
    state = viewer.state
    kind = state.edit_form.gizmo
    if not _is_shown(viewer) or state.view is None or state.settings.split.columns > 1:
        return
    centre = transforming.pivot(viewer)
    if centre is None:
        return
    camera = state.view.camera(*area.size)
    view, projection = gl_matrices(camera, state.view.distance)
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
    """Arrows, rings or knobs: what is dragged is previewed, on release it is done."""
    start, held = moving(centre).matrix, viewer.state.moving
    edited = gizmo.Matrix16(_columns(start if held is None else held[0].to.matrix @ start))
    changed = gizmo.manipulate(*seen, OPERATIONS[kind], gizmo.MODE.world, edited)
    if gizmo.is_using():
        if changed:
            with suppress(LangSplatError):  # turned inside out: what it was before stays
                transforming.preview(viewer, dragged(start, np.array(edited.values).reshape(4, 4).T))
    elif held is not None:
        transforming.transform(viewer, held[0].to)


def _box_handles(viewer: Viewer, seen: tuple[Any, Any]) -> None:
    """The box of the panel with handles on its corners and edges; on release the clip follows."""
    form, unit = viewer.state.edit_form, gizmo.Matrix6([-0.5, -0.5, -0.5, 0.5, 0.5, 0.5])
    corners = np.array([form.low, form.high])
    matrix = np.diag([*np.maximum(np.ptp(corners, axis=0), 1e-6), 1.0])
    matrix[:3, 3] = corners.mean(0)
    edited = gizmo.Matrix16(_columns(matrix))
    operation, mode = gizmo.OPERATION.bounds, gizmo.MODE.local
    if gizmo.manipulate(*seen, operation, mode, edited, local_bounds=unit):
        low, high = box_of(np.array(edited.values).reshape(4, 4).T)
        transforming.set_box(viewer, low, high)
    elif not gizmo.is_using():
        transforming.follow_box(viewer)


def box_of(matrix: Array) -> tuple[Point, Point]:
    """Lowest and highest corner of the unit cube about the origin after a (4, 4) matrix without rotation."""
    half = np.abs(np.diag(matrix)[:3]) / 2
    low, high = (tuple(map(float, matrix[:3, 3] + sign * half)) for sign in (-1, 1))
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def dragged(start: Array, now: Array) -> Similarity:
    """The similarity that leads from one (4, 4) matrix to another; of unlike scales the one that changed the
    most. Raises InputError where there is none."""
    change = now @ np.linalg.inv(start)
    scales = np.linalg.norm(now[:3, :3], axis=0) / np.linalg.norm(start[:3, :3], axis=0)
    if np.ptp(scales) < 1e-5:
        return similarity(change)
    factor = float(scales[np.argmax(np.abs(np.log(np.maximum(scales, 1e-12))))])
    return scaling(factor).about(start[:3, 3])


def gl_matrices(camera: Camera, distance: float) -> tuple[Array, Array]:
    """View and projection (4, 4) of a camera as OpenGL has them: y up, z towards the eye, depths -1 to 1."""
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
