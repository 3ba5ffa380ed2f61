"""The camera path and its keyframes; films, and images of any size."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from langsplat_core.errors import InputError, LangSplatError
from langsplat_core.io.cameras import write_cameras
from langsplat_core.progress import Progress
from langsplat_viewer.actions.settings import open_panel
from langsplat_viewer.actions.viewpoint import glide_to, leave_path, path_seconds
from langsplat_viewer.camera.controls import with_projection
from langsplat_viewer.camera.flight import (
    LONGEST,
    SAME_TIME,
    Keyframe,
    Motion,
    pose_of,
    stretched,
    turntable,
    view_of,
    with_keyframe,
)
from langsplat_viewer.files.projects import MOST_KEYFRAMES, PATHS, read_flight, write_flight
from langsplat_viewer.options import MAX_SIDE, say_compiling
from langsplat_viewer.output import (
    VIDEO,
    Shot,
    cameras_of,
    check_film,
    draw_something,
    free_name,
    has_video,
    make_film,
    save_png,
)
from langsplat_viewer.rendering.renderer import open_renderer
from langsplat_viewer.state import SPACING, flight_of
from langsplat_viewer.viewer import Viewer


def save_picture(viewer: Viewer, folder: Path = Path()) -> Path | None:
    """Save the scene as shown to a new PNG in `folder`; returns its path, None if that failed."""
    state = viewer.state
    if viewer.surface is None or state.scene is None or state.view is None:
        viewer.say_error("open a scene first, then save a picture of it")
        return None
    path = free_name(folder, state.path.stem if state.path else "picture", ".png")
    surface, other, transparent = viewer.surface, viewer.beside, state.session.picture.transparent

    def write() -> None:
        images = [surface.capture(state.request(transparent=transparent))]
        if other is not None and other.surface is not None and other.state.scene is not None:
            images.append(other.surface.capture(other.state.request(transparent=transparent)))
        save_png(path, state.session.split.joined(images, images[0].shape[1]))

    return viewer.save(path, write)


def save_view(viewer: Viewer, folder: Path = Path()) -> Path | None:
    """Save the camera, in perspective, to a new file that `--camera` reads; its path, None if that failed."""
    state = viewer.state
    if state.view is None:
        viewer.say_error("open a scene first, then save a view of it")
        return None
    path = free_name(folder, f"{state.path.stem if state.path else 'view'}-view", ".json")
    camera = with_projection(state.view, orthographic=False).camera(*state.size)
    span = f" --orthographic {state.view.span_in(*state.size):.6g}" if state.view.orthographic else ""
    more = f"; show it again with --camera {path.name}{span}"
    return viewer.save(path, lambda: write_cameras(path, (camera,)), more)


def add_keyframe(viewer: Viewer) -> None:
    """Add the current view as a keyframe, some seconds after the last one."""
    state, record = viewer.state, viewer.state.record
    if state.view is None:
        viewer.say_error("open a scene first, then record a path in it")
        return
    keyframes = state.session.keyframes
    last = keyframes[-1].seconds + SPACING if keyframes else 0.0
    if last > LONGEST or len(keyframes) >= MOST_KEYFRAMES:
        viewer.say_error(f"a path has at most {MOST_KEYFRAMES} keyframes and {LONGEST:.0f} seconds")
        return
    added = Keyframe(last, pose_of(state.view))
    record.turns = False
    _set(viewer, (*keyframes, added), added)
    state.say(f"keyframe {len(keyframes) + 1} at {added.seconds:.1f} s")


def choose_keyframe(viewer: Viewer, key: Keyframe) -> None:
    """Go to a keyframe."""
    state, record = viewer.state, viewer.state.record
    if state.extent is not None:
        glide_to(viewer, view_of(key.pose, state.extent))
        record.chosen, record.at = key, key.seconds


def delete_keyframe(viewer: Viewer, key: Keyframe) -> None:
    """Take a keyframe off the path; the others keep their times."""
    _set(viewer, tuple(other for other in viewer.state.session.keyframes if other is not key), None)


def move_keyframe(viewer: Viewer, key: Keyframe, seconds: float) -> None:
    """Move a keyframe to another time, or beside a keyframe that has that time."""
    others = tuple(other for other in viewer.state.session.keyframes if other is not key)
    seconds = min(max(seconds, 0.0), LONGEST)
    while any(abs(other.seconds - seconds) < SAME_TIME for other in others):
        seconds += 0.01
    moved = replace(key, seconds=seconds)
    _set(viewer, with_keyframe(others, moved), moved)


def replace_keyframe(viewer: Viewer, key: Keyframe) -> None:
    """Put the current view in the place of a keyframe."""
    if viewer.state.view is not None:
        new = replace(key, pose=pose_of(viewer.state.view))
        _set(viewer, with_keyframe(viewer.state.session.keyframes, new), new)


def set_path_seconds(viewer: Viewer, seconds: float) -> None:
    """Set how long the path, or the turn, takes."""
    state, record = viewer.state, viewer.state.record
    seconds = min(max(seconds, 0.1), LONGEST)
    if record.turns:
        record.at *= seconds / record.turn_seconds
        record.turn_seconds = seconds
    elif path_seconds(viewer) > 0:
        steps = len(state.session.keyframes) * SAME_TIME
        _set(viewer, stretched(state.session.keyframes, max(seconds, steps)), None)


def clear_path(viewer: Viewer) -> None:
    """Take all keyframes off the path."""
    if viewer.state.session.keyframes:
        _set(viewer, (), None)


def _set(viewer: Viewer, keyframes: tuple[Keyframe, ...], chosen: Keyframe | None) -> None:
    leave_path(viewer)
    viewer.change(keyframes=keyframes)
    record = viewer.state.record
    record.chosen = chosen
    record.at = chosen.seconds if chosen is not None else min(record.at, path_seconds(viewer))


def set_turning(viewer: Viewer, turns: bool) -> None:
    """Have the path go once around what the view turns around, in place of the keyframes."""
    leave_path(viewer)
    viewer.state.record.turns, viewer.state.record.at = turns, 0.0


def save_path(viewer: Viewer, folder: Path = Path()) -> Path | None:
    """Save the path to a new file in `folder`; None where that failed."""
    state = viewer.state
    if not state.session.keyframes:
        viewer.say_error("a path to save needs a keyframe: add one at the current view")
        return None
    path = free_name(folder, state.path.stem if state.path else "camera", PATHS)
    more = "; langsplat-viewer --headless --path makes a film of it"
    return viewer.save(path, lambda: write_flight(path, flight_of(state.session.keyframes)), more)


def load_path(viewer: Viewer, path: Path) -> None:
    """Take the path of a file in place of the one that is there."""
    try:
        flight = read_flight(path)
    except LangSplatError as error:
        viewer.say_error(str(error))
        return
    record = viewer.state.record
    record.turns = False
    _set(viewer, flight.keyframes, None)
    record.at = 0.0
    open_panel(viewer, "Record")
    viewer.state.say(f"{path.name}: {len(flight.keyframes)} keyframes, {flight.seconds:.1f} s")


# Films and images of any size, drawn by the CPU on a thread of their own.


def set_film_size(viewer: Viewer, width: int, height: int) -> None:
    """Set the size of films and of images of any size, pixels."""
    width, height = (min(max(side, 1), MAX_SIDE) for side in (width, height))
    viewer.state.record.size = (width, height)


def film_motion(viewer: Viewer) -> Motion | None:
    """Return the path that is filmed; None without one."""
    state, record = viewer.state, viewer.state.record
    if state.view is None or path_seconds(viewer) <= 0:
        return None
    if record.turns:
        return turntable(record.turn_from or state.view, record.turn_seconds)
    return flight_of(state.session.keyframes)


def save_film(viewer: Viewer, folder: Path = Path()) -> None:
    """Have a film made along the path, to the typed place or to a new name in `folder`."""
    state, record, motion = viewer.state, viewer.state.record, film_motion(viewer)
    if motion is None or state.extent is None:
        viewer.say_error("a film needs a path: add a keyframe, or choose a turntable")
        return
    request = state.request(record.size)
    try:
        out = check_film(_film_out(viewer, folder), record.size)
        cameras = cameras_of(motion, state.extent, record.fps, record.size)
    except (InputError, OSError) as error:
        viewer.say_error(f"no film: {error}")
        return
    shot = Shot(request, cameras, record.fps, "cpu")

    def work(progress: Progress) -> str:
        say_compiling(progress)
        return "; ".join(make_film(shot, out, progress))

    _submit(viewer, f"film {out.name}", work)


def _film_out(viewer: Viewer, folder: Path) -> Path:
    typed = viewer.state.record.film_file.strip()
    if typed:
        return folder.absolute() / typed
    stem = f"{viewer.state.path.stem if viewer.state.path else 'scene'}-film"
    return free_name(folder, stem, VIDEO if has_video() else "")


def save_sized_picture(viewer: Viewer, folder: Path = Path()) -> None:
    """Have the scene as shown drawn in the size of a film and saved under a new name in `folder`."""
    state = viewer.state
    if state.view is None:
        viewer.say_error("open a scene first, then save a picture of it")
        return
    width, height = state.record.size
    request = state.request((width, height), state.session.picture.transparent)
    stem = f"{state.path.stem if state.path else 'picture'}-{width}x{height}"

    def work(progress: Progress) -> str:
        say_compiling(progress)
        path = free_name(folder, stem, ".png")
        with open_renderer("cpu") as renderer:
            save_png(path, draw_something(request, renderer))
        return f"saved {path}"

    _submit(viewer, f"picture of {width} x {height}", work)


def cancel_film(viewer: Viewer) -> None:
    """Stop what is being drawn; a folder of images is continued by the same film."""
    viewer.recorder.cancel()
    viewer.state.say("film stopped")


def _submit(viewer: Viewer, label: str, work: Callable[[Progress], str]) -> None:
    viewer.recorder.submit(label, work, viewer.state.say, viewer.say_error)
