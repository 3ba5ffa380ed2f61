"""Opening scenes: read, shown, listed, returned to, chosen in the file browser; and their photographs."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import is_compiled
from langsplat_core.display.displays import DISPLAYS, latent_colours
from langsplat_core.errors import InputError
from langsplat_core.io import cameras, language
from langsplat_core.io.scenes import format_of, scene_files
from langsplat_core.pipeline.forecast import count_photographs
from langsplat_core.pipeline.report import stated_warnings
from langsplat_core.progress import Progress
from langsplat_core.query.engine import no_field
from langsplat_core.query.finding import Answered, Hit, find
from langsplat_core.query.library import Library, update_library
from langsplat_core.scene import Camera, Scene, surface
from langsplat_core.semantics.encoders import DEMO
from langsplat_viewer.actions import projects
from langsplat_viewer.actions.filming import load_path
from langsplat_viewer.actions.history import forget, remember
from langsplat_viewer.actions.outline import have_things
from langsplat_viewer.actions.queries import ask, ask_again, load_queries, set_canonical
from langsplat_viewer.actions.selecting import leave
from langsplat_viewer.actions.settings import open_panel, show_scenes
from langsplat_viewer.actions.viewpoint import opening_view, read_bookmarks
from langsplat_viewer.camera.controls import Extent, extent_of
from langsplat_viewer.files import disk
from langsplat_viewer.files.disk import Entry, Photograph, Stamps, list_folder, stamps
from langsplat_viewer.files.preferences import with_photographs, with_recent
from langsplat_viewer.files.projects import PATHS, PROJECTS, QUERIES, Things, read_project, scene_of
from langsplat_viewer.jobs import one_line
from langsplat_viewer.marks import of_scene
from langsplat_viewer.rendering.request import UNCLIPPED, why_undrawable
from langsplat_viewer.state import LibraryView, Recording, SceneState, ViewerState
from langsplat_viewer.viewer import Viewer, Visit, unanswered, visit_of


@dataclass(frozen=True, eq=False)
class _Opened:
    """A scene with all that the window's thread should not have to compute."""

    scene: Scene
    unusable: dict[str, int]  # reason -> Gaussians that are therefore not drawn
    extent: Extent
    read: Stamps  # its files as they were before they were read
    doubts: tuple[str, ...]  # what the report of its training says against it


def open_scene(
    viewer: Viewer,
    path: Path,
    then: Callable[[Viewer], None] = lambda viewer: None,
    check: Callable[[Scene], None] = lambda scene: None,
) -> None:
    """Read a scene in the background; `then` runs once it is on screen. The scene shown so far stays
    until the new one is there, and for good if that fails; what was deleted in it and not saved is asked
    about first. `check` raises InputError for a scene that is not to be shown."""
    leave(viewer, lambda viewer: _open(viewer, path, then, check), f"{path.name} is opened")


def _open(viewer: Viewer, path: Path, then: Callable[[Viewer], None], check: Callable[[Scene], None]) -> None:
    cancel(viewer)
    viewer.state.opening = path
    backend = viewer.state.backend

    def work(progress: Progress) -> _Opened:
        progress(f"opening {path.name}", 0.1)
        read = stamps(scene_files(path))
        scene = viewer.services.load_scene(path)
        check(scene)
        progress(f"preparing {path.name}", 0.6)
        viewer.services.warm_up(scene, backend, progress)
        progress(f"preparing {path.name}", 0.9)
        unusable = scene.gaussians.invalid_rows()
        doubts = stated_warnings(path, len(scene.gaussians))
        return _Opened(scene, unusable, extent_of(scene), read, doubts)

    def done(opened: _Opened) -> None:
        _show_scene(viewer, path, opened)
        then(viewer)

    def failed(reason: str) -> None:
        viewer.state.opening = None
        viewer.say_error(reason)

    viewer.run(f"opening {path.name}", work, done, failed)


def cancel(viewer: Viewer) -> None:
    """Drop the work under way."""
    viewer.worker.cancel()
    viewer.state.opening = None
    photograph = viewer.state.photograph
    if photograph is not None and photograph.image is None and not photograph.reason:
        viewer.state.photograph = replace(photograph, reason="cancelled")
    waiting = [query for query in viewer.state.queries if query.pending]
    for query in waiting:
        query.pending = False
        query.problem = "" if query.result else "cancelled"


