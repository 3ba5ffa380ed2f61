"""The camera path: its keyframes, playing it, and films of it."""

from pathlib import Path

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer.actions import filming, viewpoint
from langsplat_viewer.camera.flight import Keyframe
from langsplat_viewer.commands import with_key
from langsplat_viewer.panels.style import (
    beside,
    beside_boxed,
    box_with_button,
    elided,
    leave_room,
    muted,
    next_button,
    small_wrapped,
    stoppable,
    tip,
    width_of,
)
from langsplat_viewer.state import FPS_CHOICES
from langsplat_viewer.viewer import Viewer

ROWS = 3.5  # of the list: the half one says that there are more
NUMBER_EM, FPS_EM = 7.5, 4.5


def draw(viewer: Viewer) -> None:
    """Draw the panel "Record": what the path is, playing it, saving it, films."""
    record = viewer.state.record
    if imgui.radio_button("Keyframes", not record.turns):
        filming.set_turning(viewer, False)
    beside_boxed("Turntable")
    if imgui.radio_button("Turntable", record.turns):
        filming.set_turning(viewer, True)
    tip("Once around what the view turns around; F makes that the latest result")
    imgui.begin_disabled(viewer.state.view is None)
    _play(viewer)
    if record.turns:
        _duration(viewer)
    else:
        _keyframes(viewer)
    _film(viewer)
    imgui.end_disabled()


def _play(viewer: Viewer) -> None:
    record, seconds = viewer.state.record, viewpoint.path_seconds(viewer)
    imgui.begin_disabled(seconds <= 0)
    if imgui.button("Stop##path" if record.began is not None else "Play##path"):
        viewpoint.toggle_playing(viewer)
    tip(with_key("Play", viewpoint.toggle_playing))
    imgui.same_line()
    loop = imgui.calc_text_size("Loop").x + imgui.get_frame_height() + 2 * imgui.get_style().item_spacing.x
    imgui.set_next_item_width(-loop)
    changed, at = imgui.slider_float("##at", record.at, 0.0, max(seconds, 1e-3), "%.2f s")
    if changed:
        viewpoint.scrub(viewer, at)
    imgui.end_disabled()
    imgui.same_line()
    changed, loops = imgui.checkbox("Loop", record.loops)
    if changed:
        filming.set_looping(viewer, loops)


def _duration(viewer: Viewer) -> None:
    seconds = viewpoint.path_seconds(viewer)
    imgui.begin_disabled(seconds <= 0)
    wanted = _number("Duration", seconds, 1.0)
    if wanted is not None:
        filming.set_path_seconds(viewer, wanted)
    imgui.end_disabled()


def _number(label: str, value: float, step: float) -> float | None:
    """A time to type or to step; the new one once it is entered."""
    imgui.set_next_item_width(hello_imgui.em_size(NUMBER_EM))
    flags = imgui.InputTextFlags_.enter_returns_true
    changed, new = imgui.input_float(label, value, step, 5 * step, "%.2f s", flags)
    return new if changed and abs(new - value) > 1e-6 else None


def _keyframes(viewer: Viewer) -> None:
    record = viewer.state.record
    if imgui.button("Add keyframe"):
        filming.add_keyframe(viewer)
    tip(with_key("The current view", filming.add_keyframe))
    if next_button("Clear", bool(record.keyframes)):
        filming.clear_path(viewer)
    beside("Duration", hello_imgui.em_size(NUMBER_EM))
    _duration(viewer)
    height = ROWS * imgui.get_frame_height_with_spacing()
    if imgui.begin_child("keyframes", ImVec2(0, height), imgui.ChildFlags_.borders):
        if not record.keyframes:
            small_wrapped("Add the current view; the path goes smoothly from one to the next", muted())
        for number, key in enumerate(record.keyframes, 1):
            imgui.push_id(number)
            _line(viewer, number, key)
            imgui.pop_id()
    imgui.end_child()
    imgui.begin_disabled(record.chosen is None)
    _chosen(viewer, record.chosen)
    imgui.end_disabled()
    _file(viewer)


