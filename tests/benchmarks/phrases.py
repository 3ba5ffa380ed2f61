"""Reports on phrases that are true of a room, by its geometry and its names.

* phrases: phrases with structure, asked whole and composed; names of regions, inventories (`words`);
* counts: phrases for none, one or several things, after GR-LERF.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise, product
from typing import get_args

import numpy as np

from assets.making.dataset import MIN_PIXELS, Region, Truth, photographed_room
from assets.making.objects import EVERYTHING
from assets.making.world import CATEGORIES, World, object_words
from langsplat_core.arrays import Array
from langsplat_core.extensions.benchmarks.report import intersection_over_union, markdown
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import Extreme, Side, atoms, parse
from langsplat_core.query.inventory import InventoryEntry, scene_inventory
from langsplat_core.query.relations import Body, body, ranked, stands, upright, viewpoint
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import LEVELS, Camera
from tests.benchmarks.oracles import surface_points
from tests.benchmarks.room import InRooms, MaskOrigin, Room, Seeds, Variant, publish
from tests.benchmarks.scoring import MIN_GAUSSIANS, masks_and_peaks, spread

METHOD = Variant("the method", "truth")
POINTS = 3000  # on the surface of every thing, by which it is measured
MOST_CASES = 16  # of one construction, drawn at random
SHELL = ("floor", "wall")  # surround everything, and are not related to anything
VIEWER_SAYS = ("left of", "right of", "behind", "in front of", "nearest", "farthest", "leftmost", "rightmost")
FEWEST = 3  # things that a superlative chooses from
CONSTRUCTIONS = (
    *("part of thing", "subpart of thing", "thing part", "thing subpart", "A and B", "thing without part"),
    *("kind, not thing", *get_args(Side), *get_args(Extreme)),
)


@dataclass(frozen=True)
class Phrases(InRooms):
    """Every construction of the grammar, composed in 3D beside asked whole; words for every region, and the
    inventory. Some minutes per room."""

    seeds: Seeds = (301, 302, 303)
    """One room of every tier each; never the bundled scene's. Composing was tuned on 201 and 202."""

    def run(self) -> None:
        rows = self.each(lambda room: [(measure_phrases(room), name_regions(room))])
        composed, named = [score for scores, _ in rows for score in scores], [words for _, words in rows]
        tables = f"{phrase_table(composed)}\n{word_table(named)}"
        publish(self, "phrases", "Phrases with structure, and names", tables, [*composed, *named])


@dataclass(frozen=True)
class Case:
    """A phrase, how it is asked whole, and what it is true for."""

    construction: str  # one of CONSTRUCTIONS
    text: str
    whole: str  # the same in the words in which the encoder knows it best
    ids: tuple[int, ...]  # truth ids, of any level; none: nothing in the room is so
    without: tuple[int, ...] = ()  # truth ids that are taken away from these

    def mask(self, labels: Array) -> Array:
        """Map (3, ...) truth ids to (...) bool."""
        right = np.isin(labels, self.ids).any(0) & ~np.isin(labels, self.without).any(0)
        return np.asarray(right)


@dataclass(frozen=True, eq=False)
class Things:
    words: Mapping[int, str]  # whole id -> its word
    extents: Mapping[int, Body]

    def called(self, word: str) -> list[int]:
        """Ids of those that are of this word or kind."""
        return [number for number, own in self.words.items() if word in (own, *CATEGORIES.get(own, ()))]


def things_in(world: World, frame: Array, seed: int = 0) -> Things:
    """From a room's triangles, in which the origin is that of its cameras. frame: see `instances.upright`."""
    rng, owner = np.random.default_rng((seed, 5)), world.ids[world.piece_of, 2]
    words, extents = {}, {}
    for number in np.unique(owner).tolist():
        points = surface_points(world.vertices, world.triangles[owner == number], rng, count=POINTS)
        words[number], extents[number] = world.labels[number].thing, body(points, frame)
    return Things(words, extents)


def cases(truth: Truth, things: Things, seen_by: Array, seed: int) -> list[Case]:
    """At most `MOST_CASES` of every construction but of parts, of which there are all."""
    rng = np.random.default_rng((seed, 7))
    found: dict[str, list[Case]] = {name: [] for name in CONSTRUCTIONS}
    places = _relations(things, seen_by), _extremes(things, seen_by)
    for case in chain(_parts(truth), _sets(things, rng), *places):
        found[case.construction].append(case)
    drawn = []
    for name, group in found.items():
        if "part" in name or len(group) <= MOST_CASES:
            drawn += group
            continue
        for some in ([case for case in group if case.ids], [case for case in group if not case.ids]):
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
    return sorted({kind for word in things.words.values() for kind in CATEGORIES.get(word, ())})


