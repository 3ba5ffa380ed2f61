"""Phrases with structure that are true of a procedural room, from its geometry and its names."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.rooms.truth import Truth
from langsplat_core.lab.world.assembly import World
from langsplat_core.lab.world.captions import KINDS
from langsplat_core.query.compose import Body, Viewpoint, body, most, stands
from langsplat_core.query.grammar import EXTREMES, SIDES

POINTS = 3000  # on the surface of every thing, by which it is measured
MOST_CASES = 16  # of one construction, drawn at random
SHELL = ("floor", "wall")  # surround everything, and are not related to anything
VIEWER_SAYS = ("left of", "right of", "behind", "in front of", "nearest", "farthest", "leftmost", "rightmost")
FEWEST = 3  # things that a superlative chooses from
CONSTRUCTIONS = (
    *("part of thing", "subpart of thing", "thing part", "thing subpart", "A and B", "thing without part"),
    *("kind, not thing", *SIDES, *EXTREMES),
)


@dataclass(frozen=True)
class Case:
    """A phrase, how it is asked whole, and what it is true for."""

    construction: str  # one of CONSTRUCTIONS
    text: str
    whole: str  # the same in the words in which the encoder knows it best
    ids: tuple[int, ...]  # truth ids, of any level; none: nothing in the room is so
    without: tuple[int, ...] = ()  # truth ids that are taken away from these

    def mask(self, labels: Array) -> Array:
        """(3, ...) truth ids -> (...) bool."""
        right = np.isin(labels, self.ids).any(0) & ~np.isin(labels, self.without).any(0)
        return np.asarray(right)


@dataclass(frozen=True, eq=False)
class Things:
    """The single things in a room."""

    words: Mapping[int, str]  # whole id -> its word
    extents: Mapping[int, Body]

    def called(self, word: str) -> list[int]:
        """Ids of those that are of this word or kind."""
        return [number for number, own in self.words.items() if word in (own, *KINDS.get(own, ()))]


def things_in(world: World, frame: Array, seed: int = 0) -> Things:
    """From a room's triangles, in which the origin is that of its cameras. frame: see `instances.upright`."""
    rng = np.random.default_rng((seed, 5))
    corners = world.vertices[world.triangles].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    owner = world.ids[world.piece_of, 2]
    words, extents = {}, {}
    for number in np.unique(owner):
        rows = np.flatnonzero(owner == number)
        rows = rng.choice(rows, POINTS, p=area[rows] / area[rows].sum())
        shares = rng.dirichlet((1, 1, 1), POINTS)  # even over a triangle
        words[int(number)] = world.labels[number].thing
        extents[int(number)] = body((corners[rows] * shares[..., None]).sum(1), frame)
    return Things(words, extents)


def cases(truth: Truth, things: Things, seen_by: Viewpoint, seed: int) -> list[Case]:
    """At most `MOST_CASES` of every construction but of parts, of which there are all."""
    rng = np.random.default_rng((seed, 7))
    found: dict[str, list[Case]] = {name: [] for name in CONSTRUCTIONS}
    every = [
        *_parts(truth),
        *_sets(things, rng),
        *_relations(things, seen_by),
        *_extremes(things, seen_by),
    ]
    for case in every:
        found[case.construction].append(case)
    drawn = []
    for name, group in found.items():
        if "part" in name or len(group) <= MOST_CASES:
            drawn += group
            continue
        there = [case for case in group if case.ids]
        absent = [case for case in group if not case.ids]
        for some in (there, absent):
            drawn += [some[row] for row in sorted(rng.permutation(len(some))[:MOST_CASES])]
    return drawn


def _parts(truth: Truth) -> Iterator[Case]:
    names = {f"{item.thing} {item.word}": (item.thing, item.word) for item in truth.regions.values()}
    for phrase in truth.phrases:
        if phrase.kind in ("part", "subpart"):
            thing, part = names[phrase.text]
            text = f"{part} of the {thing}"
            yield Case(f"{phrase.kind} of thing", text, phrase.text, phrase.ids)
            yield Case(f"thing {phrase.kind}", phrase.text, phrase.text, phrase.ids)
            wholes = tuple(
                key for key, item in truth.regions.items() if item.level == "whole" and item.thing == thing
            )
            text = f"{thing} without its {part}"
            yield Case("thing without part", text, f"{thing} without {part}", wholes, phrase.ids)


def _sets(things: Things, rng: np.random.Generator) -> Iterator[Case]:
    words = [str(word) for word in rng.permutation(sorted(set(things.words.values()) - set(SHELL)))]
    for one, other in pairwise(words):
        ids = (*things.called(one), *things.called(other))
        yield Case("A and B", f"{one} and {other}", f"{one} and {other}", ids)
    for kind in _kinds(things):
        for word in sorted({things.words[number] for number in things.called(kind)}):
            rest = tuple(number for number in things.called(kind) if things.words[number] != word)
            if rest:
                yield Case("kind, not thing", f"{kind}, not {word}", f"{kind} not {word}", rest)


def _kinds(things: Things) -> list[str]:
    return sorted({kind for word in things.words.values() for kind in KINDS.get(word, ())})


def _relations(things: Things, seen_by: Viewpoint) -> Iterator[Case]:
    """Of a kind of which some stand so and others do not; and of single things, of which none does."""
    objects = sorted(set(things.words.values()) - set(SHELL))
    for side, anchor in product(SIDES, objects):
        anchors = things.called(anchor)
        for word in [*_kinds(things), *objects]:
            candidates = [number for number in things.called(word) if number not in anchors]
            right = tuple(
                number
                for number in candidates
                if any(
                    stands(side, things.extents[number], things.extents[other], seen_by) for other in anchors
                )
            )
            some = 0 < len(right) < len(candidates)
            if some or (word in objects and candidates and not right and side not in VIEWER_SAYS):
                text = f"{word} {side} the {anchor}"
                yield Case(side, text, text, right)


def _extremes(things: Things, seen_by: Viewpoint) -> Iterator[Case]:
    for kind, word in product(EXTREMES, _kinds(things)):
        numbers = things.called(word)
        if len(numbers) >= FEWEST:
            one = numbers[most(kind, [things.extents[number] for number in numbers], [], seen_by)]
            text = f"the {kind} {word}"
            yield Case(kind, text, f"{kind} {word}", (one,))
