"""What is under the cursor, while it rests."""

from langsplat_core.progress import Progress
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import no_field
from langsplat_core.query.pointing import Pointed, look_at_pixel
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_viewer.drawing.looking import looking_settings
from langsplat_viewer.state import Hover
from langsplat_viewer.viewer import Viewer

REST_SECONDS = 0.2  # of the mouse, after which it is asked what lies there


def toggle_pointing(viewer: Viewer) -> None:
    """Say what is under the cursor from now on, or no longer."""
    state = viewer.state
    if not state.pointing and (state.scene is None or state.scene.language is None):
        state.say("open a scene first" if state.scene is None else no_field(state.scene), is_error=True)
        return
    state.pointing, state.hover = not state.pointing, None


def hover(viewer: Viewer, pixel: tuple[int, int] | None) -> None:
    """Once per frame: the mouse is over this pixel (column, row) of the scene's area; None: elsewhere, or it
    drags. What lies there is asked once the mouse and the camera rest."""
    state = viewer.state
    if not state.pointing or state.view is None or pixel is None:
        state.hover = None
        return
    width, height = state.size
    if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
        state.hover = None
        return
    before = state.hover
    same = before is not None and (before.pixel, before.view) == (pixel, state.view)
    if not same or before is None:
        state.hover = Hover(pixel, state.view, viewer.clock)
    elif not before.asked and viewer.clock - before.since >= REST_SECONDS and viewer.worker.current is None:
        before.asked = True
        _ask(viewer, before)


def _ask(viewer: Viewer, place: Hover) -> None:
    engine = viewer.engine
    if engine is None:
        return
    camera = place.view.camera(*viewer.state.size)
    shown = [query for query in viewer.state.shown() if query is not None and query.result is not None]
    settings = looking_settings(engine.scene, camera, viewer.state.seeing.clip)
    results = [query.result for query in shown if query.result is not None]

    def work(progress: Progress) -> tuple[Describer, Pointed | None]:
        describer = viewer.describer
        if describer is None or describer.engine is not engine:
            describer = Describer(engine, progress=progress)
        rasterizer = load_lifting_rasterizer("cpu")
        return describer, look_at_pixel(
            rasterizer, describer, camera, place.pixel, results, settings=settings
        )

    def done(found: tuple[Describer, Pointed | None]) -> None:
        viewer.describer, place.found = found
        place.phrases = tuple(query.phrase for query in shown)

    viewer.worker.submit(
        "looking under the cursor", work, done, lambda reason: viewer.state.say(reason, is_error=True)
    )
