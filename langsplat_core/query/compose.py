"""Answers to phrases with structure: each phrase in the tree is asked for itself at its fitting level, and the
answers are combined among Gaussians.

A combined answer has the form of a simple one. Its relevancy is zero wherever it does not hold, the same at
every level for what has parts of several; its peak is that of its weakest necessary part.
"""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import QueryEngine, QueryResult
from langsplat_core.query.grammar import parse
from langsplat_core.query.instances import Extent, extent, most, separate, stands, upright, viewer
from langsplat_core.query.phrase_tree import (
    Atom,
    Both,
    Inside,
    Relation,
    Superlative,
    Tree,
    Union,
    Without,
    children,
    reading,
)
from langsplat_core.query.places import locate
from langsplat_core.query.surface import Surface
from langsplat_core.query.vocabulary import is_part
from langsplat_core.scene import LEVELS, Camera
from langsplat_core.scene.phrases import phrase_key, tidy
from langsplat_core.semantics.relevancy import FLOOR

WHOLE = LEVELS.index("whole")
SHARE = 0.6  # of the way from what is typical of a thing's least fitting surface to the part's peak on it
LEAST = 0.05  # quantile of a part's relevancy on its thing that stands for "not this part"
SPAN = 0.02  # of relevancy: the least distance that is divided
SAME = 0.5  # of a thing's Gaussians: what shares so many with another is the same, and not related to it
HALF = 0.5  # of the peak: what is less is no longer the place
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

    level: of what is asked for; the things that it is related to keep their own. viewpoint: who says "left of",
    "right of", "behind", "in front of", "leftmost", "rightmost" and, of nothing, "nearest" and "farthest".

    Raises InputError as `grammar.parse` does and where a viewpoint is needed, EncoderError as `QueryEngine.run`.
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
            return ComposedResult(_placed(engine.surface, answer), tree, tuple(asking.asked.values()))
    answer = engine.run(tree.text, level, progress)
    return ComposedResult(answer, tree, (answer,))


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
                return _joined([self.answer(item, level) for item in items], all_needed=True)
            case Union(items):
                return _joined([self.answer(item, level) for item in items], all_needed=False)
            case Without(what, unwanted):
                return _without(self.answer(what, level), self.answer(unwanted), isinstance(unwanted, Atom))
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
        if level != "auto" or is_part(text.split()[-1]):
            return self._ask(text, level)
        whole = self._ask(text, "whole")
        return whole if whole.peak >= FLOOR else self._ask(text, "auto")

    def _inside(self, part: Tree, whole: Tree, level: LevelChoice) -> QueryResult:
        thing = self.answer(whole)
        there = grown(self.surface, thing.members)
        if not isinstance(part, Atom):
            found = self.answer(part, level)
            return _restricted(found, found.members & there, thing)
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
        things, anchors = self._extents(what), [] if anchor is None else self._extents(anchor)
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
        labels = nearest_thing(self.surface, what.members, [numbers for numbers, _ in things])
        return _restricted(what, np.isin(labels, list(right)), anchor or what)

    def _extents(self, answer: QueryResult) -> list[tuple[Array, Extent]]:
        """Every single thing of an answer, as surface numbers and as the place it takes."""
        parts = separate(self.surface, answer.members[self.surface.rows])
        return [(numbers, extent(self.surface.positions[numbers], self._frame)) for numbers in parts]


def grown(surface: Surface, members: Array) -> Array:
    """(N,) bool, and what is next to it on the surface."""
    inside = members[surface.rows].astype(np.float32)
    result = members.copy()
    result[surface.rows[surface.links.astype(np.float32) @ inside > 0]] = True
    return result


def nearest_thing(surface: Surface, members: Array, things: list[Array]) -> Array:
    """(N,) number of the thing (of `things`, as surface numbers) that is nearest to each member; -1 for what
    is no member, and for all where there is no thing."""
    labels = np.full(len(members), -1)
    if things:
        numbers = np.concatenate(things)
        owner = np.repeat(np.arange(len(things)), [len(thing) for thing in things])
        labels[surface.rows[numbers]] = owner
    return labels