def _show_scene(viewer: Viewer, path: Path, opened: _Opened) -> None:
    state, scene = viewer.state, opened.scene
    if state.path is not None:
        viewer.visits[state.path.absolute()] = visit_of(state)
    fresh = SceneState(
        scene=scene,
        path=path,
        extent=opened.extent,
        doubts=opened.doubts,
        nothing=why_undrawable(scene.gaussians),
        camera_index=0 if scene.cameras else None,
        bookmarks=read_bookmarks(viewer, path),
        record=Recording(size=state.record.size, fps=state.record.fps),
        selection=of_scene(state.selection, len(scene.gaussians)),
    )
    state.begin(fresh)
    state.view, state.opening = opening_view(viewer), None
    state.settings = replace(state.settings, clip=UNCLIPPED)
    if scene.language is None:
        state.pointing = False
        if DISPLAYS[state.picture.display].needs_field:
            state.picture = replace(state.picture, display="rgb")
    add_scenes(viewer, [path])
    state.preferences = with_recent(state.preferences, path.absolute())
    viewer.engine, viewer.describer = viewer.services.engine(scene), None
    viewer.watch.begin(opened.read)
    forget(viewer)
    _say_opened(viewer, path, opened)
    if scene.language is not None:
        field = scene.language
        viewer.run("preparing latent colours", lambda progress: latent_colours(field))  # none is needed yet
        _compile_search(viewer)
        _warm_up_encoder(viewer, viewer.services.encoder_id or scene.language.encoder_id)


def _say_opened(viewer: Viewer, path: Path, opened: _Opened) -> None:
    scene = opened.scene
    reasons = ", ".join(f"{count:,} with {reason}" for reason, count in opened.unusable.items())
    not_drawn = f"; not drawn: {reasons}" if reasons else ""
    viewer.state.say(f"{path.name}: {len(scene.gaussians):,} Gaussians{not_drawn}")
    for reason in scene.unread:
        viewer.say_error(f"opened without what lies beside it: {reason}")
    for doubt in opened.doubts:
        viewer.say_error(doubt)
    if scene.language is None:
        viewer.state.say(no_field(scene))


def _compile_search(viewer: Viewer) -> None:
    engine = viewer.engine
    if engine is None or is_compiled(Path(surface.__file__)):
        return
    viewer.run(
        "compiling the search kernels, once per installation (half a minute)", lambda progress: engine.regions
    )


def _warm_up_encoder(viewer: Viewer, encoder_id: str) -> None:
    """Load a local encoder while the user looks round; a hub id may mean a download and waits for the
    first query that needs it."""
    if viewer.engine is None or not (encoder_id == DEMO or Path(encoder_id).expanduser().is_dir()):
        return
    viewer.run("loading the text encoder", viewer.engine.load_encoder)


# Visits: a scene that was shown before is found again as it was left.


def return_to(viewer: Viewer, visit: Visit) -> None:
    """Restore a visit in the scene that was just opened; what was asked is asked anew."""
    state = viewer.state
    if state.scene is None:
        return
    state.view, state.opening_camera = visit.view or state.view, visit.opening_camera
    count = len(state.scene.cameras)
    if visit.camera_index is not None and visit.camera_index < count:
        state.camera_index = visit.camera_index
    state.settings, state.ruler = replace(state.settings, clip=visit.clip), visit.ruler
    state.record.keyframes, state.notes = visit.keyframes, visit.notes
    state.kept, state.project = visit.kept, visit.project
    have_things(viewer, visit.things if visit.count == len(state.scene.gaussians) else Things())
    if state.scene.language is None and DISPLAYS[visit.display].needs_field:
        return
    state.picture = replace(state.picture, display=visit.display)
    state.latent_level = visit.latent_level
    if state.scene.language is None:
        return
    state.queries = [unanswered(query) for query in visit.queries]
    state.selected = None if visit.selected is None else state.queries[visit.selected]
    if visit.canonical:
        set_canonical(viewer, ", ".join(visit.canonical))  # which asks again
    else:
        ask_again(viewer)


def reload(viewer: Viewer) -> None:
    """Read the scene's files again and stay where one is; if that fails the reason is said and the scene is
    kept."""
    state = viewer.state
    path, shown = state.path, state.scene
    if path is None or shown is None:
        viewer.say_error("open a scene first; it can be read again when its file has changed")
        return
    if state.opening is not None:
        return
    known = shown.unread

    def check(scene: Scene) -> None:
        new = [reason for reason in scene.unread if reason not in known]
        if new:  # half written, or not written yet
            raise InputError(f"not read again, the scene stays as it was: {new[0]}")

    open_scene(viewer, path, lambda viewer: return_to(viewer, viewer.visits[path.absolute()]), check)


