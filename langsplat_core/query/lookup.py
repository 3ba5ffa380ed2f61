"""How the relevancy of one phrase is found at every Gaussian, by what the scene's codec allows.

A codebook gives an exact answer for a fetch; a sphere of three numbers has a table over it; what is left is
compared latent by latent.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.query.table import build_table, suits_table
from langsplat_core.scene import LanguageField
from langsplat_core.semantics.relevancy import Scale, relevancy_of

TOGETHER = 16  # phrases compared with every latent at a time: 12 bytes each per Gaussian
CHUNK = 16_384  # latents that are compared with texts, or decoded vectors held, at a time


class Lookup(Protocol):
    """Everything about a language field that does not depend on the phrase."""

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """(Q, D) unit phrase vectors -> of each in turn (3 N,) float32 relevancy; 0 where a Gaussian has no
        meaning. What can be computed for all phrases together is."""


def build_lookup(field: LanguageField, scale: Scale, exact: bool = False) -> Lookup:
    """The fastest lookup for `field`; with `exact` none that interpolates, to measure a table by."""
    if field.codec.space == "index":
        return CodeLookup(field, scale)
    if exact:
        return DecodedLookup(field, scale)
    if suits_table(field.codec):
        return build_table(field.codec, known_latents(field), scale)
    return LatentLookup(field, scale)


def known_latents(field: LanguageField) -> Array:
    """(3 N, d) latents, zero where a Gaussian has no meaning."""
    latents = np.where(field.known[..., None], field.latents, 0)
    return latents.reshape(-1, field.latents.shape[-1])


class CodeLookup:
    """K relevancies of codewords, and a fetch per Gaussian: exact."""

    def __init__(self, field: LanguageField, scale: Scale) -> None:
        count = field.codec.index_size
        self._vectors = field.codec.decode(np.arange(count, dtype=np.uint16)[:, None])
        self._zero, self._rate = scale.of(self._vectors @ scale.texts.T)
        self._codes = np.where(field.known, field.latents[..., 0], count).astype(np.uint16).reshape(-1)

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """See `Lookup`."""
        values = relevancy_of(self._vectors @ phrases.T, self._zero[:, None], self._rate[:, None])
        for row in values.T:
            found = np.empty(len(self._codes), np.float32)
            shared_workers().run(_fetch, len(found), plain(np.append(row, 0)), self._codes, found)
            yield found


@dataclass(frozen=True, eq=False)
class LatentLookup:
    """Every latent compared, in bounded memory."""

    field: LanguageField
    scale: Scale

    @cached_property
    def _read(self) -> tuple[Array, Array, Array]:
        """Rows of (3 N,) with a meaning, and the (M,) zero and rate of each."""
        field = self.field
        rows = np.flatnonzero(field.known)
        latents = field.latents.reshape(-1, field.latents.shape[-1])
        zero, rate = np.empty(len(rows), np.float32), np.empty(len(rows), np.float32)
        for start in range(0, len(rows), CHUNK):
            part = slice(start, start + CHUNK)
            zero[part], rate[part] = self.scale.of(
                field.codec.similarities(latents[rows[part]], self.scale.texts)
            )
        return rows, zero, rate

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """See `Lookup`."""
        field, (rows, zero, rate) = self.field, self._read
        latents = field.latents.reshape(-1, field.latents.shape[-1])
        for first in range(0, len(phrases), TOGETHER):
            some = phrases[first : first + TOGETHER]
            values = np.zeros((len(some), len(latents)), np.float32)
            for start in range(0, len(rows), CHUNK):
                part = slice(start, start + CHUNK)
                cosines = field.codec.similarities(latents[rows[part]], some)
                values[:, rows[part]] = relevancy_of(cosines, zero[part, None], rate[part, None]).T
            yield from values


@dataclass(frozen=True, eq=False)
class DecodedLookup:
    """Every latent decoded once, 2 KB each at D = 512."""

    field: LanguageField
    scale: Scale

    @cached_property
    def _decoded(self) -> tuple[Array, Array, Array, Array]:
        """Rows of (3 N,) with a meaning, their (M, D) vectors, and the (M,) zero and rate of each."""
        field = self.field
        rows = np.flatnonzero(field.known)
        latents = field.latents.reshape(-1, field.latents.shape[-1])
        vectors = np.empty((len(rows), field.codec.vector_dim), np.float32)
        zero, rate = np.empty(len(rows), np.float32), np.empty(len(rows), np.float32)
        for start in range(0, len(rows), CHUNK):
            part = slice(start, start + CHUNK)
            vectors[part] = field.codec.decode(latents[rows[part]])
            zero[part], rate[part] = self.scale.of(vectors[part] @ self.scale.texts.T)
        return rows, vectors, zero, rate

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """See `Lookup`."""
        rows, vectors, zero, rate = self._decoded
        for phrase in phrases:
            values = np.zeros(self.field.confidence.size, np.float32)
            values[rows] = relevancy_of(vectors @ phrase, zero, rate)
            yield values


@kernel
def _fetch(first: int, last: int, values: Array, codes: Array, found: Array) -> None:
    """Rows [first, last) of `found` (3 N,)."""
    for i in range(first, last):
        found[i] = values[codes[i]]
