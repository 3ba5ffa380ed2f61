"""Relevancy of phrases at every Gaussian, by what the scene's codec allows, and at every pixel.

Each distinct latent is compared, exactly; those of a codebook are few, and every Gaussian costs a fetch. Of
unit latents of three numbers, the relevancy of a phrase is a function on the sphere: the decoder is run once
per scene at the nodes of an octahedral grid that its latents lie between; after that a phrase costs one
matrix-vector product, and every Gaussian a bilinear interpolation at a place computed once.
"""

from collections.abc import Iterator

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel, shared_workers
from langsplat_core.display.displays import gated_mean
from langsplat_core.errors import InputError
from langsplat_core.raster.protocol import View
from langsplat_core.scene import Codec, LanguageField
from langsplat_core.semantics.relevancy import Scale, latent_relevancy, relevancy_of

RESOLUTION = 256  # nodes per side; error against exact decoding falls with its square
TOGETHER = 16  # phrases compared with every latent at a time: 4 bytes each per latent
CHUNK = 16_384  # latents that are compared with texts at a time


class SphereTable:
    """Unit latents of three numbers: decoded once at the nodes of a grid, then interpolated between them."""

    def __init__(self, codec: Codec, latents: Array, scale: Scale, resolution: int = RESOLUTION) -> None:
        """latents: (M, 3) float; those of no length have no meaning."""
        known = codec.known(latents)
        safe = np.where(known[:, None], latents, (0.0, 0.0, 1.0)).astype(np.float64)
        position = sphere_to_octahedral(safe) * (resolution - 1)
        cell = np.clip(np.floor(position), 0, resolution - 2).astype(np.int64)
        corner = cell[:, 1] * resolution + cell[:, 0]  # row-major: first coordinate fastest
        needed = np.zeros(resolution**2, bool)
        for step in (0, 1, resolution, resolution + 1):
            needed[corner[known] + step] = True
        self._resolution = resolution
        self._corner = np.where(known, corner, -1).astype(np.int32)  # (M,) lower left node
        self._fraction = (position - cell).astype(np.float32)  # (M, 2) place inside the cell, in [0, 1]
        self.used = np.flatnonzero(needed)  # (U,) nodes that some latent lies next to
        grid = np.stack([self.used % resolution, self.used // resolution], 1) / (resolution - 1)
        self._vectors = codec.decode(octahedral_to_sphere(grid).astype(np.float32))
        self._zero, self._rate = scale.of(self._vectors @ scale.texts.T)

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """(Q, D) unit phrase vectors -> of each in turn (M,) float32 relevancy; 0 for no meaning."""
        values = relevancy_of(self._vectors @ phrases.T, self._zero[:, None], self._rate[:, None])
        grid = np.zeros(self._resolution**2, np.float32)
        for row in values.T:
            grid[self.used] = row
            found = np.empty(len(self._corner), np.float32)
            arguments = grid, self._corner, self._fraction, self._resolution, found
            shared_workers().run(_interpolate, len(found), *arguments)
            yield found


def octahedral_to_sphere(uv: Array) -> Array:
    """(..., 2) in [0, 1]^2 -> (..., 3) unit vectors; the square's border is the lower hemisphere's pole."""
    xy = 2 * np.asarray(uv, np.float64) - 1
    z = 1 - np.abs(xy).sum(-1)
    vectors = np.concatenate([_folded(xy, z), z[..., None]], -1)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def sphere_to_octahedral(vectors: Array) -> Array:
    """(..., 3) non-zero vectors -> (..., 2) in [0, 1]^2; inverse of `octahedral_to_sphere`."""
    scaled = vectors / np.abs(vectors).sum(-1, keepdims=True)
    return (_folded(scaled[..., :2], scaled[..., 2]) + 1) / 2


def _folded(xy: Array, z: Array) -> Array:
    """Fold the lower half (z < 0) of the octahedron out into the square's corners, or back in."""
    return np.where((z < 0)[..., None], (1 - np.abs(xy[..., ::-1])) * np.where(xy >= 0, 1, -1), xy)


class ExactLookup:
    """Compares every distinct latent, then fetches per Gaussian: exact, in bounded memory."""

    def __init__(self, field: LanguageField, scale: Scale) -> None:
        self._codec = field.codec
        self._latents, of = field.codec.unique(field.latents.reshape(-1, field.latents.shape[-1]))
        count = len(self._latents)
        kind = np.uint16 if count <= np.iinfo(np.uint16).max else np.uint32
        self._of = np.where(field.known.reshape(-1), of, count).astype(kind)
        self._zero, self._rate = np.empty(count, np.float32), np.empty(count, np.float32)
        for part in self._parts():
            cosines = self._codec.cosines(self._latents[part], scale.texts)
            self._zero[part], self._rate[part] = scale.of(cosines)

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """(Q, D) unit phrase vectors -> of each in turn (3 N,) float32 relevancy; 0 for no meaning."""
        for first in range(0, len(phrases), TOGETHER):
            some = phrases[first : first + TOGETHER]
            values = np.zeros((len(some), len(self._latents) + 1), np.float32)  # the last: no meaning
            for part in self._parts():
                cosines = self._codec.cosines(self._latents[part], some)
                zero, rate = self._zero[part, None], self._rate[part, None]
                values[:, :-1][:, part] = relevancy_of(cosines, zero, rate).T
            for row in values:
                found = np.empty(len(self._of), np.float32)
                shared_workers().run(_fetch, len(found), row, self._of, found)
                yield found

    def _parts(self) -> Iterator[slice]:
        for start in range(0, len(self._latents), CHUNK):
            yield slice(start, min(start + CHUNK, len(self._latents)))


Lookup = SphereTable | ExactLookup  # what of a language field does not depend on the phrase


def build_lookup(field: LanguageField, scale: Scale, exact: bool = False) -> Lookup:
    """The fastest lookup for `field`; with `exact` none that interpolates, to measure a table by."""
    if field.codec.spherical and not exact:
        latents = np.where(field.known[..., None], field.latents, 0)
        return SphereTable(field.codec, latents.reshape(-1, 3), scale)
    return ExactLookup(field, scale)


@kernel
def _fetch(first: int, last: int, values: Array, codes: Array, found: Array) -> None:
    """Fill rows [first, last) of `found` (3 N,)."""
    for i in range(first, last):
        found[i] = values[codes[i]]


@kernel
def _interpolate(
    first: int, last: int, nodes: Array, corner: Array, fraction: Array, resolution: int, found: Array
) -> None:
    """Fill rows [first, last) of `found` (M,), bilinear."""
    one = np.float32(1)
    for i in range(first, last):
        node, u, v = corner[i], fraction[i, 0], fraction[i, 1]
        if node < 0:
            found[i] = 0
            continue
        low = nodes[node] * (one - u) + nodes[node + 1] * u
        high = nodes[node + resolution] * (one - u) + nodes[node + resolution + 1] * u
        found[i] = low * (one - v) + high * v


# Relevancy of pixels: per Gaussian and splatted, one linear channel per phrase (ours); or of latents that are
# splatted and decoded (the paper's order, section 3.4). Both are gated by alpha, because an uncovered pixel's
# zero latent decodes to a confident something.


def splatted_relevancy(view: View, relevancy: Array, alpha_gate: float) -> Array:
    """(N, Q) per-Gaussian relevancy -> (H, W, Q) per-pixel relevancy in [0, 1]; 0 under the gate."""
    total, alpha = view.splat(np.asarray(relevancy, np.float32))
    return gated_mean(total, alpha, alpha_gate)


def decoded_relevancy(
    view: View, field: LanguageField, level: int, phrases: Array, alpha_gate: float
) -> Array:
    """The paper's order: (Q, D) phrase vectors -> (H, W, Q) relevancy of the decoded pixel latents.

    Raises InputError for a codebook, whose numbers cannot be blended.
    """
    if not field.codec.blends:
        raise InputError(
            f"the paper's order blends latents, and this scene has a {field.codec.kind}; train one with "
            "`--codec.kind autoencoder`"
        )
    blended, alpha = view.splat(field.latents[level])
    height, width, d = blended.shape
    flat = np.where(alpha[..., None] > alpha_gate, blended, 0).reshape(-1, d)
    values = latent_relevancy(field.codec, flat, phrases, field.canonical, field.reading.temperature)
    return values.reshape(height, width, len(phrases))
