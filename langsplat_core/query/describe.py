"""Reverse queries: words for a place, the inventory of a scene, and suggestions of what to ask.

    p(word | x)  =  softmax over words of  scale * (cos(x, word) - hub(word) / 2)

The hub of a word is its mean cosine with the meanings of the scene that are nearest to it. Some words lie
near every image and would be the answer everywhere ("hubs"); what is left of the cosine says how much
better a word fits here than where it fits anyway. It is cross-domain similarity local scaling ("Word
translation without parallel data", Conneau et al. 2018, equation 3): 2 cos(x, w) - hub(w) - hub(x), halved,
and without hub(x), which all words have in common.

The canonical phrases ("object", "things", "stuff", "texture") compete too: their share is the chance that no
word of the vocabulary fits.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice, PictureConfig, RasterSettings
from langsplat_core.errors import InputError, LangSplatError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.instances import axis_aligned_box, oriented_box
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.raster.render import pixel_weights
from langsplat_core.scene import LEVELS, NO_NODE, Camera, Codec, LanguageField
from langsplat_core.scene.language import phrase_key
from langsplat_core.scene.surface import surface_areas
from langsplat_core.semantics.relevancy import FLOOR
from langsplat_core.semantics.vocabulary import Bundled, bundled_vocabulary

# Logits per spread of phrases' cosines with a meaning: a probability is then right about so often, with the
# bundled encoder and with the geometry of CLIP (rooms 201 to 203, docs/searching.md).
WORD_SCALE = 6.0
ATTRIBUTE_SCALE = 3.4
NEAREST = 10  # meanings that make a word's hub, as in the paper
BANK = 4096  # meanings that are looked at for it, of codebooks; of other codecs fewer, since none is distinct
SAMPLES = 512
CERTAIN = 0.5  # probability from which a colour or material is said
NARROWEST = 1e-6  # spread; words that are all the same have none
CELLS = 8_000_000  # numbers of a block of meanings times words: 32 MB


@dataclass(frozen=True)
class Word:
    """A phrase and how probable it is, among its vocabulary."""

    phrase: str
    probability: float  # in [0, 1]


@dataclass(frozen=True, eq=False)
class WordScores:
    """A vocabulary as numbers: everything about it that does not depend on the place that is asked for."""

    phrases: tuple[str, ...]  # V
    vectors: Array  # (V + C, D) float32 unit; the last C stand for "none of these"
    hubs: Array  # (V + C,) float32, taken half
    scale: float  # of the softmax

    def vector(self, phrase: str) -> Array:
        """(D,) unit vector of one of the phrases."""
        return self.vectors[self.phrases.index(phrase)]

    def take(self, chosen: Array) -> "WordScores":
        """The phrases for which `chosen` (V,) bool is True; the canonical ones stay."""
        rows = np.append(chosen, np.ones(len(self.vectors) - len(chosen), bool))
        phrases = tuple(phrase for phrase, kept in zip(self.phrases, chosen, strict=True) if kept)
        return replace(self, phrases=phrases, vectors=self.vectors[rows], hubs=self.hubs[rows])

    def probabilities(self, codec: Codec, latents: Array) -> Array:
        """(M, d) latents with a meaning -> (M, V + C) float32, each row adding up to 1."""
        logits = np.float32(self.scale) * (codec.cosines(latents, self.vectors) - self.hubs / 2)
        shares = np.exp(logits - logits.max(1, keepdims=True))
        return shares / shares.sum(1, keepdims=True)

    def mixture(self, codec: Codec, latents: Array, weights: Array) -> Array:
        """(M, d) latents with a meaning and (M,) weights >= 0, not all zero -> (V + C,) float64: the mean of
        their probabilities. Answers are blended, never meanings: between two things lies a third."""
        latents, of = codec.unique(latents)
        weights = np.bincount(of, weights, minlength=len(latents))
        total = np.zeros(len(self.vectors))
        for part in self._blocks(len(latents)):
            total += weights[part] @ self.probabilities(codec, latents[part])
        return total / total.sum()

    def best(self, codec: Codec, latents: Array, count: int) -> tuple[Array, Array]:
        """(M, d) latents with a meaning -> (M, count) numbers of the most probable phrases, the best first,
        and their (M, count) float32 probabilities; fewer where the vocabulary has fewer."""
        count = min(count, len(self.phrases))
        if count == 0:
            return np.empty((len(latents), 0), np.int32), np.empty((len(latents), 0), np.float32)
        words = np.empty((len(latents), count), np.int32)
        shares = np.empty((len(latents), count), np.float32)
        for part in self._blocks(len(latents)):
            found = self.probabilities(codec, latents[part])[:, : len(self.phrases)]
            some = np.argpartition(-found, count - 1, axis=1)[:, :count]
            order = np.argsort(-np.take_along_axis(found, some, 1), axis=1, kind="stable")
            words[part] = np.take_along_axis(some, order, 1)
            shares[part] = np.take_along_axis(found, words[part], 1)
        return words, shares

    def _blocks(self, count: int) -> list[slice]:
        rows = max(1, CELLS // len(self.vectors))
        return [slice(start, start + rows) for start in range(0, count, rows)]


def likely_name(words: Sequence[Word]) -> Word | None:
    """The best word, or as many as are `LIKELY` together: "mug or cup"; None where all together are not."""
    for count in range(1, len(words) + 1):
        probability = sum(word.probability for word in words[:count])
        if probability >= LIKELY:
            return Word(OR.join(word.phrase for word in words[:count]), probability)
    return None


def build_words(field: LanguageField, phrases: tuple[str, ...], vectors: Array) -> WordScores:
    """Scores of names of things, from V phrases and their (V, D) unit vectors."""
    every, bank = np.concatenate([vectors, field.canonical]).astype(np.float32), meanings(field)
    return WordScores(phrases, every, hubs(every, bank), WORD_SCALE / _spread(field, vectors, bank))


def build_attributes(field: LanguageField, phrases: tuple[str, ...], vectors: Array) -> WordScores:
    """Scores of words of which a thing has one, such as colours, from V phrases and their (V, D) unit
    vectors. Few and all of one kind, they are no hubs."""
    scale = ATTRIBUTE_SCALE / _spread(field, vectors, meanings(field))
    return WordScores(phrases, vectors.astype(np.float32), np.zeros(len(vectors), np.float32), scale)


def _spread(field: LanguageField, vectors: Array, bank: Array) -> float:
    """Median, over meanings, of the standard deviation of cosines: of everyday phrases, else of the words."""
    texts = vectors if field.everyday is None else field.everyday
    spreads = (bank @ texts.T).std(1) if len(bank) and len(texts) > 1 else np.ones(1)
    return max(float(np.median(spreads)), NARROWEST)


def meanings(field: LanguageField) -> Array:
    """(B, D) float32 unit vectors of what the scene's Gaussians mean: every codeword that one of them has, or
    those of evenly spread Gaussians where there are no codewords."""
    latents, _ = field.codec.unique(field.latents[field.known])
    most = SAMPLES if field.codec.blends else BANK  # latents that are no numbers are all distinct meanings
    chosen = np.unique(np.linspace(0, len(latents) - 1, min(most, len(latents))).astype(np.int64))
    return field.codec.decode(latents[chosen])


def hubs(vectors: Array, bank: Array) -> Array:
    """(V, D) unit vectors of words, (B, D) of meanings -> (V,) float32 mean cosine with the nearest ones."""
    count = min(NEAREST, len(bank))
    if count == 0:
        return np.zeros(len(vectors), np.float32)
    near = np.partition(vectors @ bank.T, len(bank) - count, axis=1)[:, -count:]
    return near.mean(1, dtype=np.float64).astype(np.float32)


# The inventory of a scene: every word that is true in it, where, how sure.
#
# Every meaning of the scene has its best word, and so every Gaussian. Words that cover enough of the surface
# are candidates; those that claim the same meanings are one thing by two names ("mug" and "cup"); and what is
# listed was asked for, as a phrase, and found where it was claimed.

LEAST_SHARE = 5e-4  # of the scene's surface that a word, with others for the same, must be the best for
LEAST_SPOT = 0.15  # of its largest spot's surface: a smaller one is a splinter of a border
LEAST_COUNT = 12  # Gaussians of a spot
SAME = 0.5  # overlap of claims from which two words name the same thing
LIKELY = 0.5  # probability from which a word is listed
OR = " or "
NAMES = 3  # words, at most, that a node of the tree is called by
RUNNERS_UP = 5  # words per meaning that may be names for it
MOST = 200  # candidates per level, the largest first
ATTRIBUTES: tuple[Bundled, ...] = ("colours", "materials")


@dataclass(frozen=True, eq=False)
class Spot:
    """One connected place where a word is true."""

    centre: Array  # (3,) world units
    box: Array  # (2, 3) lower and upper corner, world units, between 2 % and 98 % of its Gaussians
    rows: Array  # (M,) int64 numbers of its Gaussians
    share: float  # of the scene's surface, in [0, 1]
    colour: Word | None
    material: Word | None


@dataclass(frozen=True, eq=False)
class Entry:
    """A word that is true in the scene."""

    phrase: str
    also: tuple[str, ...]  # other words for the same
    level: int  # index into LEVELS
    probability: float  # that it or a word of `also` is right, a mean over its surface
    score: float  # peak relevancy of the phrase, as a query gives it
    share: float  # of the scene's surface, in [0, 1]
    spots: tuple[Spot, ...]  # the largest first


@dataclass(frozen=True, eq=False)
class Outline:
    """A node of the scene's tree in words, with its parts."""

    node: int  # number in the tree
    level: int  # index into LEVELS
    word: Word | None  # the best name; None where nothing of the vocabulary is likely
    count: int  # Gaussians
    share: float  # of the scene's surface, in [0, 1]
    centre: Array  # (3,) world units
    size: Array  # (3,) sides of the oriented box, longest first, world units
    votes: tuple[int, int]  # photographs with a mask of just this, and those that show it without one
    parts: tuple["Outline", ...]  # the largest first


