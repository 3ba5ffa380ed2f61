"""Opening scenes, and stopping what is under way."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from langsplat_core.arrays import Array
from langsplat_core.compiled import is_compiled
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.display.latent_colours import latent_colours
from langsplat_core.formats import scene_files
from langsplat_core.pipeline.report import stated_doubts
from langsplat_core.progress import Progress
from langsplat_core.query import regions
from langsplat_core.query.engine import no_field
from langsplat_core.scene import Scene
from langsplat_core.semantics.encoders import DEMO
from langsplat_viewer.actions import bookmarks
from langsplat_viewer.actions.camera import opening_view
from langsplat_viewer.actions.history import forget
from langsplat_viewer.actions.leaving import leave
from langsplat_viewer.camera.controls import Extent, extent_of
from langsplat_viewer.drawing.looking import why_undrawable
from langsplat_viewer.drawing.seeing import UNCLIPPED, Ruler
from langsplat_viewer.files.preferences import with_recent
from langsplat_viewer.files.watching import Stamps, stamps
from langsplat_viewer.marks.selecting import of_scene
from langsplat_viewer.recording import Recording
from langsplat_viewer.viewer import Viewer
from langsplat_viewer.visits import visit_of


@dataclass(frozen=True, eq=False)
class _Opened:
    """A scene with all that the window's thread should not have to compute."""

    scene: Scene
    unusable: dict[str, int]  # reason -> Gaussians that are therefore not drawn
    extent: Extent
    latent: Array | None  # (3, N, 3) colours
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
        latent = None if scene.language is None else latent_colours(scene.language)
        unusable = scene.gaussians.invalid_rows()
        doubts = stated_doubts(path, len(scene.gaussians))
        return _Opened(scene, unusable, extent_of(scene), latent, read, doubts)

    def done(opened: _Opened) -> None:
        _show_scene(viewer, path, opened)
        then(viewer)

    def failed(reason: str) -> None:
        viewer.state.opening = None
        viewer.state.say(reason, is_error=True)

    viewer.worker.submit(f"opening {path.name}", work, done, failed)


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
    state.opening, state.path = None, path
    if path.absolute() not in state.scenes:
        state.scenes = (*state.scenes, path.absolute())
    viewer.watch.begin(opened.read)
    state.scene, state.extent, state.latent = scene, opened.extent, opened.latent
    state.doubts = opened.doubts
    state.queries, state.selected, state.glide = [], None, None
    state.canonical, state.canonical_typed = (), ""
    state.selection = of_scene(state.selection, len(scene.gaussians))
    state.camera_index = 0 if scene.cameras else None
    state.seeing = replace(state.seeing, ruler=Ruler(), clip=UNCLIPPED)
    forget(viewer)
    state.preferences = with_recent(state.preferences, path.absolute())
    state.opening_camera = None
    bookmarks.load(viewer)
    state.record = Recording(size=state.record.size, fps=state.record.fps)
    state.view, state.nothing = opening_view(viewer), why_undrawable(scene.gaussians)
    viewer.engine, viewer.describer, state.hover = viewer.services.engine(scene), None, None
    state.pointing = state.pointing and scene.language is not None
    if scene.language is None and DISPLAYS[state.picture.display].needs_field:
        state.picture = replace(state.picture, display="rgb")
    reasons = ", ".join(f"{count:,} with {reason}" for reason, count in opened.unusable.items())
    not_drawn = f"; not drawn: {reasons}" if reasons else ""
    state.say(f"{path.name}: {len(scene.gaussians):,} Gaussians{not_drawn}")
    for reason in scene.unread:
        state.say(f"opened without what lies beside it: {reason}", is_error=True)
    for doubt in opened.doubts:
        state.say(doubt, is_error=True)
    if scene.language is None:
        state.say(no_field(scene))
    else:
        _compile_search(viewer)
        _warm_up_encoder(viewer, viewer.services.encoder_id or scene.language.encoder_id)


def _compile_search(viewer: Viewer) -> None:
    """Have what queries run on compiled before the first one, and say so, unless an earlier run did it."""
    engine = viewer.engine
    if engine is None or is_compiled(Path(regions.__file__)):
        return
    viewer.worker.submit(
        "compiling the search kernels, once per installation (half a minute)",
        lambda progress: engine.regions,
        lambda regions: None,
        lambda reason: viewer.state.say(reason, is_error=True),
    )


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
