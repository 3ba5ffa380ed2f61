"""The panels "Camera", "Timeline", "Record" and "Bookmarks"."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from imgui_bundle import ImVec2, hello_imgui, imgui, imgui_ctx

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera
from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.actions.viewpoint import THUMBNAIL
from langsplat_viewer.camera.controls import FOV_RANGE, OrbitCamera, with_fov
from langsplat_viewer.camera.flight import Keyframe, pose_of
from langsplat_viewer.commands import with_key
from langsplat_viewer.options import MAX_SIDE
from langsplat_viewer.panels import theme, ui
from langsplat_viewer.rendering.request import Clip
from langsplat_viewer.viewer import Viewer

CUT_RANGE = (0.01, 20.0)  # of the scene's radius, the least and most that a cut can be chosen


def draw_camera(viewer: Viewer) -> None:
    """Draw the panel "Camera"."""
    state, seen = viewer.state, viewer.state.open
    if seen is not None and seen.scene.cameras:
        _training_cameras(viewer, seen.scene.cameras)
    ui.verbs(viewer, "Reset", "Focus", "Frame all", "Horizon", "Align up axis")
    if seen is not None:
        _projection(viewer, seen.view)
        _cuts(viewer, seen.extent.radius)
    viewer.change("settings", **ui.draw_fields(state.session, "Camera"))
    settings.prefer(viewer, **ui.draw_fields(state.preferences, "Camera"))


def _projection(viewer: Viewer, view: OrbitCamera) -> None:
    """Draw the choice of projection, and the field of view that perspective has."""
    text = with_key("Orthographic", viewpoint.toggle_orthographic)
    changed, orthographic = imgui.checkbox(f"{text}###orthographic", view.orthographic)
    if changed:
        viewpoint.toggle_orthographic(viewer)
    ui.tip("No perspective: what is parallel looks parallel; the wheel changes the scale")
    before = view.intrinsics.fov_degrees
    with ui.disabled(orthographic):
        fov = ui.slider("Field of view", before, FOV_RANGE, "%.0f deg")
    if abs(fov - before) > 1e-3:
        viewpoint.move(viewer, lambda view: with_fov(view, fov))


def _cuts(viewer: Viewer, radius: float) -> None:
    """Draw the near and the far cut; at the ends of their sliders there is none."""
    clip, (low, high) = viewer.state.session.clip, (part * radius for part in CUT_RANGE)
    text = "%.3g" if clip.near else "off"
    near = ui.slider("Near cut", max(clip.near, low), (low, high), text, logarithmic=True)
    ui.tip("Nearer than this nothing is drawn, to look into things; world units")
    text = "%.3g" if clip.far < high else "off"
    far = ui.slider("Far cut", min(clip.far, high), (low, high), text, logarithmic=True)
    ui.tip("Farther than this nothing is drawn; world units")
    clip = Clip(0.0 if near < 1.001 * low else near, math.inf if far > 0.999 * high else far)
    settings.set_clip(viewer, clip)


def _training_cameras(viewer: Viewer, cameras: Sequence[Camera]) -> None:
    for by, label, direction in ((-1, "##previous", imgui.Dir.left), (1, "##next", imgui.Dir.right)):
        if imgui.arrow_button(label, direction):
            viewpoint.step_camera(viewer, by)
        imgui.same_line()
    index = viewer.state.camera_index or 0
    imgui.set_next_item_width(-1)
    name = cameras[index].name.replace("%", "%%")
    changed, wanted = imgui.slider_int("##camera", index, 0, len(cameras) - 1, f"camera %d  {name}")
    ui.tip("Training cameras: stand where a photograph was taken")
    if changed and wanted != viewer.state.camera_index:
        viewpoint.go_to_camera(viewer, wanted)


# The panel "Timeline": keyframes of the camera path, and playing it.

NUMBER_EM, LOOP_EM = 8.0, 5.0
MOST_EM = 8.0  # height of a thumbnail


def draw_timeline(viewer: Viewer) -> None:
    """Draw the panel "Timeline": playing the path, and its keyframes as they will look."""
    record, seconds = viewer.state.record, viewpoint.path_seconds(viewer)
    with ui.disabled(seconds <= 0):
        label = "Stop##path" if record.began is not None else "Play##path"
        if ui.button(label, with_key("Play", viewpoint.toggle_playing)):
            viewpoint.toggle_playing(viewer)
        imgui.same_line()
        imgui.set_next_item_width(-hello_imgui.em_size(NUMBER_EM + 2 * LOOP_EM))
        changed, at = imgui.slider_float("##at", record.at, 0.0, max(seconds, 1e-3), "%.2f s")
        if changed:
            viewpoint.scrub(viewer, at)
        imgui.same_line()
        if (wanted := _number("Duration", seconds, 1.0)) is not None:
            viewpoint.set_path_seconds(viewer, wanted)
    ui.beside("Loop", imgui.get_frame_height())
    settings.put(record, loops=imgui.checkbox("Loop", record.loops)[1])
    _keyframes(viewer)


def _number(label: str, value: float, step: float) -> float | None:
    """Draw a time to type or to step; return the new one once it is entered."""
    imgui.set_next_item_width(hello_imgui.em_size(NUMBER_EM))
    flags = imgui.InputTextFlags_.enter_returns_true
    changed, new = imgui.input_float(label, value, step, 5 * step, "%.2f s", flags)
    return new if changed and abs(new - value) > 1e-6 else None


def _keyframes(viewer: Viewer) -> None:
    record, keyframes = viewer.state.record, viewer.state.session.keyframes
    ui.verbs(viewer, "Add keyframe", "Turntable", "Save path")
    if ui.next_button("Clear", enabled=bool(keyframes)):
        viewpoint.set_path(viewer, ())
    _chosen(viewer, record.chosen)
    flags = imgui.WindowFlags_.horizontal_scrollbar
    if imgui.begin_child("keyframes", ImVec2(0, 0), imgui.ChildFlags_.nav_flattened, flags):
        if not keyframes:
            ui.small_wrapped("Add the current view; the path goes smoothly from one keyframe to the next")
        images = viewpoint.thumbnails(viewer)
        for number, key in enumerate(keyframes):
            with imgui_ctx.push_id(str(number)):
                _card(viewer, number, key, images.get(key))
            imgui.same_line()
    imgui.end_child()


_pictures = defaultdict[int, ui.Picture](ui.Picture)  # the thumbnails, by their numbers


def _card(viewer: Viewer, number: int, key: Keyframe, image: Array | None) -> None:
    """Draw a keyframe as it will look, over its time; a click goes there."""
    room = imgui.get_content_region_avail().y - imgui.get_text_line_height_with_spacing()
    height = min(hello_imgui.em_size(MOST_EM), max(room - 8, 16))
    size = ImVec2(height * THUMBNAIL[0] / THUMBNAIL[1], height)
    border = "accent" if key is viewer.state.record.chosen else "line"
    with imgui_ctx.begin_group():
        with theme.styled(border=border, frame_padding=hello_imgui.em_to_vec2(0.15, 0.15)):
            if image is not None:
                texture = imgui.ImTextureRef(_pictures[number].texture(image).glo)
                clicked = imgui.image_button("##keyframe", texture, size)
            else:
                clicked = imgui.button(f"{number + 1}##keyframe", size)
        ui.coloured(f"{number + 1}   {key.seconds:.2f} s")
    if clicked:
        viewpoint.choose_keyframe(viewer, key)


def _chosen(viewer: Viewer, key: Keyframe | None) -> None:
    """Draw what can be done with the keyframe that is chosen."""
    if key is None:
        return
    ui.beside("Time", hello_imgui.em_size(NUMBER_EM))
    if (seconds := _number("Time", key.seconds, 0.5)) is not None:
        viewpoint.put_keyframe(viewer, key, replace(key, seconds=seconds))
    seen = viewer.state.open
    if ui.next_button("Set to this view", "Put the current view in its place") and seen is not None:
        viewpoint.put_keyframe(viewer, key, replace(key, pose=pose_of(seen.view)))
    if ui.next_button("Remove", "Take it off the path"):
        viewpoint.put_keyframe(viewer, key)


# The panel "Record": films of the path.


def draw_record(viewer: Viewer) -> None:
    """Draw the panel "Record": films of the path, how, and where to."""
    if ui.button("Open the timeline", "Keyframes, and playing the path"):
        settings.open_panel(viewer, "Timeline")
    record = viewer.state.record
    imgui.set_next_item_width(hello_imgui.em_size(NUMBER_EM))
    changed, size = imgui.drag_int2("Size", list(record.size))
    if changed:
        width, height = (min(max(side, 1), MAX_SIDE) for side in size)
        settings.put(record, size=(width, height))
    ui.row("Images a second")
    rates = {fps: f"{fps:g}" for fps in (10.0, 24.0, 25.0, 30.0, 60.0)}
    settings.put(record, fps=ui.choice(rates, record.fps))
    imgui.set_next_item_width(-1)
    _, typed = imgui.input_text_with_hint("##film", "film.mp4 or a folder", record.film_file)
    ui.tip("Where the film goes; empty: a new name where the program was started")
    settings.put(record, film_file=typed)
    ui.verbs(viewer, "Save film", "Picture of this size")


# The panel "Bookmarks".


def draw_bookmarks(viewer: Viewer) -> None:
    """Draw the panel "Bookmarks": a box for a name, and the list."""
    if (name := ui.kept_box(viewer, "##bookmark", "name of this view", "Keep")) is not None:
        viewpoint.add_bookmark(viewer, name)
    bookmarks, words = viewer.state.session.bookmarks, "views that you keep are listed here"
    rows = [ui.Row(bookmark.name) for bookmark in bookmarks]
    clicked, gone = ui.listed("bookmarks", rows, with_key(words, viewpoint.add_bookmark))
    if clicked is not None and viewer.state.open is not None:
        viewpoint.glide_to(viewer, viewpoint.bookmarked_view(bookmarks[clicked], viewer.state.open.extent))
    if gone is not None:
        settings.take_off(viewer, "bookmarks", bookmarks[gone])
