"""Selection, hiding and deleting, by verbs, answers and tools of the mouse; transforms and crops; undo.

Every change of what is selected, hidden, deleted or moved is one step that can be undone; the settings of
tools are not. The scene that is shown is made anew from the one that was opened, by all transforms so far, so
that undoing them all gives exactly what was there.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import LangSplatError
from langsplat_core.progress import Progress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.selection import at_point, grow, in_box, shrink
from langsplat_core.scene import LEVELS
from langsplat_core.scene.transform import AXES, Similarity, moving, rotating, scaling
from langsplat_viewer import marks
from langsplat_viewer.actions.queries import ask_listed, forget_unlisted, teach, teach_given
from langsplat_viewer.actions.settings import measure_at, open_panel, pin_at
from langsplat_viewer.actions.viewpoint import focus_pixel
from langsplat_viewer.camera.controls import extent_of
from langsplat_viewer.marks import Drawn, Marks, Mode, Stroke, Tool
from langsplat_viewer.rendering.request import UNCLIPPED
from langsplat_viewer.session import Move, Point, Query, Session, change_between, pack, point_of
from langsplat_viewer.state import EditForm, Gizmo, OpenScene
from langsplat_viewer.viewer import Viewer, needs_scene


def mark(viewer: Viewer, marks: Marks) -> None:
    """Set the marks, as a step that can be undone, unless they mark the same."""
    before, session = viewer.state.marks, viewer.state.session
    viewer.change(marks=session.marks.of(marks))
    gone = int(marks.deleted.sum() - before.deleted.sum())
    if gone > 0:
        viewer.state.say(f"deleted {gone:,} Gaussians", undoes=session)


def take(viewer: Viewer, found: Array, mode: Mode | None = None) -> None:
    """Combine the selection with `found` (N,) bool, by `mode` or, None, the mode that is set."""
    state = viewer.state
    if found.any() and not (found & state.marks.shown).any():
        state.say("all of it is hidden or deleted, which is not selected")
    mark(viewer, marks.combined(state.marks, found, mode or state.tools.mode))


@needs_scene("select in it")
def has_selection(viewer: Viewer, seen: OpenScene) -> bool:
    """Return whether something is selected; report where nothing is."""
    some = bool(viewer.state.marks.selected.any())
    if not some:
        viewer.state.say("nothing is selected: choose a tool, or an answer of the search")
    return some


# Verbs.


Action = Callable[[Viewer], None]


def _verb(change: Callable[[Marks], Marks], *, needs_selection: bool = True) -> Action:
    """Return the action that applies `change` to the marks."""

    @needs_scene("select in it")
    def act(viewer: Viewer, seen: OpenScene) -> None:
        if not needs_selection or has_selection(viewer):
            mark(viewer, change(viewer.state.marks))

    return act


def _nothing(marks: Marks) -> Array:
    return np.zeros_like(marks.selected)


_of_all = partial(_verb, needs_selection=False)
select_all = _of_all(lambda marks: replace(marks, selected=marks.shown))
select_none = _of_all(lambda marks: replace(marks, selected=_nothing(marks)))
invert_selection = _of_all(lambda marks: replace(marks, selected=marks.shown & ~marks.selected))
hide_selected = _verb(lambda marks: Marks(_nothing(marks), marks.hidden | marks.selected, marks.deleted))
isolate_selected = _verb(lambda marks: replace(marks, hidden=marks.kept & ~marks.selected))
show_hidden = _of_all(lambda marks: replace(marks, hidden=_nothing(marks)))
# The file that was opened stays as it is.
delete_selected = _verb(lambda marks: Marks(_nothing(marks), marks.hidden, marks.deleted | marks.selected))


def _found(label: str, found: Callable[[QueryEngine, Array, float], Array], mode: Mode) -> Action:
    """Return the action that selects what `found` returns for the selection and reach, on the worker."""

    @needs_scene("select in it")
    def act(viewer: Viewer, seen: OpenScene) -> None:
        if has_selection(viewer):
            selected, distance = viewer.state.marks.selected, viewer.state.tools.reach * seen.extent.radius
            viewer.ask_engine(
                f"{label} the selection",
                lambda engine, _: found(engine, selected, distance),
                lambda members: take(viewer, members, mode),
            )

    return act


# Along the surface: what is within reach of the selection, and what is of nothing else.
grow_selection = _found("growing", lambda engine, old, by: grow(engine.surface, old, by), "add")
shrink_selection = _found("shrinking", lambda engine, old, by: shrink(engine.surface, old, by), "intersect")
# Wherever it is, by `QueryEngine.like`.
select_alike = _found("looking for more like", lambda engine, old, by: engine.like(old).members, "replace")


Target = int | Array  # a node of the tree, or a (3,) point on the surface, world units


def of_thing(act: Callable[[Viewer, Array], None]) -> Callable[[Viewer, Target], None]:
    """Return the action that has the worker find a thing's members, (N,) bool, and passes them to `act`."""

    def begin(viewer: Viewer, target: Target) -> None:
        level = viewer.state.session.level

        def work(engine: QueryEngine, progress: Progress) -> Array:
            if isinstance(target, int):
                return engine.tree.members(target)
            index = LEVELS.index("whole" if level == "auto" else level)
            return at_point(engine.surface, engine.regions, index, target)

        def done(members: Array) -> None:
            if members.any():
                act(viewer, members)

        if viewer.searchable() is not None:
            viewer.ask_engine("finding the thing", work, done)

    return begin


