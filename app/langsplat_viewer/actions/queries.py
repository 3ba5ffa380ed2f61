"""Searching: the box, the list of queries, their colours and their level."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.errors import InputError, UnknownWordError
from langsplat_core.pipeline.evidence import draw_evidence, find_evidence, kept_features, kept_photographs
from langsplat_core.progress import Progress
from langsplat_core.query.answers import QueryResult, recut
from langsplat_core.query.compose import ComposedResult, run_phrase
from langsplat_core.query.describe import Suggestions, completions, corrected, suggest
from langsplat_core.query.engine import QueryEngine, no_field
from langsplat_core.query.grammar import Atom, heads
from langsplat_core.query.instances import Instance
from langsplat_core.raster import load_rasterizer
from langsplat_core.scene import TaughtWord
from langsplat_core.scene.language import phrase_key, split_phrases
from langsplat_viewer.actions.selecting import has_selection
from langsplat_viewer.actions.settings import open_panel
from langsplat_viewer.files.projects import QUERIES, QuerySet, SavedQuery, read_queries, write_queries
from langsplat_viewer.jobs import one_line
from langsplat_viewer.output import free_name
from langsplat_viewer.state import SLOTS, EvidenceSheet, Query, ViewerState
from langsplat_viewer.viewer import Viewer, let_go, remember

MOST_THINGS = 20  # of one answer that are told apart


def ask(viewer: Viewer, text: str) -> None:
    """Search the scene for a phrase, or for several between commas, and show where each is true."""
    phrases = split_phrases(text)
    for phrase in phrases:
        ask_one(viewer, phrase)
    if text.strip() and not phrases:
        viewer.say_error(f"'{text.strip()[:40]}' has no word to look for")


def ask_one(viewer: Viewer, phrase: str, *, cut: float | None = None, then_show: bool = True) -> None:
    """Search the scene for one phrase. cut: a relevancy of one's own at which the answer ends; then_show:
    give it a colour if it may be there."""
    state = viewer.state
    if state.scene is None or viewer.engine is None:
        viewer.say_error("open a scene first, then search it")
        return
    if state.scene.language is None:
        viewer.say_error(no_field(state.scene))
        return
    key = phrase_key(phrase)
    query = next((q for q in state.queries if phrase_key(q.phrase) == key), None) or Query(phrase)
    remember(viewer)
    state.queries = [*(q for q in state.queries if q is not query), query]  # in order of asking
    state.asked = [*(earlier for earlier in state.asked if phrase_key(earlier) != key), phrase]
    state.recalled = len(state.asked)
    query.cut = cut
    select(viewer, query)
    _answer(viewer, query, then_show)


JOINS = {"and": "{} and {}", "or": "{} or {}", "without": "{}, not {}"}  # as the grammar reads them


def ask_combined(viewer: Viewer, first: Query, join: str, second: Query) -> None:
    """Search for two queries at once, joined by one of `JOINS`."""
    ask_one(viewer, JOINS[join].format(first.phrase, second.phrase))


def ask_again(viewer: Viewer) -> None:
    """Answer every query of the list anew: what they depend on has changed."""
    for query in viewer.state.queries:
        _answer(viewer, query)


def ask_unanswered(viewer: Viewer) -> None:
    """Answer the queries of the list that have neither an answer nor a reason why not, nor wait for one."""
    for query in viewer.state.queries:
        if query.automatic is None and not query.problem and not query.pending:
            _answer(viewer, query)


def ask_typed(viewer: Viewer) -> None:
    """Search for what stands in the box and empty it; the box keeps the keyboard for the next phrase."""
    viewer.state.focus_input = viewer.state.awaits_keyboard = True
    if not viewer.state.typed.strip():
        return
    ask(viewer, viewer.state.typed)
    viewer.state.typed = ""


def type_name(viewer: Viewer, name: str) -> None:
    viewer.state.selection = replace(viewer.state.selection, name=name)


def name_selection(viewer: Viewer) -> None:
    """Teach the typed name by what is selected, and search for it. What is saved from now on keeps it."""

    def done(word: TaughtWord) -> None:
        type_name(viewer, "")
        taught(viewer, word)

    if has_selection(viewer):
        selection = viewer.state.selection
        teach(viewer, selection.name, selection.marks.selected, done)


def teach(viewer: Viewer, name: str, members: Array, done: Callable[[TaughtWord], None]) -> None:
    """Have the worker teach a name by what (N,) bool mean; then `done`, if the scene is still there."""
    engine, scene = viewer.engine, viewer.state.scene
    if engine is not None:
        viewer.run(
            f"teaching '{name}'",
            lambda progress: engine.teach(name, members),
            lambda word: done(word) if viewer.state.scene is scene else None,
        )


def taught(viewer: Viewer, word: TaughtWord) -> None:
    """Say that a word was taught, and search for it."""
    viewer.state.say(f"taught '{word.name}'; to keep it, save the scene")
    ask_one(viewer, word.name)


def focus_search(viewer: Viewer) -> None:
    """Have the search box take the keyboard; where there is nothing to search, what is typed goes nowhere."""
    open_panel(viewer, "Search")
    scene = viewer.state.scene
    if scene is None or scene.language is None:
        viewer.say_error("open a scene first, then search it" if scene is None else no_field(scene))
        viewer.state.letters_muted = True
    else:
        viewer.state.focus_input = viewer.state.awaits_keyboard = True


def take_search_focus(viewer: Viewer) -> bool:
    """Return whether the search box takes the keyboard now; True once."""
    wanted, viewer.state.focus_input = viewer.state.focus_input, False
    return wanted


Answered = ComposedResult | UnknownWordError


def _answer(viewer: Viewer, query: Query, then_show: bool = False) -> None:
    """Have the worker answer `query` at the current level choice; only what may be there takes a colour."""
    engine, level = viewer.engine, viewer.state.level
    if engine is None:
        return
    view = viewer.state.view
    viewpoint = None if view is None else view.camera(*viewer.state.size)
    took: list[float] = []  # milliseconds

    def work(progress: Progress) -> Answered:
        began = perf_counter()
        try:
            composed = run_phrase(engine, query.phrase, level, viewpoint, progress)
        except UnknownWordError as error:
            return error
        took.append(1e3 * (perf_counter() - began))
        return composed

    def done(answered: Answered) -> None:
        if query not in viewer.state.queries:  # it was taken off meanwhile
            return
        if isinstance(answered, UnknownWordError):
            query.meant = corrected(query.phrase, answered.near) or ""
            failed(str(answered))
            return
        viewer.state.timing.add("search", took[0])
        _take(query, answered)
        if then_show:
            _show_answer(viewer, query, answered.answer)
        if answered.answer.found:
            _tell_apart(viewer, query, answered.answer)

    def failed(reason: str) -> None:
        query.problem, query.pending = reason, False
        viewer.say_error(reason)

    query.pending = True
    viewer.run(f"searching '{query.phrase}'", work, done, failed)


def _tell_apart(viewer: Viewer, query: Query, answer: QueryResult) -> None:
    """Have the worker find the instances of an answer that is shown by then: the surface that they are told
    apart on takes seconds where there are a million Gaussians."""
    engine = viewer.engine
    if engine is None:
        return

    def done(things: tuple[Instance, ...]) -> None:
        if query.automatic is answer:
            query.things = things

    viewer.run("telling things apart", lambda progress: engine.instances(answer, MOST_THINGS), done)


def _take(query: Query, composed: ComposedResult) -> None:
    query.automatic, query.things = composed.answer, ()
    query.problem, query.meant, query.pending = "", "", False
    query.result = composed.answer if query.cut is None else recut(composed.answer, query.cut)
    query.asked_for = heads(composed.tree)
    query.reading = "" if isinstance(composed.tree, Atom) else composed.reading


def _show_answer(viewer: Viewer, query: Query, answer: QueryResult) -> None:
    if answer.verdict != "not here":  # nothing is painted for it
        _give_slot(viewer, query)
    if not DISPLAYS[viewer.state.picture.display].needs_query:
        viewer.state.picture = replace(viewer.state.picture, display="relevancy")


def select(viewer: Viewer, query: Query | None) -> None:
    """Have the details of a query shown below the list."""
    viewer.state.selected = query


def show(viewer: Viewer, query: Query) -> None:
    """Show a query's heat; it takes the first free colour, else that of the longest shown one."""
    if query.slot is None:
        remember(viewer)
        _give_slot(viewer, query)