def _line(viewer: Viewer, number: int, key: Keyframe) -> None:
    side, spacing = imgui.get_frame_height(), imgui.get_style().item_spacing.x
    right = imgui.get_content_region_avail().x
    imgui.align_text_to_frame_padding()
    size = ImVec2(right - side - spacing, 0)
    if imgui.selectable(
        f"{number}   {key.seconds:.2f} s##keyframe", key is viewer.state.record.chosen, size=size
    )[0]:
        filming.choose_keyframe(viewer, key)
    imgui.same_line(imgui.get_cursor_start_pos().x + right - side)
    if imgui.button("x", ImVec2(side, 0)):
        filming.delete_keyframe(viewer, key)
    tip("Take it off the path")


def _chosen(viewer: Viewer, key: Keyframe | None) -> None:
    seconds = _number("##time of the keyframe", 0.0 if key is None else key.seconds, 0.5)
    if seconds is not None and key is not None:
        filming.move_keyframe(viewer, key, seconds)
    if next_button("Set to this view") and key is not None:
        filming.replace_keyframe(viewer, key)
    tip("Put the current view in its place")


def _file(viewer: Viewer) -> None:
    leave_room("", NUMBER_EM + 2)
    hint = "file.path.json"
    _, typed = imgui.input_text_with_hint("##path file", hint, viewer.state.record.path_typed)
    filming.type_path_file(viewer, typed)
    if next_button("Save path"):
        filming.save_path(viewer, Path.cwd())
    if next_button("Load"):
        filming.load_typed_path(viewer, Path.cwd())


def _film(viewer: Viewer) -> None:
    record = viewer.state.record
    imgui.separator()
    imgui.set_next_item_width(hello_imgui.em_size(NUMBER_EM))
    changed, size = imgui.input_int2("Size", list(record.size))
    if changed:
        filming.set_film_size(viewer, *size)
    beside("fps", hello_imgui.em_size(FPS_EM))
    imgui.set_next_item_width(hello_imgui.em_size(FPS_EM))
    if imgui.begin_combo("fps", f"{record.fps:g}"):
        for fps in FPS_CHOICES:
            if imgui.selectable(f"{fps:g}", fps == record.fps)[0]:
                filming.set_film_fps(viewer, fps)
        imgui.end_combo()
    imgui.set_next_item_width(-1)
    hint = "film.mp4, .webp, .gif or a folder; empty: a new name"
    _, typed = imgui.input_text_with_hint("##film", hint, record.film_typed)
    filming.type_film(viewer, typed)
    work = viewer.recorder.current
    if work is not None:
        if stoppable(*work, tag="film"):
            filming.cancel_film(viewer)
        return
    if imgui.button("Save film"):
        filming.save_film(viewer, Path.cwd())
    if next_button("Save picture##sized"):
        filming.save_sized_picture(viewer, Path.cwd())
    tip("What is shown now, in this size")
    if next_button("Copy as command"):
        filming.copy_command(viewer, Path.cwd())
    tip("The command that draws this picture without a window")


# The panel "Bookmarks".


def draw_bookmarks(viewer: Viewer) -> None:
    """Draw the panel "Bookmarks": a box for a name, and the list."""
    state = viewer.state
    imgui.begin_disabled(state.view is None)
    hint = "name of this view"
    entered, typed = box_with_button("##bookmark", hint, state.bookmark_typed, "Keep")
    viewpoint.type_bookmark(viewer, typed)
    if entered:
        viewpoint.add_bookmark(viewer, state.bookmark_typed)
    imgui.end_disabled()
    if imgui.begin_child("bookmarks"):
        if not state.bookmarks:
            words = "views that you keep are listed here"
            small_wrapped(with_key(words, viewpoint.add_bookmark), muted())
        for number, bookmark in enumerate(state.bookmarks):
            imgui.push_id(number)
            side, right = imgui.get_frame_height(), imgui.get_content_region_avail().x
            room = right - side - imgui.get_style().item_spacing.x
            name = elided(bookmark.name, room, width_of)
            imgui.align_text_to_frame_padding()
            if imgui.selectable(f"{name}##bookmark", False, size=ImVec2(room, 0))[0]:
                viewpoint.go_to_bookmark(viewer, bookmark)
            imgui.same_line(imgui.get_cursor_start_pos().x + right - side)
            if imgui.button("x", ImVec2(side, 0)):
                viewpoint.delete_bookmark(viewer, bookmark)
            imgui.pop_id()
    imgui.end_child()
