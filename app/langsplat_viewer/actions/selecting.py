"""Selection: verbs, answers and their instances, tools of the mouse, export, and the question before leaving.

Every change of what is selected, hidden or deleted is one step that can be undone; the settings of tools are
not.
"""

from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.io import cameras, sidecar
from langsplat_core.io.scenes import save_scene
from langsplat_core.io.shapes import write_points
from langsplat_core.progress import Progress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.instances import Instance
from langsplat_core.query.selection import at_point, grow, of_rows, shrink
from langsplat_core.scene import LEVELS, Scene
from langsplat_viewer import marks
from langsplat_viewer.marks import Drawn, Marks, Mode, Stroke, Tool
from langsplat_viewer.output import free_name
from langsplat_viewer.rendering.request import UNCLIPPED
from langsplat_viewer.session import Query
from langsplat_viewer.state import Leaving
from langsplat_viewer.viewer import Viewer

NOTHING = "nothing is selected: choose a tool, or an answer of the search"


def mark(viewer: Viewer, marks: Marks) -> None:
    """Take other marks, unless they mark the same."""
    if not marks.same(viewer.state.marks):
        viewer.remember()
        put_marks(viewer, marks)


def put_marks(viewer: Viewer, marks: Marks) -> None:
    """Take other marks without a step of its own to undo."""
    state = viewer.state
    viewer.put(marks=state.session.marks.of(marks, state.marks))
    state.marks = marks


def take(viewer: Viewer, found: Array, mode: Mode | None = None) -> None:
    """Combine the selection with `found` (N,) bool; `mode` in place of the one that is set."""
    state = viewer.state
    mark(viewer, marks.combined(state.marks, found, mode or state.tools.mode))


def has_scene(viewer: Viewer) -> bool:
    """Return whether a scene is open; say so where none is."""
    if viewer.state.scene is None:
        viewer.say_error("open a scene first, then select in it")
    return viewer.state.scene is not None


def has_selection(viewer: Viewer) -> bool:
    """Return whether something is selected; say so where nothing is."""
    if not has_scene(viewer):
        return False
    some = bool(viewer.state.marks.selected.any())
    if not some:
        viewer.state.say(NOTHING)
    return some


def select_all(viewer: Viewer) -> None:
    """Select everything that is shown."""
    if has_scene(viewer):
        take(viewer, viewer.state.marks.shown, "replace")


def select_none(viewer: Viewer) -> None:
    """Select nothing."""
    if has_scene(viewer):
        take(viewer, np.zeros_like(viewer.state.marks.selected), "replace")


def invert_selection(viewer: Viewer) -> None:
    """Select what is shown and was not selected."""
    if has_scene(viewer):
        take(viewer, ~viewer.state.marks.selected, "replace")


def hide_selected(viewer: Viewer) -> None:
    """Take the selection out of the image until all is shown again."""
    if has_selection(viewer):
        mark(viewer, marks.hiding(viewer.state.marks))


def isolate_selected(viewer: Viewer) -> None:
    """Hide everything that is not selected."""
    if has_selection(viewer):
        marks = viewer.state.marks
        mark(viewer, replace(marks, hidden=marks.kept & ~marks.selected))


def show_hidden(viewer: Viewer) -> None:
    """Show all that is hidden."""
    if has_scene(viewer):
        marks = viewer.state.marks
        mark(viewer, replace(marks, hidden=np.zeros_like(marks.hidden)))


def delete_selected(viewer: Viewer) -> None:
    """Take the selection out of the image and of what is saved; the file that was opened stays as it is."""
    if has_selection(viewer):
        marks = viewer.state.marks
        mark(viewer, Marks(np.zeros_like(marks.selected), marks.hidden, marks.deleted | marks.selected))


def reach(viewer: Viewer) -> float:
    """Return how far growing and shrinking go at a time, world units."""
    extent = viewer.state.extent
    return viewer.state.tools.reach * (0.0 if extent is None else extent.radius)


def grow_selection(viewer: Viewer) -> None:
    """Add what is within reach along the surface."""
    if has_selection(viewer):
        selected, distance = viewer.state.marks.selected, reach(viewer)
        find(viewer, "growing", lambda engine: grow(engine.surface, selected, distance), "add")


def shrink_selection(viewer: Viewer) -> None:
    """Leave out what is within reach of something else along the surface."""
    if has_selection(viewer):
        selected, distance = viewer.state.marks.selected, reach(viewer)
        find(viewer, "shrinking", lambda engine: shrink(engine.surface, selected, distance), "intersect")


def select_alike(viewer: Viewer) -> None:
    """Select everything that is like what is selected, wherever it is, by `QueryEngine.like`."""
    if has_selection(viewer):
        selected = viewer.state.marks.selected
        find(viewer, "looking for more like", lambda engine: engine.like(selected).members, "replace")


