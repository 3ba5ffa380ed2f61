"""Hierarchical merging of the regions of a photograph: the data structure behind the graph's masks."""

import heapq

import numpy as np

from langsplat_core.arrays import Array

MEAN_LIGHTNESS = 0.25  # weight of lightness where mean colours are compared: shade is no other thing
EDGE_LIGHTNESS = 0.4  # and where a boundary's contrast is measured
CONTRAST_REACH = 2  # px on either side of a boundary, because blurred edges are wider than one step
SIZE_POWER = 0.25  # how much cheaper small regions merge than large ones
SIZE_UNIT = 1 / 200  # of the picture: a region of this size merges at its plain cost
ENCLOSED = 0.5  # a region wholly inside another merges with it at this much less


class RegionGraph:
    """Regions of a picture with their neighbours; the cheapest pair merges first, so that every later
    partition is made of unions of every earlier one.

    The cost of a pair is the distance of its mean colours plus the mean contrast along the common
    boundary, less for small regions and for those that the other one encloses.
    """

    def __init__(self, labels: Array, colours: Array) -> None:
        """labels: (H, W) int, 0..N-1, each present; colours: (H, W, 3) lightness and two chromaticities."""
        self._labels = labels
        count = int(labels.max()) + 1
        flat = labels.ravel()
        self._size = np.bincount(flat, minlength=count).astype(float)  # px
        shades = colours * (MEAN_LIGHTNESS, 1.0, 1.0)
        sums = [np.bincount(flat, shades[..., c].ravel(), count) for c in range(3)]
        self._mean = np.stack(sums, axis=1) / self._size[:, None]
        self._neighbours = _adjacency(labels, colours, count)
        self._perimeter = [sum(length for length, _ in edges.values()) for edges in self._neighbours]
        self._parent = np.arange(count)
        self._version = [0] * count  # rises with every change: entries of the heap with another are stale
        self._heap: list[tuple[float, int, int, int, int]] = []
        for i in range(count):
            for j in self._neighbours[i]:
                if i < j:
                    self._push(i, j)

    def merge_until(self, cost: float, min_fraction: float) -> None:
        """Merge every pair cheaper than `cost`, then every region below `min_fraction` of the picture with
        its cheapest neighbour."""
        while self._heap and self._heap[0][0] <= cost:
            _, i, j, version_i, version_j = heapq.heappop(self._heap)
            if (self._version[i], self._version[j]) == (version_i, version_j):
                self._merge(i, j)
        alive = np.flatnonzero(self._parent == np.arange(len(self._parent)))
        while len(alive) > 1:
            smallest = int(alive[np.argmin(self._size[alive])])
            if self._size[smallest] >= min_fraction * self._labels.size:
                return
            into = min(self._neighbours[smallest], key=lambda other: (self._cost(smallest, other), other))
            self._merge(into, smallest)
            alive = alive[alive != smallest]

    def partition(self) -> Array:
        """(H, W) int: the regions as they are now, numbered 0..M-1."""
        roots = self._parent
        while not np.array_equal(roots, roots[roots]):
            roots = roots[roots]
        return np.unique(roots, return_inverse=True)[1][self._labels]

    def _cost(self, i: int, j: int) -> float:
        length, contrast = self._neighbours[i][j]
        smaller = min(self._size[i], self._size[j]) / self._labels.size
        shared = length / min(self._perimeter[i], self._perimeter[j])
        enclosure = 1 - ENCLOSED * max(0.0, 2 * shared - 1)
        difference = float(np.linalg.norm(self._mean[i] - self._mean[j])) + contrast / length
        return float(difference * (smaller / SIZE_UNIT) ** SIZE_POWER * enclosure)

    def _push(self, i: int, j: int) -> None:
        heapq.heappush(self._heap, (self._cost(i, j), i, j, self._version[i], self._version[j]))

    def _merge(self, kept: int, gone: int) -> None:
        size = self._size[kept] + self._size[gone]
        weighted = self._mean[kept] * self._size[kept] + self._mean[gone] * self._size[gone]
        self._mean[kept], self._size[kept] = weighted / size, size
        edges = self._neighbours[gone]
        self._perimeter[kept] += self._perimeter[gone] - 2 * edges[kept][0]
        for other, (length, contrast) in edges.items():
            del self._neighbours[other][gone]
            if other != kept:
                old = self._neighbours[kept].get(other, (0.0, 0.0))
                edge = (old[0] + length, old[1] + contrast)
                self._neighbours[kept][other] = self._neighbours[other][kept] = edge
        self._neighbours[gone] = {}
        self._parent[gone] = kept
        self._version[kept] += 1
        self._version[gone] += 1
        for other in self._neighbours[kept]:
            self._push(kept, other)


def _adjacency(labels: Array, colours: Array, count: int) -> list[dict[int, tuple[float, float]]]:
    """Per region: neighbour -> (length of the common boundary, px; sum of the contrast along it)."""
    weighted = colours * (EDGE_LIGHTNESS, 1.0, 1.0)
    pairs, contrasts = [], []
    for axis in (0, 1):
        steps = np.arange(labels.shape[axis] - 1)
        before = weighted.take(np.maximum(steps - CONTRAST_REACH + 1, 0), axis)
        after = weighted.take(np.minimum(steps + CONTRAST_REACH, labels.shape[axis] - 1), axis)
        first, second = labels.take(steps, axis), labels.take(steps + 1, axis)
        boundary = first != second
        low, high = np.minimum(first, second)[boundary], np.maximum(first, second)[boundary]
        pairs.append(low.astype(np.int64) * count + high)
        contrasts.append(np.linalg.norm(before - after, axis=-1)[boundary])
    keys, inverse = np.unique(np.concatenate(pairs), return_inverse=True)
    lengths = np.bincount(inverse, minlength=len(keys))
    sums = np.bincount(inverse, np.concatenate(contrasts), len(keys))
    neighbours: list[dict[int, tuple[float, float]]] = [{} for _ in range(count)]
    for key, length, total in zip(keys.tolist(), lengths.tolist(), sums.tolist(), strict=True):
        i, j = divmod(key, count)
        neighbours[i][j] = neighbours[j][i] = (float(length), total)
    return neighbours
