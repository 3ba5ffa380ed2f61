"""Searching: the box, the list of queries, their colours, thresholds and level."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.errors import InputError, UnknownWordError
from langsplat_core.pipeline.evidence import draw_evidence, find_evidence, kept_features, kept_photographs
from langsplat_core.progress import Progress
from langsplat_core.query.answers import QueryResult, place_of
from langsplat_core.query.compose import ComposedResult, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import Atom, heads
from langsplat_core.query.instances import Instance
from langsplat_core.query.inventory import Suggestions, completions, composed_examples, corrected, suggest
from langsplat_core.query.rule import Verdict
from langsplat_core.scene import Scene, TaughtWord
from langsplat_core.scene.language import phrase_key, split_phrases
from langsplat_viewer.actions.settings import open_panel
from langsplat_viewer.session import Query, Things, pack
from langsplat_viewer.state import QueryAnswer
from langsplat_viewer.viewer import Viewer

MOST_THINGS = 20  # instances of one answer
SIMPLE = 3  # examples without structure


def ask(viewer: Viewer, text: str) -> None:
    """Search the scene for a phrase, or for several between commas, and show where each is true."""
    phrases = split_phrases(text)
    ask_together(viewer, phrases)
    if text.strip() and not phrases:
        viewer.say_error(f"'{text.strip()[:40]}' has no word to look for")


def ask_together(viewer: Viewer, phrases: Sequence[str]) -> None:
    """Search the scene for phrases, and give a colour to each that may be there."""
    if not phrases or viewer.searchable() is None:
        return
    state = viewer.state
    listed: list[str] = []
    for phrase in phrases:
        viewer.remember()
        queries, key = state.session.queries, phrase_key(phrase)
        query = next((query for query in queries if phrase_key(query.phrase) == key), Query(phrase))
        others = (other for other in queries if other is not query)
        viewer.put(queries=(*others, replace(query, cut=None)), chosen=query.phrase)  # in the order of asking
        state.asked = [*(earlier for earlier in state.asked if phrase_key(earlier) != key), phrase]
        state.recalled = len(state.asked)
        listed.append(query.phrase)
    for phrase in listed:
        answer(viewer, phrase, shown_with=listed)


def answer(viewer: Viewer, phrase: str, shown_with: Sequence[str] = (), *, alike: bool = False) -> None:
    """Have the worker answer a query of the list; it takes a colour unless the answer is "not here".

    shown_with: the phrases that were asked together, it too; without, what is shown stays. alike: a name
    finds all that is like what it was given to. Its instances come later: the surface that they are told
    apart on takes seconds where there are a million Gaussians.
    """
    state, engine, seen = viewer.state, viewer.engine, viewer.state.open
    if engine is None or seen is None:
        return
    viewpoint, level = seen.view.camera(*state.size), state.session.level
    members = None if alike else state.session.things.named(phrase)

    def work(progress: Progress) -> QueryAnswer:
        try:
            composed = run_phrase(engine, phrase, level, viewpoint, progress)
        except UnknownWordError as error:
            return QueryAnswer(problem=str(error), meant=corrected(phrase, error.near) or "")
        return _answer_of(composed, members, _can_explain(seen.path, engine.scene))

    def done(found: QueryAnswer) -> None:
        if phrase not in state.answers:  # the query was taken off meanwhile
            return
        state.answers[phrase] = found
        if shown_with:
            painted = found.result is not None and found.result.verdict != "not here"
            state.session = state.session.answering(phrase, painted, shown_with)
        if found.result is None and shown_with:  # else it is known: the list is asked again
            viewer.say_error(found.problem)
        elif found.result is not None and found.result.found:
            _tell_apart(viewer, engine, phrase, found.result)

    state.answers[phrase] = replace(state.answers.get(phrase, QueryAnswer()), pending=True)
    viewer.run(f"searching '{phrase}'", work, done, lambda reason: done(QueryAnswer(problem=reason)))


def _can_explain(path: Path, scene: Scene) -> bool:
    """Return whether masks of all photographs of a scene are beside it."""
    try:
        kept_features(path, scene)
    except InputError:
        return False
    return True


def _answer_of(composed: ComposedResult, members: Array | None, has_evidence: bool) -> QueryAnswer:
    """Return the answer with all that is shown of it; members: (N,) bool that were given it as a name."""
    # A copy has its arrays: they are made here, and not by the thread that draws.
    found = like = replace(composed.answer)
    if members is not None:  # the answer is the thing that was given the name
        place, box = place_of(like.points[members])
        judgement = Verdict(True, like.judgement.reached, max(like.judgement.margin, 0.0))
        found = replace(like, members=members, place=place, box=box, judgement=judgement)
    if found.verdict != "not here":
        _ = found.smooth  # kept with it, for the first image that shows it
    return QueryAnswer(
        found,
        reading="" if isinstance(composed.tree, Atom) else composed.reading,
        asked_for=heads(composed.tree),
        has_evidence=has_evidence,
        like=like if members is not None and (like.members & ~members).any() else None,
    )


def _tell_apart(viewer: Viewer, engine: QueryEngine, phrase: str, result: QueryResult) -> None:
    answers = viewer.state.answers

    def done(things: tuple[Instance, ...]) -> None:
        if phrase in answers and answers[phrase].result is result:
            answers[phrase] = replace(answers[phrase], things=things)

    viewer.run("telling instances apart", lambda progress: engine.instances(result, MOST_THINGS), done)


def ask_listed(viewer: Viewer, anew: bool = True) -> None:
    """Answer the queries of the list: all of them if `anew`, else those that were not asked yet."""
    for query in viewer.state.session.queries:
        if anew or query.phrase not in viewer.state.answers:
            answer(viewer, query.phrase)


def forget_unlisted(viewer: Viewer) -> None:
    """Drop the answers to queries that left the list: they hold numbers for every Gaussian."""
    state = viewer.state
    listed = {query.phrase for query in state.session.queries}
    state.answers = {phrase: known for phrase, known in state.answers.items() if phrase in listed}


def focus_search(viewer: Viewer) -> None:
    """Give the keyboard to the search box; report where there is nothing to search.

    In that case letters are no commands until a click or Esc.
    """
    state, can_search = viewer.state, viewer.searchable() is not None
    if state.open is not None:
        open_panel(viewer, "Search")
    state.focus_input = state.awaits_keyboard = can_search
    state.letters_muted = not can_search


# Taught names.


def teach(viewer: Viewer, name: str, members: Array, node: int | None = None) -> None:
    """Have the worker teach a name by the features of `members` (N,) bool, and search for it.

    It finds just these. Files that are saved from now on hold the name. node: of the tree, if they are one.
    """

    def taught(word: TaughtWord) -> None:
        things, bits = viewer.state.session.things, pack(members)
        assert bits is not None  # else there was nothing to teach by
        given = {other: those for other, those in things.given.items() if phrase_key(other) != word.key}
        names = things.names if node is None else {**things.names, node: word.name}
        viewer.change(things=Things(names, {**given, word.name: bits}))
        viewer.state.say(f"taught '{word.name}'; to keep it, save the project or the scene")
        ask_together(viewer, [word.name])

    viewer.ask_engine(f"teaching '{name}'", lambda engine, _: engine.teach(name, members), taught)


def teach_given(viewer: Viewer) -> None:
    """Have the worker teach the session's names that the scene's file lacks."""
    given, engine = viewer.state.session.things.given, viewer.engine

    def work(engine: QueryEngine, progress: Progress) -> None:
        for name, bits in given.items():
            if not engine.is_taught(name):
                engine.teach(name, bits.mask)

    if engine is not None and not all(map(engine.is_taught, given)):
        viewer.ask_engine("teaching names", work, lambda nothing: None)


# The list of queries.


def show(viewer: Viewer, phrase: str, shown: bool = True) -> None:
    """Show the heat of a query, in the first free colour, else that of the longest shown; or hide it."""
    session = viewer.state.session
    session = session.showing(phrase) if shown else session.with_query(phrase, slot=None)
    viewer.change(queries=session.queries)


def remove(viewer: Viewer, phrase: str) -> None:
    """Take a query off the list; if it was chosen, the latest one becomes chosen."""
    left = viewer.state.session.without({phrase})
    viewer.change(queries=left.queries, chosen=left.chosen)
    forget_unlisted(viewer)


def remove_all(viewer: Viewer) -> None:
    """Take all queries off the list; one undo brings them back."""
    if not viewer.state.session.queries:
        viewer.state.say("no queries are listed")
        return
    viewer.change(queries=(), chosen="")
    forget_unlisted(viewer)
    viewer.state.say("removed all queries", undoes=viewer.history.past[-1])


def set_level(viewer: Viewer, level: LevelChoice) -> None:
    """Choose the semantic level of all queries, or leave it to the score ("auto")."""
    if level != viewer.state.session.level:
        viewer.change(level=level)
        ask_listed(viewer)


def set_cut(viewer: Viewer, phrase: str, cut: float | None) -> None:
    """Set the threshold of an answer, None for its own one."""
    session, cut = viewer.state.session, None if cut is None else min(max(cut, 0.0), 1.0)
    query = session.query(phrase)
    if query is not None and viewer.state.answer(query).result is not None:
        viewer.change(f"threshold of {phrase}", queries=session.with_query(phrase, cut=cut).queries)


# Evidence of an answer.


def explain(viewer: Viewer, query: Query) -> None:
    """Have the worker draw the evidence of an answer, and show it."""
    engine, state, result = viewer.engine, viewer.state, viewer.state.result(query)
    if engine is None or result is None or state.open is None:
        return
    path, scene, asked_for = state.open.path, engine.scene, state.answer(query).asked_for

    def work(progress: Progress) -> Array:
        features = kept_features(path, scene)
        photographs = kept_photographs(path, scene, progress=progress)
        found = find_evidence(engine, result, asked_for, features, progress)
        if found is None:
            raise InputError(f"'{query.phrase}': nothing in the scene answers")
        return draw_evidence(found, result, scene, features, photographs)

    def done(image: Array) -> None:
        if query.phrase in state.answers:
            state.evidence = query.phrase, image

    viewer.run(f"looking for the evidence of '{query.phrase}'", work, done)


# Suggestions: examples of the scene, completions, corrections, earlier phrases.


def prepare_suggestions(viewer: Viewer) -> None:
    """Have the worker find examples, once per scene, when it has nothing else to do."""
    state, engine = viewer.state, viewer.engine
    if engine is state.suggestions_of or viewer.worker.current is not None:
        return
    state.suggestions, state.suggestions_of = Suggestions(), engine
    if not state.has_field:
        return
    here = viewer.has_encoder_here

    def work(engine: QueryEngine, progress: Progress) -> Suggestions:
        asked = engine if here else QueryEngine(engine.scene)  # by the phrasebook
        found = suggest(asked, progress=progress)
        if asked.basis.guesses:  # colours, of which nothing is a part
            return found
        return replace(found, examples=(*found.examples[:SIMPLE], *composed_examples(asked, found)))

    viewer.ask_engine("finding examples", work, partial(setattr, state, "suggestions"), lambda reason: None)


def offers(viewer: Viewer, typed: str) -> tuple[str, tuple[str, ...]]:
    """Return a title and the phrases to offer now.

    They complete what is typed; else they correct the last query, or are examples.
    """
    state, queries = viewer.state, viewer.state.session.queries
    if typed.strip():
        return "", tuple(completions(typed, state.suggestions.phrases))
    meant = state.answer(queries[-1]).meant if queries else ""
    return ("did you mean", (meant,)) if meant else ("", state.suggestions.examples)


def offered(viewer: Viewer, typed: str, is_pointed_at: bool) -> tuple[str, tuple[str, ...]]:
    """Return `offers`; those of the last call where they are pointed at and nothing else was typed since."""
    state = viewer.state
    before, shown = state.offered
    if not (is_pointed_at and shown[1] and before == typed):
        shown = offers(viewer, typed)
    state.offered = typed, shown
    return shown


def ask_offered(viewer: Viewer, phrase: str) -> None:
    """Search for what was offered; a query that it corrects leaves the list."""
    state = viewer.state
    for query in [query for query in state.session.queries if state.answer(query).meant == phrase]:
        remove(viewer, query.phrase)
    ask(viewer, phrase)


def recall(viewer: Viewer, step: int) -> str:
    """Return the phrase `step` places after the last recalled, -1 for the one before; "" behind the last."""
    state = viewer.state
    state.recalled = min(max(state.recalled + step, 0), len(state.asked))
    return state.asked[state.recalled] if state.recalled < len(state.asked) else ""
