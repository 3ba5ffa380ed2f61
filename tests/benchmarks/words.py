"""Names of regions and inventories against the truth of a room (the second table of the report `phrases`)."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from assets.making.truth import Region
from assets.making.vocabulary import colour_words, object_words
from langsplat_core.arrays import Array
from langsplat_core.bench.measure import markdown
from langsplat_core.query.describe import Describer, Entry, WordScores
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import LEVELS, LanguageField, Scene
from tests.benchmarks.room import Room
from tests.benchmarks.scoring import MIN_GAUSSIANS

TOP = 5
Regions = Mapping[int, Region]  # by truth id


@dataclass(frozen=True)
class LevelNames:
    """One way of scoring words, at one level: every region counts once."""

    how: str
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
    """All figures of one room."""

    seed: int
    names: tuple[LevelNames, ...]
    colour: float  # share of whole things of one colour whose most certain colour is right
    inventory: InventoryScore


def name_regions(room: Room, field: LanguageField) -> RoomWords:
    """Words for every region of one room, and its inventory."""
    describer = Describer(QueryEngine(Scene(room.gaussians, field), lambda _: room.encoder))
    labels, truth = room.labels, room.truth.regions
    names = []
    for how, words in _ways(describer).items():
        for level in reversed(range(len(LEVELS))):
            names.append(_names(how, words[level], describer, level, _regions(labels[level]), truth))
    start = time.perf_counter()
    entries = describer.inventory()
    seconds = time.perf_counter() - start
    score = score_inventory(entries, labels, truth, describer.areas, describer.words[2].phrases)
    colour = _colours(describer, _regions(labels[2]), truth)
    return RoomWords(room.seed, tuple(names), colour, replace(score, seconds=seconds))


def _ways(describer: Describer) -> dict[str, Sequence[WordScores]]:
    plain = [replace(words, hubs=np.zeros_like(words.hubs)) for words in describer.words]
    return {"plain cosine": plain, "hubs taken out": describer.words}


def _regions(labels: Array) -> dict[int, Array]:
    """(N,) truth ids -> the numbers of the Gaussians of each, where there are enough."""
    found = {int(key): np.flatnonzero(labels == key) for key in np.unique(labels[labels >= 0])}
    return {key: rows for key, rows in found.items() if len(rows) >= MIN_GAUSSIANS}


def _names(
    how: str,
    words: WordScores,
    describer: Describer,
    level: int,
    regions: Mapping[int, Array],
    truth: Regions,
) -> LevelNames:
    field, known, rows = describer.engine.field, describer.engine.field.known[level], []
    for key, members in regions.items():
        right = np.isin(words.phrases, truth[key].words)
        members = members[known[members]]
        if not right.any() or len(members) == 0:
            continue
        areas = np.maximum(describer.areas[members], 1e-300)
        shares = words.mixture(field.codec, field.latents[level, members], areas)[: len(right)]
        best = np.argsort(-shares, kind="stable")[:TOP]
        rows.append((right[best[0]], right[best].any(), shares[best[0]], shares[right].sum()))
    mean = np.mean(rows, axis=0) if rows else np.zeros(4)
    return LevelNames(how, LEVELS[level], len(rows), *(float(value) for value in mean))


def _colours(describer: Describer, regions: Mapping[int, Array], truth: Regions) -> float:
    hits = []
    for key, members in regions.items():
        colour = truth[key].colour
        if colour:
            said = describer.at_gaussians(members)[2].colour
            hits.append(said is not None and said.phrase in colour_words(colour))
    return float(np.mean(hits)) if hits else 0.0


def score_inventory(
    entries: Sequence[Entry], labels: Array, truth: Regions, areas: Array, phrases: Sequence[str]
) -> InventoryScore:
    """Entries of whole things against (3, N) truth ids; seconds are left 0."""
    wholes, named = [entry for entry in entries if entry.level == 2], set()
    correct = 0
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
    head = ("room", "words", "level", "regions", "first right %", "one of five %", "p of first", "p of right")
    names = (
        (room.seed, row.how, row.level, row.regions, f"{100 * row.first:.0f}", f"{100 * row.among:.0f}")
        + (f"{row.probability:.2f}", f"{row.right:.2f}")
        for room in rooms
        for row in room.names
    )
    inventories = (
        (room.seed, room.inventory.entries, f"{100 * room.inventory.true:.0f}", room.inventory.things)
        + (f"{100 * room.inventory.named:.0f}", f"{100 * room.colour:.0f}", f"{room.inventory.seconds:.1f}")
        for room in rooms
    )
    listed = ("room", "listed", "true %", "things", "named %", "colour right %", "seconds")
    return f"{markdown(head, names)}\n{markdown(listed, inventories)}"
