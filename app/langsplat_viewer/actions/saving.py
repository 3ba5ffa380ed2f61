"""Saving: pictures, views and films, exports, projects; and the question before leaving.

Files are new, or replace one that a dialog has asked about; a project is saved to the file that it came from.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import wait
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from langsplat_core import registry
from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.io import cameras, sidecar
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.files import check_output_file, write_whole
from langsplat_core.io.scenes import check_keeps, save_scene, scene_files
from langsplat_core.pipeline.webpage import make_page
from langsplat_core.progress import Progress
from langsplat_core.scene import Scene
from langsplat_viewer import output
from langsplat_viewer.actions.editing import has_selection
from langsplat_viewer.actions.settings import ask_for, folder_of
from langsplat_viewer.actions.viewpoint import bookmarked_view, count_path_as_saved, path_seconds
from langsplat_viewer.camera.flight import pose_of
from langsplat_viewer.jobs import one_line
from langsplat_viewer.options import say_compiling
from langsplat_viewer.projects import PATHS, PROJECTS, Project, write_flight, write_project
from langsplat_viewer.rendering.renderer import open_renderer
from langsplat_viewer.session import Bookmark, Session, point_of
from langsplat_viewer.state import ExportForm, FileChoice, Leaving, OpenScene, Saved, Visit, flight_of
from langsplat_viewer.viewer import CommandProcess, Viewer, needs_scene, program


def _new_file(
    scene: Path | None, folder: Path, suffix: str, more: str = "", companions: tuple[str, ...] = ()
) -> Path:
    """Return a free name after the scene's in `folder`, beside the scene or at home, where one can write."""
    places = (folder, folder if scene is None else scene.parent, Path(os.path.expanduser("~")))
    place = next((place for place in places if os.access(place, os.W_OK)), folder)
    return output.free_name(place, f"{'scene' if scene is None else scene.stem}{more}", suffix, companions)


# Pictures, views and paths.


@needs_scene("save a picture of it")
def save_picture(viewer: Viewer, seen: OpenScene, folder: Path = Path()) -> Path | None:
    """Save the scene as shown to a new PNG in `folder`; return its path, None if that failed."""
    if viewer.surface is None:
        return None
    state, path = viewer.state, _new_file(seen.path, folder, ".png")
    beside, transparent = viewer.beside, state.session.picture.transparent
    shown = [viewer] if beside is None or beside.state.open is None else [viewer, beside]

    def write() -> None:
        requests = [(one.surface, one.state.request(None, transparent)) for one in shown]
        with output.in_one_line(path, "this size"):
            images = [surface.capture(request) for surface, request in requests if surface is not None]
        output.save_png(path, state.session.split.joined(images, images[0].shape[1]))

    return viewer.save(path, write)


def _record(
    viewer: Viewer,
    label: str,
    work: Callable[[Progress], tuple[Path, str]],
    then: Callable[[], None] = lambda: None,
) -> None:
    """Have the recorder's thread write a file; `work` returns its path with the message about it."""

    def done(written: tuple[Path, str]) -> None:
        viewer.state.say(written[1], file=written[0])
        then()

    viewer.recorder.submit(label, work, done, viewer.say_error)


@needs_scene("save a picture of it")
def save_sized_picture(viewer: Viewer, seen: OpenScene, folder: Path = Path()) -> None:
    """Have the scene as shown drawn by the CPU in the size of a film, and saved to a new file."""
    state, (width, height) = viewer.state, viewer.state.record.size
    request = state.request((width, height), state.session.picture.transparent)

    def work(progress: Progress) -> tuple[Path, str]:
        path = _new_file(seen.path, folder, ".png", f"-{width}x{height}")
        progress("drawing", 0.0, path.name)
        with output.in_one_line(path, f"{width}x{height}"), open_renderer("cpu") as renderer:
            output.save_png(path, output.draw_something(request, renderer))
        return path, f"saved {path}"

    if state.session.split.mode == "scenes":
        state.say(f"the picture is of {seen.path.name} alone, without the compared scene")
    _record(viewer, f"picture of {width} x {height}", work)


@needs_scene("save a view of it")
def save_view(viewer: Viewer, seen: OpenScene, folder: Path = Path()) -> Path | None:
    """Save the camera, in perspective, to a new file that `--camera` reads; its path, None if that failed."""
    path, size = _new_file(seen.path, folder, ".json", "-view"), viewer.state.size
    camera = replace(seen.view, orthographic=False).camera(*size).moved(seen.scene.origin)
    span = f" --orthographic {seen.view.span_in(*size):.6g}" if seen.view.orthographic else ""
    more = f"; show it again with --camera {path.name}{span}"
    return viewer.save(path, lambda: write_cameras(path, (camera,)), more)


