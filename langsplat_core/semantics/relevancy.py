"""Relevancy of a phrase: as published (LERF, adopted by LangSplat, section 3.4), and relative to chance.

    relevancy(F, q) = min over canonical phrases c of  softmax(t [F.q, F.c])[0]
                    = sigmoid(t (F.q - max_c F.c))

The temperature t is 10 in the method's code and absent from the paper's formula. Other encoders need another
temperature, and their cosines have other ranges. So answers compare a phrase with everyday phrases, most of
which are absent from the scene: at every language feature F,

    fit  =  (F.q - zero) / spread,        relevancy  =  sigmoid(fit),

where the spread is the standard deviation of the everyday phrases' cosines with F, and zero is what the best
of them have by chance (the mean of the largest `TOP`), mixed with the nearest of the canonical phrases, which
are LERF's own null. A feature that is near to all phrases ("hub") thereby loses its advantage.

The module also has vocabularies, which are plain lists of phrases, and the everyday phrases.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array, pieces, sigmoid
from langsplat_core.errors import InputError, quoted
from langsplat_core.io.hostile import read_text
from langsplat_core.scene import Codec, LanguageField
from langsplat_core.scene.language import phrase_key

FLOOR = 0.5  # relevancy at fit 0: no closer to the phrase than to what is nearest by chance
MIN_HEAT_SPAN = 0.1  # least range of relevancies that a heat map is stretched over
TOP = 0.07  # share of the everyday phrases whose mean is the best by chance
CANONICAL = 0.25  # weight of the nearest canonical phrase in the zero
NARROWEST = 1e-6  # least distance of a relevancy from 0 and 1, so that its fit is finite; least spread
CHUNK = 16_384  # decoded vectors held at a time: 32 MB at 512 float32 numbers


def relevancy_of(cosines: Array, zero: Array, rate: Array | float) -> Array:
    """Return relevancies in (0, 1) of cosines; as published, zero is the best canonical cosine, rate 10."""
    return sigmoid(rate * (cosines - zero))


def latent_relevancy(
    codec: Codec,
    latents: Array,
    phrases: Array,
    canonical: Array,
    temperature: float = LanguageField.temperature,
) -> Array:
    """Return the published (M, Q) relevancy of (M, d) latents, 0 if unobserved; texts (Q, D) and (C, D)."""
    out = np.zeros((len(latents), len(phrases)), np.float32)
    known = np.flatnonzero(codec.known(latents))
    texts = np.concatenate([phrases, canonical])
    for part in pieces(len(known), CHUNK):
        rows = known[part]
        cosines = codec.cosines(latents[rows], texts)
        nearest = cosines[:, len(phrases) :].max(1, keepdims=True)
        out[rows] = relevancy_of(cosines[:, : len(phrases)], nearest, temperature)
    return out


def fit_of(relevancy: Array | float, rate: float = 1.0) -> Array:
    """Return the fit that a relevancy in [0, 1] stands for; finite at 0 and 1."""
    clipped = np.clip(np.asarray(relevancy, np.float64), NARROWEST, 1 - NARROWEST)
    return np.asarray(np.log(clipped / (1 - clipped)) / rate)


@dataclass(frozen=True, eq=False)
class Scale:
    """Scale that maps the cosines of a field to relevancies."""

    canonical: Array  # (C, D) float32 unit
    everyday: Array | None  # (V, D) float32 unit; None: as published
    temperature: float  # of relevancy as published

    @property
    def texts(self) -> Array:
        """The (T, D) unit vectors of the phrases that `of` needs cosines with."""
        return self.canonical if self.everyday is None else np.concatenate([self.canonical, self.everyday])

    def of(self, cosines: Array) -> tuple[Array, Array]:
        """Return the (M,) float32 zeros and rates of features from their (M, T) cosines with `texts`.

        Their relevancy is sigmoid(rate * (cosine - zero)).
        """
        nearest = cosines[:, : len(self.canonical)].max(1)
        if self.everyday is None:
            return nearest, np.full(len(cosines), self.temperature, np.float32)
        others = cosines[:, len(self.canonical) :]
        count = max(round(TOP * others.shape[1]), 1)
        top = np.partition(others, -count, axis=1)[:, -count:].mean(1)
        spread = np.maximum(others.std(1), NARROWEST)
        zero = CANONICAL * nearest + (1 - CANONICAL) * top
        return zero.astype(np.float32), (1 / spread).astype(np.float32)

    def fit(self, relevancy: Array | float) -> Array:
        """Return the fits, in spreads, of relevancies in [0, 1]; as published, the margins of cosines."""
        return fit_of(relevancy, 1.0 if self.everyday is not None else self.temperature)


# Vocabularies: plain lists of phrases that a scene can be described with.

BUNDLED = "things", "parts", "colours", "materials"  # lists whose phrases are in exported pages
LONGEST = 80  # characters of a phrase: CLIP reads 77 tokens


def bundled_vocabulary(name: str) -> tuple[str, ...]:
    """Return the phrases of a bundled list: one of `BUNDLED`, "nouns" or "adjectives"."""
    return read_vocabulary(Path(str(files("langsplat_assets") / "vocabulary" / f"{name}.txt")))


def read_vocabulary(path: Path) -> tuple[str, ...]:
    """Return the phrases of a text file, one a line, in lower case, each once, in the file's order.

    Empty lines and what follows a # are skipped. Raises InputError for a file that cannot be read or
    has no phrase, and names a line that is no phrase (without letter or digit, too long, unprintable).
    """
    phrases: dict[str, None] = {}
    for number, line in enumerate(read_text(path).split("\n"), 1):
        text = " ".join(line.partition("#")[0].split())
        if not text:
            continue
        phrase = phrase_key(text)
        if not (text.isprintable() and any(map(str.isalnum, phrase)) and len(phrase) <= LONGEST):
            raise InputError(
                f"{path}, line {number}: {quoted(text, 30)} is no phrase; write plain text, one "
                f"phrase of at most {LONGEST} letters per line, and comments after a #"
            )
        phrases[phrase] = None
    if not phrases:
        raise InputError(f"{path}: the vocabulary is empty; write one phrase per line, such as 'teapot'")
    return tuple(phrases)


# Everyday phrases: the null distribution of answers, and test vectors for codecs beside a scene's own.


MIXED = 96  # phrases of two words
FEWEST = 48  # least number of phrases for a distribution by chance


class TextEncoder(Protocol):
    """The text half of a CLIP model."""

    def encode_texts(self, texts: list[str]) -> Array:
        """Return (M, D) float32 unit vectors."""

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Return the words of `text` that the encoder was never taught; empty for an open vocabulary."""

    def near_words(self, word: str) -> tuple[str, ...]:
        """Return words of the vocabulary that are spelt like an unknown one, the nearest first."""


def everyday_phrases(unknown_words: Callable[[str], Sequence[str]]) -> list[str]:
    """Return nouns and `MIXED` pairs of adjective and noun, of a fixed seed, without unknown words."""
    nouns, adjectives = (
        [word for word in bundled_vocabulary(name) if not unknown_words(word)]
        for name in ("nouns", "adjectives")
    )
    if not nouns or not adjectives:
        return nouns
    generator = np.random.default_rng(0)
    pairs = zip(generator.choice(adjectives, MIXED), generator.choice(nouns, MIXED), strict=True)
    return [*nouns, *sorted({f"{adjective} {noun}" for adjective, noun in pairs})]


def everyday_vectors(encoder: TextEncoder) -> Array | None:
    """Return (V, D) float32 unit vectors of everyday phrases, rounded to float16; None for too few words."""
    phrases = everyday_phrases(encoder.unknown_words)
    if len(phrases) < FEWEST:
        return None
    return encoder.encode_texts(phrases).astype(np.float16).astype(np.float32)