@dataclass(frozen=True, eq=False)
class _Claim:
    """A group of words that claim the same meanings at one level."""

    level: int
    phrases: tuple[str, ...]  # the most claimed first
    rows: Array  # (M,) int64 numbers of the Gaussians for which one of them is the best
    probability: float


def _claims(
    codec: Codec, latents: Array, of: Array, words: WordScores, level: int, areas: Array
) -> Iterator[_Claim]:
    """Groups of words at a level, those that cover most first. latents: (M, d) the distinct ones of the
    field; of: (N,) int64 number of each Gaussian's, -1 for none."""
    best, shares = words.best(codec, latents, RUNNERS_UP)
    if best.size == 0:  # no words, or nothing that means anything
        return
    has = of >= 0
    surface = np.bincount(of[has], areas[has], minlength=len(latents))
    least = LEAST_SHARE * max(float(areas.sum()), 1e-300)
    mass = np.bincount(best.ravel(), (surface[:, None] * shares).ravel())
    order = np.argsort(-mass, kind="stable")[:MOST]
    candidates = order[mass[order] >= least / 2]
    names = np.zeros((len(surface), len(candidates)), np.float32)  # (M, C) probability of each candidate
    for column, word in enumerate(candidates):
        names[:, column] = np.where(best == word, shares, 0).sum(1)
    for group in same_things(names, surface):
        numbers = candidates[group]
        winners = np.isin(best[:, 0], numbers)
        weight = surface[winners]
        if weight.sum() < least:
            continue
        probability = float(weight @ names[winners][:, group].sum(1)) / float(weight.sum())
        if probability < LIKELY:
            continue
        rows = np.flatnonzero(has & winners[np.maximum(of, 0)])
        yield _Claim(level, tuple(words.phrases[number] for number in numbers), rows, probability)


