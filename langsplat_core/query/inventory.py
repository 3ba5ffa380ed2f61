"""The contents of a scene in words: its inventory, the outline of its tree, and suggested queries.

Every feature of the scene, and so every Gaussian, has a best word. Words that cover enough of the surface are
candidates for the inventory. Candidates that claim the same features are two names of one thing ("mug" and
"cup"). A word is listed if a query for it finds what it claimed.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain, islice, permutations
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import LangSplatError
from langsplat_core.io.files import atomic_path, check_output_file
from langsplat_core.io.scenes import save_scene
from langsplat_core.progress import Progress, silent
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.describe import LIKELY, OR, Describer, Word, likely_name
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import is_part
from langsplat_core.query.instances import axis_aligned_box, oriented_box
from langsplat_core.scene import LEVELS, NO_NODE
from langsplat_core.scene.language import phrase_key
from langsplat_core.semantics.relevancy import FLOOR

LEAST_SHARE = 5e-4  # least share of the scene's surface of a listed word or node
LEAST_SPOT = 0.15  # least area of a spot, as a share of the largest one's: smaller ones are border splinters
LEAST_COUNT = 12  # least Gaussians of a spot or node
SAME = 0.5  # overlap of claims from which two words name the same thing
RUNNERS_UP = 5  # words per feature that may be names for it
MOST = 200  # candidates per level, the largest first
DEEPEST = 64  # levels of nesting that are listed, far beyond the trees of scenes
NAMES = 3  # words, at most, in the name of a node


@dataclass(frozen=True, eq=False)
class Spot:
    """One connected part of the surface that a word describes."""

    centre: Array  # (3,) world units
    box: Array  # (2, 3) lower and upper corner, world units, between 2 % and 98 % of its Gaussians
    rows: Array = field(repr=False)  # (M,) int64 numbers of its Gaussians
    share: float  # of the scene's surface, in [0, 1]


@dataclass(frozen=True, eq=False)
class InventoryEntry:
    """A word for something in the scene."""

    phrase: str
    also: tuple[str, ...]  # other words for the same
    level: int  # index into LEVELS
    probability: float  # that it or a word of `also` is right, a mean over its surface
    score: float  # peak relevancy of the phrase, as a query gives it
    share: float  # of the scene's surface, in [0, 1]
    spots: tuple[Spot, ...]  # the largest first


@dataclass(frozen=True, eq=False)
class _Claim:
    """A group of words that claim the same features at one level."""

    level: int
    phrases: tuple[str, ...]  # the largest claim first
    rows: Array  # (M,) int64 numbers of the Gaussians whose best word is one of them
    probability: float  # at least `LIKELY`
    is_partial: bool  # unlikely features were left out to reach it


def scene_inventory(
    describer: Describer, progress: Progress = silent, placed: bool = True
) -> list[InventoryEntry]:
    """Return every word for something in the scene, once, at its coarsest level; wholes first, then by area.

    placed: find the spots of each, which needs the scene's surface.
    """
    field, known = describer.engine.field, describer.known
    of = np.full(known.shape, -1, np.int64)
    latents, of[known] = field.codec.unique(field.latents[known])
    entries: list[InventoryEntry] = []
    named: set[str] = set()
    for level in reversed(range(len(LEVELS))):
        claims = list(_claims(describer, latents, of[level], level))
        for done, claim in enumerate(claims):
            progress("checking words", done / len(claims), LEVELS[level])
            entry = _verified(describer, claim, placed) if named.isdisjoint(claim.phrases) else None
            if entry is not None:
                entries.append(entry)
                named.update(claim.phrases)
        progress("checking words", 1.0, LEVELS[level])
    return entries


def _claims(describer: Describer, latents: Array, of: Array, level: int) -> Iterator[_Claim]:
    """Yield a level's groups of words, the largest first; of: (N,) rows of the (M, d) latents, -1: none."""
    words, areas = describer.words[level], describer.areas
    best, shares = words.best(latents, RUNNERS_UP)
    if best.size == 0:  # no words, or no features
        return
    has = of >= 0
    surface = np.bincount(of[has], areas[has], minlength=len(latents))
    least = LEAST_SHARE * max(float(areas.sum()), 1e-300)
    mass = np.bincount(best.ravel(), (surface[:, None] * shares).ravel())
    order = np.argsort(-mass, kind="stable")[:MOST]
    candidates = order[mass[order] >= least / 2]
    claimed = [np.where(best == word, shares, 0).sum(1) for word in candidates]
    names = np.array(claimed, np.float32).reshape(-1, len(surface)).T  # (M, C) probability of each candidate
    for group in synonym_groups(names, surface):
        phrases, likely = [words.phrases[number] for number in candidates[group]], names[:, group].sum(1)
        winners = np.isin(best[:, 0], candidates[group])
        is_partial = bool(surface[winners] @ (likely[winners] - LIKELY) < 0)
        if is_partial:  # in a short vocabulary the best word of many features is wrong
            winners &= likely >= LIKELY
        weight = surface[winners]
        if weight.sum() >= least:
            probability = float(weight @ likely[winners]) / float(weight.sum())
            rows = np.flatnonzero(has & winners[np.maximum(of, 0)])
            yield _Claim(level, tuple(phrases), rows, probability, is_partial)


