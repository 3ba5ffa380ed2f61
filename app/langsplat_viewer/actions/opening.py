"""Opening scenes: read, shown, listed, returned to; a second scene beside the first."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from langsplat_core.compiled import is_compiled
from langsplat_core.display.displays import DISPLAYS, latent_colours
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import scene_files
from langsplat_core.pipeline.report import stated_warnings
from langsplat_core.progress import Progress
from langsplat_core.query.engine import no_field
from langsplat_core.scene import Scene, surface
from langsplat_viewer.actions import viewpoint
from langsplat_viewer.actions.editing import adopt
from langsplat_viewer.actions.selecting import leave
from langsplat_viewer.actions.settings import set_split
from langsplat_viewer.actions.viewpoint import opening_view, read_bookmarks
from langsplat_viewer.camera.controls import Extent, OrbitCamera, extent_of
from langsplat_viewer.files.disk import Stamps, stamps
from langsplat_viewer.files.preferences import with_recent
from langsplat_viewer.marks import unmarked
from langsplat_viewer.rendering.request import Split, why_undrawable
from langsplat_viewer.session import Query, Session, Things
from langsplat_viewer.state import Recording, SceneState, ViewerState
from langsplat_viewer.viewer import History, Viewer, Visit


@dataclass(frozen=True, eq=False)
class _Opened:
    """A scene with all that the window's thread should not have to compute."""

    scene: Scene
    unusable: dict[str, int]  # reason -> Gaussians that are therefore not drawn
    extent: Extent
    read: Stamps  # its files as they were before they were read
    warnings: tuple[str, ...]  # what the report of its training says against it


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

    if viewer.state.is_unsaved:
        leave(viewer, begin, f"{path.name} is opened")
    else:
        begin(viewer)


def cancel(viewer: Viewer) -> None:
    """Drop what the worker does and is to do."""
    viewer.worker.cancel()
    viewer.state.opening = None
    state = viewer.state
    for query in state.session.queries:
        answer = state.answer(query)
        if answer.pending:
            reason = "" if answer.result else "cancelled"
            state.answers[query.phrase] = replace(answer, pending=False, problem=reason)


def _show_scene(viewer: Viewer, path: Path, opened: _Opened) -> None:
    state, scene = viewer.state, opened.scene
    if state.path is not None:
        viewer.visits[state.path.absolute()] = _visit(state)
    session = state.session.of_next_scene(read_bookmarks(viewer, path))
    if scene.language is None:
        state.pointing = False
        session = _without_field(session)
    fresh = SceneState(
        session=session,
        saved=session,
        scene=scene,
        path=path,
        extent=opened.extent,
        warnings=opened.warnings,
        nothing=why_undrawable(scene.gaussians),
        marks=unmarked(len(scene.gaussians)),
        camera_index=0 if scene.cameras else None,
        record=Recording(size=state.record.size, fps=state.record.fps),
    )
    state.begin(fresh)
    state.view, state.opening, state.leaving = opening_view(viewer), None, None
    state.tools = replace(state.tools, stroke=None)
    add_scenes(viewer, [path])
    state.preferences = with_recent(state.preferences, path.absolute())
    viewer.engine, viewer.describer = viewer.services.engine(scene), None
    viewer.watch.begin(opened.read)
    viewer.history = History()
    _say_opened(viewer, path, opened)
    if scene.language is not None:
        field = scene.language
        viewer.run("preparing latent colours", lambda progress: latent_colours(field))  # none is needed yet
        _compile_search(viewer)
        if viewer.has_encoder_here:  # while the user looks round
            viewer.run("loading the text encoder", viewer.engine.load_encoder)


def _without_field(session: Session) -> Session:
    """Return the session of a scene that cannot be searched."""
    if not DISPLAYS[session.picture.display].needs_field:
        return replace(session, queries=(), canonical=())
    return replace(session, queries=(), canonical=(), picture=replace(session.picture, display="rgb"))


def _say_opened(viewer: Viewer, path: Path, opened: _Opened) -> None:
    scene = opened.scene
    reasons = ", ".join(f"{count:,} with {reason}" for reason, count in opened.unusable.items())
    not_drawn = f"; not drawn: {reasons}" if reasons else ""
    viewer.state.say(f"{path.name}: {len(scene.gaussians):,} Gaussians{not_drawn}")
    for reason in scene.unread:
        viewer.say_error(f"opened without what lies beside it: {reason}")
    for warning in opened.warnings:
        viewer.say_error(warning)
    if scene.language is None:
        viewer.state.say(no_field(scene))


def _compile_search(viewer: Viewer) -> None:
    engine = viewer.engine
    if engine is None or is_compiled(surface.merge_patches):
        return
    viewer.run(
        "compiling the search kernels, once per installation (half a minute)", lambda progress: engine.regions
    )


