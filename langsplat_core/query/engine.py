"""The query engine: from a phrase to its answer in a scene.

A phrase becomes a text vector (`texts`), the vector a relevancy of every Gaussian (`lookup`), these
become fits of the regions of the scene's tree (`answers`), and the fits an answer (`rule`).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy

from langsplat_core.arrays import Array, check_array
from langsplat_core.config import LevelChoice
from langsplat_core.errors import EncoderError, InputError, expect
from langsplat_core.io.scenes import load_scene
from langsplat_core.io.sidecar import SUFFIX, Words
from langsplat_core.progress import Progress, silent
from langsplat_core.query import answers
from langsplat_core.query import taught as taught_words
from langsplat_core.query.answers import AnswerRule, QueryResult, Regions
from langsplat_core.query.basis import Basis, basis_of
from langsplat_core.query.grammar import STOP_WORDS, named, only, thing_and_part
from langsplat_core.query.instances import Instance, find_instances, find_wholes
from langsplat_core.query.lookup import Lookup, Relevancy, through_cells
from langsplat_core.query.rule import Bars, bars_of, decide, on_things, scaling_of, with_pieces
from langsplat_core.query.texts import LoadEncoder, TextVectors
from langsplat_core.scene import LEVELS, NO_NODE, Calibration, LanguageField, Scene, TaughtWord, Tree
from langsplat_core.scene.language import LONGEST_NAME, MOST_SHOWN, phrase_key, split_phrases, tidy
from langsplat_core.scene.surface import Surface, build_surface, build_tree, surface_weights
from langsplat_core.semantics.encoders import kept_calibration, same_vectors
from langsplat_core.semantics.relevancy import Scale, TextEncoder, relevancy_of

SAMPLE = 200_000  # Gaussians, about, that tell which regions touch; the surface of a million takes 5 s


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
        latent itself and not its cell. rule: "regions" becomes "peak" if neither scene nor encoder has
        everyday phrases. words: the user's, before the scene's; EncoderError if they are of another encoder.
        """
        expect(scene, Scene, "load_scene(path) returns one")
        expect(words, Words | None, "read_words(path) returns them")
        if isinstance(load_encoder, str):
            raise InputError("no name alone; say QueryEngine(scene, load_text_encoder(name))")
        if rule not in ("regions", "peak"):
            raise InputError(f"no rule {rule!r}; choose regions or peak")
        self.scene = scene
        self.exact = exact
        self._rule: AnswerRule = rule
        field = scene.language
        self._texts = None if field is None else TextVectors(field, load_encoder, encoder_id)
        taught = () if field is None else field.taught
        if words is not None:
            check_words(self.field, words)
            taught += words.words
        self.taught: dict[str, TaughtWord] = {word.key: word for word in taught}

    def __deepcopy__(self, memo: object) -> "QueryEngine":
        """Return the engine itself: copies of its answers (`dataclasses.asdict`) share it with its locks."""
        return self

    # Answers.

    def run(self, phrase: str, level: LevelChoice = "auto", progress: Progress = silent) -> QueryResult:
        """Answer `phrase` as one name; a taught word by its examples. Raises as `TextVectors.of` does.

        The level is that of the scene in all views. "Lid of the teapot" is one name; `run_phrase` parses it.
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
        vectors = self.texts.of(texts, progress)  # first, so that a refused phrase leaves nothing cached
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
        relevancies = self._lookup.relevancies(self.texts.of(names)) if names else ()
        return dict(zip(names, map(self._own_fits, relevancies), strict=True))

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
        scaling = scaling_of(self.calibration, sought, phrase)
        decision = decide(self.regions.table, fits, sought, level, self.bars, scaling, on)
        return answers.by_regions(phrase, relevancy, decision, means, self.regions)

    def run_inside(
        self, names: Sequence[str], members: Array, level: LevelChoice, calibration: Calibration | None
    ) -> QueryResult:
        """Answer a part, by the mean over its `names`, among regions of `members` (N,) bool and their pieces.

        The verdict is by the first name, among these regions. Raises as `TextVectors.of` does.
        """
        assert self.chance is not None
        asked = list(self._lookup.relevancies(self.texts.of(names)))
        relevancy = replace(asked[0], values=np.mean([one.values for one in asked], axis=0))
        fits, table = list(map(self._own_fits, asked)), self.regions.table
        on = with_pieces(table, self.regions.mostly(members), self.touching)
        judged = bars_of(table, self.chance, on), scaling_of(calibration, "inside", names[0]), on
        decision = decide(table, fits, "inside", level, *judged)
        return answers.by_regions(names[0], relevancy, decision, self.scene.gaussians.means, self.regions)

    def instances(self, result: QueryResult, at_most: int | None = None) -> tuple[Instance, ...]:
        """Return the instances among the members of an answer, best first, at most `at_most`."""
        expect(result, QueryResult, "that of run_phrase(engine, text) is its answer")
        wholes, join = self.tree.voted_wholes, result.level == len(LEVELS) - 1
        members, even, gaussians = result.members, result.even, self.scene.gaussians
        if join and self.bars is not None:  # by the rule "peak", relevancies vary and need smoothing
            found = find_wholes(gaussians, members, even, wholes, at_most)
            if found is not None:
                return found
        return find_instances(self.surface, gaussians, members, even, at_most, wholes, join)

    # Data that answers are computed from, each made when it is first needed.

    @property
    def texts(self) -> TextVectors:
        """Vectors of phrases; InputError if the scene has no language field."""
        if self._texts is None:
            raise InputError(no_field(self.scene))
        return self._texts

    @property
    def field(self) -> LanguageField:
        """The scene's language field; InputError if it has none."""
        return self.texts.field

    @property
    def rule(self) -> AnswerRule:
        """Rule for answers: "regions" if there are everyday phrases to compare with, else "peak"."""
        return "regions" if self.scale.everyday is not None else "peak"

    @property
    def scale(self) -> Scale:
        """Scale that turns cosines into relevancies."""
        everyday = None if self._rule == "peak" else self.texts.everyday
        return Scale(self.field.canonical, everyday, self.field.temperature)

    @property
    def calibration(self) -> Calibration | None:
        """The calibration of probabilities: the scene's own, else the user's; None by the rule "peak"."""
        return self.field.calibration or self._kept if self.rule == "regions" else None

    @cached_property
    def _kept(self) -> Calibration | None:
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
        field, tree, drawn = self.field, self.field.tree, self.scene.gaussians.valid()
        if tree is not None and not drawn.all():  # rows that cannot be drawn are nowhere
            tree = replace(tree, leaves=np.where(drawn, tree.leaves, np.int32(NO_NODE)))
        return tree or build_tree(self.surface, field.codec, field.latents, field.known)

    @cached_property
    def regions(self) -> Regions:
        """The tree's nodes at each level."""
        return answers.build_regions(self.tree, surface_weights(self.scene.gaussians))

    @cached_property
    def touching(self) -> Array:
        """The (P, 2) pairs of wholes that may be pieces of one thing, see `touching_wholes`."""
        gaussians = self.scene.gaussians
        some = np.arange(0, len(gaussians), len(gaussians) // SAMPLE + 1)
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
        by_chance = self._rule == "regions" and self.texts.everyday_so_far is not None
        return basis_of(self.field, by_chance, self.field.calibration or self._kept)

    def unknown_words(self, phrase: str) -> tuple[str, ...]:
        """Return the words of a phrase that its encoder was never taught; none of a taught word."""
        return () if self.is_taught(phrase) else self.texts.unknown_words(phrase)

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
        cosines = vectors @ self.texts.of([phrase])[0]
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