def same_things(names: Array, surface: Array) -> list[list[int]]:
    """(M, C) probabilities of C words, the most claimed first, for meanings of (M,) surface -> groups of
    columns that name the same. Two words do where most of what either claims is claimed by the other as well:
    sum_m s_m min(p_ma, p_mb) >= SAME max(sum_m s_m p_ma, sum_m s_m p_mb). A word joins the first group whose
    most claimed word it agrees with."""
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


# Words for Gaussians, for a pixel, and for a whole scene.


@dataclass(frozen=True)
class Words:
    """The most probable words for a place at one level."""

    level: int  # index into LEVELS
    words: tuple[Word, ...]  # the most probable first; none where nothing is known
    other: float  # probability that no word of the vocabulary fits
    known: float  # share of the place that has a meaning at this level, in [0, 1]
    colour: Word | None = None  # where one is `CERTAIN` enough
    material: Word | None = None


Levels = tuple[Words, ...]  # of subpart, part and whole


class Describer:
    """Reverse queries against one scene. The vocabulary is encoded once, here; a question costs milliseconds.
    Not for use by two threads at once."""

    def __init__(
        self, engine: QueryEngine, vocabulary: Sequence[str] | None = None, progress: Progress = silent
    ) -> None:
        """vocabulary: phrases for all levels, by default the bundled ones: everyday things, and below the
        level "whole" parts of things too. Those with words that the encoder was never taught are left out.
        Raises InputError for a scene without a language field and where no phrase is left, EncoderError as
        `QueryEngine.known_vectors` does."""
        things = tuple(vocabulary) if vocabulary is not None else bundled_vocabulary("things")
        parts = () if vocabulary is not None else bundled_vocabulary("parts")
        phrases = (*things, *parts)
        field = engine.field
        self.engine, self._known = engine, engine.field.known
        known, vectors = engine.known_vectors(phrases, progress)
        self.left_out: tuple[str, ...] = tuple(sorted(set(phrases) - set(known)))
        if not known:
            raise InputError(
                f"the encoder knows none of the vocabulary's {len(phrases)} phrases; name others, or use "
                "a scene made with OpenCLIP weights"
            )
        whole = np.isin(known, things)
        every = build_words(field, known, vectors)
        self.words: tuple[WordScores, WordScores, WordScores] = (every, every, every.take(whole))
        taught = [engine.known_vectors(bundled_vocabulary(name), progress) for name in ATTRIBUTES]
        self._attributes = [build_attributes(field, *pair) if pair[0] else None for pair in taught]

    @cached_property
    def areas(self) -> Array:
        """(N,) float64 surface of every Gaussian, see `surface_areas`."""
        return surface_areas(self.engine.scene.gaussians)

    def at_gaussians(self, rows: Array, weights: Array | None = None, top: int = 5) -> Levels:
        """Words for the Gaussians at `rows` (M indices, or a boolean mask of length N) taken together.
        weights: (M,) >= 0, how much each counts; by default its surface."""
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows
        counted = self.areas[rows] if weights is None else np.asarray(weights, np.float64)
        if weights is None and not counted.any():  # without any surface they still mean something
            counted = np.ones(len(rows))
        return tuple(self._at_level(level, rows, counted, top) for level in range(len(LEVELS)))

    def inventory(self, progress: Progress = silent) -> list[Entry]:
        """Every word that is true in the scene, whole things first, then by surface. A word is listed once,
        at the coarsest level where it is claimed and found."""
        field = self.engine.field
        of = np.full(self._known.shape, -1, np.int64)
        latents, of[self._known] = field.codec.unique(field.latents[self._known])
        entries: list[Entry] = []
        named: set[str] = set()
        for level in reversed(range(len(LEVELS))):
            claims = list(_claims(field.codec, latents, of[level], self.words[level], level, self.areas))
            for done, claim in enumerate(claims):
                progress("checking words", done / len(claims), LEVELS[level])
                if named.isdisjoint(claim.phrases):
                    entry = self._verified(claim)
                    if entry is not None:
                        entries.append(entry)
                        named.update(claim.phrases)
            progress("checking words", 1.0, LEVELS[level])
        return entries

    def outline(self, least: float = LEAST_SHARE) -> tuple[Outline, ...]:
        """The scene's tree, wholes with the largest surface first. Left out are nodes of less than `least` of
        the scene's surface, and parts that say nothing new: without a word, or with that of what they are in;
        their own parts take their place."""
        tree, members = self.engine.tree, self.engine.tree.gaussians()
        every = max(float(self.areas.sum()), 1e-300)
        totals = np.array([self.areas[rows].sum() for rows in members]) / every
        large = [
            node for node, rows in enumerate(members) if totals[node] >= least and len(rows) >= LEAST_COUNT
        ]
        large.sort(key=lambda node: -totals[node])
        parts: dict[int, list[int]] = {}
        for node in large:
            parts.setdefault(int(tree.parents[node]), []).append(node)

        def below(node: int, word: Word | None) -> Iterator[Outline]:
            for part in parts.get(node, []):
                own = self._name(part, members[part])
                if own is None or (word is not None and own.phrase.split(OR)[0] in word.phrase.split(OR)):
                    yield from below(part, word)
                else:
                    yield shown(part, own)

        def shown(node: int, word: Word | None) -> Outline:
            rows = members[node]
            weights = np.maximum(self.areas[rows], 1e-300)
            positions = self.engine.scene.gaussians.means[rows].astype(np.float64)
            return Outline(
                node=node,
                level=int(tree.levels[node]),
                word=word,
                count=len(rows),
                share=float(totals[node]),
                centre=weights @ positions / weights.sum(),
                size=2 * oriented_box(positions).half_extents,
                votes=(int(tree.votes[node, 0]), int(tree.votes[node, 1])),
                parts=tuple(sorted(below(node, word), key=lambda part: -part.share)),
            )

        return tuple(shown(node, self._name(node, members[node])) for node in parts.get(NO_NODE, []))

    def _name(self, node: int, rows: Array) -> Word | None:
        level, weights = int(self.engine.tree.levels[node]), np.maximum(self.areas[rows], 1e-300)
        return likely_name(self._at_level(level, rows, weights, NAMES).words)

    def _verified(self, claim: _Claim) -> Entry | None:
        """The claim as an entry under the first of its words that a query finds there, if any."""
        areas, level = self.areas, claim.level
        for phrase in claim.phrases:
            vector = self.words[level].vector(phrase)
            result = self.engine.run(phrase, get_args(LevelChoice)[1 + level], vector=vector)  # after "auto"
            agreed = claim.rows[result.relevancy[level, claim.rows] > FLOOR]
            if not result.found or 2 * areas[agreed].sum() < areas[claim.rows].sum():
                continue
            spots = tuple(self._spot(level, part) for part in self._solid(agreed))
            if spots:
                others = tuple(other for other in claim.phrases if other != phrase)
                share = float(sum(spot.share for spot in spots))
                return Entry(phrase, others, level, claim.probability, result.peak, share, spots)
        return None

    def _solid(self, rows: Array) -> list[Array]:
        """The connected parts of Gaussians `rows` (M,), the largest first, without splinters."""
        surface, areas = self.engine.surface, self.areas
        numbers = np.flatnonzero(np.isin(surface.rows, rows))
        found = [surface.rows[part] for part in surface.parts(numbers).each()]
        parts = sorted(found, key=lambda part: -areas[part].sum())
        least = LEAST_SPOT * areas[parts[0]].sum() if parts else 0.0
        return [part for part in parts if len(part) >= LEAST_COUNT and areas[part].sum() >= least]

    def _spot(self, level: int, rows: Array) -> Spot:
        weights = np.maximum(self.areas[rows], 1e-300)
        positions = self.engine.scene.gaussians.means[rows].astype(np.float64)
        colour, material = self._looks(self.engine.field.latents[level, rows], weights)
        return Spot(
            centre=weights @ positions / weights.sum(),
            box=axis_aligned_box(positions),
            rows=rows,
            share=float(weights.sum()) / float(self.areas.sum()),
            colour=colour,
            material=material,
        )

    def _looks(self, latents: Array, weights: Array) -> tuple[Word | None, Word | None]:
        """Colour and material of (M, d) latents with a meaning, weighted by (M,), where one is certain."""
        colour, material = (self._certain(words, latents, weights) for words in self._attributes)
        return colour, material

    def _certain(self, words: WordScores | None, latents: Array, weights: Array) -> Word | None:
        if words is None:
            return None
        shares = words.mixture(self.engine.field.codec, latents, weights)
        best = int(shares.argmax())
        return Word(words.phrases[best], float(shares[best])) if shares[best] >= CERTAIN else None

    def _at_level(self, level: int, rows: Array, weights: Array, top: int) -> Words:
        field = self.engine.field
        known = self._known[level, rows] & (weights > 0)
        total, seen = float(weights.sum()), float(weights[known].sum())
        if not known.any():
            return Words(level, (), 0.0, 0.0)
        latents, weights = field.latents[level, rows[known]], weights[known]
        names = self.words[level]
        shares = names.mixture(field.codec, latents, weights)
        best = np.argsort(-shares[: len(names.phrases)], kind="stable")[: max(top, 0)]
        words = tuple(Word(names.phrases[i], float(shares[i])) for i in best)
        other = float(shares[len(names.phrases) :].sum())
        return Words(level, words, other, seen / total, *self._looks(latents, weights))


