"""The picture that is shown as the reference rasterizer draws it, in float64. No window here."""

from collections.abc import Callable
from copy import copy

from langsplat_core.arrays import Array
from langsplat_core.display.compose import compose
from langsplat_core.raster import load_rasterizer
from langsplat_viewer.drawing.channels import ArrayChannels
from langsplat_viewer.drawing.looking import drawn_scene
from langsplat_viewer.drawing.sight import Sight
from langsplat_viewer.pictures import splitting
from langsplat_viewer.pictures.marked_scene import layers_of, marked_scene
from langsplat_viewer.state import ViewerState

LONGEST_SIDE = 160  # pixels: the reference takes as long for more, but what is shown is drawn in the window


def small(state: ViewerState) -> ViewerState:
    """The same in a small window of the same shape."""
    factor = min(LONGEST_SIDE / max(state.size), 1.0)
    shown = copy(state)
    shown.size = max(round(state.size[0] * factor), 1), max(round(state.size[1] * factor), 1)
    return shown


def reference_of(state: ViewerState) -> Callable[[], Array]:
    """What draws the state as it is now, (H, W, C) uint8, whatever becomes of it: for another thread."""
    assert state.scene is not None
    assert state.view is not None
    shown = splitting.pictures(state)
    marked = marked_scene(state.scene, state.selection.marks)
    scene = drawn_scene(marked.scene, state.seeing.splats)
    sight = Sight(scene, state.view.camera(*splitting.picture_size(state)), state.seeing.clip)
    pictures = [(one.shown_picture(), one.heat_ranges()) for one in shown]
    layers = [layers_of(one, marked) for one in shown]
    split = state.seeing.split

    def draw() -> Array:
        channels = ArrayChannels(load_rasterizer("reference"))
        wanted = [held.channel(picture) for held, (picture, _) in zip(layers, pictures, strict=True)]
        drawn = channels.render_all(sight, wanted)
        images = [compose(found, *look) for found, look in zip(drawn, pictures, strict=True)]
        return splitting.joined(split, images)

    return draw
