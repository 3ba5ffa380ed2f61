"""A scene's own codebook: K unit vectors in CLIP space, and a latent is the number of one of them.

A scene means a countable number of things. A phrase costs one (K, D) product and a fetch per Gaussian, and
what is fetched is an exact cosine with a vector of CLIP's own space: nothing is decoded.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.scene.codec.protocol import LatentSpace

LARGEST = 65_535  # codewords: indices are 16 bits, and one number stays free for "no meaning"
ROWS = 16_384  # vectors compared with all codewords at a time


@dataclass(frozen=True, eq=False)
class CodebookCodec:
    """Codewords, and a colour for each by which people tell them apart."""

    vectors: Array  # (K, D) float32 unit vectors, 1 <= K <= LARGEST
    colours: Array  # (K, 3) float32 in [0, 1]; near codewords have near colours
    kind: ClassVar[str] = "codebook"
    space: ClassVar[LatentSpace] = "index"
    latent_dim: ClassVar[int] = 1

    def __post_init__(self) -> None:
        dims = check_array("codec vectors", self.vectors, ("K", "D"), dtype=np.float32)
        check_array("codec colours", self.colours, ("K", 3), dims, dtype=np.float32)
        if not 1 <= dims["K"] <= LARGEST:
            raise ValueError(f"codec vectors: {dims['K']} codewords; from 1 to {LARGEST} can be numbered")

    @property
    def index_size(self) -> int:
        return len(self.vectors)

    @property
    def vector_dim(self) -> int:
        return int(self.vectors.shape[1])

    def encode(self, vectors: Array) -> Array:
        nearest = np.empty((len(vectors), 1), np.uint16)
        for start in range(0, len(vectors), ROWS):
            part = slice(start, start + ROWS)
            nearest[part, 0] = (np.asarray(vectors[part], np.float32) @ self.vectors.T).argmax(1)
        return nearest

    def decode(self, latents: Array) -> Array:
        return self.vectors[latents[:, 0]]

    def similarities(self, latents: Array, vectors: Array) -> Array:
        cosines: Array = (self.vectors @ vectors.T).astype(np.float32)[latents[:, 0]]
        return cosines

    def tensors(self) -> dict[str, Array]:
        return {"vectors": self.vectors, "colours": self.colours}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> "CodebookCodec":
        missing = {"vectors", "colours"} - set(tensors)
        if missing:
            raise ValueError(f"codebook codec without its {' and '.join(sorted(missing))}")
        return cls(tensors["vectors"], tensors["colours"])


def principal_colours(vectors: Array, weights: Array) -> Array:
    """(K, c) vectors of any meaning -> (K, 3) float32 colours in [0, 1]: their first three principal axes,
    each stretched between its 2 % and 98 % quantiles; an axis that is missing or flat is grey.

    weights: (K,) >= 0, how often each occurs; the axes and quantiles are those of what occurs.
    """
    if vectors.shape[1] != 3:
        vectors = _principal(vectors.astype(np.float64), weights)
    return stretched(vectors, weights)


def stretched(axes: Array, weights: Array) -> Array:
    """(K, 3) numbers -> (K, 3) float32 in [0, 1], every axis between its weighted 2 % and 98 % quantiles."""
    colours = np.full(axes.shape, 0.5)
    occurs = np.flatnonzero(weights > 0)
    if len(occurs) == 0:
        return colours.astype(np.float32)
    for axis in range(3):
        values = axes[:, axis].astype(np.float64)
        low, high = _quantiles(values[occurs], weights[occurs])
        if high - low > 1e-6:
            colours[:, axis] = np.clip((values - low) / (high - low), 0, 1)
    return colours.astype(np.float32)


def _principal(vectors: Array, weights: Array) -> Array:
    total = max(float(weights.sum()), 1e-30)
    centred = vectors - (weights @ vectors) / total
    _, axes = np.linalg.eigh((centred * weights[:, None]).T @ centred + 1e-12 * np.eye(vectors.shape[1]))
    projected = centred @ axes[:, ::-1][:, :3]
    return np.pad(projected, ((0, 0), (0, 3 - projected.shape[1])))


def _quantiles(values: Array, weights: Array) -> tuple[float, float]:
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order], dtype=np.float64)
    low, high = np.searchsorted(below, np.array([0.02, 0.98]) * below[-1]).clip(max=len(order) - 1)
    return float(values[order[low]]), float(values[order[high]])