def ask_for_name(viewer: Viewer) -> None:
    """Give the keyboard to the box for a name of the selection."""
    if has_selection(viewer):
        open_panel(viewer, "Selection")
        viewer.state.focus_name = viewer.state.awaits_keyboard = True


def name_selection(viewer: Viewer, name: str) -> None:
    """Teach a name by the selection."""
    if has_selection(viewer):
        teach(viewer, name, viewer.state.marks.selected)


def chosen_query(viewer: Viewer) -> Query | None:
    """Return the query whose details are shown, else the latest; None without one."""
    session = viewer.state.session
    return session.query(session.chosen) or (session.queries[-1] if session.queries else None)


@needs_scene("select in it")
def select_query(
    viewer: Viewer, seen: OpenScene, query: Query | None = None, mode: Mode | None = None
) -> None:
    """Select the members of an answer, by default that of `chosen_query`."""
    query = query or chosen_query(viewer)
    result = None if query is None else viewer.state.result(query)
    if query is None or result is None:
        viewer.state.say("search for something first, then select what was found")
    elif result.verdict == "not here":
        viewer.state.say(f"'{query.phrase}' is not here: nothing to select")
    else:
        take(viewer, result.members, mode)


# Tools of the mouse: a stroke begins, goes on and ends; (u, v) are fractions of the scene's area.

STEP = 0.002  # of the image: nearer places of a stroke are one
MOST_PLACES = 4000  # places of a stroke that are kept


def set_tools(viewer: Viewer, **values: Any) -> None:
    """Change how the mouse selects: fields of `Tools`."""
    viewer.state.tools = replace(viewer.state.tools, **values)


def use_tool(viewer: Viewer, tool: Tool | None) -> None:
    """Choose the tool of the left button; None: a drag turns the camera again."""
    set_tools(viewer, tool=tool, stroke=None)


def begin_stroke(viewer: Viewer, u: float, v: float) -> None:
    """Begin at a place; a sphere and a box are drawn around the surface that lies there."""
    state = viewer.state
    tool, centre = state.tools.tool, None
    if tool is None or state.open is None:
        return
    if tool not in marks.ON_SCREEN:
        centre = viewer.point_at(u, v, "select")
        if centre is None:
            return
    state.glide = None
    set_tools(viewer, stroke=Stroke(((u, v),), centre))


def click_middle(viewer: Viewer) -> None:
    """Click the middle of the image, for ruler, note or tool; without one, turn around what is there."""
    act = focus_pixel if viewer.state.tools.tool is None else begin_stroke
    act = pin_at if viewer.state.pins_notes else act
    act = measure_at if viewer.state.session.ruler.measures else act
    act(viewer, 0.5, 0.5)
    end_stroke(viewer)  # where one has begun


def extend_stroke(viewer: Viewer, u: float, v: float) -> None:
    """Add a place (u, v) to the stroke under way."""
    stroke = viewer.state.tools.stroke
    if stroke is None:
        return
    (last_u, last_v), moved = stroke.path[-1], stroke.path
    if max(abs(u - last_u), abs(v - last_v)) >= STEP and len(moved) < MOST_PLACES:
        set_tools(viewer, stroke=replace(stroke, path=(*moved, (u, v))))