def _give_slot(viewer: Viewer, query: Query) -> None:
    if query.slot is not None:
        return
    shown = viewer.state.in_order_of_showing()
    free = sorted(set(range(SLOTS)) - {q.slot for q in shown})
    query.slot = free[0] if free else shown[0].slot
    query.shown_since = 1 + max((q.shown_since for q in shown), default=0)
    if not free:
        shown[0].slot = None


def hide(viewer: Viewer, query: Query) -> None:
    """Keep a query in the list without its heat."""
    remember(viewer)
    query.slot = None


def remove(viewer: Viewer, query: Query) -> None:
    state = viewer.state
    if query in state.queries:
        remember(viewer)
        state.queries = [q for q in state.queries if q is not query]
        if state.selected is query:
            select(viewer, state.queries[-1] if state.queries else None)
        let_go(viewer)


def remove_all(viewer: Viewer) -> None:
    """Take all queries off the list; one undo brings them back."""
    state = viewer.state
    if state.queries:
        remember(viewer)
        state.queries = []
        select(viewer, None)
        let_go(viewer)


def set_level(viewer: Viewer, level: LevelChoice) -> None:
    """Choose the semantic level of all queries, or leave it to the score ("auto")."""
    if level == viewer.state.level:
        return
    remember(viewer)
    viewer.state.level = level
    ask_again(viewer)