def save_path(viewer: Viewer, folder: Path = Path()) -> Path | None:
    """Save the camera path to a new file in `folder`; None where that failed."""
    keyframes = viewer.state.session.keyframes
    if not keyframes:
        viewer.say_error("a path to save needs a keyframe: add one at the current view")
        return None
    path = _new_file(viewer.state.path, folder, PATHS)
    more, flight = "; langsplat-viewer --headless --path makes a film of it", flight_of(keyframes)
    saved = viewer.save(path, lambda: write_flight(path, flight.moved(viewer.state.origin)), more)
    if saved is not None:
        count_path_as_saved(viewer)
    return saved


# Films, drawn by the CPU on a thread of their own.


def save_film(viewer: Viewer, folder: Path = Path()) -> None:
    """Have a film made along the path, to the typed place or to a new name in `folder`."""
    state, record, path = viewer.state, viewer.state.record, viewer.state.session.keyframes
    if state.open is None or path_seconds(viewer) <= 0:
        viewer.say_error("a film needs a path: add two keyframes, or press Turntable")
        return
    typed, fps, request = record.film_file.strip(), record.fps, state.request(record.size)
    scene, suffix = state.path, output.VIDEO if output.has_video() else ""

    def named() -> Path:
        new = folder.absolute() / os.path.expanduser(typed)
        return output.check_film(new if typed else _new_file(scene, folder, suffix, "-film"), record.size)

    try:
        named()
        seen_by = output.cameras_of(flight_of(path), state.open.extent, fps, record.size)
    except (InputError, OSError) as error:
        viewer.say_error(f"no film: {error}")
        return

    def work(progress: Progress) -> tuple[Path, str]:
        say_compiling(progress)
        out = named()  # a free name may have been taken by an earlier film meanwhile
        return out, "; ".join(output.make_film(request, seen_by, fps, out, "cpu", progress))

    if state.session.split.mode == "scenes":
        state.say(f"the film is of {state.open.path.name} alone, without the compared scene")
    _record(viewer, "film", work)


# The scene as it was edited.

COMPANIONS = (sidecar.SUFFIX, cameras.SUFFIX)
ALL_DELETED = "all Gaussians are deleted; undo (Ctrl+Z) brings them back"
LONGEST_WAIT = 60.0  # seconds that a window which is closed waits for what is being written


@needs_scene("save it")
def save_edited(
    viewer: Viewer, seen: OpenScene, folder: Path, then: Callable[[Viewer], None] = lambda viewer: None
) -> None:
    """Have the worker write the scene without what was deleted to a new file; `then` runs after that."""
    state = viewer.state
    marked, rows = state.session, np.flatnonzero(state.marks.kept)
    if len(rows) == 0:
        viewer.say_error(f"not saved: {ALL_DELETED}")
        return
    scene = replace(seen.scene, language=viewer.language)

    def work(progress: Progress) -> Path:
        path = _new_file(seen.path, folder, ".ply", "-edited", COMPANIONS)
        save_scene(path, replace(scene.take(rows), path=path))
        return path

    def done(path: Path) -> None:
        state.say(f"saved {path}: {len(rows):,} Gaussians", file=path)
        _count_as_saved(viewer, seen.scene, marked)
        then(viewer)

    state.writing = viewer.run(
        "saving the scene", work, done, lambda reason: viewer.say_error(f"not saved: {reason}")
    ).future


def _count_as_saved(viewer: Viewer, shown: Scene, session: Session) -> None:
    """Count the edits of a session as saved, if its scene is still shown."""
    state, saved = viewer.state, viewer.state.saved
    if state.open is not None and state.open.scene is shown:
        edits = replace(saved.session, marks=session.marks, moves=session.moves)
        state.saved = replace(saved, session=edits)


def finish_writing(viewer: Viewer) -> None:
    """Wait for files that are being written: the window closes, and the worker's thread ends with it."""
    if viewer.state.writing is not None:
        wait([viewer.state.writing], LONGEST_WAIT)


# Exports are made by commands of the command line, each in a process of its own.