def keep_old(viewer: Viewer) -> None:
    """Keep the scene as it was read, though its files have changed."""
    viewer.watch.dismiss()


# The list of scenes. One is in memory at a time; of the others the visit is kept.

MOST = 100  # scenes that are listed


def add_scenes(viewer: Viewer, paths: Sequence[Path]) -> None:
    """List scenes, after those that are listed already."""
    listed = viewer.state.scenes
    new = dict.fromkeys(path.absolute() for path in paths)
    viewer.state.scenes = (*listed, *(path for path in new if path not in listed))[:MOST]


def switch_scene(viewer: Viewer, path: Path) -> None:
    """Show one of the list, as it was left if it was shown before."""
    state = viewer.state
    if state.path is not None and path == state.path.absolute() and state.opening is None:
        return

    def back(viewer: Viewer) -> None:
        if path in viewer.visits:
            return_to(viewer, viewer.visits[path])

    open_scene(viewer, path, back)


def step_scene(viewer: Viewer, by: int) -> None:
    """The next (1) or previous (-1) of the list, beyond its ends from the other one."""
    state = viewer.state
    others = [path for path in state.scenes if state.path is None or path != state.path.absolute()]
    if not others:
        viewer.say_error("no other scene is listed: drop several, or open another")
        return
    here = state.scenes.index(state.path.absolute()) if state.path and len(others) < len(state.scenes) else -1
    switch_scene(viewer, state.scenes[(here + by) % len(state.scenes)])


def unlist_scene(viewer: Viewer, path: Path) -> None:
    """Take a scene off the list, and forget its visit; the scene that is shown stays."""
    viewer.state.scenes = tuple(other for other in viewer.state.scenes if other != path)
    viewer.visits.pop(path, None)


# The photograph of the training camera at which the view stands, laid over the image.

SAME = 1e-6  # of the scene's radius, and of a rotation: nearer is the same place


def standing_at(state: ViewerState) -> Camera | None:
    """The training camera whose pose the view has, whatever its field of view; None elsewhere, and without
    perspective."""
    scene, view, index = state.scene, state.view, state.camera_index
    if (
        scene is None
        or view is None
        or view.orthographic
        or state.extent is None
        or index is None
        or state.glide is not None
    ):
        return None
    camera = scene.cameras[index]
    is_there = np.abs(view.eye - camera.position).max() <= SAME * state.extent.radius
    return camera if is_there and np.abs(view.rotation - camera.rotation).max() <= SAME else None


def photograph_here(state: ViewerState) -> Photograph | None:
    """Return the photograph of the camera at which the view stands, as far as it was looked for."""
    photograph = state.photograph
    return photograph if photograph is not None and photograph.camera is standing_at(state) else None


def fade_photograph(viewer: Viewer, fade: float) -> None:
    """Set the opacity of the photograph over the image, 0 to 1."""
    fade = min(max(fade, 0.0), 1.0)
    if fade != viewer.state.settings.fade:
        remember(viewer, "fade")
        viewer.state.settings = replace(viewer.state.settings, fade=fade)


def fetch_photograph(viewer: Viewer) -> None:
    """Have the worker look for a photograph that is wanted and was not looked for; called once per frame."""
    state = viewer.state
    camera = standing_at(state) if state.settings.fade > 0 else None
    if camera is None or state.path is None:
        return
    path, folder = state.path, _folder(viewer)
    before = state.photograph
    if before is not None and before.camera is camera and before.folder == folder:
        return
    wanted = state.photograph = Photograph(camera, folder)

    def work(progress: Progress) -> Array:
        return disk.read_photograph(disk.find_photograph(camera.name, path, folder), camera)

    def done(image: Array) -> None:
        if state.photograph is wanted:
            state.photograph = replace(wanted, image=image)

    def failed(reason: str) -> None:
        if state.photograph is wanted:
            state.photograph = replace(wanted, reason=reason)

    viewer.run(f"reading the photograph {camera.name}", work, done, failed)


def _folder(viewer: Viewer) -> str:
    path = viewer.state.path
    return "" if path is None else viewer.state.preferences.photographs.get(str(path.absolute()), "")


def ask_for_photographs(viewer: Viewer) -> None:
    """Open the browser to choose the folder that has the photographs of the scene."""
    state = viewer.state
    if state.path is not None:
        browse(viewer, Path(_folder(viewer) or state.path.parent).absolute())
        state.picks_folder = "photographs"


