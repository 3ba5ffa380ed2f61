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
from langsplat_core.semantics.relevancy import CHUNK, from_cosines, latent_relevancy

TOGETHER = 16  # phrases compared with every latent at a time: 12 bytes each per Gaussian


class Lookup(Protocol):
    """Everything about a language field that does not depend on the phrase."""

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """(Q, D) unit phrase vectors -> of each in turn (3 N,) float32 relevancy; 0 where a Gaussian has no
        meaning. What can be computed for all phrases together is."""


def build_lookup(field: LanguageField, exact: bool = False) -> Lookup:
    """The fastest lookup for `field`; with `exact` none that interpolates, to measure a table by."""
    if field.codec.space == "index":
        return CodeLookup(field)
    if exact:
        return DecodedLookup(field)
    if suits_table(field.codec):
        return build_table(field.codec, known_latents(field), field.canonical, field.reading.temperature)
    return LatentLookup(field)


def known_latents(field: LanguageField) -> Array:
    """(3 N, d) latents, zero where a Gaussian has no meaning."""
    latents = np.where(field.known[..., None], field.latents, 0)
    return latents.reshape(-1, field.latents.shape[-1])


class CodeLookup:
    """K relevancies of codewords, and a fetch per Gaussian: exact."""

    def __init__(self, field: LanguageField) -> None:
        count = field.codec.index_size
        self._temperature = field.reading.temperature
        self._vectors = field.codec.decode(np.arange(count, dtype=np.uint16)[:, None])
        self._nearest = (self._vectors @ field.canonical.T).max(1)
        self._codes = np.where(field.known, field.latents[..., 0], count).astype(np.uint16).reshape(-1)

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """See `Lookup`."""
        values = from_cosines(self._vectors @ phrases.T, self._nearest[:, None], self._temperature)
        for row in values.T:
            found = np.empty(len(self._codes), np.float32)
            shared_workers().run(_fetch, len(found), plain(np.append(row, 0)), self._codes, found)
            yield found


@dataclass(frozen=True, eq=False)
class LatentLookup:
    """Every latent compared, in bounded memory."""

    field: LanguageField

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """See `Lookup`."""
        field = self.field
        latents, temperature = known_latents(field), field.reading.temperature
        for start in range(0, len(phrases), TOGETHER):
            some = phrases[start : start + TOGETHER]
            values = latent_relevancy(field.codec, latents, some, field.canonical, temperature)
            yield from np.ascontiguousarray(values.T)


@dataclass(frozen=True, eq=False)
class DecodedLookup:
    """Every latent decoded once, 2 KB each at D = 512."""

    field: LanguageField

    @cached_property
    def _decoded(self) -> tuple[Array, Array, Array]:
        """Rows of (3 N,) with a meaning, their (M, D) vectors, and (M,) their cosine with the nearest
        canonical phrase."""
        field = self.field
        rows = np.flatnonzero(field.known)
        latents = field.latents.reshape(-1, field.latents.shape[-1])
        vectors = np.empty((len(rows), field.codec.vector_dim), np.float32)
        nearest = np.empty(len(rows), np.float32)
        for start in range(0, len(rows), CHUNK):
            part = slice(start, start + CHUNK)
            vectors[part] = field.codec.decode(latents[rows[part]])
            nearest[part] = (vectors[part] @ field.canonical.T).max(1)
        return rows, vectors, nearest

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """See `Lookup`."""
        rows, vectors, nearest = self._decoded
        for phrase in phrases:
            values = np.zeros(self.field.confidence.size, np.float32)
            values[rows] = from_cosines(vectors @ phrase, nearest, self.field.reading.temperature)
            yield values


@kernel
def _fetch(first: int, last: int, values: Array, codes: Array, found: Array) -> None:
    """Rows [first, last) of `found` (3 N,)."""
    for i in range(first, last):
        found[i] = values[codes[i]]