# The surface under one pixel: where it is, what it is called, and how relevant it is to what was asked.


@dataclass(frozen=True, eq=False)
class Pointed:
    """The surface that one pixel shows, in words."""

    position: Array  # (3,) world units
    depth: float  # camera z, world units
    words: Levels  # at each level the most probable
    relevancy: tuple[float, ...]  # in [0, 1], of each answer at its level


def look_at_pixel(
    rasterizer: LiftingRasterizer,
    describer: Describer,
    camera: Camera,
    pixel: tuple[int, int],
    results: Sequence[QueryResult] = (),
    top: int = 3,
    settings: RasterSettings | None = None,
) -> Pointed | None:
    """The surface that `camera` sees at `pixel` (column, row) of its image; None where that is mostly empty.
    Every Gaussian counts by its blending weight there; the surface is at the median of their depths, as the
    rasterizers have it. `settings` of image formation: by default the scene's own."""
    scene = describer.engine.scene
    rows, weights = pixel_weights(scene, camera, pixel, rasterizer, settings)
    total = float(weights.sum())
    if total <= PictureConfig().alpha_gate:
        return None
    means = scene.gaussians.means[rows].astype(np.float64)
    depths = means @ camera.rotation[2] + camera.world_to_camera[2, 3]
    order = np.argsort(depths, kind="stable")
    median = order[np.searchsorted(np.cumsum(weights[order], dtype=np.float64), 0.5 * total)]
    depth = float(depths[median])
    centre = (pixel[0] + 0.5, pixel[1] + 0.5)
    relevancy = (float(weights @ result.relevancy[result.level][rows]) / total for result in results)
    return Pointed(
        position=camera.unproject(centre, depth),
        depth=depth,
        words=describer.at_gaussians(rows, weights, top),
        relevancy=tuple(relevancy),
    )


