"""What is written: pictures, views and films, parts of the scene, projects; and the question before leaving.

Everything goes to new files, never over old ones, but a project to the file that it came from.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError, LangSplatError
from langsplat_core.io import cameras, sidecar
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.scenes import save_scene
from langsplat_core.io.shapes import write_points
from langsplat_core.pipeline.webpage import write_page
from langsplat_core.progress import Progress
from langsplat_core.scene import Scene
from langsplat_viewer import output
from langsplat_viewer.actions.editing import adopt, has_selection
from langsplat_viewer.actions.settings import ask_for, folder_of
from langsplat_viewer.actions.viewpoint import bookmarked_view, path_motion
from langsplat_viewer.camera.flight import pose_of
from langsplat_viewer.jobs import one_line
from langsplat_viewer.options import say_compiling
from langsplat_viewer.projects import (
    MADE,
    PATHS,
    PROJECTS,
    Project,
    checked,
    plain,
    write_flight,
    write_project,
)
from langsplat_viewer.rendering.renderer import open_renderer
from langsplat_viewer.session import Bookmark, Session
from langsplat_viewer.state import FileChoice, Leaving, flight_of
from langsplat_viewer.viewer import Viewer


def _new_file(viewer: Viewer, folder: Path, suffix: str, more: str = "") -> Path:
    """Return a free name in `folder`, after the scene's."""
    path = viewer.state.path
    return output.free_name(folder, f"{'scene' if path is None else path.stem}{more}", suffix)


# Pictures, views and paths.


def save_picture(viewer: Viewer, folder: Path = Path()) -> Path | None:
    """Save the scene as shown to a new PNG in `folder`; return its path, None if that failed."""
    state = viewer.state
    if viewer.surface is None or state.scene is None or state.view is None:
        viewer.say_error("open a scene first, then save a picture of it")
        return None
    path = _new_file(viewer, folder, ".png")
    beside, transparent = viewer.beside, state.session.picture.transparent
    shown = [viewer] if beside is None or beside.state.scene is None else [viewer, beside]

    def write() -> None:
        requests = [(one.surface, one.state.request(None, transparent)) for one in shown]
        with output.in_one_line(path, "this size"):
            images = [surface.capture(request) for surface, request in requests if surface is not None]
        output.save_png(path, state.session.split.joined(images, images[0].shape[1]))

    return viewer.save(path, write)


def _record(viewer: Viewer, label: str, work: Callable[[Progress], tuple[Path, str]]) -> None:
    """Have the recorder's thread write a file; `work` returns it with what is said of it."""

    def done(written: tuple[Path, str]) -> None:
        viewer.state.say(written[1], file=written[0])

    viewer.recorder.submit(label, work, done, viewer.say_error)


def save_sized_picture(viewer: Viewer, folder: Path = Path()) -> None:
    """Have the scene as shown drawn by the CPU in the size of a film, and saved to a new file."""
    state, (width, height) = viewer.state, viewer.state.record.size
    if state.view is None:
        viewer.say_error("open a scene first, then save a picture of it")
        return
    request = state.request((width, height), state.session.picture.transparent)

    def work(progress: Progress) -> tuple[Path, str]:
        path = _new_file(viewer, folder, ".png", f"-{width}x{height}")
        progress("drawing", 0.0, path.name)
        with output.in_one_line(path, f"{width}x{height}"), open_renderer("cpu") as renderer:
            output.save_png(path, output.draw_something(request, renderer))
        return path, f"saved {path}"

    _record(viewer, f"picture of {width} x {height}", work)


def save_page(viewer: Viewer, folder: Path = Path()) -> None:
    """Have the scene, without what was deleted, written as a web page that can be searched, a new file.

    It opens with the current view, and has the bookmarks and notes.
    """
    state, session = viewer.state, viewer.state.session
    if not viewer.has_scene("write its web page") or not (state.scene and state.view and state.extent):
        return
    scene, kept = replace(state.scene, language=viewer.language), state.marks.kept
    stands = {"as exported": replace(state.view, orthographic=False)}
    stands |= {bookmark.name: bookmarked_view(bookmark, state.extent) for bookmark in session.bookmarks}
    first = [replace(view.camera(*state.size), name=name) for name, view in stands.items()]
    notes = [(note.text, note.at) for note in session.notes]

    def work(progress: Progress) -> tuple[Path, str]:
        path = _new_file(viewer, folder, ".html")
        left = scene if kept.all() else scene.take(np.flatnonzero(kept))
        engine = viewer.services.engine(left) if left.language is not None else None
        report = write_page(path, left, engine, path.stem, progress, first, notes)
        return path, f"saved {path}: {report.bytes / 1e6:.1f} MB, opens in any browser"

    _record(viewer, "web page", work)


