"""Relevancy of a phrase (LERF, adopted by LangSplat, section 3.4), exact.

    relevancy(F, q) = min over canonical phrases c of  softmax(10 [F.q, F.c])[0]
                    = sigmoid(10 (F.q - max_c F.c))

The factor 10 stands in the method's code, not in the paper's formula.
"""

import numpy as np

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.scene import Codec
from langsplat_core.scene.codec import SHORTEST

TEMPERATURE = 10.0
FLOOR = 0.5  # no closer to the phrase than to the closest of "object", "things", "stuff", "texture"
MIN_HEAT_SPAN = 0.1  # a peak closer than this to the floor is not stretched to full heat
CHUNK = 16_384  # decoded vectors held at a time: 32 MB at 512 float32 numbers


def from_cosines(phrases: Array, nearest_canonical: Array) -> Array:
    """Cosines with phrases and the largest one with a canonical phrase, of shapes that go together ->
    relevancy in (0, 1)."""
    return sigmoid(TEMPERATURE * (phrases - nearest_canonical))


def relevancy(vectors: Array, phrases: Array, canonical: Array) -> Array:
    """(M, D) unit vectors, (Q, D) unit phrase vectors, (K, D) unit canonical vectors -> (M, Q) in (0, 1)."""
    return from_cosines(vectors @ phrases.T, (vectors @ canonical.T).max(1, keepdims=True))


def latent_relevancy(codec: Codec, latents: Array, phrases: Array, canonical: Array) -> Array:
    """(M, d) latents of any length, (Q, D), (K, D) -> (M, Q) relevancy of what they stand for, exact, in
    bounded memory. A zero latent has no meaning and gets relevancy 0."""
    out = np.zeros((len(latents), len(phrases)), np.float32)
    known = np.flatnonzero(np.linalg.norm(latents, axis=1) > SHORTEST)
    texts = np.concatenate([phrases, canonical])
    for start in range(0, len(known), CHUNK):
        rows = known[start : start + CHUNK]
        cosines = codec.similarities(latents[rows], texts)
        nearest = cosines[:, len(phrases) :].max(1, keepdims=True)
        out[rows] = from_cosines(cosines[:, : len(phrases)], nearest)
    return out
