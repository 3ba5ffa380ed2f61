"""What a codec costs in the only currency that counts: the relevancy of phrases."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import CANONICAL_PHRASES, Codec
from langsplat_core.semantics.encoder import Encoder, PhraseEncoder
from langsplat_core.semantics.everyday import everyday_phrases, everyday_vectors
from langsplat_core.semantics.relevancy import Scale, relevancy_of

CHUNK = 4_096  # vectors judged at a time


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """The phrases that errors are measured with, and against which relevancy is read."""

    phrases: Array  # (Q, D) float32 unit text vectors
    scale: Scale

    def relevancy(self, vectors: Array) -> Array:
        """(M, D) unit vectors -> (M, Q) in [0, 1]."""
        zero, rate = self.scale.of(vectors @ self.scale.texts.T)
        return relevancy_of(vectors @ self.phrases.T, zero[:, None], rate[:, None])


@dataclass(frozen=True)
class RelevancyError:
    """Absolute differences to the relevancy of the unquantised vectors, over vectors and phrases."""

    mean: float
    p99: float


def everyday_vocabulary(encoder: Encoder | PhraseEncoder, phrases: tuple[str, ...] = ()) -> Vocabulary:
    """`phrases` and everyday ones, as `encoder` writes them."""
    texts = list(dict.fromkeys([*phrases, *everyday_phrases(encoder.unknown_words)]))
    canonical = encoder.encode_texts(list(CANONICAL_PHRASES))
    scale = Scale(canonical, everyday_vectors(encoder), encoder.temperature)
    return Vocabulary(encoder.encode_texts(texts) if texts else canonical, scale)


def relevancy_error(made: Array, vectors: Array, vocabulary: Vocabulary) -> RelevancyError:
    """Of (M, D) `made` in place of (M, D) `vectors`, both float32 unit vectors; 0 where M = 0."""
    differences = [
        np.abs(vocabulary.relevancy(made[i : i + CHUNK]) - vocabulary.relevancy(vectors[i : i + CHUNK]))
        for i in range(0, len(vectors), CHUNK)
    ]
    if not differences:
        return RelevancyError(0.0, 0.0)
    errors = np.concatenate([part.astype(np.float32).ravel() for part in differences])
    return RelevancyError(float(errors.mean(dtype=np.float64)), float(np.quantile(errors, 0.99)))


@dataclass(frozen=True)
class CodecReport:
    """What a codec loses of vectors that it was not fitted to."""

    cosine: float  # mean, of a vector with what the codec makes of it
    error_mean: float  # of relevancy, see `RelevancyError`
    error_p99: float


def codec_report(codec: Codec, vectors: Array, vocabulary: Vocabulary) -> CodecReport:
    """Of (M, D) float32 unit vectors."""
    made = codec.decode(codec.encode(vectors))
    error = relevancy_error(made, vectors, vocabulary)
    cosine = float((made * vectors).sum(1).mean()) if len(vectors) else 1.0
    return CodecReport(cosine, error.mean, error.p99)
