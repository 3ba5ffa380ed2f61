"""The panels "Display", "Camera", "Overlays", "Notes", "Record" and "Bookmarks"."""

import math
from dataclasses import replace
from itertools import groupby

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.display.displays import COLOUR_MAPS, DISPLAYS, DisplayRow
from langsplat_core.query.answers import FLOOR
from langsplat_core.scene import LEVELS
from langsplat_viewer.actions import browsing, filming, opening, projects, settings, viewpoint
from langsplat_viewer.camera.controls import FOV_RANGE, OrbitCamera, adopt_up, level, with_fov
from langsplat_viewer.camera.flight import Keyframe
from langsplat_viewer.camera.overlays import length_text
from langsplat_viewer.commands import BUTTONS, OVERLAY_TITLES, Button, buttons_of, is_shown, with_key
from langsplat_viewer.panels import ui
from langsplat_viewer.rendering.request import MOST_DEGREE, SIZE_RANGE, Clip, Splats
from langsplat_viewer.state import FPS_CHOICES
from langsplat_viewer.viewer import Viewer

CUT_RANGE = (0.01, 20.0)  # of the scene's radius, the least and most that a cut can be chosen
WIDTH_EM = 11.0  # of lists and of sliders of `ui`, where there is room
LEAST_SPAN = 1e-3  # of a heat scale
BACKDROPS = {(grey, grey, grey): name for name, grey in (("Black", 0.0), ("Grey", 0.5), ("White", 1.0))}


def draw_display(viewer: Viewer) -> None:
    for _, group in groupby(DISPLAYS.values(), lambda row: row.name if row.by_level else row.needs_query):
        _display_line(viewer, tuple(group))
    _compared(viewer)
    picture = viewer.state.session.picture
    needs_query = DISPLAYS[picture.display].needs_query
    if needs_query and not viewer.state.shown():
        ui.small_wrapped("search for something to see where it is", ui.muted())
    if picture.display == "relevancy":
        picture = replace(picture, heat_opacity=ui.slider("Heat opacity", picture.heat_opacity, (0.0, 1.0)))
        picture = replace(picture, heat_scale=_heat_scale(viewer))
    if needs_query:
        picture = replace(picture, dim=ui.slider("Rest dimmed to", picture.dim, (0.0, 1.0)))
    if any(pane.row.uses_map for pane in viewer.state.panes()):
        names = list(COLOUR_MAPS)
        ui.leave_room("Colour map", WIDTH_EM)
        changed, chosen = imgui.combo("Colour map", names.index(picture.colour_map), list(names))
        if changed:
            settings.set_colour_map(viewer, names[chosen])
    picture = replace(picture, colour_map=viewer.state.session.picture.colour_map)
    picture = replace(picture, background=_backdrop(picture.background))
    ui.tip("What shows where the scene is not")
    picture = replace(picture, transparent=imgui.checkbox("Save without backdrop", picture.transparent)[1])
    ui.tip("Pictures are saved transparent where the scene is not")
    settings.set_picture(viewer, picture)
    viewer.change("settings", **ui.draw_fields(viewer.state.session, "Display"))
    _splats(viewer)


def _splats(viewer: Viewer) -> None:
    scene, splats = viewer.state.scene, viewer.state.session.splats
    size = ui.slider("Splat size", splats.size, SIZE_RANGE)
    ui.tip("Smaller, every Gaussian can be seen; answers and files do not change")
    degree, most = splats.sh_degree, MOST_DEGREE if scene is None else scene.gaussians.sh_degree
    if most > 0:
        ui.leave_room("SH degree", WIDTH_EM)
        flags = imgui.SliderFlags_.always_clamp
        changed, chosen = imgui.slider_int("SH degree", min(degree, most), 0, most, "%d", flags)
        degree = (MOST_DEGREE if chosen == most else chosen) if changed else degree
        ui.tip("Up to which degree colours change with the direction that they are seen from")
    viewer.change("splats", splats=Splats(size, degree))


