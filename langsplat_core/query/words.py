"""Reverse queries: which words of a vocabulary say best what a vector of CLIP's space means.

    p(word | x)  =  softmax over words of  scale * (cos(x, word) - hub(word) / 2)

The hub of a word is its mean cosine with the meanings of the scene that are nearest to it. Some words lie
near every picture and would be the answer everywhere ("hubs"); what is left of the cosine says how much
better a word fits here than where it fits anyway. It is cross-domain similarity local scaling ("Word
translation without parallel data", Conneau et al. 2018, equation 3): 2 cos(x, w) - hub(w) - hub(x), halved,
and without hub(x), which all words have in common.

The canonical phrases ("object", "things", "stuff", "texture") compete too: their share is the chance that no
word of the vocabulary fits.
"""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import Codec, LanguageField

# Logits per spread of phrases' cosines with a meaning: a probability is then right about so often, with the
# bundled encoder and with the geometry of CLIP (rooms 201 to 203, docs/describing.md).
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
        """(D,) of one of the phrases."""
        found: Array = self.vectors[self.phrases.index(phrase)]
        return found

    def take(self, chosen: Array) -> "WordScores":
        """Those phrases for which `chosen` (V,) bool is True; the canonical ones stay."""
        rows = np.append(chosen, np.ones(len(self.vectors) - len(chosen), bool))
        phrases = tuple(phrase for phrase, kept in zip(self.phrases, chosen, strict=True) if kept)
        return replace(self, phrases=phrases, vectors=self.vectors[rows], hubs=self.hubs[rows])

    def probabilities(self, codec: Codec, latents: Array) -> Array:
        """(M, d) latents with a meaning -> (M, V + C) float32, each row adding up to 1."""
        if codec.space == "index":
            cosines = codec.decode(latents) @ self.vectors.T
        else:
            cosines = codec.similarities(latents, self.vectors)
        logits = np.float32(self.scale) * (cosines - self.hubs / 2)
        shares = np.exp(logits - logits.max(1, keepdims=True))
        result: Array = shares / shares.sum(1, keepdims=True)
        return result

    def mixture(self, codec: Codec, latents: Array, weights: Array) -> Array:
        """(M, d) latents with a meaning and (M,) weights >= 0, not all zero -> (V + C,) float64: the mean of
        their probabilities. Answers are blended, never meanings: between two things lies a third."""
        if codec.space == "index":
            codes, inverse = np.unique(latents[:, 0], return_inverse=True)
            latents, weights = codes[:, None], np.bincount(inverse, weights, minlength=len(codes))
        total = np.zeros(len(self.vectors))
        for part in self._blocks(len(latents)):
            total += weights[part].astype(np.float64) @ self.probabilities(codec, latents[part])
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


def build_words(field: LanguageField, phrases: tuple[str, ...], vectors: Array) -> WordScores:
    """Names of things: V phrases and their (V, D) unit vectors."""
    every, bank = np.concatenate([vectors, field.canonical]).astype(np.float32), meanings(field)
    return WordScores(phrases, every, hubs(every, bank), WORD_SCALE / _spread(field, vectors, bank))


def build_attributes(field: LanguageField, phrases: tuple[str, ...], vectors: Array) -> WordScores:
    """Words of which a thing has one, such as colours: V phrases and their (V, D) unit vectors. Few and all
    of one kind, they are no hubs."""
    none, scale = (
        np.zeros(len(vectors), np.float32),
        ATTRIBUTE_SCALE / _spread(field, vectors, meanings(field)),
    )
    return WordScores(phrases, vectors.astype(np.float32), none, scale)


def _spread(field: LanguageField, vectors: Array, bank: Array) -> float:
    """Median, over meanings, of the standard deviation of cosines: of everyday phrases, else of the words."""
    texts = vectors if field.everyday is None else field.everyday
    spreads = (bank @ texts.T).std(1) if len(bank) and len(texts) > 1 else np.ones(1)
    return max(float(np.median(spreads)), NARROWEST)


def meanings(field: LanguageField) -> Array:
    """(B, D) float32 unit vectors of what the scene's Gaussians mean: every codeword that one of them has, or
    those of evenly spread Gaussians where there are no codewords."""
    latents = field.latents[field.known]
    if field.codec.space == "index":
        latents, most = np.unique(latents)[:, None], BANK
    else:
        most = SAMPLES
    chosen = np.unique(np.linspace(0, len(latents) - 1, min(most, len(latents))).astype(np.int64))
    return field.codec.decode(latents[chosen])


def hubs(vectors: Array, bank: Array) -> Array:
    """(V, D) unit vectors of words, (B, D) of meanings -> (V,) float32 mean cosine with the nearest ones."""
    count = min(NEAREST, len(bank))
    if count == 0:
        return np.zeros(len(vectors), np.float32)
    near = np.partition(vectors @ bank.T, len(bank) - count, axis=1)[:, -count:]
    found: Array = near.mean(1, dtype=np.float64).astype(np.float32)
    return found


def certain(words: WordScores, codec: Codec, latents: Array, weights: Array) -> Word | None:
    """The attribute of (M, d) latents with a meaning, weighted by (M,), where it is probable enough."""
    shares = words.mixture(codec, latents, weights)
    best = int(shares.argmax())
    return Word(words.phrases[best], float(shares[best])) if shares[best] >= CERTAIN else None
