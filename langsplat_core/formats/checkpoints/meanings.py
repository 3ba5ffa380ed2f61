"""What the Gaussians of a foreign checkpoint mean, each method's own way, read a block at a time.

A `Meaning` is the vectors of N Gaussians at one level. Methods keep 512 numbers per Gaussian, or something
smaller that stands for them; either way no (N, 512) array is made here.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array

NO_CODE = 255  # in every place of a product code: no meaning


class Meaning(Protocol):
    """The vectors of N Gaussians."""

    def __len__(self) -> int:
        """N"""

    @property
    def dim(self) -> int:
        """Numbers per vector."""

    def rows(self, indices: Array) -> Array:
        """(n,) whole numbers below N -> (n, dim) float32 vectors of any length; zero for no meaning."""


@dataclass(frozen=True, eq=False)
class Vectors:
    """A vector for each: Occam's LGS, Feature-3DGS; or a latent for each: LangSplat."""

    values: Array  # (N, D) floats of any length

    def __len__(self) -> int:
        return len(self.values)

    @property
    def dim(self) -> int:
        return int(self.values.shape[1])

    def rows(self, indices: Array) -> Array:
        return np.asarray(self.values[indices], np.float32)


@dataclass(frozen=True, eq=False)
class SparseCodes:
    """LangSplatV2: a Gaussian is a mixture of the few codewords that its logits name.

    The weights are the largest `topk` of a softmax, scaled to the sum 1. Logits that are all equal were
    never trained, and stand for nothing.
    """

    logits: Array  # (N, L K) floats, for L layers of codewords one after the other
    codewords: Array  # (L, K, D) float32; the layers' mixtures are added
    topk: int = 4

    def __len__(self) -> int:
        return len(self.logits)

    @property
    def dim(self) -> int:
        return int(self.codewords.shape[2])

    def rows(self, indices: Array) -> Array:
        layers, size, dim = self.codewords.shape
        logits = np.asarray(self.logits[indices], np.float32)
        mixed = np.zeros((len(logits), dim), np.float32)
        for layer in range(layers):
            weights = _largest_of_softmax(logits[:, layer * size : (layer + 1) * size], self.topk)
            mixed += weights @ self.codewords[layer]
        return np.where(np.ptp(logits, axis=1, keepdims=True) != 0, mixed, np.float32(0))


def _largest_of_softmax(logits: Array, count: int) -> Array:
    """(n, K) logits -> (n, K) weights: the `count` largest of their softmax over their sum, else 0."""
    powers = np.exp(logits - logits.max(1, keepdims=True))
    shares = powers / powers.sum(1, keepdims=True)
    count = min(count, shares.shape[1])
    largest = np.argsort(-shares, axis=1, kind="stable")[:, :count]
    kept = np.take_along_axis(shares, largest, 1)
    weights = np.zeros_like(shares)
    np.put_along_axis(weights, largest, kept / (kept.sum(1, keepdims=True) + 1e-10), 1)
    return weights


@dataclass(frozen=True, eq=False)
class ProductCodes:
    """Dr. Splat: a byte for each of M parts of the vector names one of 256 centroids of that part."""

    codes: Array  # (N, M) uint8; a row of NO_CODE has no meaning
    centroids: Array  # (M, 256, D / M) float32

    def __len__(self) -> int:
        return len(self.codes)

    @property
    def dim(self) -> int:
        return int(self.centroids.shape[0] * self.centroids.shape[2])

    def rows(self, indices: Array) -> Array:
        codes = np.asarray(self.codes[indices])
        parts = self.centroids[np.arange(codes.shape[1]), codes]
        known = (codes != NO_CODE).any(1)
        return np.where(known[:, None], parts.reshape(len(codes), self.dim), np.float32(0))


@dataclass(frozen=True, eq=False)
class Leaves:
    """OpenGaussian: a Gaussian belongs to one cluster, and the clusters have vectors."""

    index: Array  # (N,) int64 rows of `vectors`; anything beyond them has no meaning
    vectors: Array  # (K, D) float32 of any length; zero for a cluster without a meaning

    def __len__(self) -> int:
        return len(self.index)

    @property
    def dim(self) -> int:
        return int(self.vectors.shape[1])

    def rows(self, indices: Array) -> Array:
        index = self.index[indices]
        named = (index >= 0) & (index < len(self.vectors))
        return np.where(named[:, None], self.vectors[np.where(named, index, 0)], np.float32(0))


@dataclass(frozen=True, eq=False)
class Rearranged:
    """A meaning carried over to other Gaussians."""

    meaning: Meaning
    partner: Array  # (N,) int64 row of `meaning`; -1 for none

    def __len__(self) -> int:
        return len(self.partner)

    @property
    def dim(self) -> int:
        return self.meaning.dim

    def rows(self, indices: Array) -> Array:
        partner = self.partner[indices]
        out = np.zeros((len(partner), self.dim), np.float32)
        found = partner >= 0
        out[found] = self.meaning.rows(partner[found])
        return out
