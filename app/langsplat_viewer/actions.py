"""What the viewer can do: the functions that buttons, keys, dropped files and tests call.

Each takes the `Viewer` and changes its state; long work goes to the worker. None of them raises for
something a user did: the reason appears in the messages area.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import Display, LevelChoice
from langsplat_core.display.compose import latent_colours
from langsplat_core.progress import Progress
from langsplat_core.query.engine import NO_FIELD, QueryResult
from langsplat_core.scene import Scene
from langsplat_viewer.answers import Answers, LoadEncoder
from langsplat_viewer.controls import (
    Extent,
    OrbitCamera,
    between,
    default_view,
    extent_of,
    focus,
    from_camera,
)
from langsplat_viewer.jobs import Worker
from langsplat_viewer.state import GLIDE_SECONDS, SLOTS, Glide, Query, ViewerState

NEEDS_FIELD: tuple[Display, ...] = ("latent", "relevancy", "segmentation")


class Surface(Protocol):
    """The picture on screen, as far as actions need it."""

    def point_at(self, u: float, v: float) -> Array | None:
        """(3,) world point of the surface at a place in the picture, fractions from the top left corner."""

    def capture(self, state: ViewerState) -> Array:
        """(H, W, 3) uint8, the scene as shown, at full resolution and without panels."""


@dataclass(frozen=True)
class Services:
    """What the viewer needs from the layers below; tests put small fakes here."""

    load_scene: Callable[[Path], Scene]
    load_encoder: LoadEncoder
    encoder_id: str = ""  # in place of the text encoder that a scene names
    warm_up: Callable[[Scene, str], None] = lambda scene, backend: None  # first use of a backend is slow


@dataclass(eq=False)
class Viewer:
    """The viewer's state together with what acts on it."""

    services: Services
    state: ViewerState = field(default_factory=ViewerState)
    worker: Worker = field(default_factory=Worker)
    answers: Answers | None = None
    surface: Surface | None = None
    clock: float = 0.0  # seconds, as of the last `tick`


@dataclass(frozen=True, eq=False)
class _Opened:
    """A scene with all that the window's thread should not have to compute."""

    scene: Scene
    unusable: dict[str, int]  # reason -> Gaussians that are therefore not drawn
    extent: Extent
    view: OrbitCamera
    latent: Array | None


def tick(viewer: Viewer, now: float) -> None:
    """Start of a frame at `now` seconds: take what the worker finished and move a gliding camera on."""
    viewer.clock = now
    viewer.worker.poll()
    glide = viewer.state.glide
    if glide is not None:
        t = (now - glide.began) / GLIDE_SECONDS
        viewer.state.view = between(glide.start, glide.end, t)
        if t >= 1:
            viewer.state.glide = None


# --- Opening ---------------------------------------------------------------------------------------


def open_scene(viewer: Viewer, path: Path, then: Callable[[Viewer], None] = lambda viewer: None) -> None:
    """Read a scene in the background; `then` runs once it is on screen. The scene shown so far stays
    until the new one is there, and for good if that fails."""
    cancel(viewer)
    viewer.state.opening = path
    backend = viewer.state.backend

    def work(progress: Progress) -> _Opened:
        progress(f"opening {path.name}", 0.1)
        scene = viewer.services.load_scene(path)
        progress(f"preparing {path.name}", 0.6)
        viewer.services.warm_up(scene, backend)
        progress(f"preparing {path.name}", 0.9)
        latent = None if scene.language is None else latent_colours(scene.language)
        unusable = scene.gaussians.invalid_rows()
        extent = extent_of(scene)
        return _Opened(scene, unusable, extent, default_view(scene, extent), latent)

    def done(opened: _Opened) -> None:
        _show_scene(viewer, path, opened)
        then(viewer)

    def failed(reason: str) -> None:
        viewer.state.opening = None
        viewer.state.say(reason, is_error=True)

    viewer.worker.submit(f"opening {path.name}", work, done, failed)


def _show_scene(viewer: Viewer, path: Path, opened: _Opened) -> None:
    state, scene = viewer.state, opened.scene
    state.opening, state.path = None, path
    state.scene, state.extent, state.latent = scene, opened.extent, opened.latent
    state.queries, state.camera_index, state.glide = [], 0 if scene.cameras else None, None
    state.view = opened.view
    if scene.language is None and state.picture.display in NEEDS_FIELD:
        state.picture = replace(state.picture, display="rgb")
    viewer.answers = Answers(scene, viewer.services.load_encoder, viewer.services.encoder_id)
    reasons = ", ".join(f"{count:,} with {reason}" for reason, count in opened.unusable.items())
    not_drawn = f"; not drawn: {reasons}" if reasons else ""
    state.say(f"{path.name}: {len(scene.gaussians):,} Gaussians{not_drawn}")
    if scene.language is None:
        state.say(NO_FIELD)
        return
    encoder = viewer.services.encoder_id or scene.language.encoder_id
    if encoder == "demo" or Path(encoder).expanduser().is_dir():
        # Warm it up while the user looks round; a hub id may mean a download and waits for the first query.
        viewer.worker.submit(
            "loading the text encoder",
            viewer.answers.load_encoder,
            lambda nothing: None,
            lambda reason: state.say(reason, is_error=True),
        )


def cancel(viewer: Viewer) -> None:
    """Drop the work under way."""
    viewer.worker.cancel()
    viewer.state.opening = None
    waiting = [query for query in viewer.state.queries if query.pending]
    for query in waiting:
        query.pending = False
        query.problem = "" if query.result else "cancelled"


# --- Queries ---------------------------------------------------------------------------------------