# What an answer stands on.


def explain(viewer: Viewer, query: Query) -> None:
    """Have the worker draw the evidence of an answer, and show it."""
    engine, state, result = viewer.engine, viewer.state, query.result
    if engine is None or result is None or state.path is None:
        return
    path, scene = state.path, engine.scene

    def work(progress: Progress) -> Array:
        features = kept_features(path, scene)
        photographs = kept_photographs(path, scene, progress=progress)
        rasterizer = load_rasterizer("cpu")
        found = find_evidence(engine, result, query.asked_for, features, rasterizer, progress)
        if found is None:
            raise InputError(f"'{query.phrase}': nothing in the scene answers")
        return draw_evidence(found, result, scene, features, photographs, rasterizer)

    def done(image: Array) -> None:
        if query in state.queries:
            state.evidence = EvidenceSheet(query.phrase, image)

    viewer.run(f"looking for the evidence of '{query.phrase}'", work, done)


# How queries are asked and where they end: own cuts, canonical phrases, whole sets of queries.


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


def set_canonical(viewer: Viewer, text: str) -> None:
    """Compare everything with other canonical phrases, between commas; "" for the scene's own again."""
    phrases = tuple(split_phrases(text))
    engine, state = viewer.engine, viewer.state
    if engine is None or not state.has_field:
        viewer.say_error("open a scene with a language field first")
        return

    def work(progress: Progress) -> tuple[str, ...]:
        engine.compare_with(phrases, progress)
        return engine.canonical_phrases

    def done(canonical: tuple[str, ...]) -> None:
        state.canonical, state.canonical_typed = phrases, ", ".join(canonical)
        state.say(f"compared with {', '.join(canonical)}")
        ask_again(viewer)

    viewer.run("encoding canonical phrases", work, done)


def listed_queries(state: ViewerState) -> QuerySet:
    """The list as it is saved."""
    saved = tuple(SavedQuery(query.phrase, query.cut, query.slot is not None) for query in state.queries)
    return QuerySet(saved, state.level, state.canonical)


def save_queries(viewer: Viewer, folder: Path = Path()) -> Path | None:
    """Save the list to a new file in `folder`; returns its path, None if there is none or that failed."""
    state = viewer.state
    if not state.queries:
        viewer.say_error("search for something first, then save the queries")
        return None
    path = free_name(folder, state.path.stem if state.path else "scene", QUERIES)
    more = "; open it, or drop it onto the window, to ask them again"
    return viewer.save(path, lambda: write_queries(path, listed_queries(state)), more)


def load_queries(viewer: Viewer, path: Path) -> None:
    """Ask all queries of a file, after those that are listed already."""
    state = viewer.state
    try:
        wanted = read_queries(path)
    except InputError as error:
        viewer.say_error(one_line(error))
        return
    if not state.has_field:
        viewer.say_error(f"{path.name}: open a scene that can be searched first")
        return
    if wanted.canonical != state.canonical:
        set_canonical(viewer, ", ".join(wanted.canonical))
    set_level(viewer, wanted.level)
    for query in wanted.queries:
        ask_one(viewer, query.phrase, cut=query.cut, then_show=query.shown)


# What is offered to a searcher: examples of the scene, completions, corrections, earlier phrases.


def prepare_suggestions(viewer: Viewer) -> None:
    """Have the worker find examples, once per scene, when it has nothing else to do."""
    state, engine = viewer.state, viewer.engine
    if state.scene is state.suggestions_of or viewer.worker.current is not None:
        return
    state.suggestions, state.suggestions_of = Suggestions(), state.scene
    scene = state.scene
    if engine is None or scene is None or not state.has_field:
        return
    asked = engine if viewer.has_encoder_here else QueryEngine(scene)  # the phrasebook alone

    def work(progress: Progress) -> Suggestions:
        return suggest(asked, progress=progress)

    def done(found: Suggestions) -> None:
        if viewer.state.scene is scene:
            viewer.state.suggestions = found

    viewer.run("finding examples", work, done, lambda reason: None)


def offers(viewer: Viewer) -> tuple[str, tuple[str, ...]]:
    """Return a title and the phrases to offer now: those that go on from what is typed, else a correction of
    the last query, else, before the first query, examples."""
    state = viewer.state
    if state.typed.strip():
        return "", tuple(completions(state.typed, state.suggestions.phrases))
    last = state.queries[-1] if state.queries else None
    if last is None:
        return "try", state.suggestions.examples
    return "did you mean", (last.meant,) if last.meant else ()


def completion(viewer: Viewer) -> str:
    """The phrase that goes on from what is typed, "" for none."""
    phrases = offers(viewer)[1] if viewer.state.typed.strip() else ()
    return phrases[0] if phrases else ""


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
