"""A phrase as a small table: relevancy over the sphere of latents.

With d = 3 and unit latents, the relevancy of one phrase is a function on the sphere. The decoder is run
once per scene at the nodes of an octahedral grid that its latents lie between; after that a phrase costs one
matrix-vector product, and every Gaussian looks its value up by bilinear interpolation at a place computed
once.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel, shared_workers
from langsplat_core.scene import Codec
from langsplat_core.scene.codec import meaningful
from langsplat_core.semantics.relevancy import Scale, relevancy_of

RESOLUTION = 256  # nodes per side; error against exact decoding falls with its square


def octahedral_to_sphere(uv: Array) -> Array:
    """(..., 2) in [0, 1]^2 -> (..., 3) unit vectors; the square's border is the lower hemisphere's pole."""
    xy = 2 * np.asarray(uv, np.float64) - 1
    z = 1 - np.abs(xy).sum(-1)
    folded = (1 - np.abs(xy[..., ::-1])) * np.where(xy >= 0, 1, -1)
    xy = np.where((z < 0)[..., None], folded, xy)
    vectors = np.concatenate([xy, z[..., None]], -1)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def sphere_to_octahedral(vectors: Array) -> Array:
    """(..., 3) non-zero vectors -> (..., 2) in [0, 1]^2; inverse of `octahedral_to_sphere`."""
    scaled = vectors / np.abs(vectors).sum(-1, keepdims=True)
    xy, z = scaled[..., :2], scaled[..., 2]
    folded = (1 - np.abs(xy[..., ::-1])) * np.where(xy >= 0, 1, -1)
    return (np.where((z < 0)[..., None], folded, xy) + 1) / 2


@dataclass(frozen=True, eq=False)
class SphereTable:
    """Decoded vectors at the U nodes of R x R that are needed, and where M latents lie between them."""

    used: Array  # (U,) int64 index of each node in the grid, row-major
    vectors: Array  # (U, D) float32 decoded unit vectors
    zero: Array  # (U,) cosine of relevancy 0.5, see `chance.Scale`
    rate: Array  # (U,)
    corner: Array  # (M,) int32 index of the lower left node; -1 for a latent without meaning
    fraction: Array  # (M, 2) float32 position inside the cell, in [0, 1]
    resolution: int

    def relevancies(self, phrases: Array) -> Iterator[Array]:
        """(Q, D) unit phrase vectors -> of each in turn (M,) float32 relevancy; 0 where the latent has no
        meaning."""
        values = relevancy_of(self.vectors @ phrases.T, self.zero[:, None], self.rate[:, None])
        nodes = np.zeros(self.resolution**2, np.float32)
        for row in values.T:
            nodes[self.used] = row
            found = np.empty(len(self.corner), np.float32)
            arguments = nodes, self.corner, self.fraction, self.resolution, found
            shared_workers().run(_interpolate, len(found), *arguments)
            yield found


def suits_table(codec: Codec) -> bool:
    """Whether the codec's latents lie on a sphere."""
    return codec.latent_dim == 3 and codec.space == "sphere"


def build_table(codec: Codec, latents: Array, scale: Scale, resolution: int = RESOLUTION) -> SphereTable:
    """Tabulate `codec` for (M, 3) latents; those of no length have no meaning."""
    if not suits_table(codec):
        raise ValueError(f"a sphere table needs unit latents of 3 numbers; {codec.kind} has others")
    known = meaningful(codec, latents)
    safe = np.where(known[:, None], latents, (0.0, 0.0, 1.0)).astype(np.float64)
    position = sphere_to_octahedral(safe) * (resolution - 1)
    cell = np.clip(np.floor(position), 0, resolution - 2).astype(np.int64)
    corner = cell[:, 1] * resolution + cell[:, 0]  # row-major: first coordinate fastest
    needed = np.zeros(resolution**2, bool)
    for step in (0, 1, resolution, resolution + 1):
        needed[corner[known] + step] = True
    used = np.flatnonzero(needed)
    grid = np.stack([used % resolution, used // resolution], 1) / (resolution - 1)
    vectors = codec.decode(octahedral_to_sphere(grid).astype(np.float32))
    zero, rate = scale.of(vectors @ scale.texts.T)
    return SphereTable(
        used=used,
        vectors=vectors,
        zero=zero,
        rate=rate,
        corner=np.where(known, corner, -1).astype(np.int32),
        fraction=(position - cell).astype(np.float32),
        resolution=resolution,
    )


@kernel
def _interpolate(
    first: int, last: int, nodes: Array, corner: Array, fraction: Array, resolution: int, found: Array
) -> None:
    """Rows [first, last) of `found` (M,), bilinear."""
    one = np.float32(1)
    for i in range(first, last):
        node, u, v = corner[i], fraction[i, 0], fraction[i, 1]
        if node < 0:
            found[i] = 0
            continue
        low = nodes[node] * (one - u) + nodes[node + 1] * u
        high = nodes[node + resolution] * (one - u) + nodes[node + resolution + 1] * u
        found[i] = low * (one - v) + high * v