def _relations(things: Things, seen_by: Array) -> Iterator[Case]:
    """Of a kind of which some stand so and others do not; and of single things, of which none does."""
    objects = sorted(set(things.words.values()) - set(SHELL))
    for side, anchor in product(get_args(Side), objects):
        anchors = things.called(anchor)
        for word in [*_kinds(things), *objects]:
            candidates = [number for number in things.called(word) if number not in anchors]
            pairs = [
                (number, stands(side, things.extents[number], things.extents[other], seen_by))
                for number, other in product(candidates, anchors)
            ]
            right = tuple(dict.fromkeys(number for number, stood in pairs if stood))
            some = 0 < len(right) < len(candidates)
            if some or (word in objects and candidates and not right and side not in VIEWER_SAYS):
                text = f"{word} {side} the {anchor}"
                yield Case(side, text, text, right)


def _extremes(things: Things, seen_by: Array) -> Iterator[Case]:
    for kind, word in product(get_args(Extreme), _kinds(things)):
        numbers = things.called(word)
        if len(numbers) >= FEWEST:
            one = numbers[ranked(kind, [things.extents[number] for number in numbers], [], seen_by)[0]]
            text = f"the {kind} {word}"
            yield Case(kind, text, f"{kind} {word}", (one,))


@dataclass(frozen=True)
class PhraseScore:
    """One case in one room; means over views. NaN where nothing could be compared."""

    construction: str
    text: str
    way: str  # "whole" or "composed"
    seed: int
    present: bool
    found: bool
    ious: tuple[float, ...]  # per view in which the truth is visible
    hits: tuple[bool, ...]  # whether the peak lies on it
    direct: float  # intersection over union of Gaussians
    seconds: float


def measure_phrases(room: Room) -> list[PhraseScore]:
    """All cases of one room that the encoder knows the words of, whole and composed."""
    engine, held_out = room.engine(METHOD, room.capture.cameras), room.held_out
    frame = upright(engine.scene.up())
    things = things_in(photographed_room(room.seed, room.tier), frame, room.seed)
    asked = [
        case
        for case in cases(room.truth, things, viewpoint(held_out[0], frame), room.seed)
        if not any(engine.unknown_words(atom.text) for atom in atoms(parse(case.text)))
    ]
    rows: list[PhraseScore] = []
    for way in ("whole", "composed"):
        engine.run("object")  # so that no time goes into preparation
        answered = []
        for case in asked:
            start = time.perf_counter()
            if way == "composed":
                result = run_phrase(engine, case.text, viewpoint=held_out[0]).answer
            else:  # without the words that the encoder was never taught, such as "near": with them it refuses
                unknown = engine.unknown_words(case.whole)
                result = engine.run(" ".join(word for word in case.whole.split() if word not in unknown))
            answered.append((case, result, time.perf_counter() - start))
        rows += _scores(room, answered, held_out, way)
        room.progress(way, 1.0)
    return rows


def _scores(
    room: Room, answered: Sequence[tuple[Case, QueryResult, float]], cameras: Sequence[Camera], way: str
) -> list[PhraseScore]:
    """Answers, each with the seconds that it took, beside the truth."""
    ious: list[list[float]] = [[] for _ in answered]
    hits: list[list[bool]] = [[] for _ in answered]
    for camera in cameras:
        labels = room.truth.labels(camera.name)
        masks = [case.mask(labels) for case, _, _ in answered]
        visible = [row for row, mask in enumerate(masks) if mask.sum() >= MIN_PIXELS]
        answers = [answered[row][1] for row in visible]
        view = CpuRasterizer().view(room.gaussians, camera)
        for row, (found, peak) in zip(visible, masks_and_peaks(view, answers), strict=True):
            ious[row].append(intersection_over_union(found, masks[row]))
            hits[row].append(bool(masks[row][peak]))
    seen = (room.labels >= 0).any(axis=0)
    rows = []
    for (case, answer, seconds), overlaps, peaks in zip(answered, ious, hits, strict=True):
        right = case.mask(room.labels)[seen]
        enough = right.sum() >= MIN_GAUSSIANS
        direct = intersection_over_union(answer.members[seen], right) if enough else float("nan")
        said = bool(case.ids), answer.found, tuple(overlaps), tuple(peaks), direct, seconds
        rows.append(PhraseScore(case.construction, case.text, way, room.seed, *said))
    return rows