def choose_photograph_folder(viewer: Viewer, folder: Path) -> None:
    """Set the folder of this scene's photographs, and remember it."""
    state = viewer.state
    state.browser = None
    if state.path is not None:
        state.preferences = with_photographs(state.preferences, state.path.absolute(), folder.absolute())


# The library: all scenes of a folder, searched by their index.

MOST_HITS = 200  # scenes that the panel lists


def ask_for_folder(viewer: Viewer, purpose: Literal["library", "dataset"]) -> None:
    """Open the browser to choose a folder of scenes, or one to train on."""
    ask_for_file(viewer)
    viewer.state.picks_folder = purpose


def choose_folder(viewer: Viewer, folder: Path) -> None:
    """Take the folder that the browser was opened for."""
    state = viewer.state
    if state.picks_folder == "library":
        open_library(viewer, folder)
    elif state.picks_folder == "dataset":
        state.browser, state.training_form = None, replace(state.training_form, dataset=str(folder))
    else:
        choose_photograph_folder(viewer, folder)


def open_library(viewer: Viewer, folder: Path) -> None:
    """Read the index of a folder, and the scenes that are new there, in the background."""
    viewer.state.browser, load = None, lru_cache(maxsize=1)(viewer.services.load_encoder)

    def done(library: Library) -> None:
        hits = [Hit(folder / scene.path, "not here", 0.0, None) for scene in library.scenes]
        _show_hits(viewer, LibraryView(library, load, said=f"{len(hits)} scenes"), hits)
        for scene in library.unread:
            viewer.say_error(f"{scene.path}: {scene.unread}")
        open_panel(viewer, "Library")

    def work(progress: Progress) -> Library:
        return update_library(folder, load_encoder=load, progress=progress)

    viewer.run(f"reading the scenes of {folder.name}", work, done)


def ask_library(viewer: Viewer, phrase: str) -> None:
    """Rank the scenes of the library by how certain it is that they have what a phrase names."""
    view = viewer.state.library
    if view is None or not phrase.strip():
        return
    library, phrase = view.library, phrase.strip()

    def done(answers: list[Answered]) -> None:
        hits = sorted((hit for each in answers for hit in each.hits), key=lambda hit: -hit.margin)
        found = sum(hit.verdict == "found" for hit in hits)
        problems = [each.problem for each in answers if each.problem]
        said = "; ".join([f"'{phrase}': found in {found} of {len(hits)} scenes", *problems])
        _show_hits(viewer, replace(view, phrase=phrase, said=said), hits)

    def work(progress: Progress) -> list[Answered]:
        return find(library, phrase, view.load_encoder, 0, progress)

    viewer.run(f"searching '{phrase}' in {len(library.scenes)} scenes", work, done)


def _show_hits(viewer: Viewer, view: LibraryView, hits: Sequence[Hit]) -> None:
    listed, pictures = tuple(hits[:MOST_HITS]), view.library.thumbnails or {}
    names = [hit.path.relative_to(view.library.folder).as_posix() for hit in listed]
    image = np.concatenate([pictures[name] for name in names]) if names else None
    viewer.state.library = replace(view, hits=listed, thumbnails=image)


def type_library(viewer: Viewer, text: str) -> None:
    """Take the text of the library's box."""
    viewer.state.library_typed = text


def open_hit(viewer: Viewer, hit: Hit) -> None:
    """Open a scene of the library, and search it for what was looked for in all of them."""
    view = viewer.state.library
    phrase = "" if view is None else view.phrase
    open_scene(viewer, hit.path, lambda viewer: ask(viewer, phrase))


# The file browser, typed paths, files dropped onto the window, and recent scenes.

COMPANIONS = (cameras.SUFFIX, language.SUFFIX)  # files beside a scene, read with it
NAMED = 3  # files that a message names


def ask_for_file(viewer: Viewer) -> None:
    """Open the browser in the folder of the scene that is shown."""
    state = viewer.state
    browse(viewer, (Path.cwd() if state.path is None else state.path.parent).absolute())
    state.picks_folder, state.picks_beside = "", False


def ask_for_beside(viewer: Viewer) -> None:
    """Open the browser to choose a scene to show beside this one."""
    ask_for_file(viewer)
    viewer.state.picks_beside = True


def open_beside(viewer: Viewer, path: Path) -> None:
    """Show another scene right of a line, seen and asked as this one is."""
    beside = Viewer(viewer.services)
    beside.worker.wake, beside.state.backend = viewer.worker.wake, viewer.state.backend
    if viewer.beside is not None:
        viewer.beside.worker.close()
    viewer.beside = beside
    show_scenes(viewer)
    open_scene(beside, path)


