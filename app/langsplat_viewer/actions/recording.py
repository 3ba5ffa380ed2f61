"""The camera path and its keyframes; what is undone of them."""

from dataclasses import replace
from pathlib import Path

from langsplat_core.errors import LangSplatError
from langsplat_viewer.actions.camera import glide_to
from langsplat_viewer.actions.history import remember
from langsplat_viewer.actions.playback import leave_path, path_seconds
from langsplat_viewer.actions.settings import open_panel
from langsplat_viewer.camera.flight import (
    LONGEST,
    SAME_TIME,
    Keyframe,
    pose_of,
    stretched,
    view_of,
    with_keyframe,
)
from langsplat_viewer.files.flight_files import MOST, SUFFIX, read_flight, write_flight
from langsplat_viewer.jobs import one_line
from langsplat_viewer.output.saving import free_name
from langsplat_viewer.recording import SPACING, flight_of
from langsplat_viewer.viewer import Viewer


def add_keyframe(viewer: Viewer) -> None:
    """The current view, some seconds after the last keyframe."""
    state, record = viewer.state, viewer.state.record
    if state.view is None:
        state.say("open a scene first, then record a path in it", is_error=True)
        return
    last = record.keyframes[-1].seconds + SPACING if record.keyframes else 0.0
    if last > LONGEST or len(record.keyframes) >= MOST:
        state.say(f"a path has at most {MOST} keyframes and {LONGEST:.0f} seconds", is_error=True)
        return
    added = Keyframe(last, pose_of(state.view))
    record.turns = False
    _set(viewer, (*record.keyframes, added), added)
    state.say(f"keyframe {len(record.keyframes)} at {added.seconds:.1f} s")


def choose_keyframe(viewer: Viewer, key: Keyframe) -> None:
    """Stand where a keyframe is."""
    state, record = viewer.state, viewer.state.record
    if state.extent is not None:
        glide_to(viewer, view_of(key.pose, state.extent))
        record.chosen, record.at = key, key.seconds


def delete_keyframe(viewer: Viewer, key: Keyframe) -> None:
    """Take it off the path; the others keep their times."""
    _set(viewer, tuple(other for other in viewer.state.record.keyframes if other is not key), None)


def move_keyframe(viewer: Viewer, key: Keyframe, seconds: float) -> None:
    """To another time; to that of another one: beside it."""
    others = tuple(other for other in viewer.state.record.keyframes if other is not key)
    seconds = min(max(seconds, 0.0), LONGEST)
    while any(abs(other.seconds - seconds) < SAME_TIME for other in others):
        seconds += 0.01
    moved = replace(key, seconds=seconds)
    _set(viewer, with_keyframe(others, moved), moved)


def replace_keyframe(viewer: Viewer, key: Keyframe) -> None:
    """Put the current view in its place."""
    if viewer.state.view is not None:
        new = replace(key, pose=pose_of(viewer.state.view))
        _set(viewer, with_keyframe(viewer.state.record.keyframes, new), new)


def set_path_seconds(viewer: Viewer, seconds: float) -> None:
    """Play the whole path in that time."""
    record = viewer.state.record
    seconds = min(max(seconds, 0.1), LONGEST)
    if record.turns:
        record.at *= seconds / record.turn_seconds
        record.turn_seconds = seconds
    elif path_seconds(viewer) > 0:
        steps = len(record.keyframes) * SAME_TIME
        _set(viewer, stretched(record.keyframes, max(seconds, steps)), None)


def clear_path(viewer: Viewer) -> None:
    """Take all keyframes off."""
    if viewer.state.record.keyframes:
        _set(viewer, (), None)


def _set(viewer: Viewer, keyframes: tuple[Keyframe, ...], chosen: Keyframe | None) -> None:
    remember(viewer)
    leave_path(viewer)
    record = viewer.state.record
    record.keyframes, record.chosen = keyframes, chosen
    record.at = chosen.seconds if chosen is not None else min(record.at, path_seconds(viewer))


def set_turning(viewer: Viewer, turns: bool) -> None:
    """Whether the path goes once around what the view turns around, in place of the keyframes."""
    leave_path(viewer)
    viewer.state.record.turns, viewer.state.record.at = turns, 0.0


def set_looping(viewer: Viewer, loops: bool) -> None:
    """Whether a played path begins again at its end."""
    viewer.state.record.loops = loops


def type_path_file(viewer: Viewer, text: str) -> None:
    """What stands in the box for a file with a path."""
    viewer.state.record.path_typed = text


def save_path(viewer: Viewer, folder: Path) -> Path | None:
    """Save the path to the typed file, or to a new one in `folder`; None where that failed."""
    state, record = viewer.state, viewer.state.record
    if not record.keyframes:
        state.say("a path to save needs a keyframe: add one at the current view", is_error=True)
        return None
    stem = state.path.stem if state.path else "camera"
    path = (
        folder / record.path_typed.strip() if record.path_typed.strip() else free_name(folder, stem, SUFFIX)
    )
    try:
        write_flight(path, flight_of(record.keyframes))
    except (OSError, ValueError) as error:
        state.say(f"{path}: not saved ({one_line(error)})", is_error=True)
        return None
    record.path_typed = str(path)
    state.say(f"saved {path}; langsplat-viewer --headless --path makes a film of it")
    return path


def load_path(viewer: Viewer, path: Path) -> None:
    """Take the path of a file in place of the one that is there."""
    try:
        flight = read_flight(path)
    except LangSplatError as error:
        viewer.state.say(str(error), is_error=True)
        return
    record = viewer.state.record
    record.turns = False
    _set(viewer, flight.keyframes, None)
    record.at, record.path_typed = 0.0, str(path)
    open_panel(viewer, "Record")
    viewer.state.say(f"{path.name}: {len(flight.keyframes)} keyframes, {flight.seconds:.1f} s")


def load_typed_path(viewer: Viewer, folder: Path) -> None:
    """Take the path of the typed file."""
    typed = viewer.state.record.path_typed.strip()
    if typed:
        load_path(viewer, folder / typed)
    else:
        viewer.state.say("type the name of a file with a path first", is_error=True)