def save_view(viewer: Viewer, folder: Path = Path()) -> Path | None:
    """Save the camera, in perspective, to a new file that `--camera` reads; its path, None if that failed."""
    state = viewer.state
    if state.view is None:
        viewer.say_error("open a scene first, then save a view of it")
        return None
    path = _new_file(viewer, folder, ".json", "-view")
    camera = replace(state.view, orthographic=False).camera(*state.size).moved(state.origin)
    span = f" --orthographic {state.view.span_in(*state.size):.6g}" if state.view.orthographic else ""
    more = f"; show it again with --camera {path.name}{span}"
    return viewer.save(path, lambda: write_cameras(path, (camera,)), more)


def save_path(viewer: Viewer, folder: Path = Path()) -> Path | None:
    """Save the camera path to a new file in `folder`; None where that failed."""
    keyframes = viewer.state.session.keyframes
    if not keyframes:
        viewer.say_error("a path to save needs a keyframe: add one at the current view")
        return None
    path = _new_file(viewer, folder, PATHS)
    more = "; langsplat-viewer --headless --path makes a film of it"
    return viewer.save(
        path, lambda: write_flight(path, flight_of(keyframes).moved(viewer.state.origin)), more
    )


# Films, drawn by the CPU on a thread of their own.


def save_film(viewer: Viewer, folder: Path = Path()) -> None:
    """Have a film made along the path, to the typed place or to a new name in `folder`."""
    state, record, motion = viewer.state, viewer.state.record, path_motion(viewer)
    if motion is None or state.extent is None:
        viewer.say_error("a film needs a path: add a keyframe, or choose a turntable")
        return
    typed, request = record.film_file.strip(), state.request(record.size)
    try:
        new = folder.absolute() / typed
        if not typed:
            new = _new_file(viewer, folder, output.VIDEO if output.has_video() else "", "-film")
        out = output.check_film(new, record.size)
        shot = output.Shot(
            request, output.cameras_of(motion, state.extent, record.fps, record.size), record.fps, "cpu"
        )
    except (InputError, OSError) as error:
        viewer.say_error(f"no film: {error}")
        return

    def work(progress: Progress) -> tuple[Path, str]:
        say_compiling(progress)
        return out, "; ".join(output.make_film(shot, out, progress))

    _record(viewer, f"film {out.name}", work)


# The selection, the rest, or the scene without what was deleted.

Part = Literal["selection", "rest", "edited"]
COMPANIONS = (sidecar.SUFFIX, cameras.SUFFIX)
LONGEST_WAIT = 60.0  # seconds that a window which is closed waits for what is being written


def export(
    viewer: Viewer,
    folder: Path,
    part: Part,
    as_points: bool = False,
    then: Callable[[Viewer], None] = lambda viewer: None,
) -> None:
    """Have the worker write a part of the scene to a new file in `folder`; `then` runs once it is there."""
    if not (viewer.has_scene("save it") if part == "edited" else has_selection(viewer)):
        return
    state, marks, session = viewer.state, viewer.state.marks, viewer.state.session
    assert state.scene is not None
    shown, scene = state.scene, replace(state.scene, language=viewer.language)
    parts = {"selection": marks.selected, "rest": marks.kept & ~marks.selected, "edited": marks.kept}
    rows = np.flatnonzero(parts[part])
    if len(rows) == 0:
        viewer.say_error(f"the {part} holds no Gaussians: nothing to write")
        return
    stem = f"{state.path.stem if state.path else 'scene'}-{part}{'-points' if as_points else ''}"

    def done(written: tuple[Path, int]) -> None:
        path, count = written
        state.say(f"saved {path}: {count:,} {'points' if as_points else 'Gaussians'}", file=path)
        if part == "edited" and not as_points and state.scene is shown:
            state.saved = replace(state.saved, marks=session.marks, moves=session.moves)
        then(viewer)

    state.writing = viewer.run(
        f"saving the {part}",
        lambda progress: _write(scene, rows, folder, stem, as_points),
        done,
        lambda reason: viewer.say_error(f"not saved: {reason}"),
    ).future


def _write(scene: Scene, rows: Array, folder: Path, stem: str, as_points: bool) -> tuple[Path, int]:
    path = output.free_name(folder, stem, ".ply", () if as_points else COMPANIONS)
    if as_points:
        return path, write_points(path, scene.take(rows))
    save_scene(path, replace(scene.take(rows), path=path))
    return path, len(rows)


def finish_writing(viewer: Viewer) -> None:
    """Wait until what is being written is there: the window closes, and the worker's thread ends with it."""
    if viewer.state.writing is not None:
        wait([viewer.state.writing], LONGEST_WAIT)


# Projects.


def save(viewer: Viewer) -> None:
    """Save the project to its file; where it has none yet, a dialog asks for one."""
    if viewer.state.project is None:
        save_as(viewer)
    else:
        save_project(viewer)


def save_as(viewer: Viewer) -> None:
    """Have a dialog ask for the file that the project is saved to from now on."""
    if viewer.has_scene("save the project"):
        new = _new_file(viewer, folder_of(viewer), PROJECTS)
        choice = FileChoice("Save the project", _save_to, "save", (PROJECTS,), new)
        ask_for(viewer, choice)


