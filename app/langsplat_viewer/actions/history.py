"""History: queries, view settings, notes and marks as they were before each change, to be undone."""

from dataclasses import dataclass

from langsplat_core.config import LevelChoice, PictureConfig
from langsplat_viewer.camera.flight import Keyframe
from langsplat_viewer.files.projects import Note, Things
from langsplat_viewer.marks import Move, PackedMarks, pack
from langsplat_viewer.state import Query, ViewSettings
from langsplat_viewer.viewer import Viewer

LONGEST = 100  # steps that can be undone
GESTURE = 1.0  # seconds: changes of one setting that follow each other sooner are one step


@dataclass(frozen=True, eq=False)
class Moment:
    """The queries and how they were looked at; what is selected, hidden, deleted and moved."""

    queries: tuple[tuple[Query, int | None, int, float | None], ...]  # with slot, shown_since and cut
    selected: Query | None
    picture: PictureConfig
    latent_level: int
    level: LevelChoice
    settings: ViewSettings
    overlays: tuple[str, ...]
    marks: PackedMarks
    moves: tuple[Move, ...]
    keyframes: tuple[Keyframe, ...]
    things: Things
    notes: tuple[Note, ...]


def now(viewer: Viewer) -> Moment:
    """Return the present moment."""
    state = viewer.state
    viewer.history.marks = pack(state.selection.marks, viewer.history.marks)
    return Moment(
        queries=tuple((query, query.slot, query.shown_since, query.cut) for query in state.queries),
        selected=state.selected,
        picture=state.picture,
        latent_level=state.latent_level,
        level=state.level,
        settings=state.settings,
        overlays=state.preferences.overlays,
        marks=viewer.history.marks.packed,
        moves=state.selection.moves,
        keyframes=state.record.keyframes,
        things=state.things,
        notes=state.notes,
    )


def remember(viewer: Viewer, setting: str = "") -> None:
    """Make what follows one step that can be undone; call it before a change. `setting` names one that is
    moved, as sliders are: its changes in quick succession are one step."""
    history = viewer.history
    goes_on = setting != "" and setting == history.setting and viewer.clock - history.set_at < GESTURE
    history.setting, history.set_at = setting, viewer.clock
    if not goes_on:
        history.past = [*history.past[1 - LONGEST :], now(viewer)]
        history.future = []


def let_go(viewer: Viewer) -> None:
    """Drop the answers of queries that are in no list any more but in what can be undone: numbers for every
    Gaussian. They are asked anew when they come back."""
    listed = {id(query) for query in viewer.state.queries}
    for moment in (*viewer.history.past, *viewer.history.future):
        for query, *_ in moment.queries:
            if id(query) not in listed:
                query.result = query.automatic = None
                query.things, query.pending = (), False


def forget(viewer: Viewer) -> None:
    """Empty the history: nothing that was done in another scene can be undone."""
    history = viewer.history
    history.past, history.future, history.marks, history.setting = [], [], None, ""
