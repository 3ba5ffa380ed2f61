"""The language field: what every Gaussian means, at three levels."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from langsplat_core.arrays import Array, check_array, sigmoid
from langsplat_core.scene.codec import Codec, latent_dtype, meaningful
from langsplat_core.scene.phrases import phrase_key

LEVELS = ("subpart", "part", "whole")  # index 0, 1, 2 wherever a level axis appears
CANONICAL_PHRASES = ("object", "things", "stuff", "texture")  # LERF's negatives, used by LangSplat
NO_THING = 65_535  # in `LanguageField.things`: of no thing in particular


@dataclass(frozen=True)
class Calibration:
    """What the best cosine margins of an answer say about whether the thing is there at all (Platt 1999):
    ``probability = sigmoid(constant + whole * margin of whole things + finer * the better one of the finer
    levels)``, present and absent being as likely beforehand."""

    constant: float
    whole: float
    finer: float
    found: float = 0.75  # probability from which a phrase counts as found; 0.5 up to here is a weak match

    def __post_init__(self) -> None:
        slopes = (self.whole, self.finer)
        if not (np.isfinite([self.constant, *slopes]).all() and sum(slopes) > 0 and 0.5 <= self.found <= 1):
            raise ValueError(f"{self}: expected finite numbers, rising with margins, and found in [0.5, 1]")

    def probability(self, margins: tuple[float, float, float]) -> float:
        """That what is asked for is there, in (0, 1). margins: the best of each level, cosine with the phrase
        minus that with the nearest canonical phrase."""
        subpart, part, whole = margins
        logit = self.constant + self.whole * whole + self.finer * max(subpart, part)
        return float(sigmoid(np.array(logit)))


@dataclass(frozen=True)
class Reading:
    """How cosines of one text encoder are read: other encoders have another scale."""

    temperature: float = 10.0  # of the softmax; 10 in the public code of LERF and LangSplat, for CLIP
    found: float = 0.6  # peak relevancy from which a phrase counts as present, without a calibration
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.temperature) and self.temperature > 0 and 0 <= self.found <= 1):
            raise ValueError(
                f"reading: temperature {self.temperature} and found {self.found}; expected a positive number "
                "and one in [0, 1]"
            )


@dataclass(frozen=True, eq=False)
class LanguageField:
    """Latents of N Gaussians at the three levels, with everything a query needs beside them."""

    latents: Array  # (3, N, d) of the codec's type; zero where a Gaussian was never observed
    confidence: Array  # (3, N) float32 >= 0: total blending weight with which it was observed
    codec: Codec
    canonical: Array  # (4, D) float32 unit text vectors of CANONICAL_PHRASES
    encoder_id: str  # hub id or folder of the text encoder, e.g. "demo"
    phrasebook: Mapping[str, Array] = field(default_factory=dict)  # `phrase_key` -> (D,) unit vector
    reading: Reading = field(default_factory=Reading)
    things: Array | None = None  # (N,) uint16 number of the thing that each belongs to, or NO_THING

    def __post_init__(self) -> None:
        d, big = self.codec.latent_dim, self.codec.vector_dim
        dims = check_array("latents", self.latents, (len(LEVELS), "N", d), dtype=latent_dtype(self.codec))
        if self.codec.index_size and self.latents.max(initial=0) >= self.codec.index_size:
            raise ValueError(
                f"latents: {self.latents.max()} is not the number of one of {self.codec.index_size} codewords"
            )
        check_array("confidence", self.confidence, (len(LEVELS), "N"), dims, dtype=np.float32)
        check_array("canonical", self.canonical, (len(CANONICAL_PHRASES), big), dtype=np.float32)
        if self.things is not None:
            check_array("things", self.things, ("N",), dims, dtype=np.uint16)
        known = {phrase_key(phrase): vector for phrase, vector in self.phrasebook.items()}
        object.__setattr__(self, "phrasebook", known)
        for phrase, vector in known.items():
            check_array(f"phrasebook[{phrase!r}]", vector, (big,), dtype=np.float32)

    def __len__(self) -> int:
        return int(self.latents.shape[1])

    @property
    def known(self) -> Array:
        """(3, N) whether a Gaussian has a meaning at a level."""
        flat = meaningful(self.codec, self.latents.reshape(-1, self.latents.shape[2]))
        known: Array = (self.confidence > 0) & flat.reshape(self.confidence.shape)
        return known

    def take(self, rows: Array) -> "LanguageField":
        """The field of the Gaussians at `rows` (indices or a boolean mask)."""
        return replace(
            self,
            latents=self.latents[:, rows],
            confidence=self.confidence[:, rows],
            things=None if self.things is None else self.things[rows],
        )
