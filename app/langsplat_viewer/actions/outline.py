"""The outline: the scene's tree in words, and actions on a thing that is listed or clicked."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.display.displays import Subject, nodes
from langsplat_core.progress import Progress
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.instances import axis_aligned_box
from langsplat_core.query.inventory import Outline, scene_outline
from langsplat_core.scene.language import tidy
from langsplat_viewer.actions.editing import Target, mark, of_thing, select_alike, take
from langsplat_viewer.actions.queries import teach
from langsplat_viewer.actions.viewpoint import focus_on
from langsplat_viewer.session import point_of
from langsplat_viewer.state import OpenScene, OutlineView
from langsplat_viewer.viewer import Viewer, needs_scene

SURE = 0.7  # probability below which a name is shown as a question
BACKGROUND = {"wall", "floor", "ground", "ceiling", "skirting", "rug", "carpet"}  # listed last in the outline


def wanted(viewer: Viewer) -> OutlineView:
    """Return the outline of the scene, as far as it is known, or why there is none.

    The worker finds it once it has nothing else to do.
    """
    state, work = viewer.state, viewer.worker.current
    if state.outline is None:
        if work is not None or not state.has_field:
            missing = state.why_no_field or "open a scene with a language field"
            return OutlineView(problem=missing if work is None else f"{work[0]} ...")
        if not viewer.has_encoder_here and not state.session.queries:
            reason = f"names come from the encoder '{viewer.encoder_id}': search for something first"
            return OutlineView(problem=reason)
        state.outline = OutlineView(problem="looking for what is here ...")
        _find(viewer)
    return state.outline


def _find(viewer: Viewer) -> None:
    def work(engine: QueryEngine, progress: Progress) -> tuple[Describer, OutlineView]:
        describer = viewer.describing(engine, progress)
        progress("looking for what is here", 0.5)
        roots = things_first(scene_outline(describer))
        return describer, OutlineView(roots, engine.tree)

    def done(found: tuple[Describer, OutlineView]) -> None:
        viewer.describer, viewer.state.outline = found

    def failed(reason: str) -> None:
        viewer.state.outline = OutlineView(problem=reason)

    viewer.ask_engine("looking for what is here", work, done, failed)


def things_first(rows: Iterable[Outline]) -> tuple[Outline, ...]:
    """Return rows with those that are likely to be walls and floors last, else in their order."""

    def is_background(row: Outline) -> bool:
        return row.word is not None and not BACKGROUND.isdisjoint(row.word.phrase.split())

    return tuple(sorted(rows, key=is_background))


def name_of(viewer: Viewer, row: Outline) -> str:
    """Return the name that was given to a row, else what it is likely to be."""
    given = viewer.state.session.things.names.get(row.node)
    return given or ("unknown" if row.word is None else row.word.phrase)


def sure_of(viewer: Viewer, row: Outline) -> tuple[bool, str]:
    """Return whether a row's name is reliable, and the text behind it that says so."""
    if row.word is None or row.node in viewer.state.session.things.names:
        return row.node in viewer.state.session.things.names, ""
    is_sure = viewer.has_percentages and row.word.probability >= SURE
    said = f" {100 * row.word.probability:.0f} %" if viewer.has_percentages else ""
    return is_sure, said if is_sure else "?" + said


def filtered(viewer: Viewer, rows: Iterable[Outline], text: str) -> Iterator[Outline]:
    """Yield the rows with every word of `text` in their name or in that of a part, with those parts alone."""
    words = text.lower().split()
    for row in rows:
        parts = tuple(filtered(viewer, row.parts, text))
        name = name_of(viewer, row).lower()
        if all(word in name for word in words):
            yield row
        elif parts:
            yield replace(row, parts=parts)


def hidden_nodes(viewer: Viewer) -> Array:
    """Return (K,) bool: nodes of which nothing is shown."""
    view = viewer.state.outline
    if view is None or view.tree is None:
        return np.zeros(0, bool)
    return view.hidden(view.tree, viewer.state.marks)


def colour_of(viewer: Viewer, node: int) -> tuple[float, float, float] | None:
    """Return a node's mean colour in the display if that colours things: the latents, or the tree."""
    state = viewer.state
    display, view = state.session.picture.display, state.outline
    if display not in ("latent", "tree") or view is None or view.tree is None or viewer.engine is None:
        return None
    key, field = (display, state.session.latent_level, node), viewer.engine.scene.language
    if key not in view.colours and field is not None:
        subject = Subject(state.count, field, level=state.session.latent_level)
        values = field.colours[state.session.latent_level] if display == "latent" else nodes(subject)
        inside = view.tree.members(node)
        mean = np.zeros(3) if values is None else np.median(values[inside], axis=0)
        view.colours[key] = point_of(mean)
    return view.colours.get(key)


def in_view(viewer: Viewer) -> list[Outline]:
    """Return the rows of named wholes whose middle is in the image, those that look largest first."""
    state = viewer.state
    if state.outline is None or state.open is None:
        return []
    names = state.session.things.names
    rows = [row for row in state.outline.roots if row.word is not None or row.node in names]
    if not rows:
        return []
    camera = state.open.view.camera(*state.size)
    pixels, depths = camera.project(np.array([row.centre for row in rows]))
    inside = (depths > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
    order = sorted(np.flatnonzero(inside), key=lambda place: -rows[place].share / depths[place] ** 2)
    return [rows[place] for place in order]


# Actions on a thing.


def _hidden(viewer: Viewer, hidden: Array) -> None:
    marks = viewer.state.marks
    mark(viewer, replace(marks, selected=marks.selected & ~hidden, hidden=hidden))


@of_thing
@needs_scene()
def visit(viewer: Viewer, seen: OpenScene, members: Array) -> None:
    """Select a thing, and look at it from as near as it is small."""
    take(viewer, members, "replace")
    box = axis_aligned_box(seen.scene.gaussians.means[members].astype(np.float64))
    focus_on(viewer, box.mean(0), box)


@of_thing
def find_alike(viewer: Viewer, members: Array) -> None:
    """Select everything like a thing."""
    take(viewer, members, "replace")
    select_alike(viewer)


# Select it, replacing the selection; hide it, keeping the rest of the selection; show it again.
select = of_thing(lambda viewer, members: take(viewer, members, "replace"))
hide = of_thing(lambda viewer, members: _hidden(viewer, viewer.state.marks.hidden | members))
show = of_thing(lambda viewer, members: _hidden(viewer, viewer.state.marks.hidden & ~members))


def give_name(viewer: Viewer, target: Target, name: str) -> None:
    """Name a thing, and teach the name, so that searching for the name finds the thing."""
    name, node = tidy(name), target if isinstance(target, int) else None
    if name:
        of_thing(lambda viewer, members: teach(viewer, name, members, node))(viewer, target)
