"""Relevancy of a phrase (LERF, adopted by LangSplat, section 3.4), exact.

    relevancy(F, q) = min over canonical phrases c of  softmax(10 [F.q, F.c])[0]
                    = sigmoid(10 (F.q - max_c F.c))

0.5 means: no closer to the phrase than to the closest of "object", "things", "stuff", "texture".
The factor 10 stands in the method's code, not in the paper's formula.
"""

import numpy as np

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.scene import Codec, LinearCodec

TEMPERATURE = 10.0
CHUNK = 16_384  # decoded vectors held at a time: 32 MB at 512 float32 numbers


def relevancy(vectors: Array, phrases: Array, canonical: Array) -> Array:
    """(M, D) unit vectors, (Q, D) unit phrase vectors, (K, D) unit canonical vectors -> (M, Q) in (0, 1)."""
    nearest = (vectors @ canonical.T).max(1, keepdims=True)
    return sigmoid(TEMPERATURE * (vectors @ phrases.T - nearest))


def latent_relevancy(codec: Codec, latents: Array, phrases: Array, canonical: Array) -> Array:
    """(M, d) latents -> (M, Q) relevancy of the decoded vectors, exact, in bounded memory.

    Latents are normalised first: a blended latent is shorter than 1 but keeps its direction.
    A zero latent has no meaning and gets relevancy 0.
    """
    out = np.zeros((len(latents), len(phrases)), np.float32)
    length = np.linalg.norm(latents, axis=1)
    known = np.flatnonzero(length > 1e-6)
    if isinstance(codec, LinearCodec):
        # cos(B^T l, q) = l.(B q) / |l| for orthonormal rows of B: the big vectors never appear.
        phrases, canonical = phrases @ codec.basis.T, canonical @ codec.basis.T
    for start in range(0, len(known), CHUNK):
        rows = known[start : start + CHUNK]
        vectors = (latents[rows] / length[rows, None]).astype(np.float32)
        if not isinstance(codec, LinearCodec):
            vectors = codec.decode(vectors)
        out[rows] = relevancy(vectors, phrases, canonical)
    return out
