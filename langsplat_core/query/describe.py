"""Reverse queries: the most probable words for Gaussians, and for the surface under a pixel.

    p(word | x)  =  softmax over words of  scale * (cos(x, word) - hub(word) / 2)

The hub of a word is its mean cosine with the features of the scene that are nearest to it: some words lie
near every image and would be the answer everywhere. This is cross-domain similarity local scaling (Conneau et
al. 2018, equation 3), halved, without hub(x), which is the same for all words. The canonical phrases compete
too: their share is the probability that no word of the vocabulary fits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from langsplat_core.arrays import Array, pieces
from langsplat_core.config import PictureConfig, RasterSettings
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.render import pixel_weights
from langsplat_core.scene import LEVELS, Camera, CodebookCodec, Codec, LanguageField
from langsplat_core.scene.surface import surface_areas
from langsplat_core.semantics.relevancy import bundled_vocabulary

# Logits per spread of phrases' cosines with a feature. With it probabilities are calibrated, for the bundled
# encoder and for CLIP's geometry (rooms 201 to 203, docs/searching.md).
WORD_SCALE = 6.0
NEAREST = 10  # features that a word's hub is averaged over, as in the paper
BANK = 4096  # features, at most, among which they are found
LIKELY = 0.5  # least probability of a name
OR = " or "  # between words for one instance
CELLS = 8_000_000  # numbers, at most, of features times words that are held at once: 32 MB


@dataclass(frozen=True)
class Word:
    """A phrase and its probability within a vocabulary."""

    phrase: str
    probability: float  # in [0, 1]


def likely_name(words: Sequence[Word]) -> Word | None:
    """Return the fewest best words that are `LIKELY` together, such as "mug or cup"; None if all are not."""
    for count in range(1, len(words) + 1):
        probability = sum(word.probability for word in words[:count])
        if probability >= LIKELY:
            return Word(OR.join(word.phrase for word in words[:count]), probability)
    return None


@dataclass(frozen=True, eq=False)
class WordScores:
    """Part of the probabilities of a vocabulary in a scene that does not depend on the Gaussians."""

    codec: Codec  # of the scene's features
    phrases: tuple[str, ...]  # V
    vectors: Array  # (V + C, D) float32 unit; the last C are the canonical phrases: "none of these"
    hubs: Array  # (V + C,) float32
    scale: float  # of the softmax

    def take(self, chosen: Array) -> "WordScores":
        """Return the scores of the phrases for which `chosen` (V,) bool is True; the canonical ones stay."""
        rows = np.append(chosen, np.ones(len(self.vectors) - len(chosen), bool))
        phrases = tuple(phrase for phrase, kept in zip(self.phrases, chosen, strict=True) if kept)
        return replace(self, phrases=phrases, vectors=self.vectors[rows], hubs=self.hubs[rows])

    @cached_property
    def _of_codewords(self) -> Array | None:
        """The (K, V + C) float32 probabilities at all codewords; None without a codebook or above `CELLS`."""
        if not isinstance(self.codec, CodebookCodec) or self.codec.size * len(self.vectors) > CELLS:
            return None
        return self._softmax(np.arange(self.codec.size)[:, None])

    def probabilities(self, latents: Array) -> Array:
        """Return (M, V + C) float32 probabilities for (M, d) latents, each row adding up to 1."""
        known = self._of_codewords
        return self._softmax(latents) if known is None else known[latents[:, 0]]

    def _softmax(self, latents: Array) -> Array:
        logits = np.float32(self.scale) * (self.codec.cosines(latents, self.vectors) - self.hubs / 2)
        shares = np.exp(logits - logits.max(1, keepdims=True))
        return shares / shares.sum(1, keepdims=True)

    def mixture(self, latents: Array, weights: Array) -> Array:
        """Return the (V + C,) float64 mean of the probabilities for (M, d) latents, weighted by (M,).

        Weights are >= 0, not all zero. Probabilities are blended, as mean features may mean something else.
        """
        latents, of = self.codec.unique(latents)
        weights = np.bincount(of, weights, minlength=len(latents))
        total = np.zeros(len(self.vectors))
        for part in self._blocks(len(latents)):
            total += weights[part] @ self.probabilities(latents[part])
        return total / total.sum()

    def best(self, latents: Array, count: int) -> tuple[Array, Array]:
        """Return (M, count) indices of the most probable phrases of (M, d) latents, best first.

        Also returns their float32 probabilities. A vocabulary of fewer phrases gives fewer columns.
        """
        count = min(count, len(self.phrases))
        words = np.empty((len(latents), count), np.int32)
        shares = np.empty((len(latents), count), np.float32)
        for part in self._blocks(len(latents) if count else 0):
            found = self.probabilities(latents[part])[:, : len(self.phrases)]
            some = np.argpartition(-found, count - 1, axis=1)[:, :count]
            order = np.argsort(-np.take_along_axis(found, some, 1), axis=1, kind="stable")
            words[part] = np.take_along_axis(some, order, 1)
            shares[part] = np.take_along_axis(found, words[part], 1)
        return words, shares

    def _blocks(self, count: int) -> list[slice]:
        return pieces(count, max(1, CELLS // len(self.vectors)))


def build_words(field: LanguageField, phrases: tuple[str, ...], vectors: Array) -> WordScores:
    """Return the scores of V phrases with (V, D) unit vectors in a scene's field."""
    every = np.concatenate([vectors, field.canonical]).astype(np.float32)
    bank = field_features(field)
    # Median, over features, of the spread of their cosines with everyday phrases, else with the words.
    texts = vectors if field.everyday is None else field.everyday
    spreads = (bank @ texts.T).std(1) if len(bank) and len(texts) > 1 else np.ones(1)
    scale = WORD_SCALE / max(float(np.median(spreads)), 1e-6)  # equal words have no spread
    return WordScores(field.codec, phrases, every, hubs(every, bank), scale)