def cut_inside(
    engine: QueryEngine, asked: list[QueryResult], thing: QueryResult, there: Array, level: LevelChoice
) -> QueryResult:
    """What `asked` says of a part, cut anew among the Gaussians of its thing. there: (N,) bool."""
    surface, known = engine.surface, engine.field.known
    relevancy = np.mean([result.relevancy for result in asked], axis=0, dtype=np.float32)
    relevancy = np.where(there, relevancy, 0)
    numbers = np.flatnonzero(there[surface.rows])
    peaks = [peak_among(surface, values, numbers) for values in relevancy]
    own = int(np.argmax(peaks[:WHOLE])) if max(peaks[:WHOLE]) > 0 else WHOLE
    chosen = own if level == "auto" else LEVELS.index(level)
    peak, inside = peaks[chosen], there & known[chosen]
    own_surface = thing.members & known[chosen]  # without what it touches, which may be anything
    low = float(np.quantile(relevancy[chosen][own_surface], LEAST)) if own_surface.any() else peak
    members = inside & (relevancy[chosen] > low + SHARE * max(peak - low, SPAN))
    fits = peak_among(surface, asked[0].relevancy[chosen], numbers) >= engine.field.reading.found
    return replace(
        asked[0],
        level=chosen,
        scores=(peaks[0], peaks[1], peaks[2]),
        relevancy=relevancy,
        peak=peak,
        found=bool(members.any() and thing.found and fits),
        members=members,
    )


def peak_among(surface: Surface, values: Array, numbers: Array) -> float:
    """The highest of the means over neighbourhoods of some of the surface, see `Surface.smooth`; 0 for none."""
    if len(numbers) == 0:
        return 0.0
    near = surface.neighbours[numbers]
    weights = surface.weights[near]
    return float(((weights * values[surface.rows[near]]).sum(1) / weights.sum(1)).max())


def picture_cut(answer: QueryResult) -> float:
    """The relevancy at `answer.level` above which a picture shows the answer: half way between its members and
    what is none, so that at an edge more than half of a pixel is of members."""
    values = answer.relevancy[answer.level]
    if not answer.members.any():
        return 1.0
    least = float(values[answer.members].min())
    below = values[~answer.members & (values < least)]
    return (least + float(below.max(initial=0))) / 2


def _joined(answers: list[QueryResult], all_needed: bool) -> QueryResult:
    """The union of answers, found if all are, or any is; what is not found of alternatives does not count."""
    counting = answers if all_needed else [answer for answer in answers if answer.found] or answers
    score = min if all_needed else max
    values = np.max([np.where(a.members, a.relevancy[a.level], 0) for a in counting], axis=0)
    peak = score(answer.peak for answer in counting)
    return replace(
        counting[0],
        scores=(peak, peak, peak),
        relevancy=np.tile(values.astype(np.float32), (len(LEVELS), 1)),
        peak=peak,
        found=(all if all_needed else any)(answer.found for answer in answers),
        members=np.any([answer.members for answer in counting], axis=0),
    )


def _without(what: QueryResult, unwanted: QueryResult, rivals: bool) -> QueryResult:
    """`what` but for `unwanted`, if that is there. rivals: two names of whole things, of which the better one
    counts: a green mug resembles "red mug", and "mug" more."""
    if not unwanted.found:
        return what
    taken = unwanted.members
    if rivals and what.level == unwanted.level:
        taken = taken & (unwanted.relevancy[unwanted.level] >= what.relevancy[what.level])
    return _restricted(what, ~taken, what)


def _restricted(answer: QueryResult, keep: Array, needed: QueryResult) -> QueryResult:
    """`answer` where `keep` (N,) holds alone; nothing is found without `needed`."""
    members = answer.members & keep
    return replace(
        answer,
        relevancy=np.where(members, answer.relevancy, 0),
        peak=answer.peak if members.any() else 0.0,
        found=bool(members.any() and answer.found and needed.found),
        members=members,
    )


def _placed(surface: Surface, answer: QueryResult) -> QueryResult:
    """`answer` with the place of its strongest connected members."""
    values = np.where(answer.members, answer.relevancy[answer.level], 0)
    smoothed = surface.smooth(np.tile(values.astype(np.float32), (len(LEVELS), 1)))[0]
    place = locate(surface, smoothed, HALF * float(smoothed.max(initial=0)))
    found = (None, None) if place is None else (place.position, place.box)
    return replace(answer, place=found[0], box=found[1])
