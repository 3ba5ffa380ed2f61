"""The surface that Gaussians lie on, as the nearest neighbours of each: to smooth over it, and to walk
along it."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.scene import LEVELS, Gaussians

NEIGHBOURS = 16
FAINTEST = 1e-3  # weight of a Gaussian whose opacity is less, so that no mean divides by nothing
REACH = 4.0  # times the median distance of a Gaussian's neighbours: what is farther is another surface


@dataclass(frozen=True, eq=False)
class Surface:
    """The M Gaussians that count, each with its k nearest, itself first; near ones have near numbers."""

    rows: Array  # (M,) int64 indices of the Gaussians: valid, and visible to the eye
    positions: Array  # (M, 3) float64 their means, world units
    neighbours: Array  # (M, k) int32 numbers in [0, M)
    weights: Array  # (M,) float32 opacity
    links: csr_matrix  # (M, M) who is next to whom on one surface; symmetric
    anchors: Array  # (N,) int32 number of every Gaussian, if it is too faint of the nearest; -1: none is near

    def smooth(self, values: Array) -> Array:
        """(3, N) values of all Gaussians -> (3, M) float32 opacity-weighted means over each neighbourhood.

        The 3D counterpart of the mean filter that the paper applies to a relevancy map before it
        takes the peak (section 4.1, "implementation details"): one stray Gaussian decides nothing.
        """
        count, workers = len(self.rows), shared_workers()
        packed = np.empty((count, len(LEVELS) + 1), np.float32)
        workers.run(_pack, count, plain(values), self.rows, self.weights, packed)
        smoothed = np.empty((len(LEVELS), count), np.float32)
        workers.run(_smooth, count, packed, self.neighbours, smoothed)
        return smoothed

    def connected(self, inside: Array, seed: int) -> Array:
        """(M,) bool, and a member of it -> numbers of all that are linked to that member through members."""
        reached = np.empty(int(inside.sum()), np.int32)
        count = _walk(self.links.indptr, self.links.indices, inside.copy(), seed, reached)
        return reached[:count]


def build_surface(gaussians: Gaussians, min_opacity: float = 0.1) -> Surface:
    """Of all valid Gaussians with at least `min_opacity` (of all valid ones if none has)."""
    valid = gaussians.valid()
    opacity = np.where(valid, sigmoid(gaussians.opacity_logits.astype(np.float64)), 0)
    rows = np.flatnonzero(opacity >= min_opacity)
    if len(rows) == 0:
        rows = np.flatnonzero(valid)
    k = min(NEIGHBOURS, len(rows))
    if k == 0:
        return _empty(len(gaussians))
    rows = rows[cKDTree(gaussians.means[rows].astype(np.float64)).indices]  # leaf by leaf: near ones meet
    positions = gaussians.means[rows].astype(np.float64)
    tree = cKDTree(positions)
    distances, neighbours = tree.query(positions, k=k, workers=-1)
    shape = (len(rows), k)
    distances, neighbours = distances.reshape(shape), neighbours.reshape(shape).astype(np.int32)
    weights = np.maximum(opacity[rows], FAINTEST).astype(np.float32)
    reach = REACH * np.median(distances, axis=1) + 1e-12
    anchors = np.full(len(gaussians), -1, np.int32)
    anchors[rows] = np.arange(len(rows))
    faint = np.flatnonzero(valid & (anchors < 0))
    gap, nearest = tree.query(gaussians.means[faint].astype(np.float64), workers=-1)
    anchors[faint] = np.where(gap <= reach[nearest], nearest, -1)
    return Surface(rows, positions, neighbours, weights, _links(neighbours, distances, reach), anchors)


def surface_areas(gaussians: Gaussians) -> Array:
    """(N,) float64 area that each Gaussian covers, world units squared: opacity times its two longest axes
    (one standard deviation each), 0 for invalid rows. What is larger than 99 % of them counts as that: a
    veil of a few huge Gaussians is no surface."""
    valid = gaussians.valid()
    scales = np.sort(np.where(valid[:, None], gaussians.log_scales, -np.inf).astype(np.float64), axis=1)
    opacity = sigmoid(np.where(valid, gaussians.opacity_logits, -np.inf).astype(np.float64))
    areas = opacity * np.exp(scales[:, 1:].sum(1))
    return np.minimum(areas, np.quantile(areas, 0.99)) if len(areas) else areas


def _empty(count: int) -> Surface:
    """Of `count` Gaussians none of which is valid."""
    return Surface(
        rows=np.zeros(0, np.int64),
        positions=np.zeros((0, 3)),
        neighbours=np.zeros((0, 1), np.int32),
        weights=np.zeros(0, np.float32),
        links=csr_matrix((0, 0), dtype=bool),
        anchors=np.full(count, -1, np.int32),
    )


def _links(neighbours: Array, distances: Array, reach: Array) -> csr_matrix:
    near = distances <= reach[:, None]
    count = len(neighbours)
    source = np.repeat(np.arange(count, dtype=np.int32), near.sum(1))
    one_way = csr_matrix((np.ones(len(source), bool), (source, neighbours[near])), shape=(count, count))
    return (one_way + one_way.T).tocsr()


@kernel
def _pack(first: int, last: int, values: Array, rows: Array, weights: Array, packed: Array) -> None:
    """Weighted values and weight side by side (M, 4): a neighbour costs one access to memory, not four."""
    for i in range(first, last):
        row, weight = rows[i], weights[i]
        packed[i, 0] = weight * values[0, row]
        packed[i, 1] = weight * values[1, row]
        packed[i, 2] = weight * values[2, row]
        packed[i, 3] = weight


@kernel
def _smooth(first: int, last: int, packed: Array, neighbours: Array, smoothed: Array) -> None:
    """Rows [first, last) of `smoothed` (3, M) from what `_pack` made of everyone."""
    for i in range(first, last):
        subpart = part = whole = total = np.float32(0)
        for k in range(neighbours.shape[1]):
            j = neighbours[i, k]
            subpart += packed[j, 0]
            part += packed[j, 1]
            whole += packed[j, 2]
            total += packed[j, 3]
        smoothed[0, i] = subpart / total
        smoothed[1, i] = part / total
        smoothed[2, i] = whole / total


@kernel
def _walk(indptr: Array, indices: Array, waiting: Array, seed: int, reached: Array) -> int:
    """Breadth first from `seed` over members that are `waiting`; who was reached, and how many."""
    reached[0] = seed
    waiting[seed] = False
    done, found = 0, 1
    while done < found:
        here = reached[done]
        done += 1
        for entry in range(indptr[here], indptr[here + 1]):
            there = indices[entry]
            if waiting[there]:
                waiting[there] = False
                reached[found] = there
                found += 1
    return found