def field_features(field: LanguageField) -> Array:
    """Return (B, D) float32 unit vectors of the scene's distinct features, evenly sampled above `BANK`."""
    latents, _ = field.codec.unique(field.latents[field.known])
    chosen = np.unique(np.linspace(0, len(latents) - 1, min(BANK, len(latents))).astype(np.int64))
    return field.codec.decode(latents[chosen])


def hubs(vectors: Array, bank: Array) -> Array:
    """Return the (V,) float32 mean cosines of (V, D) words with their `NEAREST` of (B, D) features."""
    count = min(NEAREST, len(bank))
    if count == 0:
        return np.zeros(len(vectors), np.float32)
    near = np.partition(vectors @ bank.T, len(bank) - count, axis=1)[:, -count:]
    return near.mean(1, dtype=np.float64).astype(np.float32)


# Words for Gaussians and pixels.


@dataclass(frozen=True)
class LevelWords:
    """The most probable words for some Gaussians at one level."""

    level: int  # index into LEVELS
    words: tuple[Word, ...]  # the most probable first; none without features
    other: float  # probability that no word of the vocabulary fits
    known: float  # share of the weight that has a feature at this level, in [0, 1]


Levels = tuple[LevelWords, ...]  # of subpart, part and whole


class Describer:
    """Reverse queries against one scene, for one thread at a time."""

    def __init__(
        self, engine: QueryEngine, vocabulary: Sequence[str] | None = None, progress: Progress = silent
    ) -> None:
        """Encode the words that may name what is in the scene.

        vocabulary: phrases for all levels, by default the bundled ones: everyday things, and below the level
        "whole" parts of things too. Phrases with words that the encoder was never taught are left out. Raises
        InputError without a language field or if no phrase is left, else as `TextVectors.of_known`.
        """
        things = tuple(vocabulary) if vocabulary is not None else bundled_vocabulary("things")
        parts = () if vocabulary is not None else bundled_vocabulary("parts")
        phrases, field = (*things, *parts), engine.field
        self.engine, self.known = engine, field.known
        known, vectors = engine.texts.of_known(phrases, progress)
        self.left_out: tuple[str, ...] = tuple(sorted(set(phrases) - set(known)))
        if not known:
            raise InputError(
                f"the encoder knows none of the vocabulary's {len(phrases)} phrases; name others, or use "
                "a scene made with OpenCLIP weights"
            )
        every = build_words(field, known, vectors)
        self.words: tuple[WordScores, WordScores, WordScores]
        self.words = every, every, every.take(np.isin(known, things))

    @cached_property
    def areas(self) -> Array:
        """The (N,) float64 surface of every Gaussian, see `surface_areas`."""
        return surface_areas(self.engine.scene.gaussians)

    def at_gaussians(self, rows: Array, weights: Array | None = None, top: int = 5) -> Levels:
        """Return words for Gaussians at `rows` (M, or (N,) bool), weighted by (M,) `weights`, else area."""
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows
        counted = self.areas[rows] if weights is None else np.asarray(weights, np.float64)
        if weights is None and not counted.any():  # without any area they still have features
            counted = np.ones(len(rows))
        return tuple(self.at_level(level, rows, counted, top) for level in range(len(LEVELS)))

    def at_level(self, level: int, rows: Array, weights: Array, top: int) -> LevelWords:
        """Return words for the Gaussians at `rows` (M,) at one level, weighted by (M,)."""
        field = self.engine.field
        known = self.known[level, rows] & (weights > 0)
        total, seen = float(weights.sum()), float(weights[known].sum())
        if not known.any():
            return LevelWords(level, (), 0.0, 0.0)
        latents, weights = field.latents[level, rows[known]], weights[known]
        names = self.words[level]
        shares = names.mixture(latents, weights)
        best = np.argsort(-shares[: len(names.phrases)], kind="stable")[: max(top, 0)]
        words = tuple(Word(names.phrases[i], float(shares[i])) for i in best)
        return LevelWords(level, words, float(shares[len(names.phrases) :].sum()), seen / total)


@dataclass(frozen=True, eq=False)
class Pointed:
    """The surface at one pixel: its position, words and relevancies."""

    position: Array  # (3,) world units
    depth: float  # camera z, world units
    words: Levels  # the most probable at each level
    relevancy: tuple[float, ...]  # in [0, 1], of each answer at its level


def look_at_pixel(
    describer: Describer,
    camera: Camera,
    pixel: tuple[int, int],
    results: Sequence[QueryResult] = (),
    top: int = 3,
    settings: RasterSettings | None = None,
) -> Pointed | None:
    """Return the surface that `camera` sees at a pixel (column, row); None if the pixel is mostly empty.

    Gaussians count by their blending weights; the depth is their median. settings: the scene's by default.
    """
    scene = describer.engine.scene
    rows, weights = pixel_weights(scene, camera, pixel, settings)
    total = float(weights.sum())
    if total <= PictureConfig().alpha_gate:
        return None
    depths = camera.project(scene.gaussians.means[rows].astype(np.float64))[1]
    order = np.argsort(depths, kind="stable")
    median = order[np.searchsorted(np.cumsum(weights[order], dtype=np.float64), 0.5 * total)]
    depth = float(depths[median])
    relevancy = (float(weights @ result.relevancy[result.level][rows]) / total for result in results)
    place = camera.unproject((pixel[0] + 0.5, pixel[1] + 0.5), depth)
    return Pointed(place, depth, describer.at_gaussians(rows, weights, top), tuple(relevancy))