def phrase_table(rows: Sequence[PhraseScore]) -> str:
    """Markdown: per construction, whole / composed."""
    lines = []
    for name in CONSTRUCTIONS:
        both = [
            [row for row in rows if (row.construction, row.way) == (name, way)]
            for way in ("whole", "composed")
        ]
        if both[0]:
            here = [[row for row in way if row.present] for way in both]
            lines.append((
                name,
                len(here[0]),
                sum(len(row.ious) for row in here[0]),
                _pair([[iou for row in way for iou in row.ious] for way in here]),
                _pair([[hit for row in way for hit in row.hits] for way in here]),
                _pair([[row.direct for row in way if not np.isnan(row.direct)] for way in here]),
                _pair([[row.found for row in way] for way in here]),
                _pair([[not row.found for row in way if not row.present] for way in both]),
            ))  # fmt: skip
    figures = ("mIoU %", "localisation %", "3D IoU %", "found %", "not there: rejected %")
    return markdown(("construction", "phrases", "views", *figures), lines)


def _pair(ways: Sequence[Sequence[float]]) -> str:
    """Percent; "-" for no figures."""
    return " / ".join(f"{100 * np.mean(way):.1f}" if len(way) else "-" for way in ways)


# Phrases for none, one or several things, after GR-LERF (ZeroSplat, ECCV 2026), with the measures of
# generalised referring segmentation (GRES, CVPR 2023).

TARGETS = ("none", "one", "several", "all")


@dataclass(frozen=True)
class Counts(InRooms):
    """Phrases for none, one or several things of a room: what they cover, and how many things they name.

    Ours beside the published reading, a threshold on relevancy. Some minutes per room."""

    masks: MaskOrigin = "truth"  # where outlines come from

    def run(self) -> None:
        rows = self.each(lambda room: measure_counts(room, replace(METHOD, masks=self.masks)))
        publish(self, "counts", "None, one or several", count_table(rows), rows)


@dataclass(frozen=True)
class CountScore:
    """One phrase, with the numbers of things that it names and that were answered."""

    score: PhraseScore
    true: int
    said: int

    @property
    def overlaps(self) -> tuple[float, float]:
        """Intersections over union, mean over the views and in 3-D: of nothing 1 where that is the answer."""
        if not (self.true and self.score.found):
            return (float(self.true == 0 and not self.score.found),) * 2
        return float(np.mean(self.score.ious)) if self.score.ious else np.nan, self.score.direct


def targets(truth: Truth, things: Things, seed: int) -> Iterator[Case]:
    """Names, kinds and colours of things that are there and that are not, joined and left out."""
    rng = np.random.default_rng((seed, 13))
    words = sorted(set(things.words.values()) - set(SHELL))
    for word in (*words, *_kinds(things), *truth.absent(EVERYTHING)):
        yield Case("name", word, word, tuple(things.called(word)))
    colours = sorted({truth.regions[number].colour for number in things.words} - {""})
    for word, colour in product(words, colours):
        ids = tuple(number for number in things.called(word) if truth.regions[number].colour == colour)
        # Of the colours that it has not, one in as many as there are.
        text = f"{colour} {word}"
        if ids or (text not in truth.words and rng.random() < 1 / len(colours)):
            yield Case("colour", text, text, ids)
    yield from _sets(things, rng)


def measure_counts(room: Room, variant: Variant) -> list[CountScore]:
    """Every phrase of one room that the encoder knows the words of, by both readings."""
    ours = room.engine(variant, room.capture.cameras)
    published = QueryEngine(ours.scene, lambda _: room.encoder, rule="peak")
    things = things_in(photographed_room(room.seed, room.tier), upright(ours.scene.up()), room.seed)
    shown = set(_regions(room.labels[2]))
    asked = [
        case
        for case in targets(room.truth, things, room.seed)
        if shown.issuperset(case.ids) and not ours.unknown_words(case.whole)
    ]
    rows = []
    for way, answers in (
        ("published", (published.run(case.whole) for case in asked)),
        ("ours", (run_phrase(ours, case.text).answer for case in asked)),
    ):
        answered = [(case, answer, 0.0) for case, answer in zip(asked, answers, strict=True)]
        said = [len(ours.instances(answer)) if answer.found else 0 for _, answer, _ in answered]
        scores = _scores(room, answered, room.held_out, way)
        rows += [
            CountScore(*row) for row in zip(scores, (len(case.ids) for case in asked), said, strict=True)
        ]
        room.progress(way, 1.0)
    return rows


def count_table(rows: Sequence[CountScore]) -> str:
    """Markdown: per reading and number of things, means over rooms with their standard deviation."""
    lines = []
    for way, kind in product(("published", "ours"), TARGETS):
        rooms: dict[int, list[tuple[float, ...]]] = {}
        for row in rows:
            if row.score.way == way and kind in ("all", TARGETS[min(row.true, 2)]):
                right = row.score.found == row.score.present, row.said == row.true
                rooms.setdefault(row.score.seed, []).append((*row.overlaps, *right))
        columns = 100 * np.array([np.nanmean(each, axis=0) for each in rooms.values()]).reshape(-1, 4).T
        lines.append((way, kind, sum(map(len, rooms.values())), *map(spread, columns)))
    figures = ("gIoU %", "3-D gIoU %", "found, or rejected, rightly %", "right number %")
    return markdown(("reading", "things named", "phrases", *figures), lines)