# Suggestions of what to ask: examples that a scene answers, and phrases that begin like what is being typed.

EXAMPLES = 6
TRIES = 4  # candidates that are asked for each example wanted


@dataclass(frozen=True)
class Suggestions:
    """Examples and phrases for someone who does not know a scene."""

    examples: tuple[str, ...] = ()  # each is found in the scene
    phrases: tuple[str, ...] = ()  # that its encoder or its phrasebook knows, what is in the scene first


def suggest(engine: QueryEngine, at_most: int = EXAMPLES, progress: Progress = silent) -> Suggestions:
    """Examples for a scene with a language field, from its inventory and phrasebook, each asked and found;
    none where nothing can be asked. Seconds: keep what it returns."""
    book = tuple(engine.field.phrasebook)
    here: tuple[str, ...] = ()
    taught: tuple[str, ...] = ()
    try:
        describer = Describer(engine, progress=progress)
        taught = describer.words[0].phrases
        entries = sorted(describer.inventory(progress), key=lambda entry: -entry.probability)
        here = tuple(entry.phrase for entry in entries)
    except LangSplatError:  # no encoder here, or one that knows none of the words: the phrasebook is left
        pass
    candidates = tuple(dict.fromkeys((*here, *book)))
    found = (phrase for phrase in candidates[: TRIES * at_most] if _is_found(engine, phrase))
    return Suggestions(tuple(islice(found, at_most)), tuple(dict.fromkeys((*candidates, *taught))))


