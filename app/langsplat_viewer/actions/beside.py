"""A second scene, or the same by another encoder or method, right of a line across the image: a viewer of its
own without a window, which looks and asks as the first one does."""

from dataclasses import replace

import numpy as np

from langsplat_viewer.actions import viewpoint
from langsplat_viewer.actions.queries import ask_one, set_canonical, set_level
from langsplat_viewer.camera.controls import Extent, OrbitCamera
from langsplat_viewer.rendering.request import Split
from langsplat_viewer.state import Query
from langsplat_viewer.viewer import Viewer

ALIKE = 0.5, 1.5  # of two scenes in the same coordinates: distance of their middles in radii, ratio of radii


def follow(viewer: Viewer) -> None:
    """Give the second scene the first one's view and queries, once per frame, or close it."""
    state, beside = viewer.state, viewer.beside
    is_wanted = state.settings.split.mode == "scenes"
    if beside is None:
        if is_wanted:  # undone
            state.settings = replace(state.settings, split=replace(state.settings.split, mode="off"))
        return
    if not is_wanted:
        beside.worker.close()
        viewer.beside = None
        return
    beside.take_results()
    viewpoint.tick(beside, viewer.clock)
    for message in beside.state.messages:
        state.say(f"beside: {message.text}", message.is_error)
    beside.state.messages = []
    if beside.state.scene is not None and state.view is not None and state.extent is not None:
        _look(viewer, beside)
        _ask(viewer, beside)


def _look(viewer: Viewer, beside: Viewer) -> None:
    state, other, (view, canonical) = viewer.state, beside.state, beside.linked
    assert state.extent is not None
    assert other.extent is not None
    if state.view is not None and view is not state.view:
        other.view, beside.linked = linked(state.view, state.extent, other.extent), (state.view, canonical)
    has_field = other.scene is not None and other.scene.language is not None
    other.picture = state.picture if has_field else replace(state.picture, display="rgb")
    other.latent_level, other.size = state.latent_level, state.size
    other.settings = replace(state.settings, split=Split())


def linked(view: OrbitCamera, here: Extent, there: Extent) -> OrbitCamera:
    """The same view of another scene: itself where both have the same coordinates, as far as their extents
    tell, else from the same side and as far away in radii."""
    ratio = there.radius / here.radius
    if (
        np.linalg.norm(here.centre - there.centre) < ALIKE[0] * here.radius
        and 1 / ALIKE[1] < ratio < ALIKE[1]
    ):
        return view
    target = there.centre + ratio * (view.target - here.centre)
    return replace(view, target=target, distance=ratio * view.distance)


def _ask(viewer: Viewer, beside: Viewer) -> None:
    """Ask what the first is asked; each answer has the colour of the first one's."""
    state, other = viewer.state, beside.state
    if other.scene is None or other.scene.language is None:
        return
    if other.level != state.level:
        set_level(beside, state.level)
    if beside.linked[1] != state.canonical:
        beside.linked = beside.linked[0], state.canonical
        set_canonical(beside, ", ".join(state.canonical))
    answered = {query.phrase: query for query in other.queries}
    wanted = {query.phrase: query for query in state.queries}
    for phrase, query in wanted.items():
        if phrase not in answered and not query.pending and not query.problem:
            ask_one(beside, phrase, cut=query.cut)
        elif phrase in answered:
            _show(query, answered[phrase])
    if any(phrase not in wanted for phrase in answered):
        other.queries = [query for query in other.queries if query.phrase in wanted]


def _show(query: Query, other: Query) -> None:
    here = other.result is not None and other.result.verdict != "not here"
    other.slot, other.shown_since = (query.slot if here else None), query.shown_since