def _heat_scale(viewer: Viewer) -> tuple[float, float] | None:
    """Relevancies at the ends of the colour bar: each answer's own, or the same for all."""
    scale = viewer.state.session.picture.heat_scale
    changed, fixed = imgui.checkbox("Fixed heat scale", scale is not None)
    ui.tip("The same colour means the same relevancy in every answer, image and scene")
    if changed:
        own = [result.heat_range for result in viewer.state.shown_results() if result is not None]
        lows, highs = zip(*own, strict=True) if own else ((FLOOR,), (1.0,))
        return (min(lows), max(highs)) if fixed else None
    if scale is None:
        return None
    ui.leave_room("From, to", WIDTH_EM)
    flags = imgui.SliderFlags_.always_clamp
    changed, low, high = imgui.drag_float_range2("From, to", *scale, 0.002, 0.0, 1.0, "%.3f", "%.3f", flags)
    return (low, high) if changed and high - low > LEAST_SPAN else scale


def _backdrop(background: tuple[float, float, float]) -> tuple[float, float, float]:
    background = ui.radio(BACKDROPS, background)
    ui.beside_boxed("Backdrop")
    flags = imgui.ColorEditFlags_.no_inputs | imgui.ColorEditFlags_.uint8
    changed, colour = imgui.color_edit3("Backdrop", list(background), flags)
    red, green, blue = (min(max(float(part), 0.0), 1.0) for part in colour)
    return (red, green, blue) if changed else background


def _display_line(viewer: Viewer, rows: tuple[DisplayRow, ...]) -> None:
    """Displays that need the same, beside each other; one that has several buttons is named before them."""
    state = viewer.state
    buttons = [button for row in rows for button in buttons_of(row)]
    if len(buttons) > len(rows):
        imgui.align_text_to_frame_padding()
        imgui.text(rows[0].label)
        imgui.same_line()
    for place, button in enumerate(buttons):
        if place:
            ui.beside_boxed(button.label)
        imgui.begin_disabled(state.lacks_field and DISPLAYS[button.display].needs_field)
        if imgui.radio_button(button.label, is_shown(state, button)):
            settings.set_display(viewer, button.display, button.latent_level)
        imgui.end_disabled()


def _compared(viewer: Viewer) -> None:
    """Draw the choice of what is shown beside it."""
    state, split = viewer.state, viewer.state.session.split
    second = Button("", split.second, split.second_level if DISPLAYS[split.second].by_level else None)
    shown = {"off": "nothing", "levels": "three levels", "wipe": compared_name(second)}.get(split.mode, "")
    if viewer.beside is not None and viewer.beside.state.path is not None:
        shown = viewer.beside.state.path.name
    ui.leave_room("Beside it", WIDTH_EM)
    if not imgui.begin_combo("Beside it", shown):
        return
    if imgui.selectable("nothing", split.mode == "off")[0]:
        settings.set_split(viewer, "off")
    for button in BUTTONS:
        imgui.begin_disabled(state.lacks_field and DISPLAYS[button.display].needs_field)
        if imgui.selectable(compared_name(button), shown == compared_name(button))[0]:
            settings.compare_with(viewer, button.display, button.latent_level)
        imgui.end_disabled()
    imgui.begin_disabled(state.lacks_field)
    if imgui.selectable("three levels", split.mode == "levels")[0] and split.mode != "levels":
        settings.toggle_levels(viewer)
    imgui.end_disabled()
    if imgui.selectable("another scene ...", split.mode == "scenes")[0]:
        browsing.ask_for_beside(viewer)
    imgui.end_combo()


def compared_name(button: Button) -> str:
    """Return the name of a display in the list of those that can be beside another."""
    row = DISPLAYS[button.display]
    return row.label if button.latent_level is None else f"{row.label}, {LEVELS[button.latent_level]}"


