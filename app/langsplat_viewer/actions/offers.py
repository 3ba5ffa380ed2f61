"""What is offered to a searcher: examples of the scene, completions, corrections, earlier phrases."""

from pathlib import Path

from langsplat_core.progress import Progress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.suggestions import Suggestions, completions, suggest
from langsplat_core.semantics.encoders import DEMO
from langsplat_viewer.actions.queries import ask, remove
from langsplat_viewer.viewer import Viewer


def prepare_suggestions(viewer: Viewer) -> None:
    """Have the worker find examples, once per scene, when it has nothing else to do."""
    state, engine = viewer.state, viewer.engine
    if state.scene is state.suggestions_of or viewer.worker.current is not None:
        return
    state.suggestions, state.suggestions_of = Suggestions(), state.scene
    if engine is None or state.scene is None or state.scene.language is None:
        return
    scene = state.scene
    encoder_id = viewer.services.encoder_id or state.scene.language.encoder_id
    local = encoder_id == DEMO or Path(encoder_id).expanduser().is_dir()
    asked = engine if local else QueryEngine(scene)  # a hub id may mean a download: the phrasebook alone

    def work(progress: Progress) -> Suggestions:
        return suggest(asked, progress=progress)

    def done(found: Suggestions) -> None:
        if viewer.state.scene is scene:
            viewer.state.suggestions = found

    viewer.worker.submit("finding examples", work, done, lambda reason: None)


def offers(viewer: Viewer) -> tuple[str, tuple[str, ...]]:
    """What to offer now, and its title: phrases that go on from what is typed, else a correction of the last
    query, else, before the first query, examples."""
    state = viewer.state
    if state.typed.strip():
        return "", tuple(completions(state.typed, state.suggestions.phrases))
    last = state.queries[-1] if state.queries else None
    if last is None:
        return "try", state.suggestions.examples
    return "did you mean", (last.meant,) if last.meant else ()


def ask_offered(viewer: Viewer, phrase: str) -> None:
    """Search for what was offered; a query that it corrects leaves the list."""
    for query in [query for query in viewer.state.queries if query.meant == phrase]:
        remove(viewer, query)
    viewer.state.typed = ""
    ask(viewer, phrase)


def recall(viewer: Viewer, step: int) -> str:
    """The phrase `step` places later than the last recalled, -1 for the one before; "" behind the last."""
    state = viewer.state
    state.recalled = min(max(state.recalled + step, 0), len(state.asked))
    return state.asked[state.recalled] if state.recalled < len(state.asked) else ""
