"""Relevancy of a phrase (LERF, adopted by LangSplat, section 3.4), exact.

    relevancy(F, q) = min over canonical phrases c of  softmax(t [F.q, F.c])[0]
                    = sigmoid(t (F.q - max_c F.c))

The temperature t is 10 in the method's code, absent from the paper's formula; other encoders have another.
"""

import numpy as np

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.scene import Codec, Reading
from langsplat_core.scene.codec import meaningful

FLOOR = 0.5  # no closer to the phrase than to the closest of "object", "things", "stuff", "texture"
MIN_HEAT_SPAN = 0.1  # a peak closer than this to the floor is not stretched to full heat
CHUNK = 16_384  # decoded vectors held at a time: 32 MB at 512 float32 numbers


def from_cosines(phrases: Array, nearest_canonical: Array, temperature: float) -> Array:
    """Cosines with phrases and the largest one with a canonical phrase, of shapes that go together ->
    relevancy in (0, 1)."""
    return sigmoid(temperature * (phrases - nearest_canonical))


def relevancy(
    vectors: Array, phrases: Array, canonical: Array, temperature: float = Reading.temperature
) -> Array:
    """(M, D) unit vectors, (Q, D) unit phrase vectors, (C, D) unit canonical vectors -> (M, Q) in (0, 1)."""
    return from_cosines(vectors @ phrases.T, (vectors @ canonical.T).max(1, keepdims=True), temperature)


def latent_relevancy(
    codec: Codec,
    latents: Array,
    phrases: Array,
    canonical: Array,
    temperature: float = Reading.temperature,
) -> Array:
    """(M, d) latents of any length, (Q, D), (C, D) -> (M, Q) relevancy of what they stand for, exact, in
    bounded memory. A latent without meaning gets relevancy 0."""
    out = np.zeros((len(latents), len(phrases)), np.float32)
    known = np.flatnonzero(meaningful(codec, latents))
    texts = np.concatenate([phrases, canonical])
    for start in range(0, len(known), CHUNK):
        rows = known[start : start + CHUNK]
        cosines = codec.similarities(latents[rows], texts)
        nearest = cosines[:, len(phrases) :].max(1, keepdims=True)
        out[rows] = from_cosines(cosines[:, : len(phrases)], nearest, temperature)
    return out