@dataclass(frozen=True)
class ExportRow:
    """An export: a command of the command line and its options."""

    words: str  # the command, with placeholders for the scene, the output and --encoder
    about: str
    # Suffix, "" of a folder -> bytes in all, for each Gaussian, and for each coefficient of its colours, as
    # measured on the bundled scene. `at_most`: it may be much less. `beside`: companions are added.
    sizes: Mapping[str, tuple[float, float, float]]
    options: tuple[str, ...] = ()  # of `OPTIONS`
    at_most: bool = False
    beside: bool = False
    finds: str = ""  # other words that people look for


CELL, UNIT = "--resolution", "--metres-per-unit"
OPTIONS: dict[str, tuple[str, float, tuple[float, float]]] = {  # label, default (False: a switch), limits
    "--max-psnr-loss": ("Loss allowed, dB", 0.1, (0.01, 3.0)),
    "--watertight": ("Close all holes", False, (0, 1)),
    CELL: ("Metres of a cell", 0.05, (0.01, 0.5)),
    UNIT: ("Metres of a unit", 1.0, (0.001, 1000.0)),  # where the scene has none
}
SCENE_SIZES = {
    ".ply": (0, 56, 12), ".spz": (0, 14, 2), ".sog": (0, 20, 0.5), ".glb": (0, 52, 12), ".gltf": (0, 70, 16),
    ".splat": (0, 32, 0), ".usdc": (0, 44, 12),
}  # fmt: skip
PAGE, SCENE = "web page", "scene"
EXPORTS = {
    PAGE: ExportRow(
        "export {scene} {out}", "One file that any browser shows and searches, without a network.",
        {".html": (1.2e6, 52, 3)}, finds="save html browser share website offline",
    ),
    SCENE: ExportRow(
        "convert {scene} {out}", ".ply keeps everything; .spz and .sog are a fifth, and rounded; .splat is "
        "without view dependence.", SCENE_SIZES, beside=True,
        finds="save convert format ply spz sog gltf splat write as cleaned",
    ),
    "cleaned copy": ExportRow(
        "clean {scene} {out}", "Without floaters: small regions that touch nothing, and veils in free space.",
        SCENE_SIZES, options=("--max-psnr-loss",), at_most=True, beside=True, finds="floaters remove tidy",
    ),
    "compacted copy": ExportRow(
        "compact {scene} --out {out}", "Without Gaussians and colours that the views do not need.",
        SCENE_SIZES, options=("--max-psnr-loss",), at_most=True, beside=True,
        finds="compress smaller prune shrink reduce",
    ),
    "mesh": ExportRow(
        "mesh {scene} {out}", "Triangles with colours: .glb in metres with y up, .ply in the scene's units.",
        {".glb": (15e6, 0, 0), ".ply": (15e6, 0, 0)}, options=("--watertight",), at_most=True,
        finds="triangles surface glb geometry print",
    ),
    "map for a robot": ExportRow(
        "map {scene} {out} {encoder}", "Occupancy grid, labelled voxels and a collider, into a folder.",
        {"": (5e6, 0, 0)}, options=(CELL, UNIT), finds="occupancy ros navigation voxels collider",
    ),
    "labels": ExportRow(
        "describe {scene} --labels {out} {encoder}", "The scene with instance, part and class of each "
        "Gaussian, and the words for them.", {".ply": (6e4, 68, 12)}, beside=True,
        finds="segmentation classes instances annotations",
    ),
}  # fmt: skip


def exports() -> tuple[str, ...]:
    """Return the titles of the exports that work here: an extension may be absent."""
    known = {"export", "convert", "describe", *registry.references("commands")}
    return tuple(title for title, row in EXPORTS.items() if row.words.split()[0] in known)


@needs_scene("export it")
def ask_export(viewer: Viewer, seen: OpenScene, title: str, only_selected: bool = False) -> None:
    """Open the dialog of the export `title`, unless there is nothing to write."""
    if not viewer.state.marks.kept.any():
        viewer.say_error(f"nothing to export: {ALL_DELETED}")
        return
    if only_selected and not has_selection(viewer):
        return
    row = EXPORTS[title]
    shown = (flag for flag in row.options if flag != UNIT or seen.scene.metres_per_unit is None)
    values = {flag: OPTIONS[flag][1] for flag in shown}
    viewer.state.export_form = ExportForm(title, next(iter(row.sizes)), values, only_selected)


def exported(viewer: Viewer, form: ExportForm) -> Array:
    """Return (N,) bool: the Gaussians that are written."""
    marks = viewer.state.marks
    return marks.selected if form.only_selected else marks.kept


