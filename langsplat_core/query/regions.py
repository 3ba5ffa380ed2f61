"""Regions: patches of the surface that mean the same, at each level.

Gaussians vary, things do not: an answer made of whole regions has the borders of the things and no
speckles, and its peak is a mean over a patch instead of one lucky Gaussian. Regions are found once for a
scene, on the graph of neighbours along its surface, by the criterion of Felzenszwalb and Huttenlocher
(2004): two patches merge where the step between their meanings is no larger than the steps within either.
Where a scene knows which thing a Gaussian belongs to (`LanguageField.things`), these are the borders of
the coarsest level: the encoder may see the front and the back of a thing differently, and it stays one.
"""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.scene import LEVELS, NO_THING, Codec, LanguageField
from langsplat_core.scene.surface import Surface, divide

SCALE = 6.8  # of the criterion, in typical steps times Gaussians: larger prefers larger regions
SMALLEST = 10  # Gaussians; smaller patches join the neighbour that means the most similar
BORDER = 0.6  # added to the step between two things, in typical steps
UNKNOWN = 2.0  # step between a Gaussian with a meaning and one without: as much as between opposites
PIECES = 4  # that a level is summed in, so that more than three cores have work
STEPS = 65_535 / (UNKNOWN + 2 * BORDER)  # of 1 - cosine that are told apart: 16 bits sort in linear time


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of the M Gaussians of a surface, and of the N of its scene."""

    of: Array  # (3, M) int32 number of the region at each level, from 0
    sizes: tuple[Array, ...]  # (R,) Gaussians in each region of a level
    everywhere: Array  # (3, N) int32 the same of all Gaussians, faint ones with the nearest; -1: none is near
    weights: Array  # (N,) float32 opacity of the surface's Gaussians, 0 for all others
    totals: tuple[Array, ...]  # (R,) float64 sums of these weights

    def means(self, values: Array) -> tuple[Array, ...]:
        """(3, N) values of all Gaussians -> of every level the (R,) float64 opacity-weighted means.

        In the order of the Gaussians and not of the surface: memory is read from front to back.
        """
        longest = max(len(total) for total in self.totals)
        sums = np.zeros((len(LEVELS) * PIECES, longest))
        workers = shared_workers()
        workers.run(_sum_pieces, len(sums), plain(values), self.everywhere, self.weights, sums)
        levels = sums.reshape(len(LEVELS), PIECES, longest).sum(1)
        return tuple(row[: len(total)] / total for row, total in zip(levels, self.totals, strict=True))

    def spread(self, level: int, values: Array, others: Array) -> Array:
        """(R,) values of a level's regions -> (N,) of all Gaussians: of a faint one what is next to it, and
        where nothing is, its own of `others` (N,) of the same type."""
        spread = np.empty_like(others)
        shared_workers().run(_spread, len(others), self.everywhere[level], values, others, spread)
        return spread

    def even(self, values: Array) -> Array:
        """(3, N) float32 values -> the same, of every region its mean; of what is off the surface its own."""
        own = plain(values)
        means = [row.astype(np.float32) for row in self.means(own)]
        return np.stack([self.spread(level, row, own[level]) for level, row in enumerate(means)])


def build_regions(surface: Surface, field: LanguageField) -> Regions:
    """Regions of a scene's surface, by what its field means there; once for a scene."""
    ends = surface.ends
    of = []
    for level, known in enumerate(field.known[:, surface.rows]):
        latents = field.latents[level, surface.rows]
        steps = _steps(field.codec, latents, known, ends)
        # Between two Gaussians drawn by chance, on average: what is far in this encoder's space.
        typical = field.codec.spread(latents[known]) if known.any() else 1.0
        if level == len(LEVELS) - 1 and field.things is not None:
            steps = _along_things(steps, field.things[surface.rows], ends, BORDER * typical)
        ranks = np.round(steps * STEPS).astype(np.uint16)
        order = np.argsort(ranks, kind="stable").astype(np.int32)
        of.append(divide(surface, steps, order, SCALE * typical, SMALLEST))
    return regions_from(surface, np.stack(of))


def regions_from(surface: Surface, of: Array) -> Regions:
    """Regions by the (3, M) int32 number of each Gaussian's region at each level, counted from 0."""
    everywhere = np.full((len(LEVELS), len(surface.anchors)), -1, np.int32)
    near = surface.anchors >= 0
    everywhere[:, near] = of[:, surface.anchors[near]]
    weights = np.zeros(len(surface.anchors), np.float32)
    weights[surface.rows] = surface.weights
    totals = tuple(np.bincount(row, surface.weights) for row in of)
    return Regions(of, tuple(map(np.bincount, of)), everywhere, weights, totals)


def _steps(codec: Codec, latents: Array, known: Array, ends: tuple[Array, Array]) -> Array:
    """(E,) 1 - cosine between what the two ends of each link mean, in [0, 2]."""
    a, b = ends
    steps = codec.distances(latents, a, b)
    both, neither = known[a] & known[b], ~known[a] & ~known[b]
    return np.asarray(np.where(both, steps, np.where(neither, 0.0, UNKNOWN)).clip(0, UNKNOWN))


def _along_things(steps: Array, things: Array, ends: tuple[Array, Array], border: float) -> Array:
    """No step within a thing, a larger one between two."""
    a, b = things[ends[0]], things[ends[1]]
    told = (a != NO_THING) & (b != NO_THING)
    return np.where(told, np.where(a == b, 0, steps + border), steps)


@kernel
def _sum_pieces(first: int, last: int, values: Array, everywhere: Array, weights: Array, sums: Array) -> None:
    """Rows [first, last) of `sums` (3 P, R): of a level's P pieces the weighted sums over its regions."""
    count, pieces = len(weights), len(sums) // len(values)
    for row in range(first, last):
        level, piece = row // pieces, row % pieces
        for i in range(count * piece // pieces, count * (piece + 1) // pieces):
            if weights[i] > 0:
                sums[row, everywhere[level, i]] += np.float64(weights[i]) * values[level, i]


@kernel
def _spread(first: int, last: int, of: Array, values: Array, others: Array, spread: Array) -> None:
    """Rows [first, last) of `spread` (N,)."""
    for i in range(first, last):
        region = of[i]
        spread[i] = values[region] if region >= 0 else others[i]
