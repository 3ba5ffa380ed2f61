"""The language field: what every Gaussian means, at three levels."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.scene.codec import Codec, latent_dtype, meaningful
from langsplat_core.scene.phrases import phrase_key
from langsplat_core.scene.reading import Reading

LEVELS = ("subpart", "part", "whole")  # index 0, 1, 2 wherever a level axis appears
CANONICAL_PHRASES = ("object", "things", "stuff", "texture")  # LERF's negatives, used by LangSplat
NO_THING = 65_535  # in `LanguageField.things`: of no thing in particular


@dataclass(frozen=True, eq=False)
class LanguageField:
    """Latents of N Gaussians at the three levels, with everything a query needs beside them."""

    latents: Array  # (3, N, d) of the codec's type; zero where a Gaussian was never observed
    confidence: Array  # (3, N) float32 >= 0: total blending weight with which it was observed
    codec: Codec
    canonical: Array  # (C, D) float32 unit text vectors, of CANONICAL_PHRASES unless a query chose others
    encoder_id: str  # hub id or folder of the text encoder, e.g. "demo"
    phrasebook: Mapping[str, Array] = field(default_factory=dict)  # `phrase_key` -> (D,) unit vector
    reading: Reading = field(default_factory=Reading)
    things: Array | None = None  # (N,) uint16 number of the thing that each belongs to, or NO_THING
    everyday: Array | None = None  # (V, D) float32 unit vectors of phrases most of which name nothing here

    def __post_init__(self) -> None:
        d, big = self.codec.latent_dim, self.codec.vector_dim
        dims = check_array("latents", self.latents, (len(LEVELS), "N", d), dtype=latent_dtype(self.codec))
        if self.codec.index_size and self.latents.max(initial=0) >= self.codec.index_size:
            raise ValueError(
                f"latents: {self.latents.max()} is not the number of one of {self.codec.index_size} codewords"
            )
        check_array("confidence", self.confidence, (len(LEVELS), "N"), dims, dtype=np.float32)
        check_array("canonical", self.canonical, ("C", big), dtype=np.float32)
        if len(self.canonical) == 0:
            raise ValueError("canonical: a phrase is compared with one other at least")
        if self.things is not None:
            check_array("things", self.things, ("N",), dims, dtype=np.uint16)
        if self.everyday is not None:
            check_array("everyday", self.everyday, ("V", big), dtype=np.float32)
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
