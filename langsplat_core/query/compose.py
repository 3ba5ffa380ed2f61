"""Phrases with structure: each phrase of the tree is asked for itself, and the answers are combined.

The relevancy of a combined answer is zero wherever it does not hold, and the same at every level where it has
parts of several; its peak is that of its weakest necessary part.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult, locate, place_of
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import (
    ADJECTIVES,
    Atom,
    Both,
    Counted,
    Inside,
    Phrase,
    Relation,
    Superlative,
    Union,
    Without,
    atoms,
    children,
    named,
    parse,
    unparse,
)
from langsplat_core.query.relations import Body, body, ranked, separate, stands, upright, viewpoint
from langsplat_core.query.rule import RULE, Verdict, combined
from langsplat_core.scene import LEVELS, Camera
from langsplat_core.scene.language import phrase_key, tidy
from langsplat_core.semantics.relevancy import FLOOR

# Of the peak, where the place ends; of a thing's Gaussians, which two things share that are the same; of the
# way below its best region, to which an unwanted name reaches.
HALF = 0.5
SAID_BY_VIEWER = ("left of", "right of", "behind", "in front of", "leftmost", "rightmost")


@dataclass(frozen=True, eq=False)
class ComposedResult:
    """The answer to a phrase, and the tree as which it was read."""

    answer: QueryResult  # in the form of a simple one
    tree: Phrase

    @property
    def reading(self) -> str:
        """The tree as text, such as "handle  inside  red mug"."""
        return unparse(self.tree)


def run_phrase(
    engine: QueryEngine,
    text: str,
    level: LevelChoice = "auto",
    viewpoint: Camera | None = None,
    progress: Progress = silent,
) -> ComposedResult:
    """Answer a phrase as the grammar reads it.

    It is asked whole, as `QueryEngine.run` does, where the grammar finds no structure, and where only the
    whole phrase can be asked (of a phrasebook). level: of what is asked for; the things that it is related to
    keep their own. viewpoint: from where left, right, behind and in front are said, and "nearest" and
    "farthest" where they are of nothing else. Raises InputError as `grammar.parse` does and where a viewpoint
    is needed, EncoderError as `QueryEngine.run`.
    """
    tree = parse(text, engine.taught)
    if isinstance(tree, Atom):
        return ComposedResult(engine.run(tree.text, level, progress), tree)
    _check_viewpoint(tree, viewpoint)
    try:
        found = _Asking(engine, viewpoint, progress).answer(tree, level)
    except EncoderError:
        if phrase_key(text) not in engine.field.phrasebook:
            raise
        return ComposedResult(engine.run(text, level, progress), Atom(tidy(text)))
    # The place is that of the strongest connected members.
    values = np.where(found.members, found.relevancy[found.level], 0).astype(np.float32)
    smoothed = engine.surface.smooth(values)
    place, box = locate(engine.surface, smoothed, HALF * float(smoothed.max(initial=0)))
    return ComposedResult(replace(found, phrase=tidy(text), place=place, box=box), tree)


def encoded_texts(engine: QueryEngine, tree: Phrase) -> list[str]:
    """Return what of a phrase is encoded: its atoms, but for taught words."""
    return [atom.text for atom in atoms(tree) if not engine.is_taught(atom.text)]


def check_phrase(
    engine: QueryEngine, text: str, viewpoint: Camera | None = None, progress: Progress = silent
) -> None:
    """Raise what `run_phrase` would, without searching; what was encoded for it is kept."""
    tree = parse(text, engine.taught)
    _check_viewpoint(tree, viewpoint)
    try:
        engine.text_vectors(encoded_texts(engine, tree), progress)
    except EncoderError:
        if phrase_key(text) not in engine.field.phrasebook:
            raise


def encode_phrases(engine: QueryEngine, texts: Sequence[str]) -> None:
    """Encode many phrases together, as far as they can be; `check_phrase` says of the others why not."""
    wanted: list[str] = []
    for text in texts:
        with suppress(InputError):
            wanted += encoded_texts(engine, parse(text, engine.taught))
    with suppress(EncoderError, InputError):
        engine.known_vectors(wanted)


def _check_viewpoint(tree: Phrase, viewpoint: Camera | None) -> None:
    """Raise InputError for the first word in the tree that only a viewer can say, if there is none."""
    if viewpoint is None and isinstance(tree, Relation | Superlative):
        free = isinstance(tree, Superlative) and tree.kind in ("nearest", "farthest") and tree.anchor is None
        if free or tree.kind in SAID_BY_VIEWER:
            raise InputError(f"'{tree.kind}' depends on where one stands; give a camera, or say it otherwise")
    for child in children(tree):
        _check_viewpoint(child, viewpoint)


class _Asking:
    """The phrases of one tree, each asked once."""

    def __init__(self, engine: QueryEngine, camera: Camera | None, progress: Progress) -> None:
        self.engine, self._progress = engine, progress
        self._asked: dict[tuple[str, LevelChoice], QueryResult] = {}
        self._frame = upright(engine.scene.up())
        self._viewpoint = None if camera is None else viewpoint(camera, self._frame)

    def answer(self, tree: Phrase, level: LevelChoice = "auto", count: int = 1) -> QueryResult:
        """Return the answer to a tree, of a superlative the `count` that are most so; without a place."""
        match tree:
            case Atom(text):
                return self._thing(text, level)
            case Both(items) | Union(items):
                return joined([self.answer(item, level) for item in items], isinstance(tree, Both))
            case Without(what, unwanted):
                excluded, wanted = self.answer(unwanted), self.answer(what, level)
                members = excluded.members
                if isinstance(unwanted, Atom):
                    # A green mug may be in the answer to "red mug", for want of a better one; it is not what
                    # "not red mug" means.
                    members = members & within_reach(self.engine, excluded, HALF)[0]
                return restricted(wanted, ~members, wanted) if excluded.found else wanted
            case Inside(part, whole):
                return self._inside(part, whole, level)
            case Counted(count, what):
                every = self.answer(what, level, count)
                enough = every.found and count_things(self.engine, every).most >= count
                return replace(every, judgement=replace(every.judgement, found=enough))
            case Relation() | Superlative():
                return self._chosen(tree, level, count)

    def _ask(self, text: str, level: LevelChoice) -> QueryResult:
        key = (phrase_key(text), level)
        if key not in self._asked:
            self._asked[key] = self.engine.run(text, level, self._progress)
        return self._asked[key]

    def _thing(self, text: str, level: LevelChoice) -> QueryResult:
        """Return the answer to a phrase; a thing is looked for among wholes, unless it fits none."""
        if level != "auto" or named(text) != "thing" or self.engine.is_taught(text):
            return self._ask(text, level)
        whole = self._ask(text, "whole")
        return whole if whole.peak >= FLOOR else self._ask(text, "auto")

    def _inside(self, part: Phrase, whole: Phrase, level: LevelChoice) -> QueryResult:
        thing, engine = self.answer(whole), self.engine
        if not isinstance(part, Atom) or engine.is_taught(part.text) or engine.bars is None:
            found = self.answer(part, level)
            return restricted(found, thing.members, thing)
        names, on = [part.text], thing.members
        if isinstance(whole, Atom) and not engine.is_taught(whole.text):
            names += filter(engine.is_known, [f"{whole.text} {part.text}"])
            if ADJECTIVES.isdisjoint(whole.text.lower().split()):  # else it is told from others of its kind
                on = within_reach(engine, thing, RULE.around)[0]
        calibration = engine.calibration if thing.probability is not None else None
        found = engine.run_inside(names, on, level, calibration)
        return restricted(found, found.members, thing)

    def _chosen(self, tree: Relation | Superlative, level: LevelChoice, count: int) -> QueryResult:
        what = self.answer(tree.what, level)
        anchor = None if tree.anchor is None else self.answer(tree.anchor)
        things, anchors = self._bodies(what), [] if anchor is None else self._bodies(anchor)
        if isinstance(tree, Superlative):
            every, others = [thing for _, thing in things], [other for _, other in anchors]
            right = {*ranked(tree.kind, every, others, self._viewpoint)[:count]}
        else:
            right = {
                row
                for row, (mine, thing) in enumerate(things)
                if any(
                    stands(tree.kind, thing, other, self._viewpoint)
                    for theirs, other in anchors
                    if np.isin(mine, theirs).mean() < HALF
                )
            }
        keep = np.zeros(len(what.members), bool)
        for row in right:
            keep[self.engine.surface.rows[things[row][0]]] = True
        return restricted(what, keep, anchor or what)

    def _bodies(self, answer: QueryResult) -> list[tuple[Array, Body]]:
        """Every single thing of an answer, as surface numbers and as the place it takes."""
        surface = self.engine.surface
        parts = separate(surface, answer.members[surface.rows], self.engine.tree)
        return [(numbers, body(surface.positions[numbers], self._frame)) for numbers in parts]


def joined(answers: Sequence[QueryResult], all_needed: bool) -> QueryResult:
    """Return the union of answers, found if all are, or any; alternatives that are not found do not count."""
    counting = answers if all_needed else [answer for answer in answers if answer.found] or answers
    score = min if all_needed else max
    values = np.max([np.where(a.members, a.relevancy[a.level], 0) for a in counting], axis=0)
    peak = score(answer.peak for answer in counting)
    return replace(
        counting[0],
        scores=(peak, peak, peak),
        relevancy=np.tile(values.astype(np.float32), (len(LEVELS), 1)),
        even=np.max([np.where(a.members, a.even, 0) for a in counting], axis=0),
        peak=peak,
        judgement=combined([answer.judgement for answer in counting], all_needed),
        members=np.any([answer.members for answer in counting], axis=0),
    )


def restricted(answer: QueryResult, keep: Array, needed: QueryResult) -> QueryResult:
    """`answer` limited to `keep` (N,); nothing is found where `needed` is not."""
    members = answer.members & keep
    judgement = combined([answer.judgement, needed.judgement], all_needed=True)
    return replace(
        answer,
        relevancy=np.where(members, answer.relevancy, 0),
        even=np.where(members, answer.even, 0),
        peak=answer.peak if members.any() else 0.0,
        judgement=judgement if members.any() else judgement.absent,
        members=members,
    )


def within_reach(engine: QueryEngine, answer: QueryResult, *shares: float) -> list[Array]:
    """Return (N,) bool of each share: the answer if it reached so far below its best region."""
    fits = engine.scale.fit(answer.even)
    best = float(fits[answer.members].max(initial=-np.inf))
    return [np.asarray(fits >= RULE.least_fit(best, share)) for share in shares]


@dataclass(frozen=True)
class Number:
    """Number of single things in an answer, with the least and most that there may be."""

    best: int
    least: int  # with a stricter cut
    most: int  # with a wider one


def count_things(engine: QueryEngine, answer: QueryResult) -> Number:
    """Return the number of single things in an answer, as `separate` tells them apart, and its range."""
    least, most = within_reach(engine, answer, RULE.strict, RULE.wide)
    low, own, high = (
        len(separate(engine.surface, inside[engine.surface.rows], engine.tree))
        for inside in (least & answer.members, answer.members, most | answer.members)
    )
    return Number(own, min(low, own), max(high, own))


# Answers of a scene's field, and masks of the same phrase in its photographs.

Spoke = Literal["both", "the field", "the photographs", "neither"]
TOUCHED = 0.1  # of a region of the field, in masks: from then on these alone say what of it is the thing


@dataclass(frozen=True, eq=False)
class Heard:
    """An answer of the field and of masks in photographs, and what each of them said."""

    answer: QueryResult
    field: Array  # (N,) bool members by the field; none where it did not find the phrase
    masks: Array  # (N,) bool members by masks

    def who(self, rows: Array | slice = slice(None)) -> Spoke:
        """Return who found the thing of these Gaussians, each having most of them, or any thing at all."""
        least = 0.0 if isinstance(rows, slice) else HALF
        spoke = self.field[rows].mean() > least, self.masks[rows].mean() > least
        names: tuple[Spoke, ...] = ("neither", "the photographs", "the field", "both")
        return names[2 * spoke[0] + spoke[1]]


def with_masks(engine: QueryEngine, found: QueryResult, shares: Array) -> Heard:
    """Return an answer together with masks; shares: (N,) of `selection.shares_in_masks`.

    What lies by more than half in masks is the thing, more sharply than regions are, with their mean share as
    its score. Regions of the field's answer that masks hardly touch stay, and so does what no photograph
    sees: a segmenter misses, too.
    """
    field, masks = found.members & found.found, shares > HALF
    if masks.sum() < RULE.smallest:
        return Heard(found, field, np.zeros_like(masks))
    regions = engine.regions
    level = found.level if found.found else regions.level_of(masks)
    touched = regions.means(np.tile(masks, (len(LEVELS), 1)))[level] >= TOUCHED
    settled = regions.spread(level, touched, np.zeros_like(masks)) & ~np.isnan(shares)
    kept = field & ~masks & ~settled
    even = np.where(masks, shares[masks].mean(), np.where(kept, found.even, 0)).astype(np.float32)
    peak = float(even.max())
    judgement = found.judgement if found.found else Verdict(True, "masks", 10 * (peak - HALF))
    merged = replace(found, level=level, members=masks | kept, even=even, peak=peak, judgement=judgement)
    best = engine.instances(merged, 1)
    place, box = place_of(best[0].points) if best else (None, None)
    return Heard(replace(merged, place=place, box=box), field, masks)