def draw_overlays(viewer: Viewer) -> None:
    state = viewer.state
    for name, title in OVERLAY_TITLES.items():
        if imgui.checkbox(title.capitalize(), name in state.session.overlays)[0]:
            settings.toggle_overlay(viewer, name)
    ruler, scene = state.session.ruler, state.scene
    measure = with_key("Measure", settings.toggle_measuring)
    imgui.begin_disabled(scene is None)
    if imgui.checkbox(f"{measure}###measure", ruler.measures)[0]:
        settings.toggle_measuring(viewer)
    ui.tip("Click two points on the surface; Esc ends it")
    imgui.end_disabled()
    if ruler.measures:
        metres = None if scene is None else scene.metres_per_unit
        text = "click a second point" if ruler.points else "click a first point"
        if ruler.length is not None:
            text = length_text(ruler.length, metres)
        ui.small_wrapped(text, ui.muted())
        if scene is not None and metres is None:
            ui.small_wrapped("the scene has no scale in metres; langsplat scale gives it one", ui.muted())


def draw_notes(viewer: Viewer) -> None:
    """Draw the panel "Notes": texts pinned to places, kept in the project."""
    state, side = viewer.state, imgui.get_frame_height()
    imgui.begin_disabled(state.scene is None)
    pin = with_key("Pin one to what is clicked", projects.toggle_pinning)
    if imgui.checkbox(pin, state.pins_notes)[0]:
        projects.toggle_pinning(viewer)
    if ui.button("Pin one to the selection", enabled=bool(state.marks.selected.any())):
        projects.pin_to_selection(viewer)
    if ui.next_button(
        "Save project", "Notes, queries, selection, edits, views: one file, to be opened again"
    ):
        projects.save_project(viewer)
    imgui.end_disabled()
    if not state.session.notes:
        ui.small_wrapped("notes are listed here", ui.muted())
    for number, note in enumerate(state.session.notes):
        imgui.push_id(number)
        imgui.set_next_item_width(-side - imgui.get_style().item_spacing.x)
        if projects.take_fresh_note(viewer, note):
            imgui.set_keyboard_focus_here()
        changed, text = imgui.input_text("##note", note.text)
        if changed:
            projects.write_note(viewer, note, text)
        imgui.same_line()
        if imgui.button("x", ImVec2(side, 0)):
            projects.remove_note(viewer, note)
        imgui.pop_id()


def draw_camera(viewer: Viewer) -> None:
    state = viewer.state
    imgui.begin_disabled(state.view is None)
    if state.scene is not None and state.scene.cameras:
        _training_cameras(viewer)
    if ui.button(with_key("Reset", viewpoint.reset_view), "Return to the opening view"):
        viewpoint.reset_view(viewer)
    if ui.next_button(with_key("Focus", viewpoint.focus_result)):
        viewpoint.focus_result(viewer)
    if ui.next_button("Frame all", with_key("Show the whole scene from this side", viewpoint.frame_scene)):
        viewpoint.frame_scene(viewer)
    if ui.button("Horizon", "Turn the picture until the horizon is level"):
        viewpoint.move(viewer, level)
    if ui.next_button("Up is up", "Take what is up in the picture as the world's up"):
        viewpoint.move(viewer, adopt_up)
    if state.view is not None:
        _projection(viewer, state.view)
    _cuts(viewer)
    settings.prefer(viewer, **ui.draw_fields(state.preferences, "Camera"))
    imgui.end_disabled()


def _projection(viewer: Viewer, view: OrbitCamera) -> None:
    """With perspective or without; the field of view is one of perspective."""
    text = with_key("Orthographic", viewpoint.toggle_orthographic)
    _, orthographic = imgui.checkbox(f"{text}###orthographic", view.orthographic)
    viewpoint.set_orthographic(viewer, orthographic)
    ui.tip("No perspective: what is parallel looks parallel; the wheel changes the scale")
    before = view.intrinsics.fov_degrees
    imgui.begin_disabled(orthographic)
    fov = ui.slider("Field of view", before, FOV_RANGE, "%.0f deg")
    imgui.end_disabled()
    if abs(fov - before) > 1e-3:
        viewpoint.move(viewer, lambda view: with_fov(view, fov))