def _save_to(viewer: Viewer, path: Path) -> None:
    save_project(viewer, to=path)


def save_project(viewer: Viewer, folder: Path = Path(), to: Path | None = None) -> Path | None:
    """Save the project, as `to` or to the file that it came from or to a new one in `folder`.

    Return where it is, None where that failed.
    """
    state = viewer.state
    if state.scene is None or state.path is None or state.view is None:
        viewer.say_error("open a scene first, then save the project")
        return None
    path = to or state.project or _new_file(viewer, folder, PROJECTS)
    read = state.project_read if path == state.project else None
    project = Project(
        scene=os.path.abspath(state.path),
        gaussians=len(state.scene.gaussians),
        origin=(float(state.origin[0]), float(state.origin[1]), float(state.origin[2])),
        view=Bookmark("view", pose_of(state.view), state.view.distance),
        session=state.session,
        intrinsics=state.view.intrinsics,
        panels=state.preferences.panels or (),
    )
    written: list[tuple[Project, Path | None]] = []

    def apart() -> Path:
        return output.free_name(path.parent, f"{path.name.removesuffix(PROJECTS)}-other", PROJECTS)

    def write() -> None:
        written.append(write_project(path, project, apart, read))

    if viewer.save(path, write) is None:
        return None
    ((state.project_read, kept),) = written
    state.project = path
    if kept is not None:
        viewer.say_error(f"{path.name} held what this window has not: kept as {kept.name}")
    _take_over(viewer, state.project_read.session)
    state.saved = state.session
    state.preferences = state.preferences.with_recent(path)
    return path


def _take_over(viewer: Viewer, written: Session) -> None:
    """Show what another window has made in the same project."""
    session = viewer.state.session
    made = {name: getattr(written, name) for name in MADE}
    if plain(written) == plain(checked(session)):
        return
    viewer.remember()  # or what is undone next is the other window's work, too
    try:
        adopt(viewer, replace(session, **made))
        viewer.state.say("with what another window has saved in it meanwhile")
    except LangSplatError as error:
        viewer.say_error(f"not shown, although saved: {one_line(error)}")


def show_in_folder(viewer: Viewer, path: Path) -> None:
    """Have the system's file manager show where a file lies."""
    program = {"darwin": "open", "win32": "explorer"}.get(sys.platform, "xdg-open")
    try:
        subprocess.Popen([program, str(path.parent)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError as error:
        viewer.say_error(f"{path.parent}: cannot be shown ({one_line(error)}); open it in a file manager")


# Another scene, or none: what was deleted and not saved is asked about first.


def leave(viewer: Viewer, then: Callable[[Viewer], None], to: str, loses_more: bool = False) -> None:
    """Do `then`: at once if nothing is lost by it, else when that was answered; `to` says what it is."""
    if viewer.state.is_unsaved or loses_more:
        viewer.state.leaving = Leaving(then, to)
    else:
        then(viewer)


def quit_viewer(viewer: Viewer) -> None:
    """Close the window; ask first where something would be lost."""
    leave(viewer, _close, "the window closes", viewer.state.is_changed)


def may_close(viewer: Viewer) -> bool:
    """Return whether the window may close now; where not, ask."""
    if not viewer.state.may_close:
        quit_viewer(viewer)
    return viewer.state.may_close


def _close(viewer: Viewer) -> None:
    if viewer.recorder.current is not None:
        viewer.state.leaving = Leaving(_close, "the window closes", film=True)
    else:
        end_at_once(viewer)


def end_at_once(viewer: Viewer) -> None:
    """Close, whatever is lost."""
    viewer.state.leaving, viewer.state.may_close = None, True


def end(viewer: Viewer, folder: Path = Path()) -> None:
    """Close without a question: what would be lost is first written to new files in `folder`.

    Where they are is said in the terminal.
    """
    viewer.state.echoes = True
    if viewer.state.has_unsaved_notes:
        save_project(viewer, folder)
    if viewer.state.is_unsaved:
        export(viewer, folder, "edited", then=end_at_once)
    else:
        end_at_once(viewer)


def go_on(viewer: Viewer) -> None:
    """Do what waited for an answer, whatever is lost."""
    leaving, viewer.state.leaving = viewer.state.leaving, None
    if leaving is not None:
        leaving.then(viewer)


def save_and_leave(viewer: Viewer, folder: Path = Path()) -> None:
    """Write the scene without what was deleted to a new file in `folder`, and go on once it is there."""
    leaving, viewer.state.leaving = viewer.state.leaving, None
    if leaving is not None:
        export(viewer, folder, "edited", then=leaving.then)


def save_project_and_leave(viewer: Viewer, folder: Path = Path()) -> None:
    """Save the project and go on; where it cannot be saved one stays."""
    if save_project(viewer, folder) is not None:
        go_on(viewer)
