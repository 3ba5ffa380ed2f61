"""An orthonormal basis: decoding is one matrix product, and a cosine needs not even that."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from langsplat_core.arrays import Array, check_array, unit
from langsplat_core.scene.codec.protocol import LatentSpace, directions


@dataclass(frozen=True, eq=False)
class LinearCodec:
    """Orthonormal rows spanning the scene's CLIP vectors."""

    basis: Array  # (d, D) float32, orthonormal rows
    kind: ClassVar[str] = "linear"
    index_size: ClassVar[int] = 0
    space: ClassVar[LatentSpace] = "flat"

    def __post_init__(self) -> None:
        check_array("codec basis", self.basis, ("d", "D"), dtype=np.float32)

    @property
    def latent_dim(self) -> int:
        return int(self.basis.shape[0])

    @property
    def vector_dim(self) -> int:
        return int(self.basis.shape[1])

    def encode(self, vectors: Array) -> Array:
        return np.asarray(vectors, np.float32) @ self.basis.T

    def decode(self, latents: Array) -> Array:
        return unit(np.asarray(latents, np.float32) @ self.basis)

    def similarities(self, latents: Array, vectors: Array) -> Array:
        # cos(B^T l, q) = l.(B q) / |l| for orthonormal rows of B: the big vectors never appear.
        towards, known = directions(latents)
        return np.where(known[:, None], towards @ (vectors @ self.basis.T).T, 0).astype(np.float32)

    def tensors(self) -> dict[str, Array]:
        return {"basis": self.basis}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> "LinearCodec":
        if "basis" not in tensors:
            raise ValueError("linear codec without its basis")
        return cls(tensors["basis"])
