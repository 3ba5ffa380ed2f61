"""What the panel "Timing" asks for."""

from langsplat_core.arrays import Array
from langsplat_core.progress import Progress
from langsplat_viewer.pictures.comparing import reference_of, small
from langsplat_viewer.timing import compared
from langsplat_viewer.viewer import Viewer


def measure_frame(viewer: Viewer) -> None:
    """Have the steps of this frame measured: the panel is seen."""
    viewer.state.timing.wanted = True


def compare_with_reference(viewer: Viewer) -> None:
    """Draw what is shown at a small size, have the reference rasterizer draw the same in the background, and
    tell the difference."""
    state = viewer.state
    if state.scene is None or state.view is None or viewer.surface is None:
        state.say("open a scene first, then compare its picture", is_error=True)
        return
    if viewer.recorder.current is not None:
        state.say("a film or a comparison is being drawn; wait for it or cancel it", is_error=True)
        return
    here = small(state)
    shown, draw, backend = viewer.surface.capture(here), reference_of(here), state.backend

    def work(progress: Progress) -> Array:
        return draw()

    def done(reference: Array) -> None:
        state.timing.comparison = compared(shown, reference, backend)

    viewer.recorder.submit(
        "comparing with the reference", work, done, lambda reason: state.say(reason, is_error=True)
    )


def stop_comparing(viewer: Viewer) -> None:
    """Do not wait for it."""
    viewer.recorder.cancel()