def synonym_groups(names: Array, surface: Array) -> list[list[int]]:
    """Return groups of columns that name the same things.

    names: (M, C) probabilities of C words, the largest claim first; surface: (M,) area of each feature. A
    word a joins the first group whose head b, its first word, overlaps with it enough:
    sum_m s_m min(p_ma, p_mb) >= SAME max(sum_m s_m p_ma, sum_m s_m p_mb).
    """
    weighted = names.astype(np.float64) * surface[:, None]
    totals = weighted.sum(0)
    groups: list[list[int]] = []
    for word in range(names.shape[1]):
        for group in groups:
            head = group[0]
            common = np.minimum(weighted[:, word], weighted[:, head]).sum()
            if common >= SAME * max(totals[word], totals[head]):
                group.append(word)
                break
        else:
            groups.append([word])
    return groups


def _verified(describer: Describer, claim: _Claim, placed: bool) -> InventoryEntry | None:
    """Return an entry under the claim's first word that a query finds at half its area; None without one."""
    engine, areas, level = describer.engine, describer.areas, claim.level
    for phrase in claim.phrases:
        result = engine.run(phrase, LEVELS[level])
        fits = result.members if claim.is_partial else result.relevancy[level] > FLOOR
        agreed = claim.rows[fits[claim.rows]]
        if not result.found or 2 * areas[agreed].sum() < areas[claim.rows].sum():
            continue
        spots = _spots(describer, agreed) if placed else ()
        if spots or (not placed and len(agreed) >= LEAST_COUNT):
            others = tuple(other for other in claim.phrases if other != phrase)
            share = float(sum(spot.share for spot in spots))
            return InventoryEntry(phrase, others, level, claim.probability, result.peak, share, spots)
    return None


def _spots(describer: Describer, rows: Array) -> tuple[Spot, ...]:
    """Return the connected parts of Gaussians `rows` (M,), the largest first, without small ones."""
    engine, areas, found = describer.engine, describer.areas, []
    on_surface = engine.surface.rows
    parts = [on_surface[part] for part in engine.surface.parts(np.flatnonzero(np.isin(on_surface, rows)))]
    parts.sort(key=lambda part: -areas[part].sum())
    for own in parts:
        if len(own) < LEAST_COUNT or areas[own].sum() < LEAST_SPOT * areas[parts[0]].sum():
            continue
        weights = np.maximum(areas[own], 1e-300)
        positions = engine.scene.gaussians.means[own].astype(np.float64)
        centre, share = weights @ positions / weights.sum(), float(weights.sum()) / float(areas.sum())
        found.append(Spot(centre, axis_aligned_box(positions), own, share))
    return tuple(found)


# The outline: the scene's tree, each node with a name and its parts.


@dataclass(frozen=True, eq=False)
class Outline:
    """A node of the scene's tree with its name and parts."""

    node: int  # number in the tree
    level: int  # index into LEVELS
    word: Word | None  # the best name; None if no word of the vocabulary is likely
    count: int  # Gaussians
    share: float  # of the scene's surface, in [0, 1]
    centre: Array  # (3,) world units
    size: Array  # (3,) sides of the oriented box, longest first, world units
    votes: tuple[int, int]  # photographs with a mask of exactly this node, and those that show it without
    parts: tuple["Outline", ...]  # the largest first