@needs_scene()
def export_size(viewer: Viewer, seen: OpenScene, form: ExportForm) -> str:
    """Return about how large the files will be, in words."""
    row, rows = EXPORTS[form.title], exported(viewer, form)
    in_all, each, by_colour = row.sizes[form.suffix]
    size = in_all + rows.sum() * (each + by_colour * seen.scene.gaussians.sh.shape[1])
    size *= (OPTIONS[CELL][1] / form.values.get(CELL, OPTIONS[CELL][1])) ** 2
    if row.beside:
        size += rows.mean() * sum(file.stat().st_size for file in scene_files(seen.path)[1:] if file.exists())
    return f"{'At most' if row.at_most else 'About'} {float(f'{size / 1e6:.2g}'):g} MB"


@needs_scene()
def choose_export(viewer: Viewer, seen: OpenScene, form: ExportForm) -> None:
    """Close the dialog of exports, have one ask for the file or folder, and write it."""
    viewer.state.export_form = None
    then = partial(run_export, form=form)
    new = _new_file(seen.path, folder_of(viewer), form.suffix, f"-{form.title.split()[0]}")
    ask_for(viewer, FileChoice(f"Export: {form.title}", then, "save", (form.suffix,), new))


@needs_scene()
def run_export(viewer: Viewer, seen: OpenScene, out: Path, form: ExportForm) -> None:
    """Have the recorder's thread run the command, on the scene's file or, if it was edited, a copy."""
    row, session = EXPORTS[form.title], viewer.state.session
    path, mask, scene = seen.path, exported(viewer, form), replace(seen.scene, language=viewer.language)
    taught = viewer.engine is not None and bool(viewer.engine.taught)
    is_own = mask.all() and not (session.moves or taught or viewer.watch.changed) and path.exists()
    rows, write_page_of, chosen = np.flatnonzero(mask), _page(viewer, seen), viewer.services.encoder_id
    encoder = f"--encoder={chosen}" if chosen else ""  # of the window
    is_new = not out.exists()
    words = [flag if value is True else f"{flag}={value:g}" for flag, value in form.values.items() if value]

    def work(progress: Progress) -> tuple[Path, str]:
        check_keeps(out, path)
        if is_new and out.exists():
            raise InputError(f"{out}: was written by an earlier export; choose another name")
        if form.title == PAGE:
            check_output_file(out)
            return out, write_page_of(out, scene.take(rows), progress)
        with TemporaryDirectory(prefix="langsplat-") as folder:
            source = path.absolute() if is_own else Path(folder) / f"{path.stem}.ply"
            if not is_own:
                progress("copying the scene", 0.0)
                save_scene(source, replace(scene.take(rows), path=source))
            named = (word.format(scene=source, out=out, encoder=encoder) for word in row.words.split())
            process = CommandProcess([*program(), *filter(None, named), *words], viewer.recorder.wake)
            try:
                while process.exit_code is None:
                    stage, fraction = [("starting", 0.0), *process.progress.stages.items()][-1]
                    progress(f"{form.title}: {stage}", fraction)
                    time.sleep(0.1)
            finally:
                process.end(patience=3.0)  # less than a window that closes waits for it
        return out, _said(process, out)

    def then() -> None:
        if form.title == SCENE and out.suffix == ".ply" and not form.only_selected:
            _count_as_saved(viewer, seen.scene, session)

    _record(viewer, form.title, work, then)


def _said(process: CommandProcess, out: Path) -> str:
    """Return a command's message about the file it wrote; InputError with the reason where it failed."""
    said = process.progress.said
    if process.exit_code != 0:
        raise InputError((said or ["no reason given"])[-1].removeprefix("langsplat: "))
    own = [line.removeprefix(f"{out}: ") for line in said if line.startswith(f"{out}: ")]
    return "; ".join([f"saved {out}", *(own or [line for line in said[-3:] if str(out) not in line])])


def _page(viewer: Viewer, seen: OpenScene) -> Callable[[Path, Scene, Progress], str]:
    """Return the function that writes a web page with the current view, the bookmarks and the notes.

    The command line does not know these. The function returns the message about the page.
    """
    state, services = viewer.state, viewer.services
    stands = {"as exported": replace(seen.view, orthographic=False)}
    stands |= {mark.name: bookmarked_view(mark, seen.extent) for mark in state.session.bookmarks}
    first = [replace(view.camera(*state.size), name=name) for name, view in stands.items()]
    notes = [(note.text, note.at) for note in state.session.notes]

    def write(out: Path, scene: Scene, progress: Progress) -> str:
        engine = None if scene.language is None else services.engine(scene)
        text, report = make_page(scene, engine, out.stem, progress, first, notes)
        write_whole(out, text)
        return f"saved {out}: {report.bytes / 1e6:.1f} MB, opens in any browser"

    return write


