"""What the pictures on screen depend on, as one value. The canvas draws when it is another than the last;
what the renderer has of it is handed over again where that part is another.

Scenes, marks, answers and cameras count as equal only where they are the same objects, which the value holds:
the id of one that is gone may be given to the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from langsplat_core.config import PictureConfig
from langsplat_core.display.compose import HeatRanges
from langsplat_core.scene import Scene
from langsplat_viewer.camera.controls import OrbitCamera
from langsplat_viewer.drawing.seeing import Clip, Splats
from langsplat_viewer.marks.selecting import Marks
from langsplat_viewer.pictures import splitting
from langsplat_viewer.state import ViewerState


@dataclass(frozen=True)
class Model:
    """Which Gaussians are drawn, and how."""

    scene: Scene
    marks: Marks
    splats: Splats


@dataclass(frozen=True)
class Look:
    """What one picture shows of them."""

    layers: tuple[object, ...]  # `ViewerState.layers_key`
    picture: PictureConfig
    heat_ranges: HeatRanges


@dataclass(frozen=True)
class Depiction:
    """All of it."""

    model: Model
    clip: Clip
    view: OrbitCamera
    size: tuple[int, int]  # of each picture at rest, pixels
    looks: tuple[Look, ...]  # from left to right

    def is_placed_as(self, other: "Depiction") -> bool:
        """Whether one projection of the Gaussians serves both."""
        return replace(self, looks=()) == replace(other, looks=())


def depiction(state: ViewerState, shown: Sequence[ViewerState]) -> Depiction:
    """Of a state with a scene and a view; `shown` are its `splitting.pictures`."""
    assert state.scene is not None
    assert state.view is not None
    return Depiction(
        Model(state.scene, state.selection.marks, state.seeing.splats),
        state.seeing.clip,
        state.view,
        splitting.picture_size(state),
        tuple(Look(one.layers_key(), one.shown_picture(), one.heat_ranges()) for one in shown),
    )
