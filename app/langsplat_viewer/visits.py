"""Where one stood in a scene and what was asked there, to be found again. It holds nothing of the scene."""

from dataclasses import dataclass

from langsplat_core.config import Display
from langsplat_core.scene import Camera
from langsplat_viewer.camera.controls import OrbitCamera
from langsplat_viewer.camera.flight import Keyframe
from langsplat_viewer.drawing.seeing import Clip, Ruler
from langsplat_viewer.state import Query, ViewerState


@dataclass(frozen=True, eq=False)
class Visit:
    """What is found again."""

    view: OrbitCamera | None
    opening_camera: Camera | None
    camera_index: int | None
    display: Display
    latent_level: int
    queries: tuple[Query, ...]  # without their answers
    selected: int | None  # index of the query whose details are shown
    canonical: tuple[str, ...]
    keyframes: tuple[Keyframe, ...]
    ruler: Ruler
    clip: Clip


def visit_of(state: ViewerState) -> Visit:
    """How things stand."""
    chosen = [place for place, query in enumerate(state.queries) if query is state.selected]
    return Visit(
        view=state.view,
        opening_camera=state.opening_camera,
        camera_index=state.camera_index,
        display=state.picture.display,
        latent_level=state.latent_level,
        queries=tuple(unanswered(query) for query in state.queries),
        selected=chosen[0] if chosen else None,
        canonical=state.canonical,
        keyframes=state.record.keyframes,
        ruler=state.seeing.ruler,
        clip=state.seeing.clip,
    )


def unanswered(query: Query) -> Query:
    """The same question, to be asked again."""
    return Query(query.phrase, query.slot, query.shown_since, cut=query.cut)
