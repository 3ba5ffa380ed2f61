"""Regions: the nodes of a scene's tree at each level, with the means of values over them."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.scene import LEVELS
from langsplat_core.scene.tree import Tree

PIECES = 4  # that a level is summed in, so that more than three cores have work


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of the N Gaussians of a scene; R of them at a level."""

    nodes: tuple[Array, ...]  # (R,) number in the tree of each region of a level, rising
    everywhere: Array  # (3, N) int32 number of the region at each level, from 0; -1: in none
    weights: Array  # (N,) float32 opacity of what counts, 0 for all others, see `surface_weights`
    parents: tuple[Array, Array]  # (R,) region of the level above that each is part of: of two levels
    sizes: tuple[Array, ...]  # (R,) Gaussians that count
    totals: tuple[Array, ...]  # (R,) float64 sums of their weights

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

    def best_parts(self, level: int, values: tuple[Array, ...]) -> Array:
        """(R, ...) the largest value among each region's parts at the level below; its own where it has none.

        values: of each level, the (R, ...) values of its regions.
        """
        own = values[level]
        if level == 0:
            return own
        best = np.full_like(own, -np.inf)
        np.maximum.at(best, self.parents[level - 1], values[level - 1])
        return np.where(np.isfinite(best), best, own)

    def level_of(self, members: Array) -> int:
        """The level with the region that overlaps most with `members` (N,) bool; of equal ones the
        coarsest."""
        best = []
        for of, sizes in zip(self.everywhere, self.sizes, strict=True):
            hits = np.bincount(of[members & (of >= 0) & (self.weights > 0)], minlength=len(sizes))
            best.append((hits / np.maximum(sizes + hits.sum() - hits, 1)).max(initial=0))
        return int(np.flatnonzero(np.array(best) == max(best))[-1])

    def counted(self, level: int, region: int) -> Array:
        """(K,) the Gaussians of one region that count."""
        return np.flatnonzero((self.everywhere[level] == region) & (self.weights > 0))


def build_regions(tree: Tree, weights: Array) -> Regions:
    """The regions of a scene. weights: (N,) float32, see `surface_weights`."""
    weights = np.where(tree.leaves >= 0, weights, np.float32(0))
    counts = np.flatnonzero(weights > 0)
    nodes, everywhere, parents, sizes, totals = [], [], [], [], []
    for level in range(len(LEVELS)):
        at = tree.at(level)
        there, first, row = np.unique(at[counts], return_index=True, return_inverse=True)
        number = np.full(tree.count + 1, -1, np.int32)
        number[there] = np.arange(len(there))
        nodes.append(there)
        everywhere.append(number[at])
        sizes.append(np.bincount(row, minlength=len(there)))
        totals.append(np.bincount(row, weights[counts], minlength=len(there)))
        parents.append(counts[first])  # a Gaussian of each region
    above = everywhere[1][parents[0]], everywhere[2][parents[1]]
    return Regions(tuple(nodes), np.stack(everywhere), weights, above, tuple(sizes), tuple(totals))


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
    """Fill rows [first, last) of `spread` (N,)."""
    for i in range(first, last):
        region = of[i]
        spread[i] = values[region] if region >= 0 else others[i]
