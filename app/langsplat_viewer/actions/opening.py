"""Opening scenes: from files, dropped, listed, returned to, trained; and a second one beside the first."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from os.path import isdir
from pathlib import Path

import numpy as np

from langsplat_core.compiled import is_compiled
from langsplat_core.datasets.photos import count_photographs
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.errors import InputError, LangSplatError
from langsplat_core.io.files import is_utf8, shown
from langsplat_core.io.scenes import format_of, scene_files
from langsplat_core.pipeline.report import PREVIEW, stated_warnings, work_folder
from langsplat_core.progress import Progress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene, surface
from langsplat_viewer import disk
from langsplat_viewer.actions import viewpoint
from langsplat_viewer.actions.editing import adopt
from langsplat_viewer.actions.saving import COMPANIONS, leave
from langsplat_viewer.actions.settings import ask_for, compare, open_panel
from langsplat_viewer.camera.controls import Extent, default_view, extent_of
from langsplat_viewer.disk import Stamps, stamps
from langsplat_viewer.jobs import one_line
from langsplat_viewer.output import free_name
from langsplat_viewer.projects import PATHS, PROJECTS, Project, digest_of, read_project
from langsplat_viewer.rendering.request import Split, why_undrawable
from langsplat_viewer.session import OF_PROJECT, MarkBits, Query, Session, Things
from langsplat_viewer.state import FileChoice, OpenScene, Recording, Saved, SceneState, ViewerState, Visit
from langsplat_viewer.viewer import History, Training, Viewer, needs_scene


@dataclass(frozen=True, eq=False)
class _Opened:
    """A scene that was read, with everything that is too slow to compute on the window's thread."""

    scene: Scene
    unusable: dict[str, int]  # reason -> Gaussians that are therefore not drawn
    extent: Extent
    read: Stamps  # its files as they were before they were read
    warnings: tuple[str, ...]  # quality warnings in the report of its training


def open_scene(
    viewer: Viewer,
    path: Path,
    then: Callable[[Viewer], None] = lambda viewer: None,
    check: Callable[[Scene], None] = lambda scene: None,
) -> None:
    """Read a scene in the background; `then` runs once it is on screen.

    The scene shown so far stays until the new one is there, and for good if that fails; what was deleted in
    it and not saved is asked about first. `check` raises InputError for a scene that is not to be shown.
    """
    if not is_utf8(path):
        viewer.say_error(f"{shown(path)}: its name is not UTF-8, which a window cannot show; rename it")
        return

    def load(progress: Progress) -> _Opened:
        progress(f"opening {path.name}", 0.1)
        read = stamps(scene_files(path))
        scene = viewer.services.load_scene(path)
        check(scene)
        progress(f"preparing {path.name}", 0.6)
        viewer.services.warm_up(scene, viewer.state.backend, progress)
        progress(f"preparing {path.name}", 0.9)
        warnings = stated_warnings(path, len(scene.gaussians))
        return _Opened(scene, scene.gaussians.invalid_rows(), extent_of(scene), read, warnings)

    def done(opened: _Opened) -> None:
        _show_scene(viewer, path, opened)
        then(viewer)

    def failed(reason: str) -> None:
        viewer.state.opening = None
        viewer.say_error(reason)

    def begin(viewer: Viewer) -> None:
        cancel(viewer)
        viewer.state.opening = path
        viewer.run(f"opening {path.name}", load, done, failed)

    leave(viewer, begin, f"{path.name} is opened")


def cancel(viewer: Viewer) -> None:
    """Cancel the running and the queued work of the worker."""
    state = viewer.state
    viewer.worker.cancel()
    state.opening = None
    for query in state.session.queries:
        answer = state.answer(query)
        if answer.pending:
            reason = "" if answer.result else "cancelled"
            state.answers[query.phrase] = replace(answer, pending=False, problem=reason)