def find(viewer: Viewer, label: str, work: Callable[[QueryEngine], Array], mode: Mode | None) -> None:
    """Have the worker find (N,) bool with the scene's engine, and take it."""
    engine, scene = viewer.engine, viewer.state.scene
    if engine is None:
        return

    def done(found: Array) -> None:
        if viewer.state.scene is scene:
            take(viewer, found, mode)

    viewer.run(f"{label} the selection", lambda progress: work(engine), done)


def chosen_query(viewer: Viewer) -> Query | None:
    """Return the query whose details are shown, else the latest; None without one."""
    state = viewer.state
    return state.chosen_query or (state.session.queries[-1] if state.session.queries else None)


def select_query(viewer: Viewer, query: Query | None = None, mode: Mode | None = None) -> None:
    """Select the members of an answer, by default that of `chosen_query`."""
    query = query or chosen_query(viewer)
    result = None if query is None else viewer.state.result(query)
    if has_scene(viewer) and query is not None and result is not None:
        if result.verdict == "not here":
            viewer.state.say(f"'{query.phrase}' is not here: nothing to select")
            return
        take(viewer, result.members, mode)
    elif viewer.state.scene is not None:
        viewer.state.say("search for something first, then select what was found")


def select_thing(viewer: Viewer, thing: Instance, mode: Mode | None = None) -> None:
    """Select one instance of an answer."""
    if has_scene(viewer):
        take(viewer, of_rows(thing.members, len(viewer.state.marks.selected)), mode)


def set_tools(viewer: Viewer, **values: Any) -> None:
    """Change how the mouse selects: fields of `Tools`."""
    viewer.state.tools = replace(viewer.state.tools, **values)


def use_tool(viewer: Viewer, tool: Tool | None) -> None:
    """Choose the tool of the left button; None: a drag turns the camera again."""
    set_tools(viewer, tool=tool, stroke=None)


# Writing what is selected, the rest, or the scene without what was deleted: to new files, never over old.

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
    """Have the worker write a part of the scene to a new file in `folder`.

    It is a PLY with its language field and cameras, or a point cloud. `then` runs once it is written; if that
    fails the reason is said.
    """
    if not (has_scene(viewer) if part == "edited" else has_selection(viewer)):
        return
    state, engine = viewer.state, viewer.engine
    scene, marks, session = state.scene, state.marks, state.session
    assert scene is not None
    field = scene.language
    if field is not None and engine is not None:
        field = replace(field, taught=tuple(engine.taught.values()))
    parts = {"selection": marks.selected, "rest": marks.kept & ~marks.selected, "edited": marks.kept}
    rows = np.flatnonzero(parts[part])
    if len(rows) == 0:
        viewer.say_error(f"the {part} holds no Gaussians: nothing to write")
        return
    stem = f"{state.path.stem if state.path else 'scene'}-{part}{'-points' if as_points else ''}"

    def work(progress: Progress) -> tuple[Path, int]:
        return _write(replace(scene, language=field), rows, folder, stem, as_points)

    def done(written: tuple[Path, int]) -> None:
        path, count = written
        kind = "points" if as_points else "Gaussians"
        state.say(f"saved {path}: {count:,} {kind}")
        if part == "edited" and not as_points and state.scene is scene:
            state.saved = replace(state.saved, marks=session.marks, moves=session.moves)
        then(viewer)

    def failed(reason: str) -> None:
        viewer.say_error(f"not saved: {reason}")

    state.writing = viewer.run(f"saving the {part}", work, done, failed).future


def _write(scene: Scene, rows: Array, folder: Path, stem: str, as_points: bool) -> tuple[Path, int]:
    path = free_name(folder, stem, ".ply", () if as_points else COMPANIONS)
    if as_points:
        return path, write_points(path, scene.gaussians.take(rows))
    save_scene(path, replace(scene.take(rows), path=path))
    return path, len(rows)


def finish_writing(viewer: Viewer) -> None:
    """Wait until what is being written is there: the window closes, and the worker's thread ends with it."""
    if viewer.state.writing is not None:
        wait([viewer.state.writing], LONGEST_WAIT)


# Another scene, or none: what was deleted and not saved is asked about first.


def leave(viewer: Viewer, then: Callable[[Viewer], None], to: str, loses_more: bool = False) -> None:
    """Do `then`: at once if nothing is lost by it, else when that was answered; `to` says what it is."""
    if viewer.state.is_unsaved or loses_more:
        viewer.state.leaving = Leaving(then, to)
    else:
        then(viewer)


def may_close(viewer: Viewer) -> bool:
    """Return whether the window may close now; where not, ask."""
    if not viewer.state.may_close:
        quit_viewer(viewer)
    return viewer.state.may_close


def quit_viewer(viewer: Viewer) -> None:
    """Close the window; ask first where something would be lost."""
    leave(viewer, _close, "the window closes", viewer.state.has_unsaved_notes)


