"""What every codec offers: two maps between CLIP vectors (D numbers) and latents (d numbers), in plain
NumPy."""

from typing import ClassVar, Literal, Protocol, Self

import numpy as np

from langsplat_core.arrays import Array

SHORTEST = 1e-6  # a latent of numbers shorter than this has no meaning

# sphere: latents have length 1; flat: any vector is one; in both, a blend lies between what was blended.
# index: a latent is one whole number that names a meaning, and numbers between two names mean nothing.
LatentSpace = Literal["sphere", "flat", "index"]


class Codec(Protocol):
    """What every codec offers; `kind` names it in the scene file."""

    kind: ClassVar[str]
    space: ClassVar[LatentSpace]

    @property
    def latent_dim(self) -> int:
        """d"""

    @property
    def vector_dim(self) -> int:
        """D"""

    @property
    def index_size(self) -> int:
        """Meanings that an index may name, counted from 0; 0 where latents are numbers."""

    def encode(self, vectors: Array) -> Array:
        """(M, D) unit CLIP vectors -> (M, d) latents, float32 or, of an index, uint16."""

    def decode(self, latents: Array) -> Array:
        """(M, d) latents -> (M, D) float32 unit vectors."""

    def similarities(self, latents: Array, vectors: Array) -> Array:
        """(M, d) latents of any length, (Q, D) unit vectors -> (M, Q) float32 cosines of what the latents
        stand for. A blended latent is shorter than its kind but keeps its direction; zero gives zeros."""

    def tensors(self) -> dict[str, Array]:
        """Named weights, as written to the scene file."""

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> Self:
        """The inverse of `tensors`; ValueError if they do not belong together."""


def latent_dtype(codec: type[Codec] | Codec) -> type[np.generic]:
    """Of the latents of `codec`."""
    return np.uint16 if codec.space == "index" else np.float32


def meaningful(codec: Codec, latents: Array) -> Array:
    """(M, d) latents -> (M,) whether each stands for anything: a zero vector of numbers does not."""
    if codec.space == "index":
        return np.ones(len(latents), bool)
    known: Array = np.linalg.norm(latents, axis=1) > SHORTEST
    return known


def directions(latents: Array) -> tuple[Array, Array]:
    """(M, d) float32 latents scaled to length 1, and (M,) whether they have a direction."""
    length = np.linalg.norm(latents, axis=1)
    known = length > SHORTEST
    return (latents / np.where(known, length, 1)[:, None]).astype(np.float32), known
