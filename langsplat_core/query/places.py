"""Where a phrase is: the strongest place among the Gaussians, its extent, and its pixel in a view."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.scene import Gaussians

NEIGHBOURS = 16


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """The nearest neighbours of every Gaussian that counts, for smoothing over the surface."""

    rows: Array  # (M,) indices of the Gaussians that count: valid, and visible to the eye
    positions: Array  # (M, 3) their means, world units
    neighbours: Array  # (M, k) positions within `rows`, the Gaussian itself first
    distances: Array  # (M, k) world units
    weights: Array  # (M,) opacity

    def smooth(self, values: Array) -> Array:
        """(N,) values of all Gaussians -> (M,) opacity-weighted means over each neighbourhood.

        The 3D counterpart of the mean filter that the paper applies to a relevancy map before it
        takes the peak (section 4.1, "implementation details"): one stray Gaussian decides nothing.
        """
        weights = self.weights[self.neighbours]
        return (values[self.rows][self.neighbours] * weights).sum(1) / weights.sum(1)


def build_neighbourhood(gaussians: Gaussians, min_opacity: float = 0.1) -> Neighbourhood:
    """Find the neighbours of all valid Gaussians with at least `min_opacity` (all valid if none has)."""
    valid = gaussians.valid()
    opacity = np.where(valid, sigmoid(gaussians.opacity_logits.astype(np.float64)), 0)
    rows = np.flatnonzero(opacity >= min_opacity)
    if len(rows) == 0:
        rows = np.flatnonzero(valid)
    positions = gaussians.means[rows].astype(np.float64)
    k = min(NEIGHBOURS, len(rows))
    if k == 0:
        return Neighbourhood(rows, positions, np.zeros((0, 1), int), np.zeros((0, 1)), opacity[rows])
    distances, neighbours = cKDTree(positions).query(positions, k=k, workers=-1)
    shape = (len(rows), k)
    weights = np.maximum(opacity[rows], 1e-3)
    return Neighbourhood(rows, positions, neighbours.reshape(shape), distances.reshape(shape), weights)


@dataclass(frozen=True, eq=False)
class Place:
    """A connected set of Gaussians that answer a phrase."""

    position: Array  # (3,) world units, the peak's neighbourhood
    box: Array  # (2, 3) lower and upper corner, world units, between 2 % and 98 % of the members
    count: int  # Gaussians in it


def locate(neighbourhood: Neighbourhood, smoothed: Array, threshold: float) -> Place | None:
    """The connected component above `threshold` that holds the peak of `smoothed` (M,); None if empty."""
    n = neighbourhood
    if len(smoothed) == 0:
        return None
    peak = int(smoothed.argmax())
    near = n.neighbours[peak]
    weights = n.weights[near] * smoothed[near]
    if weights.sum() <= 0:
        return None
    position = (n.positions[near] * weights[:, None]).sum(0) / weights.sum()

    members = np.flatnonzero(smoothed > min(threshold, smoothed[peak] - 1e-9))
    inside = np.zeros(len(smoothed), bool)
    inside[members] = True
    # Neighbours far away for their Gaussian's surroundings are other objects, not the same surface.
    reach = 4 * np.median(n.distances[members], axis=1, keepdims=True) + 1e-12
    linked = inside[n.neighbours[members]] & (n.distances[members] <= reach)
    source = np.repeat(members, linked.sum(1))
    target = n.neighbours[members][linked]
    graph = csr_matrix((np.ones(len(source), bool), (source, target)), shape=(len(smoothed),) * 2)
    _, labels = connected_components(graph, directed=False)
    members = members[labels[members] == labels[peak]]
    box = np.quantile(n.positions[members], [0.02, 0.98], axis=0)
    return Place(position, box, len(members))


def peak_pixel(relevancy: Array, window: int) -> tuple[int, int, float]:
    """Peak (column, row, value) of a relevancy map (H, W) after a mean filter of `window` px (paper: 20).

    The window never exceeds the picture; borders repeat the edge pixels.
    """
    window = max(1, min(window, *relevancy.shape))
    smooth = uniform_filter(np.asarray(relevancy, np.float64), size=window, mode="nearest")
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    return int(column), int(row), float(smooth[row, column])
