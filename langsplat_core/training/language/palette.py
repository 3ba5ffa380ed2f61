"""Colours of codewords by which neighbouring things are told apart."""

import numpy as np
from scipy.sparse import csr_matrix

from langsplat_core.arrays import Array
from langsplat_core.scene import NO_NODE, LanguageField, Tree
from langsplat_core.scene.surface import Surface

FEWEST_LINKS = 10  # between the surfaces of two nodes that are neighbours
LEAST = 30  # Gaussians of a node that has a say


def contrasting_colours(field: LanguageField, tree: Tree, surface: Surface) -> Array | None:
    """Return (K, 3) float32 colours in [0, 1] of a codebook's words, the same for all levels and views.

    None where nothing lies beside anything else. The axes are those along which the mean vectors of
    neighbouring nodes, at all levels, differ the most. Along each, words are ranked, so that all of it is
    used: a node has as much say in that as another, however large it is.
    """
    vectors = field.codec.decode(np.arange(field.codec.size, dtype=np.uint16)[:, None]).astype(np.float64)
    ends = np.stack([surface.rows[end] for end in surface.ends])
    differences, weights = [np.zeros((0, vectors.shape[1]))], np.zeros(len(vectors))
    for level in range(len(field.latents)):
        codes, node = field.latents[level, :, 0], tree.at(level)
        counted = np.flatnonzero((node != NO_NODE) & field.known[level])
        names, number, sizes = np.unique(node[counted], return_inverse=True, return_counts=True)
        if len(names) == 0:
            continue
        has_say = sizes[number] >= LEAST
        weights += np.bincount(codes[counted][has_say], 1 / sizes[number][has_say], len(vectors))
        shape = (len(names), len(vectors))
        shares = csr_matrix((1 / sizes[number], (number, codes[counted])), shape=shape)
        place = np.full(int(node.max(initial=0)) + 1, -1)
        place[names] = np.arange(len(names))
        beside = np.sort(np.where(node[ends] == NO_NODE, -1, place[node[ends]]), axis=0)
        beside = beside[:, (beside[0] >= 0) & (beside[0] < beside[1])]
        pairs, links = np.unique(beside, axis=1, return_counts=True)
        first, second = pairs[:, (links >= FEWEST_LINKS) & (sizes[pairs] >= LEAST).all(0)]
        means = shares @ vectors
        differences.append(means[first] - means[second])
    found = np.concatenate(differences)
    if not found.any() or vectors.shape[1] < 3:
        return None
    axes = np.linalg.eigh(found.T @ found)[1][:, :-4:-1]
    return _ranked(vectors @ axes, weights)


def _ranked(values: Array, weights: Array) -> Array:
    """(K, 3) numbers -> (K, 3) float32 in [0, 1]: the share of the (K,) weights that lies below each."""
    ranks = np.empty(values.shape, np.float32)
    for axis in range(3):
        order = np.argsort(values[:, axis], kind="stable")
        below = np.cumsum(weights[order])
        ranks[order, axis] = (below - weights[order] / 2) / max(below[-1], 1e-30)
    return ranks