def _cuts(viewer: Viewer) -> None:
    """Near and far cut; at the ends of their sliders there is none."""
    extent, clip = viewer.state.extent, viewer.state.session.clip
    if extent is None:
        return
    low, high = limits = CUT_RANGE[0] * extent.radius, CUT_RANGE[1] * extent.radius
    text = "%.3g" if clip.near else "off"
    near = ui.slider("Near cut", max(clip.near, low), limits, text, logarithmic=True)
    ui.tip("Nearer than this nothing is drawn, to look into things; world units")
    text = "%.3g" if clip.far < high else "off"
    far = ui.slider("Far cut", min(clip.far, high), limits, text, logarithmic=True)
    ui.tip("Farther than this nothing is drawn; world units")
    clip = Clip(0.0 if near < 1.001 * low else near, math.inf if far > 0.999 * high else far)
    settings.set_clip(viewer, clip)


def _training_cameras(viewer: Viewer) -> None:
    state = viewer.state
    assert state.scene is not None
    if imgui.arrow_button("##previous", imgui.Dir.left):
        viewpoint.step_camera(viewer, -1)
    imgui.same_line()
    if imgui.arrow_button("##next", imgui.Dir.right):
        viewpoint.step_camera(viewer, 1)
    imgui.same_line()
    index = state.camera_index or 0
    imgui.set_next_item_width(-1)
    name = state.scene.cameras[index].name.replace("%", "%%")
    changed, index = imgui.slider_int(
        "##camera", index, 0, len(state.scene.cameras) - 1, f"camera %d  {name}"
    )
    ui.tip("Training cameras: stand where a photograph was taken")
    if changed and index != state.camera_index:
        viewpoint.go_to_camera(viewer, index)
    viewer.change("fade", **ui.draw_fields(state.session, "Camera"))
    if state.session.fade == 0:
        return
    photograph = opening.photograph_here(state)
    if photograph is None:
        ui.small_wrapped("stand at a training camera to see its photograph", ui.muted())
    elif photograph.reason:
        ui.small_wrapped(photograph.reason, ui.muted())
        if imgui.button("Folder of photographs ..."):
            browsing.ask_for_photographs(viewer)


# The panel "Record": keyframes of the camera path, playing it, films of it.

ROWS = 3.5  # of the list: the half one says that there are more
NUMBER_EM, FPS_EM = 7.5, 4.5


def draw_record(viewer: Viewer) -> None:
    """Draw the panel "Record": what the path is, playing it, saving it, films."""
    record = viewer.state.record
    turns = ui.radio({False: "Keyframes", True: "Turntable"}, record.turns)
    if turns != record.turns:
        filming.set_turning(viewer, turns)
    ui.tip("Once around what the view turns around; F makes that the latest result")
    imgui.begin_disabled(viewer.state.view is None)
    _play(viewer)
    if record.turns:
        _duration(viewer)
    else:
        _keyframes(viewer)
    _films(viewer)
    imgui.end_disabled()


def _play(viewer: Viewer) -> None:
    record, seconds = viewer.state.record, viewpoint.path_seconds(viewer)
    imgui.begin_disabled(seconds <= 0)
    if ui.button(
        "Stop##path" if record.began is not None else "Play##path", with_key("Play", viewpoint.toggle_playing)
    ):
        viewpoint.toggle_playing(viewer)
    imgui.same_line()
    loop = imgui.calc_text_size("Loop").x + imgui.get_frame_height() + 2 * imgui.get_style().item_spacing.x
    imgui.set_next_item_width(-loop)
    changed, at = imgui.slider_float("##at", record.at, 0.0, max(seconds, 1e-3), "%.2f s")
    if changed:
        viewpoint.scrub(viewer, at)
    imgui.end_disabled()
    imgui.same_line()
    settings.put(record, loops=imgui.checkbox("Loop", record.loops)[1])


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
    record, keyframes = viewer.state.record, viewer.state.session.keyframes
    if ui.button("Add keyframe", with_key("The current view", filming.add_keyframe)):
        filming.add_keyframe(viewer)
    if ui.next_button("Clear", enabled=bool(keyframes)):
        filming.clear_path(viewer)
    ui.beside("Duration", hello_imgui.em_size(NUMBER_EM))
    _duration(viewer)
    height = ROWS * imgui.get_frame_height_with_spacing()
    if imgui.begin_child("keyframes", ImVec2(0, height), imgui.ChildFlags_.borders):
        if not keyframes:
            ui.small_wrapped("Add the current view; the path goes smoothly from one to the next", ui.muted())
        for number, key in enumerate(keyframes, 1):
            imgui.push_id(number)
            text = f"{number}   {key.seconds:.2f} s"
            clicked, gone = ui.row(text, "keyframe", key is record.chosen)
            ui.tip("Take it off the path")
            if clicked:
                filming.choose_keyframe(viewer, key)
            if gone:
                filming.delete_keyframe(viewer, key)
            imgui.pop_id()
    imgui.end_child()
    _chosen(viewer, record.chosen)
    ui.leave_room("", NUMBER_EM + 2)
    _, typed = imgui.input_text_with_hint("##path file", "file.path.json", record.path_file)
    settings.put(record, path_file=typed)
    if ui.next_button("Save path"):
        filming.save_path(viewer)
    if ui.next_button("Load"):
        filming.load_path_file(viewer)