def _is_found(engine: QueryEngine, phrase: str) -> bool:
    try:
        return run_phrase(engine, phrase).answer.found
    except LangSplatError:  # "of", in someone's phrasebook
        return False


def completions(text: str, phrases: Sequence[str], at_most: int = 6) -> list[str]:
    """Phrases that go on from what was typed, in the order of `phrases`: those that begin with all of it,
    then what was typed with its last word completed. Nothing where no text is, or a word has ended."""
    typed = phrase_key(text)
    if not typed or text[-1:].isspace():
        return []
    begun, _, last = typed.rpartition(" ")
    whole = [phrase for phrase in phrases if phrase.startswith(typed) and phrase != typed]
    words = dict.fromkeys(word for phrase in phrases for word in phrase.split() if word.startswith(last))
    ended = [f"{begun} {word}" for word in words if word != last] if begun else []
    return list(dict.fromkeys((*whole, *ended)))[:at_most]


def corrected(text: str, near: Mapping[str, Sequence[str]]) -> str | None:
    """`text` with every unknown word replaced by the nearest known one; None where one has none. near: as of
    `UnknownWordError`."""
    if not all(near.values()):
        return None
    words = phrase_key(text).split(" ")
    return " ".join(near[word][0] if near.get(word) else word for word in words)