# Names of regions and inventories against the truth of a room (the second table of the report `phrases`).

TOP = 5
Regions = Mapping[int, Region]  # by truth id


@dataclass(frozen=True)
class LevelNames:
    """Words for the regions of one level, each of which counts once."""

    level: str
    regions: int  # that a word of the vocabulary is right for
    first: float  # share whose most probable word is right
    among: float  # share with a right word among the first `TOP`
    probability: float  # mean of the most probable word
    right: float  # mean of the probabilities of all right words together


@dataclass(frozen=True)
class InventoryScore:
    """A room's inventory against what is in it, whole things only."""

    entries: int
    true: float  # share of them that are true of most of the surface they claim
    things: int  # kinds of thing in the room that the vocabulary has a word for
    named: float  # share of those that a true entry names
    seconds: float


@dataclass(frozen=True)
class RoomWords:
    seed: int
    names: tuple[LevelNames, ...]
    inventory: InventoryScore


def name_regions(room: Room) -> RoomWords:
    describer = Describer(room.engine(METHOD))
    labels, truth = room.labels, room.truth.regions
    names = [_names(describer, level, _regions(labels[level]), truth) for level in (2, 1, 0)]
    start = time.perf_counter()
    entries = scene_inventory(describer)
    seconds = time.perf_counter() - start
    score = score_inventory(entries, labels, truth, describer.areas, describer.words[2].phrases)
    return RoomWords(room.seed, tuple(names), replace(score, seconds=seconds))


def _regions(labels: Array) -> dict[int, Array]:
    """Map (N,) truth ids to the numbers of the Gaussians of each, where there are enough."""
    found = {int(key): np.flatnonzero(labels == key) for key in np.unique(labels[labels >= 0])}
    return {key: rows for key, rows in found.items() if len(rows) >= MIN_GAUSSIANS}


def _names(describer: Describer, level: int, regions: Mapping[int, Array], truth: Regions) -> LevelNames:
    field, known, words = describer.engine.field, describer.engine.field.known[level], describer.words[level]
    rows = []
    for key, members in regions.items():
        right = np.isin(words.phrases, truth[key].words)
        members = members[known[members]]
        if not right.any() or len(members) == 0:
            continue
        areas = np.maximum(describer.areas[members], 1e-300)
        shares = words.mixture(field.latents[level, members], areas)[: len(right)]
        best = np.argsort(-shares, kind="stable")[:TOP]
        rows.append((right[best[0]], right[best].any(), shares[best[0]], shares[right].sum()))
    mean = np.mean(rows, axis=0) if rows else np.zeros(4)
    return LevelNames(LEVELS[level], len(rows), *(float(value) for value in mean))


def score_inventory(
    entries: Sequence[InventoryEntry], labels: Array, truth: Regions, areas: Array, phrases: Sequence[str]
) -> InventoryScore:
    """Entries of whole things against (3, N) truth ids; seconds are left 0."""
    wholes, named, correct = [entry for entry in entries if entry.level == 2], set(), 0
    for entry in wholes:
        rows = np.concatenate([spot.rows for spot in entry.spots])
        ids = labels[2, rows]
        fits = {key for key in np.unique(ids[ids >= 0]) if entry.phrase in truth[int(key)].words}
        if areas[rows[np.isin(ids, list(fits))]].sum() * 2 > areas[rows].sum():
            correct += 1
            named |= {truth[int(key)].thing for key in fits}
    things = {truth[key].thing for key in _regions(labels[2])} - {""}
    things = {thing for thing in things if not set(object_words(thing)).isdisjoint(phrases)}
    return InventoryScore(
        entries=len(wholes),
        true=correct / max(len(wholes), 1),
        things=len(things),
        named=len(named & things) / max(len(things), 1),
        seconds=0.0,
    )


def word_table(rooms: Sequence[RoomWords]) -> str:
    """Both tables as Markdown: names of regions, and inventories."""
    head = ("room", "level", "regions", "first right %", "one of five %", "p of first", "p of right")
    names = (
        (room.seed, row.level, row.regions, f"{100 * row.first:.0f}", f"{100 * row.among:.0f}")
        + (f"{row.probability:.2f}", f"{row.right:.2f}")
        for room in rooms
        for row in room.names
    )
    inventories = (
        (room.seed, room.inventory.entries, f"{100 * room.inventory.true:.0f}", room.inventory.things)
        + (f"{100 * room.inventory.named:.0f}", f"{room.inventory.seconds:.1f}")
        for room in rooms
    )
    listed = ("room", "listed", "true %", "things", "named %", "seconds")
    return f"{markdown(head, names)}\n{markdown(listed, inventories)}"