def ask(viewer: Viewer, phrase: str) -> None:
    """Search the scene for a phrase and show where it is true."""
    state = viewer.state
    phrase = " ".join(phrase.split())
    if not phrase:
        return
    if state.scene is None or viewer.answers is None:
        state.say("open a scene first, then search it", is_error=True)
        return
    if state.scene.language is None:
        state.say(NO_FIELD, is_error=True)
        return
    query = next((q for q in state.queries if q.phrase.lower() == phrase.lower()), None)
    if query is None:
        query = Query(phrase)
        state.queries.append(query)
    show(viewer, query)
    if state.picture.display not in ("relevancy", "segmentation"):
        set_display(viewer, "relevancy")
    _answer(viewer, query)


def _answer(viewer: Viewer, query: Query) -> None:
    """Have the worker answer `query` at the current level choice."""
    answers, level = viewer.answers, viewer.state.level
    if answers is None:
        return

    def done(result: QueryResult) -> None:
        query.result, query.problem, query.pending = result, "", False

    def failed(reason: str) -> None:
        query.problem, query.pending = reason, False
        viewer.state.say(reason, is_error=True)

    query.pending = True
    viewer.worker.submit(
        f"searching '{query.phrase}'",
        lambda progress: answers.ask(query.phrase, level, progress),
        done,
        failed,
    )


def show(viewer: Viewer, query: Query) -> None:
    """Show a query's heat; it takes the first free colour, else that of the longest shown one."""
    if query.slot is not None:
        return
    shown = [q for q in viewer.state.queries if q.slot is not None]
    free = sorted(set(range(SLOTS)) - {q.slot for q in shown})
    query.slot = free[0] if free else shown[0].slot
    if not free:
        shown[0].slot = None
    viewer.state.queries.remove(query)  # the list is in order of showing, so that the oldest is known
    viewer.state.queries.append(query)


def hide(viewer: Viewer, query: Query) -> None:
    """Keep a query in the list without its heat."""
    query.slot = None


def remove(viewer: Viewer, query: Query) -> None:
    """Take a query off the list."""
    if query in viewer.state.queries:
        viewer.state.queries.remove(query)


def set_level(viewer: Viewer, level: LevelChoice) -> None:
    """Choose the semantic level of all queries, or leave it to the score ("auto")."""
    if level == viewer.state.level:
        return
    viewer.state.level = level
    for query in viewer.state.queries:
        _answer(viewer, query)


def set_display(viewer: Viewer, display: Display, latent_level: int | None = None) -> None:
    """Choose what is shown; `latent_level` is an index into `scene.LEVELS`."""
    state = viewer.state
    if display in NEEDS_FIELD and state.scene is not None and state.scene.language is None:
        state.say(NO_FIELD, is_error=True)
        return
    state.picture = replace(state.picture, display=display)
    if latent_level is not None:
        state.latent_level = latent_level


# --- Camera ----------------------------------------------------------------------------------------


def move(viewer: Viewer, step: Callable[[OrbitCamera], OrbitCamera]) -> None:
    """Apply one of the functions of `controls` at once; it ends a glide."""
    if viewer.state.view is not None:
        viewer.state.view, viewer.state.glide = step(viewer.state.view), None


def glide_to(viewer: Viewer, end: OrbitCamera) -> None:
    """Move smoothly to a view."""
    if viewer.state.view is not None:
        viewer.state.glide = Glide(viewer.state.view, end, viewer.clock)


def reset_view(viewer: Viewer) -> None:
    """Frame the whole scene, upright."""
    extent = viewer.state.extent
    if extent is not None:
        glide_to(viewer, from_camera(extent.home, extent))


def go_to_camera(viewer: Viewer, index: int) -> None:
    """Stand where a training photograph was taken; indices beyond the ends wrap round."""
    scene, extent = viewer.state.scene, viewer.state.extent
    if scene is None or extent is None:
        return
    if not scene.cameras:
        viewer.state.say("this scene has no training cameras (no .cameras.json beside it)", is_error=True)
        return
    viewer.state.camera_index = index % len(scene.cameras)
    glide_to(viewer, from_camera(scene.cameras[viewer.state.camera_index], extent))


def step_camera(viewer: Viewer, by: int) -> None:
    """The next (1) or previous (-1) training camera."""
    go_to_camera(viewer, (viewer.state.camera_index or 0) + by)


def focus_result(viewer: Viewer, query: Query | None = None) -> None:
    """Bring a query's place to the centre, at a distance that shows its surroundings; without `query` the
    latest one shown that was found; without any the middle of the scene."""
    state, extent = viewer.state, viewer.state.extent
    if extent is None or state.view is None:
        return
    if query is None:
        found = [q for q in state.queries if q.slot is not None and q.result and q.result.found]
        query = found[-1] if found else None
    if query is None or query.result is None or query.result.place is None:
        glide_to(viewer, focus(state.view, extent.centre, 2.6 * extent.radius))
        return
    box = query.result.box
    size = 0.1 * extent.radius if box is None else float(np.linalg.norm(box[1] - box[0]))
    near = 0.5 * extent.radius
    glide_to(viewer, focus(state.view, query.result.place, max(near, min(2.5 * size, state.view.distance))))


def focus_pixel(viewer: Viewer, u: float, v: float) -> None:
    """Turn around the surface under the cursor from now on; (u, v) are fractions of the scene's area."""
    if viewer.surface is None or viewer.state.view is None:
        return
    point = viewer.surface.point_at(u, v)
    if point is None:
        viewer.state.say("nothing under the cursor to turn around")
        return
    depth = float((point - viewer.state.view.eye) @ viewer.state.view.rotation[2])
    glide_to(viewer, focus(viewer.state.view, point, depth))