def end_stroke(viewer: Viewer, mode: Mode | None = None) -> None:
    """Select what the stroke encloses; `mode` in place of the one that is set."""
    state, drawn = viewer.state, drawn_stroke(viewer)
    if drawn is None or state.open is None:
        return
    set_tools(viewer, stroke=None)
    if drawn.tool == "thing":
        of_thing(lambda viewer, members: take(viewer, members, mode))(viewer, drawn.centre)
        return
    on_screen = drawn.tool in marks.ON_SCREEN
    wanted = state.tools.only_visible and on_screen and viewer.surface is not None
    depths = viewer.surface.depths() if wanted and viewer.surface is not None else None
    means, clip = state.open.scene.gaussians.means, state.session.clip
    found = marks.caught(drawn, means, depths)
    if clip != UNCLIPPED and on_screen:  # Gaussians that are not drawn lie under no outline
        found &= clip.keeps(means @ drawn.camera.rotation[2] + drawn.camera.world_to_camera[2, 3])
    take(viewer, found, mode)


def drawn_stroke(viewer: Viewer) -> Drawn | None:
    """Return the stroke under way, in the image as it is; None without one."""
    tools, seen = viewer.state.tools, viewer.state.open
    if tools.tool is None or tools.stroke is None or seen is None:
        return None
    camera, reach = seen.view.camera(*viewer.state.size), tools.reach * seen.extent.radius
    return Drawn(tools.tool, tools.stroke, camera, tools.brush, reach)


# Transforms of the selection, else of the scene.


def next_gizmo(viewer: Viewer) -> None:
    """Show the gizmo that moves, the one that rotates, the one that scales, the handles of the box, none."""
    kinds: tuple[Gizmo, ...] = get_args(Gizmo)
    set_gizmo(viewer, kinds[(kinds.index(viewer.state.edit_form.gizmo) + 1) % len(kinds)])


def set_gizmo(viewer: Viewer, kind: Gizmo) -> None:
    """Choose the gizmo; the box begins around the selection, unless it was set by hand."""
    form = viewer.state.edit_form
    viewer.state.edit_form = replace(form, gizmo=kind)
    if kind == "box" and (form.low, form.high) == (EditForm.low, EditForm.high):
        fill_box(viewer)


def pivot(viewer: Viewer, seen: OpenScene) -> Array:
    """Return (3,) middle of what is transformed, world units: the selection, else the scene."""
    selected = viewer.state.middle(seen.scene, viewer.state.marks)
    return seen.extent.centre if selected is None else selected


def _move_of(viewer: Viewer, to: Similarity) -> Move:
    return Move(to, pack(viewer.state.marks.selected))


@needs_scene()
def preview(viewer: Viewer, seen: OpenScene, to: Similarity) -> None:
    """Show the result of `transform` before it is applied. Raises InputError where it leads too far."""
    move = _move_of(viewer, to)
    viewer.state.moving = move, move.applied(seen.scene)


@needs_scene("transform it")
def transform(viewer: Viewer, seen: OpenScene, to: Similarity) -> None:
    """Transform the selection or, without one, the scene with its cameras. Reports why where that fails."""
    viewer.state.moving = None
    if to.is_identity:
        return
    move, before = _move_of(viewer, to), viewer.state.session
    moves = before.moves
    joined = (*moves[:-1], moves[-1].then(move)) if moves and moves[-1].of == move.of else (*moves, move)
    try:
        place(viewer, joined)
    except LangSplatError as error:
        viewer.say_error(str(error))
        return
    viewer.change(moves=joined, ruler=replace(before.ruler, points=()))
    ask_listed(viewer)
    what = "the scene" if move.of is None else "the selection"
    viewer.state.say(f"transformed {what}; save the scene to keep it")


@needs_scene()
def place(viewer: Viewer, seen: OpenScene, moves: Sequence[Move]) -> None:
    """Rebuild the shown scene from a session's transforms; InputError, and no change, where that fails."""
    scene = seen.in_file
    for move in moves:
        scene = move.applied(scene)
    scene = replace(scene, language=viewer.language)
    viewer.state.open, viewer.state.moving = replace(seen, scene=scene, extent=extent_of(scene)), None
    viewer.engine, viewer.describer = viewer.services.engine(scene), None