def scene_outline(describer: Describer) -> tuple[Outline, ...]:
    """Return the scene's tree, the whole with the largest surface first.

    Small nodes are left out. Parts without a word, or with the word of the node they are in, are replaced by
    their own parts. As files may hold any tree, DEEPEST bounds its depth, and N * DEEPEST the Gaussians read.
    """
    tree, members, areas = describer.engine.tree, describer.engine.tree.gaussians(), describer.areas
    totals = members.sums(areas) / max(float(areas.sum()), 1e-300)
    large = np.flatnonzero((totals >= LEAST_SHARE) & (members.sizes >= LEAST_COUNT))
    parts: dict[int, list[int]] = {}
    for node in sorted(large.tolist(), key=lambda node: -totals[node]):
        parts.setdefault(int(tree.parents[node]), []).append(node)
    left = DEEPEST * len(areas)  # Gaussians that may still be read

    def name_of(node: int) -> Word | None:
        nonlocal left
        left -= int(members.sizes[node])
        if left < 0:
            return None
        rows, level = members[node], int(tree.levels[node])
        weights = np.maximum(areas[rows], 1e-300)
        return likely_name(describer.at_level(level, rows, weights, NAMES).words)

    def below(node: int, word: Word | None) -> Iterator[tuple[int, Word]]:
        waiting = parts.get(node, [])[::-1]
        while waiting:
            part = waiting.pop()
            own = name_of(part)
            if own is None or (word is not None and own.phrase.split(OR)[0] in word.phrase.split(OR)):
                waiting += parts.get(part, [])[::-1]
            else:
                yield part, own

    def shown(node: int, word: Word | None, depth: int = 0) -> Outline:
        rows = members[node]
        inside = [] if depth == DEEPEST else [shown(*part, depth + 1) for part in below(node, word)]
        weights = np.maximum(areas[rows], 1e-300)
        positions = describer.engine.scene.gaussians.means[rows].astype(np.float64)
        return Outline(
            node=node,
            level=int(tree.levels[node]),
            word=word,
            count=len(rows),
            share=float(totals[node]),
            centre=weights @ positions / weights.sum(),
            size=2 * oriented_box(positions).half_extents,
            votes=(int(tree.votes[node, 0]), int(tree.votes[node, 1])),
            parts=tuple(sorted(inside, key=lambda part: -part.share)),
        )

    return tuple(shown(node, name_of(node)) for node in parts.get(NO_NODE, []))


def export_labels(describer: Describer, path: Path) -> Path:
    """Write the scene to `path` (.ply) with labels, and return the `<name>.labels.json` beside it.

    Its Gaussians have the int properties `instance`, `part` and `class`, -1 for none: the node at the top of
    the outline, the smallest node in it that holds the Gaussian, and the index in the JSON's `classes` of the
    instance's most probable word. The JSON has the nodes of the outline, each with parent, level, word,
    class, number of Gaussians, centre, `box` (axis-aligned, from 2 % to 98 % of the Gaussians) and votes.
    """
    scene, members = describer.engine.scene, describer.engine.tree.gaussians()
    none = np.full(len(scene.gaussians), NO_NODE, np.int32)
    labels = {name: none.copy() for name in ("instance", "part", "class")}
    classes: list[str] = []
    nodes: list[dict[str, Any]] = []

    def place(outline: Outline, parent: int) -> None:
        rows, word = members[outline.node], outline.word
        name = None if word is None else word.phrase.split(OR)[0]
        if name is not None and name not in classes:
            classes.append(name)
        number = NO_NODE if name is None else classes.index(name)
        labels["part"][rows] = outline.node
        if parent == NO_NODE:
            labels["instance"][rows], labels["class"][rows] = outline.node, number
        node: dict[str, Any] = {"node": outline.node, "parent": parent, "level": LEVELS[outline.level]}
        node |= {"word": None if word is None else word.phrase, "class": number}
        if word is not None and describer.engine.basis.calibration is not None:
            node["probability"] = word.probability
        positions = scene.in_world(scene.gaussians.means[rows])
        node |= {"gaussians": outline.count, "centre": scene.in_world(outline.centre).tolist()}
        nodes.append(node | {"box": axis_aligned_box(positions).tolist(), "votes": list(outline.votes)})
        for part in outline.parts:  # whose Gaussians are a subset and get the number of the part
            place(part, outline.node)

    for outline in scene_outline(describer):
        place(outline, NO_NODE)
    beside = path.with_suffix(".labels.json")
    check_output_file(beside)
    kept = {name: values for name, values in scene.extras.items() if name not in labels}
    with atomic_path(beside) as temporary:
        counts = {"gaussians": len(scene.gaussians), "classes": classes, "nodes": nodes}
        temporary.write_text(json.dumps({"scene": path.name, **counts}, indent=1) + "\n", encoding="utf-8")
        save_scene(path, replace(scene, extras=kept | labels, path=path))
    return beside