def _show_scene(viewer: Viewer, path: Path, opened: _Opened) -> None:
    state, scene, field = viewer.state, opened.scene, opened.scene.language
    if state.open is not None:
        viewer.visits[state.open.path.absolute()] = state.visit(state.open)
    session = state.session.of_next_scene()
    if field is None:
        state.pointing = False
        session = _without_field(session)
    view = default_view(scene, opened.extent, state.size)
    state.begin(
        SceneState(
            session=session,
            saved=Saved(session),
            open=OpenScene(path, scene, scene, opened.extent, view, warnings=opened.warnings),
            nothing=why_undrawable(scene.gaussians),
            camera_index=0 if scene.cameras else None,
            record=Recording(size=state.record.size, fps=state.record.fps),
        )
    )
    state.opening = state.leaving = None
    state.tools, state.show_start = replace(state.tools, stroke=None), False
    viewer.engine = engine = viewer.services.engine(scene)
    viewer.describer = None
    viewer.watch.begin(() if disk.is_preview(path) else opened.read)  # which is followed
    viewer.history = History()
    if not disk.is_preview(path):
        add_scenes(viewer, [path])
        state.preferences = state.preferences.with_recent(path.absolute())
        _say_opened(viewer, path, opened)
    if field is not None:
        viewer.run("preparing latent colours", lambda progress: field.colours)  # none is needed yet
        _prepare_search(viewer, engine)


def _without_field(session: Session) -> Session:
    display = "rgb" if DISPLAYS[session.picture.display].needs_field else session.picture.display
    return replace(session, queries=(), picture=replace(session.picture, display=display))


def _say_opened(viewer: Viewer, path: Path, opened: _Opened) -> None:
    scene = opened.scene
    reasons = ", ".join(f"{count:,} with {reason}" for reason, count in opened.unusable.items())
    not_drawn = f"; not drawn: {reasons}" if reasons else ""
    viewer.state.say(f"{path.name}: {len(scene.gaussians):,} Gaussians{not_drawn}")
    for reason in (*(f"opened without what lies beside it: {why}" for why in scene.unread), *opened.warnings):
        viewer.say_error(reason)
    if viewer.state.why_no_field:
        viewer.state.say(viewer.state.why_no_field)


def _prepare_search(viewer: Viewer, engine: QueryEngine) -> None:
    """Have the worker prepare the first search while the user looks round."""
    if not is_compiled(surface.merge_patches):
        label = "compiling the search kernels, once per installation (half a minute)"
        viewer.run(label, lambda progress: engine.regions)
    if viewer.has_encoder_here:
        viewer.run("loading the text encoder", engine.texts.encoder)


# Visits: a scene that was shown before is restored as it was left.


def return_to(viewer: Viewer, visit: Visit | None) -> None:
    """Restore the scene that was just opened as it was left, if it was; its queries are asked anew."""
    state, seen = viewer.state, viewer.state.open
    if seen is None or visit is None:
        return
    offset, opening = visit.origin - state.origin, visit.opening_camera  # a changed file may have another
    opening = None if opening is None else opening.moved(offset)
    state.open = replace(seen, view=visit.view.moved(offset), opening_camera=opening)
    if visit.camera_index is not None and visit.camera_index < len(seen.scene.cameras):
        state.camera_index = visit.camera_index
    session, saved = visit.session.moved(offset).found_again(now=state.session), visit.saved
    kept = {name: getattr(saved.session.moved(offset), name) for name in OF_PROJECT}
    state.saved = replace(saved, session=replace(state.session, **kept))
    take_session(viewer, session if visit.count == state.count else replace(session, things=Things()))
    parts = ("marks", "moves", "things", "queries")
    if any(getattr(state.session, part) != getattr(visit.session, part) for part in parts):
        state.saved = replace(state.saved, digest="")  # saving keeps the project as it was, too


def take_session(viewer: Viewer, session: Session) -> None:
    """Adopt an earlier session, without what the scene that is shown no longer has."""
    adopt(viewer, _fitting(viewer, session))


def _fitting(viewer: Viewer, session: Session) -> Session:
    if viewer.engine is None or not viewer.state.has_field:
        return replace(_without_field(session), things=Things())
    return replace(session, things=session.things.known(viewer.engine.tree.count))


