"""Opening scenes, and stopping what is under way."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from langsplat_core.arrays import Array
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.display.latent_colours import latent_colours
from langsplat_core.progress import Progress
from langsplat_core.query.engine import no_field
from langsplat_core.scene import Scene
from langsplat_core.semantics.encoders import DEMO
from langsplat_viewer.actions.settings import set_display
from langsplat_viewer.controls import Extent, OrbitCamera, default_view, extent_of
from langsplat_viewer.viewer import Viewer


@dataclass(frozen=True, eq=False)
class _Opened:
    """A scene with all that the window's thread should not have to compute."""

    scene: Scene
    unusable: dict[str, int]  # reason -> Gaussians that are therefore not drawn
    extent: Extent
    view: OrbitCamera
    latent: Array | None  # (3, N, 3) colours


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


def type_path(viewer: Viewer, text: str) -> None:
    """What stands in the box for a path."""
    viewer.state.path_typed = text


def open_typed(viewer: Viewer) -> bool:
    """Open what the box for a path names; whether it names anything."""
    text = viewer.state.path_typed.strip()
    if text:
        open_scene(viewer, Path(text).expanduser())
    return bool(text)


def cancel(viewer: Viewer) -> None:
    """Drop the work under way."""
    viewer.worker.cancel()
    viewer.state.opening = None
    waiting = [query for query in viewer.state.queries if query.pending]
    for query in waiting:
        query.pending = False
        query.problem = "" if query.result else "cancelled"


def _show_scene(viewer: Viewer, path: Path, opened: _Opened) -> None:
    state, scene = viewer.state, opened.scene
    state.opening, state.path = None, path
    state.scene, state.extent, state.latent = scene, opened.extent, opened.latent
    state.queries, state.camera_index, state.glide = [], 0 if scene.cameras else None, None
    state.view = opened.view
    viewer.engine = viewer.services.engine(scene)
    if scene.language is None and DISPLAYS[state.picture.display].needs_field:
        set_display(viewer, "rgb")
    reasons = ", ".join(f"{count:,} with {reason}" for reason, count in opened.unusable.items())
    not_drawn = f"; not drawn: {reasons}" if reasons else ""
    state.say(f"{path.name}: {len(scene.gaussians):,} Gaussians{not_drawn}")
    for reason in scene.unread:
        state.say(f"opened without what lies beside it: {reason}", is_error=True)
    if scene.language is None:
        state.say(no_field(scene))
    else:
        state.picture = replace(state.picture, threshold=scene.language.reading.found)
        _warm_up_encoder(viewer, viewer.services.encoder_id or scene.language.encoder_id)


def _warm_up_encoder(viewer: Viewer, encoder_id: str) -> None:
    """Load a local encoder while the user looks round; a hub id may mean a download and waits for the
    first query that needs it."""
    if viewer.engine is None or not (encoder_id == DEMO or Path(encoder_id).expanduser().is_dir()):
        return
    viewer.worker.submit(
        "loading the text encoder",
        viewer.engine.load_encoder,
        lambda encoder: None,
        lambda reason: viewer.state.say(reason, is_error=True),
    )
