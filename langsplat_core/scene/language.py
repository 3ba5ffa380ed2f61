"""The language field: what every Gaussian means, at three levels."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.scene.codec import Codec
from langsplat_core.scene.phrases import phrase_key

LEVELS = ("subpart", "part", "whole")  # index 0, 1, 2 wherever a level axis appears
CANONICAL_PHRASES = ("object", "things", "stuff", "texture")  # LERF's negatives, used by LangSplat


@dataclass(frozen=True, eq=False)
class LanguageField:
    """Latents of N Gaussians at the three levels, with everything a query needs beside them."""

    latents: Array  # (3, N, d) float32; zero where a Gaussian was never observed
    confidence: Array  # (3, N) float32 >= 0: total blending weight with which it was observed
    codec: Codec
    canonical: Array  # (4, D) float32 unit text vectors of CANONICAL_PHRASES
    encoder_id: str  # hub id or folder of the text encoder, e.g. "demo"
    phrasebook: Mapping[str, Array] = field(default_factory=dict)  # `phrase_key` -> (D,) unit vector

    def __post_init__(self) -> None:
        d, big = self.codec.latent_dim, self.codec.vector_dim
        dims = check_array("latents", self.latents, (len(LEVELS), "N", d), dtype=np.float32)
        check_array("confidence", self.confidence, (len(LEVELS), "N"), dims, dtype=np.float32)
        check_array("canonical", self.canonical, (len(CANONICAL_PHRASES), big), dtype=np.float32)
        known = {phrase_key(phrase): vector for phrase, vector in self.phrasebook.items()}
        object.__setattr__(self, "phrasebook", known)
        for phrase, vector in known.items():
            check_array(f"phrasebook[{phrase!r}]", vector, (big,), dtype=np.float32)

    def __len__(self) -> int:
        return int(self.latents.shape[1])

    def take(self, rows: Array) -> "LanguageField":
        """The field of the Gaussians at `rows` (indices or a boolean mask)."""
        return replace(self, latents=self.latents[:, rows], confidence=self.confidence[:, rows])