@needs_scene("read it again when its file has changed")
def reload(viewer: Viewer, seen: OpenScene) -> None:
    """Read the scene's files again and keep the view; where that fails the scene is kept."""
    if viewer.state.opening is not None:
        return
    path, known = seen.path, seen.scene.unread

    def check(scene: Scene) -> None:
        new = [reason for reason in scene.unread if reason not in known]
        if new:  # files that are half written, or not written yet
            raise InputError(f"not read again, the scene stays as it was: {new[0]}")

    open_scene(viewer, path, lambda viewer: return_to(viewer, viewer.visits[path.absolute()]), check)


# The list of scenes. One is in memory at a time; of the others only the visit is kept.

MOST_SCENES = 100  # scenes that are listed


def add_scenes(viewer: Viewer, paths: Sequence[Path]) -> None:
    """List scenes, after those that are listed already."""
    listed = dict.fromkeys((*viewer.state.scenes, *(path.absolute() for path in paths)))
    viewer.state.scenes = tuple(listed)[:MOST_SCENES]


def switch_scene(viewer: Viewer, path: Path) -> None:
    """Show a scene of the list, as it was left if it was shown before."""
    state = viewer.state
    if state.path is not None and path == state.path.absolute() and state.opening is None:
        return
    open_scene(viewer, path, lambda viewer: return_to(viewer, viewer.visits.get(path)))


def step_scene(viewer: Viewer, by: int) -> None:
    """Show the next (1) or previous (-1) scene of the list, which wraps round."""
    scenes, path = viewer.state.scenes, viewer.state.path
    if len(scenes) < 2:
        viewer.say_error("no other scene is listed: drop several, or open another")
        return
    here = scenes.index(path.absolute()) if path is not None and path.absolute() in scenes else -1
    switch_scene(viewer, scenes[(here + by) % len(scenes)])


def unlist_scene(viewer: Viewer, path: Path) -> None:
    """Take a scene off the list, and drop its visit if nothing in it is unsaved; the one shown stays."""
    viewer.state.scenes = tuple(other for other in viewer.state.scenes if other != path)
    visit = viewer.visits.get(path)
    if visit is not None and not visit.saved.lacks_notes(visit.session):
        del viewer.visits[path]


# Files that were chosen, dropped onto the window, or open lately.


def open_file(viewer: Viewer, path: Path) -> None:
    """Open a scene or a project, or take a camera path."""
    if path.name.endswith(PROJECTS):
        open_project(viewer, path)
    elif path.name.endswith(PATHS):
        viewpoint.load_path(viewer, path)
    else:
        open_scene(viewer, path)


def open_dropped(viewer: Viewer, paths: Sequence[Path]) -> None:
    """Open what was dropped onto the window.

    Of scenes the first is opened and all are listed; then paths are taken. Companions belong to their scene.
    A folder of photographs is offered for training. Other files are reported.
    """
    is_folder = len(paths) == 1 and isdir(paths[0]) and format_of(paths[0]) is None
    if is_folder and count_photographs(paths[0]):
        choose_photographs(viewer, paths[0])
        open_panel(viewer, "Train")
        return
    sets = [path for path in paths if path.name.endswith((PATHS, PROJECTS))]
    files = [path for path in paths if path not in sets]

    def open_sets(viewer: Viewer) -> None:
        for path in sets:
            open_file(viewer, path)

    scenes = [path for path in files if not path.name.endswith(COMPANIONS)] or files
    known = [path for path in scenes if format_of(path)] or scenes[:1]
    others = [path.name for path in scenes if path not in known]
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        viewer.say_error(f"not opened: {others[0]}{more}")
    if len(known) > 1:
        add_scenes(viewer, known)
        viewer.state.say(f"{len(known)} scenes: the panel Scene lists them")
        open_panel(viewer, "Scene")
    if known:
        open_scene(viewer, known[0], open_sets)
    else:
        open_sets(viewer)


# Projects: a scene with its session.