# Visits: a scene that was shown before is found again as it was left.


def _visit(state: ViewerState) -> Visit:
    return Visit(
        state.session,
        state.saved,
        state.project,
        state.view,
        state.opening_camera,
        state.camera_index,
        0 if state.scene is None else len(state.scene.gaussians),
    )


def return_to(viewer: Viewer, visit: Visit) -> None:
    """Find the scene that was just opened again as it was left; what was asked is asked anew."""
    state = viewer.state
    if state.scene is None:
        return
    state.view, state.opening_camera = visit.view or state.view, visit.opening_camera
    if visit.camera_index is not None and visit.camera_index < len(state.scene.cameras):
        state.camera_index = visit.camera_index
    session, saved = visit.session.found_again(now=state.session), visit.saved
    state.saved = replace(state.session, things=saved.things, notes=saved.notes)
    state.project = visit.project
    things = session.things if visit.count == len(state.scene.gaussians) else Things()
    take_session(viewer, replace(session, things=things))


def take_session(viewer: Viewer, session: Session) -> None:
    """Adopt a session of an earlier time, as far as the scene that is shown has what it speaks of."""
    engine, things = viewer.engine, session.things
    if viewer.state.has_field and engine is not None:
        known = things.known(engine.tree.count) if things != Things() else things
        adopt(viewer, replace(session, things=known))
    else:
        adopt(viewer, replace(_without_field(session), things=Things()))


def reload(viewer: Viewer) -> None:
    """Read the scene's files again and stay where one is; where that fails the scene is kept."""
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
    """Return the next (1) or previous (-1) of the list, beyond its ends from the other one."""
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


# A second scene, or the same by another encoder or method, right of a line across the image: a viewer of its
# own without a window, whose session follows from the first one's.

ALIKE = 0.5, 1.5  # of two scenes in the same coordinates: distance of their middles in radii, ratio of radii


def open_beside(viewer: Viewer, path: Path) -> None:
    """Show another scene right of a line, seen and asked as this one is."""
    beside = Viewer(viewer.services)
    beside.worker.wake, beside.state.backend = viewer.worker.wake, viewer.state.backend
    if viewer.beside is not None:
        viewer.beside.worker.close()
    viewer.beside = beside
    set_split(viewer, "scenes")
    open_scene(beside, path)


def follow_beside(viewer: Viewer) -> None:
    """Give the second scene the first one's view and session, once per frame, or close it."""
    state, beside = viewer.state, viewer.beside
    is_wanted = state.session.split.mode == "scenes"
    if beside is None or not is_wanted:
        if is_wanted:  # undone
            viewer.put(split=replace(state.session.split, mode="off"))
        elif beside is not None:
            beside.worker.close()
            viewer.beside = None
        return
    other = beside.state
    beside.take_results()
    viewpoint.tick(beside, viewer.clock)
    for message in other.messages:
        state.say(f"beside: {message.text}", message.is_error)
    other.messages, other.size = [], state.size
    if other.extent is None or state.extent is None or state.view is None:
        return
    if beside.followed is not state.view:
        other.view, beside.followed = linked(state.view, state.extent, other.extent), state.view
    session, before = _mirrored(state, other), beside.mirrored
    if session != before:
        beside.mirrored = session
        if before is not None and before.canonical == session.canonical:  # the same are not encoded again
            session = replace(session, canonical=other.session.canonical)
        take_session(beside, session)


def _mirrored(state: ViewerState, other: ViewerState) -> Session:
    """Return the first scene's session for the second one: what is asked and how it is shown, without edits.

    It asks what the first has answered; what is not here gets no colour there.
    """

    def hidden(query: Query) -> bool:
        result = other.result(query)
        return result is None or result.verdict == "not here"

    first = state.session
    answered = [query for query in first.queries if state.answer(query).result is not None]
    return replace(
        first.of_next_scene(other.session.bookmarks),
        split=Split(),
        clip=first.clip,
        canonical=first.canonical,
        queries=tuple(replace(query, slot=None) if hidden(query) else query for query in answered),
    )


def linked(view: OrbitCamera, here: Extent, there: Extent) -> OrbitCamera:
    """Return the same view of another scene.

    It is itself where both have the same coordinates, as far as their extents tell, else it is from the same
    side and as far away in radii.
    """
    ratio = there.radius / here.radius
    away = np.linalg.norm(here.centre - there.centre)
    if away < ALIKE[0] * here.radius and 1 / ALIKE[1] < ratio < ALIKE[1]:
        return view
    target = there.centre + ratio * (view.target - here.centre)
    return replace(view, target=target, distance=ratio * view.distance)
