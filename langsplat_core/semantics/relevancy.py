"""Relevancy of a phrase: as published (LERF, adopted by LangSplat, section 3.4), and on the scale of chance.

    relevancy(F, q) = min over canonical phrases c of  softmax(t [F.q, F.c])[0]
                    = sigmoid(t (F.q - max_c F.c))

The temperature t is 10 in the method's code, absent from the paper's formula; other encoders have another,
and cosines of 0.3 for what one calls 0.6. So answers read a phrase against everyday phrases, most of which
are not there: at every language feature its cosine is compared with theirs, in units of their spread,

    fit  =  (F.q - zero) / spread,        relevancy  =  sigmoid(fit),

where the spread is the standard deviation of the everyday phrases' cosines there, and zero is what the best
of them have by chance (the mean of the largest `TOP`), mixed with the nearest of the canonical phrases, which
are LERF's own null, of four. A feature that lies near all phrases ("hub") thereby loses its advantage.

Below: vocabularies, which are plain lists of phrases, and the everyday phrases among them.
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

FLOOR = 0.5  # no closer to the phrase than to the closest of "object", "things", "stuff", "texture"
MIN_HEAT_SPAN = 0.1  # a peak closer than this to the floor is not stretched to full heat
TOP = 0.07  # of the everyday phrases: those that fit best by chance
CANONICAL = 0.25  # weight of the nearest canonical phrase in the zero
NARROWEST = 1e-6  # distance of a relevancy from 0 and 1, so that its fit is finite; least spread
CHUNK = 16_384  # decoded vectors held at a time: 32 MB at 512 float32 numbers


def relevancy_of(cosines: Array, zero: Array, rate: Array | float) -> Array:
    """Relevancy in (0, 1) of cosines; as published zero is the best canonical cosine, rate 10."""
    return sigmoid(rate * (cosines - zero))


def relevancy(
    vectors: Array, phrases: Array, canonical: Array, temperature: float = LanguageField.temperature
) -> Array:
    """Return (M, Q) in (0, 1) of (M, D), (Q, D) phrases and (C, D) canonical unit vectors."""
    return relevancy_of(vectors @ phrases.T, (vectors @ canonical.T).max(1, keepdims=True), temperature)


def latent_relevancy(
    codec: Codec,
    latents: Array,
    phrases: Array,
    canonical: Array,
    temperature: float = LanguageField.temperature,
) -> Array:
    """Return exact (M, Q) relevancy of (M, d) latents, 0 if unobserved; texts (Q, D) and (C, D)."""
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
    """Scale on which the cosines of a field are read."""

    canonical: Array  # (C, D) float32 unit
    everyday: Array | None  # (V, D) float32 unit; None: as published
    temperature: float  # of relevancy as published

    @property
    def texts(self) -> Array:
        """The (T, D) unit vectors of all phrases that `of` compares with."""
        return self.canonical if self.everyday is None else np.concatenate([self.canonical, self.everyday])

    def of(self, cosines: Array) -> tuple[Array, Array]:
        """Return the (M,) float32 zeros and rates of language features with (M, T) cosines with `texts`.

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
        """Relevancy in [0, 1] -> the fit it stands for, in spreads; as published, the margin of cosines."""
        return fit_of(relevancy, 1.0 if self.everyday is not None else self.temperature)


# Vocabularies: plain lists of phrases that a scene can be described with.

BUNDLED = "things", "parts", "colours", "materials"  # of which a page knows the phrases
LONGEST = 80  # characters of a phrase: CLIP reads 77 tokens, and a whole paragraph is no word


def bundled_vocabulary(name: str) -> tuple[str, ...]:
    """Return the phrases of a bundled list: one of `BUNDLED`, "nouns" or "adjectives"."""
    return read_vocabulary(Path(str(files("langsplat_assets") / "vocabulary" / f"{name}.txt")))


def read_vocabulary(path: Path) -> tuple[str, ...]:
    """Return the phrases of a text file, one a line, in lower case, each once, in the file's order.

    Empty lines and lines that begin with # do not count. Raises InputError for a file that cannot be read,
    that has no phrase, or with a line that is none (no letter or digit, too long, no text), which is named.
    """
    phrases: dict[str, None] = {}
    for number, line in enumerate(read_text(path).split("\n"), 1):
        text = " ".join(line.split())
        if not text or text.startswith("#"):
            continue
        phrase = phrase_key(text)
        if not (text.isprintable() and any(map(str.isalnum, phrase)) and len(phrase) <= LONGEST):
            raise InputError(
                f"{path}, line {number}: {quoted(text, 30)} is no phrase; write plain text, one "
                f"phrase of at most {LONGEST} letters a line, or begin with # what is none"
            )
        phrases[phrase] = None
    if not phrases:
        raise InputError(f"{path}: the vocabulary is empty; write one phrase per line, such as 'teapot'")
    return tuple(phrases)


# Everyday phrases: what a codec's errors are judged on, beside a scene's own vectors, and what answers are
# compared with.


MIXED = 96  # phrases of two words
FEWEST = 48  # phrases from which they tell what fits by chance


class TextEncoder(Protocol):
    """The text half of a CLIP model."""

    def encode_texts(self, texts: list[str]) -> Array:
        """Return (M, D) float32 unit vectors."""

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Words of `text` that the encoder was never taught; empty if it cannot tell."""

    def near_words(self, word: str) -> tuple[str, ...]:
        """Words it was taught that are written like an unknown one, the nearest first."""


def everyday_phrases(unknown_words: Callable[[str], Sequence[str]]) -> list[str]:
    """Nouns and `MIXED` random pairs of adjective and noun, always the same, without unknown words."""
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
    """Return (V, D) float32 unit vectors of everyday phrases, as of float16; None if it knows too few."""
    phrases = everyday_phrases(encoder.unknown_words)
    if len(phrases) < FEWEST:
        return None
    return encoder.encode_texts(phrases).astype(np.float16).astype(np.float32)