def _chosen(viewer: Viewer, key: Keyframe | None) -> None:
    imgui.begin_disabled(key is None)
    seconds = _number("##time of the keyframe", 0.0 if key is None else key.seconds, 0.5)
    if seconds is not None and key is not None:
        filming.move_keyframe(viewer, key, seconds)
    if ui.next_button("Set to this view") and key is not None:
        filming.replace_keyframe(viewer, key)
    ui.tip("Put the current view in its place")
    imgui.end_disabled()


def _films(viewer: Viewer) -> None:
    record = viewer.state.record
    imgui.separator()
    imgui.set_next_item_width(hello_imgui.em_size(NUMBER_EM))
    changed, size = imgui.input_int2("Size", list(record.size))
    if changed:
        filming.set_film_size(viewer, *size)
    ui.beside("fps", hello_imgui.em_size(FPS_EM))
    imgui.set_next_item_width(hello_imgui.em_size(FPS_EM))
    if imgui.begin_combo("fps", f"{record.fps:g}"):
        for fps in FPS_CHOICES:
            if imgui.selectable(f"{fps:g}", fps == record.fps)[0]:
                settings.put(record, fps=fps)
        imgui.end_combo()
    imgui.set_next_item_width(-1)
    hint = "film.mp4, .webp, .gif or a folder; empty: a new name"
    _, typed = imgui.input_text_with_hint("##film", hint, record.film_file)
    settings.put(record, film_file=typed)
    work = viewer.recorder.current
    if work is not None:
        if ui.stoppable(*work, tag="film"):
            filming.cancel_film(viewer)
        return
    if imgui.button("Save film"):
        filming.save_film(viewer)
    if ui.next_button("Save picture##sized", "What is shown now, in this size"):
        filming.save_sized_picture(viewer)
    if ui.next_button("Copy as command", "The command that draws this picture without a window"):
        filming.copy_command(viewer)


# The panel "Bookmarks".


def draw_bookmarks(viewer: Viewer) -> None:
    """Draw the panel "Bookmarks": a box for a name, and the list."""
    state = viewer.state
    imgui.begin_disabled(state.view is None)
    hint = "name of this view"
    name = ui.kept_box(viewer, "##bookmark", hint, "Keep")
    if name is not None:
        viewpoint.add_bookmark(viewer, name)
    imgui.end_disabled()
    if imgui.begin_child("bookmarks"):
        if not state.session.bookmarks:
            words = "views that you keep are listed here"
            ui.small_wrapped(with_key(words, viewpoint.add_bookmark), ui.muted())
        for number, bookmark in enumerate(state.session.bookmarks):
            imgui.push_id(number)
            clicked, gone = ui.row(bookmark.name, "bookmark", False)
            if clicked:
                viewpoint.go_to_bookmark(viewer, bookmark)
            if gone:
                viewpoint.delete_bookmark(viewer, bookmark)
            imgui.pop_id()
    imgui.end_child()