def end(viewer: Viewer, folder: Path = Path()) -> None:
    """Close without a question: what is not saved is first written to a new file in `folder`."""
    if viewer.state.is_unsaved:
        export(viewer, folder, "edited", then=end_at_once)
    else:
        end_at_once(viewer)


def end_at_once(viewer: Viewer) -> None:
    """Close, whatever is lost."""
    viewer.state.leaving, viewer.state.may_close = None, True


def _close(viewer: Viewer) -> None:
    if viewer.recorder.current is not None:
        viewer.state.leaving = Leaving(_close, "the window closes", film=True)
    else:
        end_at_once(viewer)


def _answered(viewer: Viewer) -> Callable[[Viewer], None] | None:
    leaving, viewer.state.leaving = viewer.state.leaving, None
    return None if leaving is None else leaving.then


def save_and_leave(viewer: Viewer, folder: Path = Path()) -> None:
    """Write the scene without what was deleted to a new file in `folder`, and go on once it is there."""
    then = _answered(viewer)
    if then is not None:
        export(viewer, folder, "edited", then=then)


def discard_and_leave(viewer: Viewer) -> None:
    """Go on; the file that was opened is as it was."""
    then = _answered(viewer)
    if then is not None:
        then(viewer)


def stay(viewer: Viewer) -> None:
    """Stay in the scene: forget the action that waited for the answer."""
    _answered(viewer)


# Selecting with the mouse: a stroke begins, goes on and ends; (u, v) are fractions of the scene's area.

STEP = 0.002  # of the image: places nearer to each other are one
LONGEST = 4000  # places of a stroke that are kept


def begin_stroke(viewer: Viewer, u: float, v: float) -> None:
    """Return the button goes down.

    A sphere and a box are drawn around the surface that lies there.
    """
    state = viewer.state
    tool, centre = state.tools.tool, None
    if tool is None or state.scene is None or state.view is None:
        return
    if tool not in marks.ON_SCREEN:
        point = None if viewer.surface is None else viewer.surface.point_at(u, v)
        if point is None:
            state.say("nothing under the cursor to select")
            return
        centre = (float(point[0]), float(point[1]), float(point[2]))
    state.glide = None
    set_tools(viewer, stroke=Stroke(((u, v),), centre))


def extend_stroke(viewer: Viewer, u: float, v: float) -> None:
    """Add a place (u, v) to the stroke under way."""
    stroke = viewer.state.tools.stroke
    if stroke is None:
        return
    (last_u, last_v), moved = stroke.path[-1], stroke.path
    if max(abs(u - last_u), abs(v - last_v)) >= STEP and len(moved) < LONGEST:
        set_tools(viewer, stroke=replace(stroke, path=(*moved, (u, v))))


def end_stroke(viewer: Viewer, mode: Mode | None = None) -> None:
    """Return the button goes up: select what the stroke encloses; `mode` in place of the one that is set."""
    state, drawn = viewer.state, drawn_stroke(viewer)
    if drawn is None or state.scene is None:
        return
    set_tools(viewer, stroke=None)
    if drawn.tool == "thing":
        _select_under(viewer, drawn.stroke, mode)
        return
    wanted = state.tools.only_visible and drawn.tool in marks.ON_SCREEN and viewer.surface is not None
    depths = viewer.surface.depths() if wanted and viewer.surface is not None else None
    means, clip = state.scene.gaussians.means, state.session.clip
    found = marks.caught(drawn, means, depths)
    if clip != UNCLIPPED and drawn.tool in marks.ON_SCREEN:  # what is not drawn lies under no outline
        found &= clip.keeps(means @ drawn.camera.rotation[2] + drawn.camera.world_to_camera[2, 3])
    take(viewer, found, mode)


def drawn_stroke(viewer: Viewer) -> Drawn | None:
    """Return the stroke under way, in the image as it is; None without one."""
    state = viewer.state
    tool, stroke = state.tools.tool, state.tools.stroke
    if tool is None or stroke is None or state.view is None:
        return None
    return Drawn(tool, stroke, state.view.camera(*state.size), state.tools.brush, reach(viewer))


def leave_tool(viewer: Viewer) -> None:
    """Give up the stroke under way; without one, the tool."""
    if viewer.state.tools.stroke is not None:
        set_tools(viewer, stroke=None)
    else:
        use_tool(viewer, None)


def _select_under(viewer: Viewer, stroke: Stroke, mode: Mode | None) -> None:
    """Return the thing at the stroke's centre, or the part of it if that is the level of the queries."""
    state = viewer.state
    if state.scene is None or stroke.centre is None:
        return
    if state.scene.language is None:
        viewer.say_error("without a language field no things are known: use a brush, sphere or box")
        return
    level = LEVELS.index("whole" if state.session.level == "auto" else state.session.level)
    centre = np.array(stroke.centre)
    find(
        viewer,
        "finding the thing for",
        lambda engine: at_point(engine.surface, engine.regions, level, centre),
        mode,
    )
