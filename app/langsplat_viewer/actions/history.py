"""What was asked, shown and marked before, so that it can be undone."""

from dataclasses import dataclass

from langsplat_core.config import Display, LevelChoice
from langsplat_viewer.flight import Keyframe
from langsplat_viewer.selecting import Marks
from langsplat_viewer.state import Query, ViewerState
from langsplat_viewer.viewer import Viewer

LONGEST = 100  # steps that can be undone


@dataclass(frozen=True, eq=False)
class Moment:
    """The queries and how they were looked at; what is selected, hidden and deleted."""

    queries: tuple[tuple[Query, int | None, int, float | None], ...]  # with slot, shown_since and cut
    selected: Query | None
    display: Display
    latent_level: int
    level: LevelChoice
    marks: Marks
    keyframes: tuple[Keyframe, ...]


def now(state: ViewerState) -> Moment:
    """How things stand."""
    queries = tuple((query, query.slot, query.shown_since, query.cut) for query in state.queries)
    picture, marks = state.picture, state.selection.marks
    return Moment(
        queries=queries,
        selected=state.selected,
        display=picture.display,
        latent_level=state.latent_level,
        level=state.level,
        marks=marks,
        keyframes=state.record.keyframes,
    )


def remember(viewer: Viewer) -> None:
    """What follows can be undone: to be called before a change."""
    history = viewer.history
    history.past = [*history.past[1 - LONGEST :], now(viewer.state)]
    history.future = []


def forget(viewer: Viewer) -> None:
    """Another scene: nothing of before can be undone."""
    viewer.history.past, viewer.history.future = [], []