def close_browser(viewer: Viewer) -> None:
    """Close the browser without choosing a file."""
    viewer.state.browser = None


def browse(viewer: Viewer, folder: Path) -> None:
    """Show another folder in the browser."""
    viewer.state.path_typed, viewer.state.browser = "", list_folder(folder)


def choose(viewer: Viewer, entry: Entry) -> None:
    """Go into a folder, or open a scene."""
    if entry.is_file:
        close_browser(viewer)
        (open_beside if viewer.state.picks_beside else open_file)(viewer, entry.path)
    else:
        browse(viewer, entry.path)


def open_file(viewer: Viewer, path: Path) -> None:
    """Open a scene or a project, ask a set of queries, or take a camera path."""
    if path.name.endswith(PROJECTS):
        open_project(viewer, path)
    elif path.name.endswith(QUERIES):
        load_queries(viewer, path)
    elif path.name.endswith(PATHS):
        load_path(viewer, path)
    else:
        open_scene(viewer, path)


def open_project(viewer: Viewer, path: Path, then: Callable[[Viewer], None] = lambda viewer: None) -> None:
    """Open the scene of a project, and have in it what the project holds; `then` runs once it is there."""
    try:
        project = read_project(path)
        scene = scene_of(project)
    except InputError as error:
        viewer.say_error(one_line(error))
        return

    def restore(viewer: Viewer) -> None:
        return_to(viewer, projects.restore(viewer, project, path.absolute()))
        then(viewer)

    open_scene(viewer, scene, restore)


def open_dropped(viewer: Viewer, paths: Sequence[Path]) -> None:
    """Open the first scene among files that were dropped onto the window, list the others, ask the queries
    among them, and say what is none of these; what belongs to a scene lies beside it. A folder of photographs
    is offered for training."""
    if len(paths) == 1 and _is_plain_folder(paths[0]) and count_photographs(paths[0])[0]:
        choose_photographs(viewer, paths[0])
        open_panel(viewer, "Train")
        return
    sets = [path for path in paths if path.name.endswith((QUERIES, PATHS, PROJECTS))]
    files = [path for path in paths if path not in sets]
    scenes = [path for path in files if not path.name.endswith(COMPANIONS)] or files
    if not scenes:
        _ask_sets(viewer, sets)
        return
    known = [path for path in scenes if format_of(path)] or scenes[:1]
    others = [path.name for path in scenes if path not in known]
    if others:
        more = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
        viewer.say_error(f"not opened: {', '.join(others[:NAMED])}{more}")
    add_scenes(viewer, known)
    if len(known) > 1:
        viewer.state.say(f"{len(known)} scenes: the panel Scene lists them")
        open_panel(viewer, "Scene")
    first = known[0]
    open_scene(viewer, first, lambda viewer: _ask_sets(viewer, sets))


def choose_photographs(viewer: Viewer, folder: Path) -> None:
    """Take a folder of photographs, and a name beside it for the scene."""
    form = viewer.state.training_form
    out = form.out or str(folder.with_name(f"{folder.name or 'scene'}.ply"))
    viewer.state.training_form = replace(form, dataset=str(folder), out=out)


def open_all(viewer: Viewer) -> None:
    """List the scenes of the folder that the browser shows, and open the first."""
    listing = viewer.state.browser
    if listing is not None:
        paths = [entry.path for entry in listing.entries if entry.is_file and format_of(entry.path)]
        if paths:
            add_scenes(viewer, paths)
            close_browser(viewer)
            open_scene(viewer, paths[0])
        open_panel(viewer, "Scene")


def _ask_sets(viewer: Viewer, sets: Sequence[Path]) -> None:
    for path in sets:
        open_file(viewer, path)


def open_recent(viewer: Viewer, path: str) -> None:
    """Open a scene or a project again that was open before."""
    close_browser(viewer)
    open_file(viewer, Path(path))


def type_path(viewer: Viewer, text: str) -> None:
    """Take the text of the box for a path."""
    viewer.state.path_typed = text


def open_typed(viewer: Viewer) -> None:
    """Go to the folder, or open the scene, that the box names: from the folder shown where it is relative."""
    text, listing = viewer.state.path_typed.strip(), viewer.state.browser
    if not text:
        return
    path = (listing.folder if listing else Path.cwd()) / os.path.expanduser(text)
    choose(viewer, Entry(path, is_file=not _is_plain_folder(path)))


def _is_plain_folder(path: Path) -> bool:
    try:
        return path.is_dir() and format_of(path) is None
    except OSError:  # a name that no file system takes: opening it says so
        return False