# Projects.


def save(viewer: Viewer) -> None:
    """Save the project to its file; where it has none yet, a dialog asks for one."""
    if viewer.state.saved.project is None:
        save_as(viewer)
    else:
        save_project(viewer)


@needs_scene("save the project")
def save_as(viewer: Viewer, seen: OpenScene) -> None:
    """Have a dialog ask for the file that the project is saved to from now on."""
    new = _new_file(seen.path, folder_of(viewer), PROJECTS)
    ask_for(viewer, FileChoice("Save the project", save_project, "save", (PROJECTS,), new))


@needs_scene("save the project")
def save_project(viewer: Viewer, seen: OpenScene, to: Path = Path(), of: Visit | None = None) -> Path | None:
    """Save the project as `to`, or where that is a folder to the file that it came from or a new one there.

    `of`: a scene that was left, by default the one shown. Return the path, None where saving failed.
    """
    visit = of or viewer.state.visit(seen)
    saved, view = visit.saved, visit.view
    path = to if to.name.endswith(PROJECTS) else saved.project or _new_file(visit.path, to, PROJECTS)
    known = saved.digest if path == saved.project else ""
    project = Project(
        scene=os.path.abspath(visit.path),
        gaussians=visit.count,
        origin=point_of(visit.origin),
        view=Bookmark("view", pose_of(view), view.distance),
        session=visit.session,
        intrinsics=view.intrinsics,
        panels=viewer.state.preferences.panels or (),
    )
    written: list[tuple[str, Path | None]] = []

    apart = partial(output.free_name, path.parent, f"{path.name.removesuffix(PROJECTS)}-other", PROJECTS)
    if viewer.save(path, lambda: written.append(write_project(path, project, apart, known))) is None:
        return None
    ((digest, kept),) = written
    if kept is not None:
        viewer.say_error(f"{path.name} held what this window has not: kept as {kept.name}")
    visit.saved = Saved(visit.session, path, digest)
    if visit.path is seen.path:
        viewer.state.saved = visit.saved
    viewer.state.preferences = viewer.state.preferences.with_recent(path)
    return path


def show_in_folder(viewer: Viewer, path: Path) -> None:
    """Have the system's file manager show where a file lies."""
    program = {"darwin": "open", "win32": "explorer"}.get(sys.platform, "xdg-open")
    try:
        subprocess.Popen([program, str(path.parent)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError as error:
        viewer.say_error(f"{path.parent}: cannot be shown ({one_line(error)}); open it in a file manager")


# Another scene, or none: what was deleted and not saved is asked about first.


def leave(viewer: Viewer, then: Callable[[Viewer], None], to: str, loses_more: bool = False) -> None:
    """Call `then` at once if nothing is lost by it, else after the user's answer; `to`: its name in words."""
    if viewer.state.is_unsaved or loses_more:
        viewer.state.leaving = Leaving(then, to)
    else:
        then(viewer)


def quit_viewer(viewer: Viewer) -> None:
    """Close the window; ask first where something would be lost."""
    viewer.state.echoes = True  # nobody reads the messages of a window that is gone
    leave(viewer, _close, "the window closes", loses_more=bool(viewer.unsaved()))


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
    for visit in viewer.unsaved():
        save_project(viewer, folder, visit)
    if viewer.state.is_unsaved:
        save_edited(viewer, folder, end_at_once)
    else:
        end_at_once(viewer)


def go_on(viewer: Viewer) -> None:
    """Do the action that waited for an answer, whatever is lost."""
    leaving, viewer.state.leaving = viewer.state.leaving, None
    if leaving is not None:
        leaving.then(viewer)


def save_and_leave(viewer: Viewer, folder: Path = Path()) -> None:
    """Write the scene without what was deleted to a new file in `folder`, and go on once it is there."""
    leaving, viewer.state.leaving = viewer.state.leaving, None
    if leaving is not None:  # notes are asked about next
        save_edited(viewer, folder, quit_viewer if leaving.then is _close else leaving.then)


def save_project_and_leave(viewer: Viewer, folder: Path = Path()) -> None:
    """Save the projects of all scenes that need it and go on; stay where one cannot be saved."""
    is_saved = save_project(viewer, folder) is not None if viewer.state.is_changed else True
    if is_saved and all(save_project(viewer, folder, visit) for visit in viewer.unsaved()):
        go_on(viewer)