def open_project(viewer: Viewer, path: Path, then: Callable[[Viewer], None] = lambda viewer: None) -> None:
    """Open the scene of a project with the project's session; `then` runs once it is on screen."""
    try:
        digest, project = digest_of(path), read_project(path)
        if not Path(project.scene).exists():
            remedy = "move it back, or mend its path"
            raise InputError(f"{project.scene}: the project's scene is not there; {remedy}")
    except (InputError, OSError) as error:
        viewer.say_error(one_line(error))
        return

    def restore(viewer: Viewer) -> None:
        _restore(viewer, project, path.absolute(), digest)
        then(viewer)

    open_scene(viewer, Path(project.scene), restore)


def _restore(viewer: Viewer, project: Project, path: Path, digest: str) -> None:
    state, now, session = viewer.state, viewer.state.session, project.session
    offset = np.array(project.origin) - state.origin
    session = session.moved(offset)
    if project.version == 1:  # which had no other settings
        session = replace(session, split=now.split, splats=now.splats, overlays=now.overlays)
    for reason in project.left_out:
        viewer.say_error(reason)
    kept = session
    if state.count != project.gaussians:
        kept = replace(session, marks=MarkBits(), moves=(), things=Things())
        if kept != session:
            what = "what was selected, hidden, deleted, moved and named is left out"
            viewer.say_error(f"the scene has changed since: {what}")
    try:
        take_session(viewer, kept)
    except LangSplatError as error:
        viewer.say_error(f"{path}: its transforms are left out: {one_line(error)}")
        take_session(viewer, replace(kept, moves=()))
    assert state.open is not None
    view = viewpoint.bookmarked_view(project.view.moved(offset), state.open.extent)
    state.look(view if project.intrinsics is None else replace(view, intrinsics=project.intrinsics))
    whole = state.session == session and not project.left_out  # else saving keeps the file as it was, too
    state.saved = Saved(state.session, path, digest if whole else "")
    state.preferences = state.preferences.with_recent(path)
    if project.panels:
        state.preferences = replace(state.preferences, panels=project.panels)


# Training a scene from photographs, in a process of its own.

WARNING = "warning: "  # before each warning that `langsplat train` ends with


def choose_photographs(viewer: Viewer, folder: Path) -> None:
    """Fill the form with a folder of photographs, and a name beside it for the scene."""
    form = viewer.state.training_form
    out = form.out or str(folder.with_name(f"{folder.name or 'scene'}.ply"))
    viewer.state.training_form = replace(form, dataset=str(folder), out=out)


@needs_scene("train its language field")
def train_language(viewer: Viewer, seen: OpenScene) -> None:
    """Open the panel "Train" for a language field of the scene that is shown, a new file beside it.

    The photographs are named where they lie as COLMAP has them, in "images" beside the scene or one above.
    """
    path = seen.path.absolute()
    near = (place for place in (path.parent, path.parent.parent) if (place / "images").is_dir())
    viewer.state.training_form = replace(
        viewer.state.training_form,
        dataset=next((str(place) for place in near if count_photographs(place)), ""),
        gaussians=str(path),
        out=str(free_name(path.parent, f"{path.name.partition('.')[0]}-language", ".ply")),
    )
    open_panel(viewer, "Train")


def start_training(viewer: Viewer) -> None:
    """Train, or go on with what was interrupted: the same photographs and name continue."""
    form, typed = viewer.state.training_form, viewer.state.training_form.dataset.strip()
    if viewer.training is not None and viewer.training.exit_code is None:
        viewer.say_error("a training is under way; stop it first")
        return
    dataset = Path(typed).expanduser()
    out = Path(form.out.strip() or f"{dataset}.ply").expanduser()
    photographs = count_photographs(dataset)
    if not typed or photographs == 0:
        viewer.say_error(f"no photographs in '{typed}'; name a folder that has some")
        return
    gaussians, encoder = form.gaussians.strip(), form.encoder.strip() or "demo"
    form = replace(form, dataset=str(dataset), gaussians=gaussians, out=str(out), encoder=encoder)
    try:
        viewer.training = Training(form, viewer.worker.wake)
    except OSError as error:
        viewer.say_error(f"training cannot be started ({one_line(error)})")
        return
    viewer.state.say(f"training {out.name} from {photographs} photographs")


