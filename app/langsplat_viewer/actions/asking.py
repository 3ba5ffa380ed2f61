"""How queries are asked and where they end: own cuts, canonical phrases, whole sets of queries."""

from pathlib import Path

from langsplat_core.errors import InputError
from langsplat_core.progress import Progress
from langsplat_core.query.answers import recut
from langsplat_core.scene.phrases import split_phrases
from langsplat_viewer.actions.history import remember
from langsplat_viewer.actions.queries import ask_again, ask_one, set_level
from langsplat_viewer.files.querysets import SUFFIX, QuerySet, SavedQuery, read_queries, write_queries
from langsplat_viewer.jobs import one_line
from langsplat_viewer.output.saving import free_name
from langsplat_viewer.state import Query
from langsplat_viewer.viewer import Viewer


def set_cut(viewer: Viewer, query: Query, cut: float | None, *, is_new: bool = True) -> None:
    """Let an answer end at a relevancy of one's own, or (None) where it ends by itself.

    is_new: a step of its own to undo, and not a slider that moves on.
    """
    if query.automatic is None or cut == query.cut:
        return
    if is_new:
        remember(viewer)
    query.cut = cut
    query.result = query.automatic if cut is None else recut(query.automatic, cut)


def type_canonical(viewer: Viewer, text: str) -> None:
    """What stands in the box of the canonical phrases."""
    viewer.state.canonical_typed = text


def set_canonical(viewer: Viewer, text: str) -> None:
    """Compare everything with other canonical phrases, between commas; "" for the scene's own again."""
    phrases = tuple(split_phrases(text))
    engine, state = viewer.engine, viewer.state
    if engine is None or state.scene is None or state.scene.language is None:
        state.say("open a scene with a language field first", is_error=True)
        return

    def work(progress: Progress) -> tuple[str, ...]:
        engine.compare_with(phrases, progress)
        return engine.canonical_phrases

    def done(canonical: tuple[str, ...]) -> None:
        state.canonical, state.canonical_typed = phrases, ", ".join(canonical)
        state.say(f"compared with {', '.join(canonical)}")
        ask_again(viewer)

    viewer.worker.submit("encoding canonical phrases", work, done, lambda reason: state.say(reason, True))


def save_queries(viewer: Viewer, folder: Path) -> Path | None:
    """Save the list to a new file in `folder`; returns its path, None if there is none or that failed."""
    state = viewer.state
    if not state.queries:
        state.say("search for something first, then save the queries", is_error=True)
        return None
    path = free_name(folder, state.path.stem if state.path else "scene", SUFFIX)
    saved = tuple(SavedQuery(query.phrase, query.cut, query.slot is not None) for query in state.queries)
    try:
        write_queries(path, QuerySet(saved, state.level, state.canonical))
    except OSError as error:
        state.say(f"{path}: not saved ({one_line(error)})", is_error=True)
        return None
    state.say(f"saved {path}; open it, or drop it onto the window, to ask them again")
    return path


def load_queries(viewer: Viewer, path: Path) -> None:
    """Ask everything that a file has, after what is in the list already."""
    state = viewer.state
    try:
        wanted = read_queries(path)
    except InputError as error:
        state.say(one_line(error), is_error=True)
        return
    if state.scene is None or state.scene.language is None:
        state.say(f"{path.name}: open a scene that can be searched first", is_error=True)
        return
    if wanted.canonical != state.canonical:
        set_canonical(viewer, ", ".join(wanted.canonical))
    set_level(viewer, wanted.level)
    for query in wanted.queries:
        ask_one(viewer, query.phrase, cut=query.cut, then_show=query.shown)
