"""Compositional queries: each phrase of the tree is answered by itself, and the answers are combined.

The relevancy of a combined answer is zero outside its members, and equal at all levels if answers of several
levels are joined; its peak is that of its weakest necessary part.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.errors import EncoderError, InputError, expect
from langsplat_core.progress import Progress, silent
from langsplat_core.query import grammar
from langsplat_core.query.answers import QueryResult, locate, place_of
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.relations import Body, body, ranked, separate, stands, upright, viewpoint
from langsplat_core.query.rule import RULE, Verdict, combined
from langsplat_core.scene import LEVELS, Camera
from langsplat_core.scene.language import phrase_key, tidy
from langsplat_core.semantics.relevancy import FLOOR

# Share of the peak at which the place ends; of an instance's Gaussians in another that is the same one; and
# of the reach (`RULE`) within which an unwanted name excludes.
HALF = 0.5
NEED_VIEWPOINT = ("left of", "right of", "behind", "in front of", "leftmost", "rightmost")


@dataclass(frozen=True, eq=False)
class ComposedResult:
    """The answer to a phrase, and its parsed tree."""

    answer: QueryResult
    tree: grammar.Phrase

    @property
    def reading(self) -> str:
        """The tree as text, such as "handle  inside  red mug"."""
        return grammar.unparse(self.tree)


def run_phrase(
    engine: QueryEngine,
    text: str,
    level: LevelChoice = "auto",
    viewpoint: Camera | None = None,
    progress: Progress = silent,
) -> ComposedResult:
    """Answer a phrase as the grammar parses it.

    It is a plain query, as by `QueryEngine.run`, if the grammar finds no structure, or if only the whole
    phrase is known (from a phrasebook). level: of what is searched for; what it is related to is searched at
    "auto". viewpoint: the camera for left, right, behind and in front, and for "nearest" and "farthest"
    without an anchor. Raises as `parse` and `QueryEngine.run`, and InputError for a missing viewpoint.
    """
    expect(engine, QueryEngine, "QueryEngine(scene, encoder) makes one")
    expect(viewpoint, Camera | None, "scene.cameras has those of a scene")
    tree = check_phrase(engine, text, viewpoint, progress)
    if isinstance(tree, grammar.Atom):
        return ComposedResult(engine.run(tree.text, level, progress), tree)
    found = _Evaluator(engine, viewpoint, progress).answer(tree, level)
    # The position is that of the connected members with the highest relevancy.
    values = np.where(found.members, found.relevancy[found.level], 0).astype(np.float32)
    smoothed = engine.surface.smooth(values)
    place, box = locate(engine.surface, smoothed, HALF * float(smoothed.max(initial=0)))
    return ComposedResult(replace(found, phrase=tidy(text), place=place, box=box), tree)


def encoded_texts(engine: QueryEngine, tree: grammar.Phrase) -> list[str]:
    """Return the atoms of a phrase that the encoder reads: all but taught words."""
    return [atom.text for atom in grammar.atoms(tree) if not engine.is_taught(atom.text)]


def check_phrase(
    engine: QueryEngine, text: str, viewpoint: Camera | None = None, progress: Progress = silent
) -> grammar.Phrase:
    """Return the tree that `run_phrase` answers, or raise what it would; the encoded vectors are kept."""
    tree = grammar.parse(text, engine.taught)
    _check_viewpoint(tree, viewpoint)
    try:
        engine.texts.of(encoded_texts(engine, tree), progress)
    except EncoderError:
        if phrase_key(text) not in engine.field.phrasebook:
            raise
        return grammar.Atom(tidy(text))
    return tree


def encode_phrases(engine: QueryEngine, texts: Sequence[str]) -> None:
    """Encode many phrases together, without errors; `check_phrase` reports those that cannot be encoded."""
    wanted: list[str] = []
    for text in texts:
        with suppress(InputError):
            wanted += encoded_texts(engine, grammar.parse(text, engine.taught))
    with suppress(EncoderError, InputError):
        engine.texts.of_known(wanted)


def _check_viewpoint(tree: grammar.Phrase, viewpoint: Camera | None) -> None:
    """Raise InputError for the first relation in the tree that needs a viewpoint, if there is none."""
    if viewpoint is None and isinstance(tree, grammar.Relation | grammar.Superlative):
        from_here = tree.kind in ("nearest", "farthest") and tree.anchor is None
        if from_here or tree.kind in NEED_VIEWPOINT:
            raise InputError(f"'{tree.kind}' depends on where one stands; give a camera, or say it otherwise")
    for child in grammar.children(tree):
        _check_viewpoint(child, viewpoint)


class _Evaluator:
    """Evaluation of one tree, in which each phrase is queried once."""

    def __init__(self, engine: QueryEngine, camera: Camera | None, progress: Progress) -> None:
        self.engine, self._progress = engine, progress
        self._results: dict[tuple[str, LevelChoice], QueryResult] = {}
        self._frame = upright(engine.scene.up())
        self._viewpoint = None if camera is None else viewpoint(camera, self._frame)

    def answer(self, tree: grammar.Phrase, level: LevelChoice = "auto", count: int = 1) -> QueryResult:
        """Return the answer to a tree, without a position; count: how many a superlative selects."""
        match tree:
            case grammar.Atom(text):
                return self._atom(text, level)
            case grammar.Both(items) | grammar.Union(items):
                return joined([self.answer(item, level) for item in items], isinstance(tree, grammar.Both))
            case grammar.Without(what, unwanted):
                excluded, wanted = self.answer(unwanted), self.answer(what, level)
                members = excluded.members
                if isinstance(unwanted, grammar.Atom):
                    # "red mug" may also find a green mug, if nothing fits better; "not red mug" keeps it.
                    members = members & within_reach(self.engine, excluded, HALF)
                return restricted(wanted, ~members, wanted) if excluded.found else wanted
            case grammar.Inside(part, whole):
                return self._inside(part, whole, level)
            case grammar.Counted(count, what):
                every = self.answer(what, level, count)
                enough = every.found and count_instances(self.engine, every).most >= count
                return replace(every, judgement=replace(every.judgement, found=enough))
            case grammar.Relation() | grammar.Superlative():
                return self._chosen(tree, level, count)

    def _run(self, text: str, level: LevelChoice) -> QueryResult:
        key = (phrase_key(text), level)
        if key not in self._results:
            self._results[key] = self.engine.run(text, level, self._progress)
        return self._results[key]

    def _atom(self, text: str, level: LevelChoice) -> QueryResult:
        """Return the answer to a phrase; a thing is searched among wholes, unless it fits none."""
        if level != "auto" or grammar.named(text) != "thing" or self.engine.is_taught(text):
            return self._run(text, level)
        whole = self._run(text, "whole")
        return whole if whole.peak >= FLOOR else self._run(text, "auto")

    def _inside(self, part: grammar.Phrase, whole: grammar.Phrase, level: LevelChoice) -> QueryResult:
        thing, engine = self.answer(whole), self.engine
        if not isinstance(part, grammar.Atom) or engine.is_taught(part.text) or engine.bars is None:
            found = self.answer(part, level)
            return restricted(found, thing.members, thing)
        names, on = [part.text], thing.members
        if isinstance(whole, grammar.Atom) and not engine.is_taught(whole.text):
            names += filter(engine.is_known, [f"{whole.text} {part.text}"])
            if grammar.ADJECTIVES.isdisjoint(whole.text.lower().split()):  # an adjective picks one of several
                on = within_reach(engine, thing, RULE.around)
        calibration = engine.calibration if thing.probability is not None else None
        found = engine.run_inside(names, on, level, calibration)
        return restricted(found, found.members, thing)

    def _chosen(
        self, tree: grammar.Relation | grammar.Superlative, level: LevelChoice, count: int
    ) -> QueryResult:
        what = self.answer(tree.what, level)
        anchor = None if tree.anchor is None else self.answer(tree.anchor)
        things, anchors = self._bodies(what), [] if anchor is None else self._bodies(anchor)
        if isinstance(tree, grammar.Superlative):
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
        """Return the instances of an answer, each as its surface numbers and its body."""
        surface = self.engine.surface
        parts = separate(surface, answer.members[surface.rows], self.engine.tree)
        return [(numbers, body(surface.positions[numbers], self._frame)) for numbers in parts]


def joined(answers: Sequence[QueryResult], all_needed: bool) -> QueryResult:
    """Return the union of answers, found if all or any are found; alternatives not found are left out."""
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
    """Return `answer` limited to `keep` (N,) bool; it is found only if `needed` is found too."""
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


def within_reach(engine: QueryEngine, answer: QueryResult, share: float) -> Array:
    """Return the (N,) bool members that the answer has with this share of `RULE`'s reach."""
    fits = engine.scale.fit(answer.even)
    best = float(fits[answer.members].max(initial=-np.inf))
    return np.asarray(fits >= RULE.least_fit(best, share))


