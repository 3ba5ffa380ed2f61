"""Regions: the sets of Gaussians that a scene's tree makes at each level, and sums and means over them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.query.instances import axis_aligned_box
from langsplat_core.query.rule import RULE, Chance, RegionTable, region_fits
from langsplat_core.scene import LEVELS, LanguageField
from langsplat_core.scene.language import Tree
from langsplat_core.semantics.relevancy import Scale, relevancy_of

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

    @cached_property
    def table(self) -> RegionTable:
        """The regions of all levels one after the other, as the rule for answers reads them."""
        counts = np.array([len(sizes) for sizes in self.sizes])
        parts, wholes = counts[0], counts[0] + counts[1]
        parents = self.parents[0] + parts, self.parents[1] + wholes, np.full(counts[2], -1)
        solid = np.concatenate(self.sizes) >= RULE.smallest
        return RegionTable(counts[None], np.concatenate(parents), solid)

    def means(self, values: Array) -> tuple[Array, ...]:
        """Return the (R,) float64 opacity-weighted means of (3, N) values over the regions of every level.

        Summed in the order of the Gaussians and not of the surface: memory is read from front to back.
        """
        longest = max(len(total) for total in self.totals)
        sums = np.zeros((len(LEVELS) * PIECES, longest))
        workers = shared_workers()
        workers.run(_sum_pieces, len(sums), plain(values), self.everywhere, self.weights, sums)
        levels = sums.reshape(len(LEVELS), PIECES, longest).sum(1)
        return tuple(row[: len(total)] / total for row, total in zip(levels, self.totals, strict=True))

    def spread(self, level: int, values: Array, others: Array) -> Array:
        """Return the (N,) values of all Gaussians from the (R,) values of a level's regions.

        A faint Gaussian takes the value of what is next to it, and where nothing is, its own of `others`
        (N,), of the same type.
        """
        spread = np.empty_like(others)
        shared_workers().run(_spread, len(others), self.everywhere[level], values, others, spread)
        return spread

    def level_of(self, members: Array) -> int:
        """Return the level with the region that overlaps most with `members` (N,) bool.

        Of equal ones that is the coarsest.
        """
        best = []
        for of, sizes in zip(self.everywhere, self.sizes, strict=True):
            hits = np.bincount(of[members & (of >= 0) & (self.weights > 0)], minlength=len(sizes))
            best.append((hits / np.maximum(sizes + hits.sum() - hits, 1)).max(initial=0))
        return int(np.flatnonzero(np.array(best) == max(best))[-1])

    def counted(self, level: int, region: int) -> Array:
        """Return the (K,) Gaussians of one region that count."""
        return np.flatnonzero((self.everywhere[level] == region) & (self.weights > 0))


def build_regions(tree: Tree, weights: Array) -> Regions:
    """Return the regions of a scene. weights: (N,) float32, see `surface_weights`."""
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


# Language features of regions.

CHUNK = 16_384  # distinct features read at a time


def feature_sums(
    field: LanguageField, level: int, of: Array, weights: Array, count: int, read: Callable[[Array], Array]
) -> Array:
    """Return (count, V) weighted sums, over sets of Gaussians, of what `read` makes of their features.

    read: (M, d) latents -> (M, V). of: (N,) set of each Gaussian, -1 for none; weights: (N,).
    """
    rows = np.flatnonzero(field.known[level] & (of >= 0) & (weights > 0))
    latents, kinds = field.codec.unique(field.latents[level, rows])
    shares = csr_matrix((weights[rows], (of[rows], kinds)), shape=(count, len(latents))).tocsc()
    parts = [slice(start, start + CHUNK) for start in range(0, max(len(latents), 1), CHUNK)]
    return sum((shares[:, part] @ read(latents[part])).astype(np.float64) for part in parts)


def chance_in(field: LanguageField, regions: Regions, scale: Scale) -> Chance:
    """Return the fits of everyday phrases in a scene; -inf in crumbs where a level has more than these."""
    assert scale.everyday is not None

    def everyday(latents: Array) -> Array:
        cosines = field.codec.cosines(latents, scale.texts)
        zero, rate = scale.of(cosines)
        return relevancy_of(cosines[:, len(scale.canonical) :], zero[:, None], rate[:, None])

    sums = [
        feature_sums(field, level, of, regions.weights, len(totals), everyday) / totals[:, None]
        for level, (of, totals) in enumerate(zip(regions.everywhere, regions.totals, strict=True))
    ]
    own = np.concatenate([scale.fit(means).astype(np.float32) for means in sums])
    every = region_fits(regions.table, own)
    fits = [regions.table.level(level, every) for level in range(len(LEVELS))]
    solid = [sizes >= RULE.smallest for sizes in regions.sizes]
    return tuple(
        np.where(rows[:, None], row, -np.inf) if rows.any() else row
        for row, rows in zip(fits, solid, strict=True)
    )


# Where a region is.

MIDDLE = 16  # Gaussians around the middle of a region


def place_of(points: Array) -> tuple[Array, Array]:
    """Return place (3,), at what is nearest to the middle, and box (2, 3) of (K, 3) points, K >= 1."""
    points = points.astype(np.float64)
    far = ((points - points.mean(0)) ** 2).sum(1)
    near = np.argpartition(far, min(MIDDLE, len(far)) - 1)[:MIDDLE]
    return points[near].mean(0), axis_aligned_box(points)