# Suggested queries: examples, completions and corrections of the text that is typed.

EXAMPLES = 6
TRIES = 4  # candidates that are queried for each example wanted
# The basic colours of English (Berlin and Kay 1969): all that the demo encoder recognises on photographs.
COLOURS = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white", "grey")


@dataclass(frozen=True)
class Suggestions:
    """Suggested queries for a user who does not know the scene."""

    examples: tuple[str, ...] = ()  # each is found in the scene
    phrases: tuple[str, ...] = ()  # known to its encoder or phrasebook; those in the scene first


def suggest(engine: QueryEngine, at_most: int = EXAMPLES, progress: Progress = silent) -> Suggestions:
    """Return queries that are found, in seconds: inventory words, or colours if answers are guesses."""
    here = taught = tuple[str, ...]()
    with suppress(LangSplatError):  # no encoder, or one that knows none of the words: the phrasebook remains
        describer = Describer(engine, progress=progress)
        taught = describer.words[0].phrases
        entries = scene_inventory(describer, progress, placed=False)
        here = tuple(entry.phrase for entry in sorted(entries, key=lambda entry: -entry.probability))
    candidates = tuple(dict.fromkeys((*here, *engine.field.phrasebook)))
    asked = COLOURS if engine.basis.guesses else candidates[: TRIES * at_most]
    found = (phrase for phrase in asked if _is_found(engine, phrase))
    return Suggestions(tuple(islice(found, at_most)), tuple(dict.fromkeys((*candidates, *taught))))


def composed_examples(engine: QueryEngine, suggestions: Suggestions) -> tuple[str, ...]:
    """Return up to two compositional queries that are found: a part of a thing, and a thing near another."""
    here = suggestions.phrases[: TRIES * EXAMPLES]
    parts = (phrase for phrase in here if " " in phrase and is_part(phrase.split()[-1]))
    pairs = (f"{thing} near the {other}" for thing, other in permutations(suggestions.examples, 2))
    kinds = parts, islice(pairs, 12)
    found = (islice((phrase for phrase in kind if _is_found(engine, phrase)), 1) for kind in kinds)
    return tuple(chain.from_iterable(found))


def _is_found(engine: QueryEngine, phrase: str) -> bool:
    try:
        return run_phrase(engine, phrase).answer.found
    except LangSplatError:  # a stop word in a phrasebook, such as "of"
        return False


def completions(text: str, phrases: Sequence[str], at_most: int = 6) -> list[str]:
    """Return phrases that begin with `text`, then completions of its last word; none after a space."""
    typed = phrase_key(text)
    if not typed or text[-1:].isspace():
        return []
    begun, _, last = typed.rpartition(" ")
    whole = [phrase for phrase in phrases if phrase.startswith(typed) and phrase != typed]
    words = dict.fromkeys(word for phrase in phrases for word in phrase.split() if word.startswith(last))
    ended = [f"{begun} {word}" for word in words if word != last] if begun else []
    return list(dict.fromkeys((*whole, *ended)))[:at_most]


def corrected(text: str, near: Mapping[str, Sequence[str]]) -> str | None:
    """Return `text` with each unknown word replaced by the first in `near`; None if one has no near word."""
    if not all(near.values()):
        return None
    return " ".join(near[word][0] if near.get(word) else word for word in phrase_key(text).split(" "))