@dataclass(frozen=True)
class InstanceCount:
    """Number of instances in an answer, with a range."""

    best: int
    least: int  # by `RULE.strict`
    most: int  # by `RULE.wide`


def count_instances(engine: QueryEngine, answer: QueryResult) -> InstanceCount:
    """Return the number of instances in an answer, as `separate` divides it, and its range."""
    least, most = (within_reach(engine, answer, share) for share in (RULE.strict, RULE.wide))
    low, own, high = (
        len(separate(engine.surface, inside[engine.surface.rows], engine.tree))
        for inside in (least & answer.members, answer.members, most | answer.members)
    )
    return InstanceCount(own, min(low, own), max(high, own))


# Answers of a scene's field, combined with masks of the same phrase in its photographs.

FoundBy = Literal["both", "the field", "the photographs", "neither"]
TOUCHED = 0.1  # share of a region in masks from which the masks alone decide which of its Gaussians stay


@dataclass(frozen=True, eq=False)
class MaskedAnswer:
    """An answer of the field combined with masks in photographs, and the members by each of them."""

    answer: QueryResult
    field: Array  # (N,) bool members by the field; none if it did not find the phrase
    masks: Array  # (N,) bool members by masks

    def found_by(self, rows: Array | slice = slice(None)) -> FoundBy:
        """Return which of them have most of the Gaussians `rows` as members; by default, any Gaussian."""
        least = 0.0 if isinstance(rows, slice) else HALF
        found = self.field[rows].mean() > least, self.masks[rows].mean() > least
        names: tuple[FoundBy, ...] = ("neither", "the photographs", "the field", "both")
        return names[2 * found[0] + found[1]]


def with_masks(engine: QueryEngine, found: QueryResult, shares: Array) -> MaskedAnswer:
    """Return an answer combined with masks; shares: (N,) of `selection.shares_in_masks`.

    Gaussians by more than half in masks are members, with sharper borders than regions have; their score is
    the mean share. Of the field's answer, regions that masks hardly touch stay, and Gaussians out of sight.
    """
    field, masks = found.members & found.found, shares > HALF
    if masks.sum() < RULE.smallest:
        return MaskedAnswer(found, field, np.zeros_like(masks))
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
    return MaskedAnswer(replace(merged, place=place, box=box), field, masks)