def look_at_training(viewer: Viewer) -> None:
    """Open the Gaussians that a training wrote last, and from then on each newer checkpoint."""
    training = viewer.training
    if training is None:
        return
    written = disk.newest(training.out)
    if not written:
        viewer.state.say("there are no Gaussians to look at yet")
        return

    def done(preview: Path) -> None:
        if viewer.state.path == preview:  # in place of the checkpoint before
            reload(viewer)
        else:
            open_scene(viewer, preview)

    training.previewed = written
    viewer.run("reading the Gaussians so far", lambda progress: disk.write_preview(written[0][0]), done)


def watch_training(viewer: Viewer) -> None:
    """Show a training under way, and its scene when it is finished, or why there is none; once per frame.

    Its Gaussians are shown meanwhile if they were shown before, or if nothing else is open.
    """
    training, state = viewer.training, viewer.state
    if training is None:
        return
    if training.exit_code is None:
        follows = state.open is None or state.path == work_folder(training.out) / PREVIEW
        if follows and viewer.worker.current is None and state.opening is None:
            written = disk.newest(training.out)
            if written and written != training.previewed:
                look_at_training(viewer)
        return
    viewer.training = None
    if training.exit_code == 0:
        told = [line for line in training.progress.said if not line.startswith(WARNING)]
        for line in told:  # quality warnings come with the scene, from its report
            state.say(line)
        open_scene(viewer, training.out)
    elif training.interrupted:
        state.say("training stopped; Train goes on where it was")
    else:
        viewer.say_error((training.progress.said or ["no reason given"])[-1].removeprefix("langsplat: "))


# A second scene right of a line across the image, by another encoder or method in the same coordinates: a
# viewer of its own without a window, whose session follows from the first one's.


def open_beside(viewer: Viewer, path: Path) -> None:
    """Show another scene right of a line, with the same view and queries as this one."""
    beside = Viewer(viewer.services)
    beside.worker.wake, beside.state.backend = viewer.worker.wake, viewer.state.backend
    if viewer.beside is not None:
        viewer.beside.worker.close()
    viewer.beside = beside
    compare(viewer, "scenes")
    open_scene(beside, path)


def follow_beside(viewer: Viewer) -> None:
    """Give the second scene the first one's view and session, once per frame, or close it."""
    state, beside = viewer.state, viewer.beside
    is_wanted = state.session.split.mode == "scenes"
    if beside is None or not is_wanted:
        if is_wanted:  # undone, or of a project
            state.say("the compared scene is not open any more: choose it in Compare with")
            viewer.put(split=replace(state.session.split, mode="off"))
        elif beside is not None:
            beside.worker.close()
            viewer.beside = None
        return
    other = beside.state
    beside.take_results()
    viewpoint.tick(beside, viewer.clock)
    for message in other.messages:
        state.say(f"compared scene: {message.text}", message.is_error)
    other.messages, other.size = [], state.size
    if other.open is None or state.open is None:
        return
    other.look(state.open.view.moved(state.origin - other.origin))
    session = _fitting(beside, _mirrored(state, other))
    if session != other.session:
        adopt(beside, session)


def _mirrored(state: ViewerState, other: ViewerState) -> Session:
    """Return the first scene's session for the second one: what is asked and how it is shown, without edits.

    It asks the queries that the first has answered; those "not here" get no colour in it.
    """

    def hidden(query: Query) -> bool:
        result = other.result(query)
        return result is None or result.verdict == "not here"

    first = state.session
    answered = [query for query in first.queries if state.answer(query).result is not None]
    return replace(
        first.of_next_scene(),
        split=Split(),
        clip=first.clip,
        queries=tuple(replace(query, slot=None) if hidden(query) else query for query in answered),
    )


# What dialogs ask for.

ask_for_file = partial(ask_for, choice=FileChoice("Open a scene", open_file))
ask_for_beside = partial(ask_for, choice=FileChoice("Scene to compare with", open_beside))
ask_for_dataset = partial(ask_for, choice=FileChoice("Photographs to train on", choose_photographs, "folder"))