@needs_scene("transform it")
def apply_form(viewer: Viewer, seen: OpenScene) -> None:
    """Transform by the numbers of the panel: scaled and rotated about the middle, then moved."""
    form = viewer.state.edit_form
    try:
        to = scaling(form.scale)
        for axis, degrees in zip("xyz", form.rotate, strict=True):
            to = to.then(rotating(AXES[axis], degrees))
        to = (to if to.is_identity else to.about(pivot(viewer, seen))).then(moving(np.array(form.move)))
    except LangSplatError as error:
        viewer.say_error(str(error))
        return
    transform(viewer, to)
    viewer.state.edit_form = replace(form, move=EditForm.move, rotate=EditForm.rotate, scale=EditForm.scale)


# Cropping to the box of the panel.


def set_box(viewer: Viewer, low: Point, high: Point) -> None:
    """Set two opposite corners of the box."""
    viewer.state.edit_form = replace(viewer.state.edit_form, low=low, high=high)


@needs_scene()
def fill_box(viewer: Viewer, seen: OpenScene) -> None:
    """Set the box around the selection, or without one around everything that is shown."""
    marks, gaussians = viewer.state.marks, seen.scene.gaussians
    chosen = (marks.selected if marks.selected.any() else marks.shown) & gaussians.valid()
    if chosen.any():
        means = gaussians.means[chosen].astype(np.float64)
        set_box(viewer, point_of(means.min(0)), point_of(means.max(0)))


def in_crop_box(viewer: Viewer) -> Array:
    """Return (N,) bool: Gaussians whose centres lie in the box of the panel."""
    form, seen = viewer.state.edit_form, viewer.state.open
    corners = np.array([form.low, form.high])
    means = np.zeros((0, 3)) if seen is None else seen.scene.gaussians.means
    return in_box(means, corners.min(0), corners.max(0))


@needs_scene("crop it")
def crop(viewer: Viewer, seen: OpenScene) -> None:
    """Show the box of the panel, then delete what lies outside; refused where nothing lies inside."""
    marks, form = viewer.state.marks, viewer.state.edit_form
    inside = in_crop_box(viewer)
    if (form.low, form.high) == (EditForm.low, EditForm.high):
        set_gizmo(viewer, "box")
        outside = np.count_nonzero(marks.kept & ~in_crop_box(viewer))
        viewer.state.say(f"Crop again deletes the {outside:,} Gaussians outside the box")
    elif (inside & marks.kept).any():
        mark(viewer, replace(marks, selected=marks.selected & inside, deleted=marks.deleted | ~inside))
    else:
        viewer.say_error("the box holds nothing: set its corners around something, or press Fit")


# Undo and redo. The camera is not undone: its reset leads back.


Step = Literal["undo", "redo"]


def undo(viewer: Viewer, step: Step = "undo") -> None:
    """Restore the session before the last step; "redo": revert the last undo."""
    history, now, named = viewer.history, viewer.state.session, named_step(viewer, step)
    there, back = (history.past, history.future)[:: 1 if step == "undo" else -1]
    if not there:
        viewer.state.say(f"nothing to {step}")
        return
    history.setting = ""
    back.append(now)
    adopt(viewer, there.pop().undone(now=now))
    viewer.state.say(named)


redo = partial(undo, step="redo")


def named_step(viewer: Viewer, step: Step) -> str:
    """Return what a step would undo or redo, in words: "undo delete 12 Gaussians"."""
    past, future, now = viewer.history.past, viewer.history.future, viewer.state.session
    if step == "undo":
        return f"undo {change_between(past[-1], now)}" if past else step
    return f"redo {change_between(now, future[-1])}" if future else step


def adopt(viewer: Viewer, session: Session) -> None:
    """Replace the session of the scene that is shown.

    Masks, the transformed scene and answers are updated to it. Raises InputError, and changes nothing, where
    a transform leads too far.
    """
    state, before = viewer.state, viewer.state.session
    if moved := session.moves != before.moves:
        place(viewer, session.moves)
    set_tools(viewer, stroke=None)
    state.record.chosen = None
    state.session = session
    forget_unlisted(viewer)
    teach_given(viewer)
    ask_listed(viewer, anew=moved or session.level != before.level)
