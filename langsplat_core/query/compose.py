"""Answers to phrases with structure: each phrase in the tree is asked for itself at its fitting level, and
the answers are combined among the Gaussians (`query.combine`)."""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.combine import (
    cut_inside,
    grown,
    joined,
    owners,
    placed,
    restricted,
    surest,
    without,
)
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import parse
from langsplat_core.query.phrase_tree import (
    Atom,
    Both,
    Inside,
    Relation,
    Superlative,
    Tree,
    Union,
    Without,
    atoms,
    children,
    reading,
)
from langsplat_core.query.standing import Body, body, most, separate, stands, upright, viewer
from langsplat_core.query.vocabulary import named
from langsplat_core.scene import Camera
from langsplat_core.scene.phrases import phrase_key, tidy
from langsplat_core.semantics.relevancy import FLOOR

SAME = 0.5  # of a thing's Gaussians: what shares so many with another is the same, and not related to it
SAID_BY_VIEWER = ("left of", "right of", "behind", "in front of", "leftmost", "rightmost")


@dataclass(frozen=True, eq=False)
class ComposedResult:
    """The answer to a phrase and how the phrase was understood."""

    answer: QueryResult  # in the form of a simple one
    tree: Tree
    parts: tuple[QueryResult, ...]  # what was asked, phrase by phrase

    @property
    def reading(self) -> str:
        """Such as "handle  inside  red mug"."""
        return reading(self.tree)


def run_phrase(
    engine: QueryEngine,
    text: str,
    level: LevelChoice = "auto",
    viewpoint: Camera | None = None,
    progress: Progress = silent,
) -> ComposedResult:
    """Answer a phrase as the grammar reads it; whole, as `QueryEngine.run` does, where it finds no structure,
    or where only the whole phrase can be asked (of a phrasebook).

    level: of what is asked for; the things that it is related to keep their own. viewpoint: from where "left
    of", "right of", "behind", "in front of", "leftmost" and "rightmost" are said, and "nearest" and
    "farthest" where they are of nothing else.

    Raises InputError as `grammar.parse` does and where a viewpoint is needed, EncoderError as
    `QueryEngine.run`.
    """
    tree = parse(text)
    if not isinstance(tree, Atom):
        _check_viewpoint(tree, viewpoint)
        asking = _Asking(engine, viewpoint, progress)
        try:
            found = asking.answer(tree, level)
        except EncoderError:
            if phrase_key(text) not in engine.field.phrasebook:
                raise
            tree = Atom(tidy(text))
        else:
            answer = replace(found, phrase=tidy(text))
            return ComposedResult(placed(engine.surface, answer), tree, tuple(asking.asked.values()))
    answer = engine.run(tree.text, level, progress)
    return ComposedResult(answer, tree, (answer,))


def check_phrase(
    engine: QueryEngine, text: str, viewpoint: Camera | None = None, progress: Progress = silent
) -> None:
    """Raise what `run_phrase` would, without searching: for a phrase that names nothing, unknown words, an
    encoder that cannot be loaded, a viewpoint that is needed. What was encoded for it is kept."""
    tree = parse(text)
    if not isinstance(tree, Atom):
        _check_viewpoint(tree, viewpoint)
    try:
        engine.text_vectors([atom.text for atom in atoms(tree)], progress)
    except EncoderError:
        if phrase_key(text) not in engine.field.phrasebook:
            raise


def _check_viewpoint(tree: Tree, viewpoint: Camera | None) -> None:
    """InputError for the first word in the tree that only a viewer can say, if there is none."""
    match tree:
        case Relation(kind) | Superlative(kind):
            free = isinstance(tree, Superlative) and kind in ("nearest", "farthest") and tree.anchor is None
            if viewpoint is None and (free or kind in SAID_BY_VIEWER):
                raise InputError(
                    f"'{kind}' depends on where one looks from; give a camera, or say it otherwise"
                )
    for child in children(tree):
        _check_viewpoint(child, viewpoint)


class _Asking:
    """The phrases of one tree, each asked once."""

    def __init__(self, engine: QueryEngine, viewpoint: Camera | None, progress: Progress) -> None:
        self.engine, self._progress = engine, progress
        self.surface = engine.surface
        self.asked: dict[tuple[str, LevelChoice], QueryResult] = {}
        self._frame = upright(engine.scene.up())
        self._viewer = None if viewpoint is None else viewer(viewpoint, self._frame)

    def answer(self, tree: Tree, level: LevelChoice = "auto") -> QueryResult:
        """What a tree means; without a place, which only the last answer needs."""
        match tree:
            case Atom(text):
                return self._thing(text, level)
            case Both(items):
                return joined([self.answer(item, level) for item in items], all_needed=True)
            case Union(items):
                return joined([self.answer(item, level) for item in items], all_needed=False)
            case Without(what, unwanted):
                excluded = self.answer(unwanted)
                if isinstance(unwanted, Atom):
                    excluded = surest(self.engine, excluded)
                return without(self.answer(what, level), excluded)
            case Inside(part, whole):
                return self._inside(part, whole, level)
            case Relation() | Superlative():
                return self._chosen(tree, level)

    def _ask(self, text: str, level: LevelChoice) -> QueryResult:
        key = (phrase_key(text), level)
        if key not in self.asked:
            self.asked[key] = self.engine.run(text, level, self._progress)
        return self.asked[key]

    def _thing(self, text: str, level: LevelChoice) -> QueryResult:
        """A thing is looked for among wholes, unless it is a part, or fits none of them."""
        if level != "auto" or named(text) != "thing":
            return self._ask(text, level)
        whole = self._ask(text, "whole")
        return whole if whole.peak >= FLOOR else self._ask(text, "auto")

    def _inside(self, part: Tree, whole: Tree, level: LevelChoice) -> QueryResult:
        thing = self.answer(whole)
        there = grown(self.surface, thing.members)
        if not isinstance(part, Atom):
            found = self.answer(part, level)
            return restricted(found, found.members & there, thing)
        asked = [self._ask(part.text, level)]
        if isinstance(whole, Atom):
            asked += self._if_known(f"{whole.text} {part.text}", level)
        return cut_inside(self.engine, asked, thing, there, level)

    def _if_known(self, text: str, level: LevelChoice) -> list[QueryResult]:
        try:
            return [self._ask(text, level)]
        except EncoderError:
            return []

    def _chosen(self, tree: Relation | Superlative, level: LevelChoice) -> QueryResult:
        what = self.answer(tree.what, level)
        anchor = None if tree.anchor is None else self.answer(tree.anchor)
        things, anchors = self._bodies(what), [] if anchor is None else self._bodies(anchor)
        if isinstance(tree, Superlative):
            every = [thing for _, thing in things]
            others = [other for _, other in anchors]
            right = {most(tree.kind, every, others, self._viewer)} if every else set()
        else:
            right = {
                row
                for row, (mine, thing) in enumerate(things)
                if any(
                    stands(tree.kind, thing, other, self._viewer)
                    for theirs, other in anchors
                    if np.isin(mine, theirs).mean() < SAME
                )
            }
        labels = owners(self.surface, len(what.members), [numbers for numbers, _ in things])
        return restricted(what, np.isin(labels, list(right)), anchor or what)

    def _bodies(self, answer: QueryResult) -> list[tuple[Array, Body]]:
        """Every single thing of an answer, as surface numbers and as the place it takes."""
        inside = answer.members[self.surface.rows]
        parts = separate(self.surface, inside, self.engine.field.things)
        return [(numbers, body(self.surface.positions[numbers], self._frame)) for numbers in parts]
