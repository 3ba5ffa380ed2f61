"""The query engine: from a phrase to its answer in a scene.

A phrase becomes a text vector (`text_vectors`), the vector a relevancy of every Gaussian (`lookup`), these
become fits of the regions of the scene's tree (`answers`), and the fits an answer (`rule`).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np
import scipy

from langsplat_core.arrays import Array, check_array
from langsplat_core.config import LevelChoice
from langsplat_core.errors import EncoderError, InputError, UnknownWordError
from langsplat_core.io.scenes import load_scene
from langsplat_core.io.sidecar import SUFFIX, Words
from langsplat_core.progress import Progress, silent
from langsplat_core.query import answers
from langsplat_core.query import taught as taught_words
from langsplat_core.query.answers import AnswerRule, QueryResult, Regions
from langsplat_core.query.grammar import STOP_WORDS, check_names, named, only, thing_and_part
from langsplat_core.query.instances import Instance, find_instances, find_wholes
from langsplat_core.query.lookup import Lookup, Relevancy, through_cells
from langsplat_core.query.rule import Bars, bars_of, decide, on_things, scaling_of
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    LEVELS,
    Calibration,
    LanguageField,
    Scene,
    TaughtWord,
    Tree,
)
from langsplat_core.scene.language import LONGEST_NAME, MOST_SHOWN, phrase_key, split_phrases, tidy
from langsplat_core.scene.surface import Surface, build_surface, build_tree, surface_weights
from langsplat_core.semantics.encoders import DEMO, DEMO_ELSEWHERE, kept_calibration, same_vectors
from langsplat_core.semantics.relevancy import FEWEST, Scale, TextEncoder, everyday_vectors, relevancy_of

BATCH = 512  # phrases that are encoded at a time
SAMPLE = 200_000  # Gaussians, about, that tell which regions touch; the surface of a million takes 5 s

LoadEncoder = Callable[[str], TextEncoder]  # from a hub id, a folder or "demo"; may raise EncoderError


def no_field(scene: Scene) -> str:
    """Return the reason why a scene has no language field."""
    none = f"no language field (NAME{SUFFIX}) lies beside it; `langsplat train` makes one"
    return f"it can be looked at, not searched: {next((why for why in scene.unread if SUFFIX in why), none)}"


def searchable(path: Path) -> Scene:
    """Return the scene of a file; InputError if it has no language field."""
    scene = load_scene(path)
    if scene.language is None:
        raise InputError(f"{path}: {no_field(scene)}")
    return scene


@dataclass(frozen=True)
class Basis:
    """The encoder and calibration behind the answers in a scene, in words for people."""

    encoder: str  # as the scene names it
    calibration: str | None  # scenes in which probabilities were calibrated; None: there are none
    short: str  # one line
    long: str  # the same with consequences and remedy
    guesses: bool  # True for the demo encoder outside the rooms that it was made for


class QueryEngine:
    """Queries against one scene.

    Everything that depends on the scene alone is computed at the first query, and the text encoder is loaded
    when a phrase first needs it. Several threads may query at once; they take turns at the encoder.
    """

    def __init__(
        self,
        scene: Scene,
        load_encoder: LoadEncoder | TextEncoder | None = None,
        *,
        encoder_id: str = "",
        exact: bool = False,
        rule: AnswerRule = "regions",
        words: Words | None = None,
    ) -> None:
        """Prepare queries against a scene; nothing is computed yet.

        load_encoder: an encoder or a function that loads one; without it, only phrases of the scene's
        phrasebook are answered. encoder_id: in place of the one that the scene names. exact: compare every
        latent itself instead of its cell, as a reference for the cells. rule: "regions" becomes "peak" if
        neither scene nor encoder has everyday phrases. words: the user's, before the scene's; EncoderError if
        they are of another encoder.
        """
        given: Any = load_encoder
        if isinstance(scene, str | Path) or isinstance(given, str):
            raise InputError("no name alone; say QueryEngine(load_scene(path), load_text_encoder(name))")
        self.scene = scene
        self.exact = exact
        self._rule: AnswerRule = rule
        self._load_encoder: Any = (lambda _: given) if hasattr(given, "encode_texts") else given
        self._encoder_id = encoder_id
        self._encoder: TextEncoder | None = None
        self._encoder_checked = False
        self._turn = RLock()  # guards the encoder, whose tokenizer is not thread-safe
        # Vectors of phrases that need no encoding, 2 KB each at D = 512.
        self._vectors: dict[str, Array] = {} if scene.language is None else dict(scene.language.phrasebook)
        taught = () if scene.language is None else scene.language.taught
        if words is not None:
            check_words(self.field, words)
            taught += words.words
        self.taught: dict[str, TaughtWord] = {word.key: word for word in taught}

    # Answers.

    def run(self, phrase: str, level: LevelChoice = "auto", progress: Progress = silent) -> QueryResult:
        """Answer `phrase` as one name; a taught word by its examples. Raises as `text_vectors` does.

        The level is chosen per scene and not per view, so that images do not flicker between levels. "Lid of
        the teapot" is one name here; `run_phrase` parses it.
        """
        return self.run_many([phrase], level, progress)[0]

    def run_many(
        self, phrases: Sequence[str], level: LevelChoice = "auto", progress: Progress = silent
    ) -> list[QueryResult]:
        """Return the answers of `run` to several phrases, which are encoded and compared together."""
        if level not in ("auto", *LEVELS):
            raise InputError(f"no level {level!r}; choose auto or one of {', '.join(LEVELS)}")
        if isinstance(phrases, str) or not all(isinstance(phrase, str) for phrase in phrases):
            raise InputError("a phrase is text: run('blue gift'), or run_many(['cup', 'lamp']) for several")
        texts = [phrase for phrase in phrases if not self.is_taught(phrase)]
        vectors = self.text_vectors(texts, progress)  # first, so that a refused phrase leaves nothing cached
        relevancies = self._lookup.relevancies(vectors) if texts else iter(())
        others, found = self._fits_of_names(texts), []
        for phrase in phrases:
            progress(f"searching '{tidy(phrase)}'", 0.5)
            if self.is_taught(phrase):
                found.append(self._by_examples(self.taught[phrase_key(phrase)], level))
            else:
                found.append(self._answer(tidy(phrase), next(relevancies), level, others))
            vars(found[-1])["engine"] = self  # `replace` would compute its deferred arrays
        return found

    def relevancy(self, vector: Array) -> Array:
        """Return (3, N) float32 relevancy per level and Gaussian of a (D,) unit text vector."""
        return next(self._lookup.relevancies(vector[None]))()

    def _fits_of_names(self, phrases: Sequence[str]) -> dict[str, Array]:
        """Return the (R,) own fits of the wholes and parts in `phrases`, as far as the encoder knows them."""
        wanted = dict.fromkeys(name for phrase in phrases for name in thing_and_part(tidy(phrase)))
        names = [name for name in wanted if self.is_known(name) and self.bars is not None]
        relevancies = self._lookup.relevancies(self.text_vectors(names)) if names else ()
        found = zip(names, relevancies, strict=True)
        return {name: self._own_fits(relevancy) for name, relevancy in found}

    def _own_fits(self, relevancy: Relevancy) -> Array:
        return self.scale.fit(self._mixtures @ relevancy.values)

    def is_known(self, name: str) -> bool:
        """Return True if the encoder knows all words of a phrase, and it is no taught word."""
        try:
            return bool(name) and not (self.is_taught(name) or self.unknown_words(name))
        except EncoderError:
            return False

    def _answer(
        self, phrase: str, relevancy: Relevancy, level: LevelChoice, others: dict[str, Array]
    ) -> QueryResult:
        means = self.scene.gaussians.means
        if self.bars is None:
            return answers.by_peak(
                phrase, relevancy(), means, self.surface, self.scale, self.field.found, level
            )
        thing, part = map(others.get, thing_and_part(phrase))
        fits, on = [self._own_fits(relevancy)], None
        if thing is not None:
            fits += [] if part is None else [part]
            on = on_things(self.regions.table, thing, self.touching)
        sought = named(phrase)
        judged = self.bars, scaling_of(self.calibration, sought, phrase), on
        decision = decide(self.regions.table, fits, sought, level, *judged)
        return answers.by_regions(phrase, relevancy, decision, means, self.regions)

    def run_inside(
        self, names: Sequence[str], members: Array, level: LevelChoice, calibration: Calibration | None
    ) -> QueryResult:
        """Answer a part, by the mean over its `names`, among the regions of an instance, `members` (N,) bool.

        The verdict is by the first name, among these regions. Raises as `text_vectors` does.
        """
        assert self.bars is not None
        assert self.chance is not None
        asked = list(self._lookup.relevancies(self.text_vectors(names)))
        relevancy = replace(asked[0], values=np.mean([one.values for one in asked], axis=0))
        fits, on, table = list(map(self._own_fits, asked)), self.regions.mostly(members), self.regions.table
        bars = self.bars if calibration else bars_of(table, self.chance, on)
        decision = decide(table, fits, "inside", level, bars, scaling_of(calibration, "inside", names[0]), on)
        return answers.by_regions(names[0], relevancy, decision, self.scene.gaussians.means, self.regions)

    def instances(self, result: QueryResult, at_most: int | None = None) -> tuple[Instance, ...]:
        """Return the instances among the members of an answer, best first, at most `at_most`."""
        wholes, join = self.tree.voted_wholes, result.level == len(LEVELS) - 1
        members, even, gaussians = result.members, result.even, self.scene.gaussians
        if join and self.bars is not None:  # by the rule "peak", relevancies vary and need smoothing
            found = find_wholes(gaussians, members, even, wholes, at_most)
            if found is not None:
                return found
        return find_instances(self.surface, gaussians, members, even, at_most, wholes, join)

    # Data that answers are computed from, each made when it is first needed.

    @property
    def field(self) -> LanguageField:
        """The scene's language field; InputError if it has none."""
        if (field := self.scene.language) is None:
            raise InputError(no_field(self.scene))
        return field

    @property
    def rule(self) -> AnswerRule:
        """Rule for answers: "regions" if there are everyday phrases to compare with, else "peak"."""
        return "regions" if self.scale.everyday is not None else "peak"

    @property
    def scale(self) -> Scale:
        """Scale that turns cosines into relevancies."""
        field = self.field
        return Scale(field.canonical, self._everyday, field.temperature)

    @property
    def calibration(self) -> Calibration | None:
        """The calibration of probabilities: the scene's own, else the user's; None by the rule "peak"."""
        return self.field.calibration or self._kept if self.rule == "regions" else None

    @cached_property
    def _kept(self) -> Calibration | None:
        """The user's own calibration for the scene's encoder."""
        return kept_calibration(self.field.encoder_id, self.field.canonical)

    @cached_property
    def _lookup(self) -> Lookup:
        return Lookup(self.field if self.exact else through_cells(self.field), self.scale)

    @cached_property
    def _mixtures(self) -> "scipy.sparse.csr_matrix":
        return self.regions.mixtures(self._lookup.features, self._lookup.count + 1)

    @cached_property
    def surface(self) -> Surface:
        """The surface of the scene's Gaussians; takes 0.1 s for 80 000."""
        return build_surface(self.scene.gaussians)

    @cached_property
    def tree(self) -> Tree:
        """The scene's own tree, else one that is built from its surface."""
        field = self.field
        if field.tree is not None:
            return field.tree
        return build_tree(self.surface, field.codec, field.latents, field.known)

    @cached_property
    def regions(self) -> Regions:
        """The tree's nodes at each level."""
        return answers.build_regions(self.tree, surface_weights(self.scene.gaussians))

    @cached_property
    def touching(self) -> Array:
        """The (P, 2) pairs of wholes that may be pieces of one thing, see `touching_wholes`."""
        return self.touching_in(SAMPLE)

    def touching_in(self, sample: int) -> Array:
        """Return what `touching` has, by the surface of about `sample` of the Gaussians."""
        gaussians = self.scene.gaussians
        some = np.arange(0, len(gaussians), len(gaussians) // sample + 1)
        surface = self.surface if len(some) == len(gaussians) else build_surface(gaussians.take(some))
        return answers.touching_wholes(self.regions, surface.ends, some[surface.rows])

    @cached_property
    def chance(self) -> Array | None:
        """The (R, V) fits of everyday phrases in the regions of all levels; None without such phrases."""
        if self.rule == "peak":
            return None
        return answers.chance_in(self.regions.table, self._mixtures, self._lookup, self.scale)

    @cached_property
    def bars(self) -> Bars | None:
        """The best fits of everyday phrases in the scene; None without such phrases."""
        return None if self.chance is None else bars_of(self.regions.table, self.chance)

    @property
    def basis(self) -> Basis:
        """The basis of answers, as far as it is known: nothing is loaded for it."""
        field = self.field
        everyday = None if self._rule == "peak" else self.__dict__.get("_everyday", _enough(field.everyday))
        name = "demo encoder" if field.encoder_id == DEMO else field.encoder_id
        guesses = field.encoder_id == DEMO and field.calibration is None
        calibration = None
        if guesses:
            short, long = f"{name}, made for drawn rooms: guesses here", DEMO_ELSEWHERE
        elif everyday is None:
            short = f"{name}, as published: no everyday phrases to compare with"
            long = f"{short}. Found is a relevancy of {field.found:g} or more, without percentages"
        elif field.calibration is None and self._kept is None:
            short = f"{name}, no calibration here: found is more than by chance"
            long = (
                f"{short}. Percentages are of phrases for nothing here that fit as well (found: up to 5); "
                "probabilities need a calibration in such scenes"
            )
        elif field.calibration is None:
            short, calibration = f"{name}, calibrated by `langsplat doctor`", "the bundled room"
            long = f"{short}, from drawn rooms: percentages hold there, and may be off in this scene"
        else:
            short, calibration = f"{name}, calibrated in drawn rooms", "drawn rooms"
            long = f"{short}. Percentages hold in such rooms, and this scene is one"
        return Basis(field.encoder_id, calibration, short, long, guesses)

    # Text vectors.

    def load_encoder(self, progress: Progress = silent) -> TextEncoder:
        """Return the text encoder, which the first call loads, in seconds; EncoderError if that fails."""
        with self._turn:
            if self._encoder is None:
                if self._load_encoder is None:
                    raise EncoderError(
                        "without a text encoder only the phrases in the scene's phrasebook can be asked; "
                        f"the scene was made with {self.field.encoder_id}"
                    )
                progress("loading the text encoder", 0.1)
                self._encoder = self._load_encoder(self._encoder_id or self.field.encoder_id)
            return self._encoder

    def unknown_words(self, phrase: str) -> tuple[str, ...]:
        """Return the words of `phrase` that the encoder was never taught. Raises as `load_encoder` does."""
        key = phrase_key(phrase)
        return () if key in self.taught or key in self._vectors else self.load_encoder().unknown_words(key)

    def text_vectors(self, phrases: Sequence[str], progress: Progress = silent) -> Array:
        """Return (Q, D) unit vectors of phrases, from the scene's phrasebook, else encoded together.

        Raises InputError for an empty phrase and one of stop words alone, UnknownWordError for words that the
        encoder was never taught, and EncoderError if the encoder cannot be loaded or is not the scene's.
        """
        keys = list(map(phrase_key, phrases))
        fresh = [key for key in dict.fromkeys(keys) if key not in self._vectors]
        for key in fresh:
            check_names(key.split())
        if fresh:
            encoder = self.load_encoder(progress)
            with self._turn:
                if unknown := dict.fromkeys(word for key in fresh for word in encoder.unknown_words(key)):
                    near = {word: encoder.near_words(word) for word in unknown}
                    raise UnknownWordError(near, "use other words, or a scene made with OpenCLIP weights")
                self._encode(encoder, fresh)
        return self._stacked(keys)

    def known_vectors(
        self, phrases: Iterable[str], progress: Progress = silent
    ) -> tuple[tuple[str, ...], Array]:
        """Return the keys of `phrases` whose words the encoder was taught, each once, and (V, D) vectors.

        Raises EncoderError if the encoder cannot be loaded or is not the scene's.
        """
        keys = tuple(dict.fromkeys(map(phrase_key, phrases)))
        fresh = [key for key in keys if key not in self._vectors and not only(STOP_WORDS, key.split())]
        if fresh:
            encoder = self.load_encoder(progress)
            progress("loading the text encoder", 1.0)
            self._encode(encoder, [key for key in fresh if not encoder.unknown_words(key)], progress)
        known = tuple(key for key in keys if key in self._vectors)
        return known, self._stacked(known)

    def _stacked(self, keys: Sequence[str]) -> Array:
        vectors = [self._vectors[key] for key in keys]
        return np.stack(vectors) if vectors else np.zeros((0, self.field.codec.vector_dim), np.float32)

    def _encode(self, encoder: TextEncoder, keys: Sequence[str], progress: Progress = silent) -> None:
        """Encode phrases in batches and keep their vectors; EncoderError if `encoder` is not the scene's."""
        for start in range(0, len(keys), BATCH):
            batch = list(keys[start : start + BATCH])
            with self._turn:
                self._check_encoder(encoder)
                vectors = np.asarray(encoder.encode_texts(batch), np.float32)
            self._vectors.update(zip(batch, vectors, strict=True))
            progress("reading the vocabulary", (start + len(batch)) / len(keys))

    def _check_encoder(self, encoder: TextEncoder) -> None:
        """Raise EncoderError unless `encoder` makes the scene's canonical vectors: others give noise."""
        if self._encoder_checked:
            return
        own, made_with = self.field.canonical, self.field.encoder_id
        canonical = np.asarray(encoder.encode_texts(list(CANONICAL_PHRASES)), np.float64)
        if not same_vectors(canonical, own):
            raise EncoderError(
                f"the scene was made with other weights of {made_with}, vectors of {own.shape[1]} numbers; "
                "give those with --encoder, or make the scene again"
            )
        self._encoder_checked = True

    @cached_property
    def _everyday(self) -> Array | None:
        """The scene's own everyday vectors, else the encoder's; None by the rule "peak" or if too few."""
        if self._rule == "peak":
            return None
        if self.field.everyday is not None:
            return _enough(self.field.everyday)
        try:
            encoder = self.load_encoder()
            with self._turn:
                self._check_encoder(encoder)
                return everyday_vectors(encoder)
        except EncoderError:
            return None

    # Taught words.

    @cached_property
    def word_space(self) -> taught_words.WordSpace:
        """The scene's regions in the space where taught words are compared."""
        return taught_words.build_word_space(self.field, self.regions, self.tree.votes[:, 0])

    def is_taught(self, phrase: str) -> bool:
        """Return True if a phrase is a taught word, which is answered by its examples."""
        return phrase_key(phrase) in self.taught

    def teach(self, name: str, members: Array, level: LevelChoice = "auto") -> TaughtWord:
        """Learn `name` for the features of `members` (N,) bool; "auto": at the level of their likest region.

        From now on the name is answered by its examples and not as text. Taught again, at its own level, it
        gets one more example. Nothing is written. Raises InputError for an unusable name, for members without
        a feature, and for a word that was taught at another level or has `MOST_SHOWN` examples.
        """
        tidied = tidy(name)
        unsayable = only(STOP_WORDS, phrase_key(name).split()) or split_phrases(name) != [tidied]
        if unsayable or len(tidied) > LONGEST_NAME or "," in tidied:
            raise InputError(
                f"'{tidied[:LONGEST_NAME]}' cannot be a name; give one of at most {LONGEST_NAME} characters, "
                "without commas and semicolons, such as 'grandma's vase'"
            )
        if (known := self.taught.get(phrase_key(name))) is not None and len(known.vectors) >= MOST_SHOWN:
            raise InputError(f"'{tidied}' was shown {MOST_SHOWN} times, which is the most; remove it first")
        if known is not None and level not in ("auto", LEVELS[known.level]):
            raise InputError(f"'{tidied}' was taught at level {LEVELS[known.level]}; teach it there again")
        word = self._word_of(tidied, members, level if known is None else LEVELS[known.level])
        if known is not None:
            vectors = np.concatenate([known.vectors, word.vectors])
            word = replace(known, vectors=vectors, rivals=np.append(known.rivals, word.rivals))
        self.taught[word.key] = word
        return word

    def like(self, members: Array) -> QueryResult:
        """Answer with all that resembles `members` (N,) bool, themselves included; no word is kept."""
        return self._by_examples(self._word_of("more like this", members, "auto"), "auto")

    def _word_of(self, name: str, members: Array, level: str) -> TaughtWord:
        members = np.asarray(members)
        check_array("members", members, ("N",), {"N": len(self.field)}, bool)
        at = self.regions.level_of(members) if level == "auto" else LEVELS.index(level)
        return taught_words.of_example(self.word_space, self.field, self.regions, name, members, at)

    def _by_examples(self, word: TaughtWord, level: LevelChoice) -> QueryResult:
        means = self.scene.gaussians.means
        return taught_words.by_examples(word, self.word_space, self.regions, means, level)

    def compare(self, phrase: str, vectors: Array, level: int) -> tuple[Array, Array]:
        """Return the (M,) cosines of a phrase with (M, D) unit image vectors at a level, and (M,) fits."""
        if self.is_taught(phrase):
            return taught_words.compare(self.taught[phrase_key(phrase)], self.word_space, vectors, level)
        cosines = vectors @ self.text_vectors([phrase])[0]
        zero, rate = self.scale.of(vectors @ self.scale.texts.T)
        return cosines, self.scale.fit(relevancy_of(cosines, zero, rate))


def check_words(field: LanguageField, words: Words) -> None:
    """Raise EncoderError unless taught words are of a field's encoder, by its canonical vectors."""
    if not same_vectors(words.canonical, field.canonical):
        which = f"{words.path}: these words" if words.path else "these words"
        raise EncoderError(
            f"{which} were taught with {words.encoder_id}, the scene was made with {field.encoder_id}; "
            "teach them in a scene of that encoder"
        )


def _enough(everyday: Array | None) -> Array | None:
    return None if everyday is None or len(everyday) < FEWEST else everyday
