"""Things: which masks of different photographs show one and the same, and so which Gaussians belong together.

Two masks of different views are of one thing where most of what they claim, among the Gaussians that both
views see, is claimed by both; masks linked so, directly or not, are one thing, and a Gaussian belongs to the
thing whose masks it paints most of. No vector is looked at: that the front and the back of a thing mean
slightly different things to the encoder does not tear it apart. (Clustering masks by what they claim in 3D
is known from MaskClustering, Yan et al. 2024; this is its plainest form.)
"""

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from langsplat_core.arrays import Array
from langsplat_core.scene import LEVELS, NO_THING
from langsplat_core.training.language.mask_groups import MaskGroups
from langsplat_core.training.language.memberships import Memberships

SAME = 0.6  # overlap over union of what two masks claim from which they are one thing
SAMPLE = 50_000  # Gaussians that decide which masks go together: what is compared grows with views squared


def find_things(members: Memberships, counts: Sequence[int]) -> Array:
    """(N,) uint16 number of the thing that each Gaussian belongs to, at the coarsest level.

    NO_THING where no mask of that level shows it, or where a scene has more things than can be numbered.

    counts: number of masks of each view. Things are numbered from the largest, by number of Gaussians.
    """
    level = len(LEVELS) - 1
    numbers = masks_of_things(members, counts, level)
    size = int(numbers.max(initial=-1)) + 1
    of_mask = np.split(np.where(numbers >= 0, numbers, size).astype(np.int32), np.cumsum(counts)[:-1])
    groups = MaskGroups(tuple(of_mask), np.zeros((size + 1, 1), np.float32))
    things = np.full(members.count, size, np.int64)
    for number, (first, last) in enumerate(members.blocks):
        weights = members.block(number, groups)[:, level * (size + 1) : (level + 1) * (size + 1)].tocsr()
        if weights.nnz:
            known = np.diff(weights.indptr) > 0
            things[first:last] = np.where(known, np.asarray(weights.argmax(axis=1)).ravel(), size)
    order = np.argsort(-np.bincount(things, minlength=size + 1)[:size], kind="stable")
    rank = np.full(size + 1, NO_THING)
    rank[order] = np.minimum(np.arange(size), NO_THING)
    return np.asarray(rank[things].astype(np.uint16))


def masks_of_things(members: Memberships, counts: Sequence[int], level: int) -> Array:
    """(M,) number of the thing that each mask of all views shows, from 0; -1 for masks of other levels and
    for those that claim nothing."""
    firsts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    claims, views = _claims(members, firsts, level)
    _, found = connected_components(_overlapping(claims, views), directed=False)
    numbers = np.full(int(firsts[-1]), -1)
    at_level = np.flatnonzero(np.diff(claims.tocsc().indptr) > 0)
    numbers[at_level] = np.unique(found[at_level], return_inverse=True)[1]
    return numbers


def _claims(members: Memberships, firsts: Array, level: int) -> tuple[sparse.csr_matrix, Array]:
    """(n, M) ones where a mask holds more than half of a sampled Gaussian's weight in its view and level."""
    chosen = np.full(members.count, -1)
    sample = np.random.default_rng(0).permutation(members.count)[:SAMPLE]
    chosen[np.sort(sample)] = np.arange(len(sample))
    rows, columns = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for view, pairs in enumerate(members.pairs):
        here = pairs[(pairs["level"] == level) & (chosen[pairs["row"]] >= 0)]
        row = chosen[here["row"]]
        total = np.bincount(row, here["weight"], len(sample))
        strong = here["weight"] > 0.5 * total[row]
        rows.append(row[strong])
        columns.append(firsts[view] + here["mask"][strong].astype(np.int64))
    joined_rows, joined_columns = np.concatenate(rows), np.concatenate(columns)
    ones = np.ones(len(joined_rows), np.float32)
    shape = (len(sample), int(firsts[-1]))
    views = np.searchsorted(firsts, np.arange(firsts[-1]), side="right") - 1
    return sparse.csr_matrix((ones, (joined_rows, joined_columns)), shape), views


def _overlapping(claims: sparse.csr_matrix, views: Array) -> sparse.csr_matrix:
    """(M, M) links between masks of different views whose overlap over union, where both see, is large."""
    both = (claims.T @ claims).tocoo()
    shape = len(views), int(views.max(initial=-1)) + 1
    of_view = sparse.csr_matrix((np.ones(len(views), np.float32), (np.arange(len(views)), views)), shape)
    seen = claims @ of_view  # (n, V): is the Gaussian claimed in the view at all
    visible = (claims.T @ seen).tocsr()  # (M, V): Gaussians of the mask that the view sees
    a, b = both.row, both.col
    union = _at(visible, a, views[b]) + _at(visible, b, views[a]) - both.data
    same = (views[a] != views[b]) & (both.data > SAME * union)
    square = (len(views), len(views))
    return sparse.csr_matrix((np.ones(int(same.sum()), bool), (a[same], b[same])), square)


def _at(matrix: sparse.csr_matrix, rows: Array, columns: Array) -> Array:
    return np.asarray(matrix[rows, columns]).ravel() if len(rows) else np.zeros(0, np.float32)
