"""The tree of a scene: nested sets of Gaussians, wholes with their parts and these with their subparts.

Gaussians vary, things do not: an answer made of whole nodes has the borders of the things and no speckles,
and its peak is a mean over a patch instead of one lucky Gaussian.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from langsplat_core.arrays import Array, check_array

NO_NODE = -1
LEVEL_COUNT = 3


@dataclass(frozen=True, eq=False)
class Tree:
    """K nodes, each a set of Gaussians within its parent's. Children come before their parents."""

    leaves: Array  # (N,) int32 smallest node that each Gaussian is in; NO_NODE for those in none
    parents: Array  # (K,) int32 node that each is part of, a later one; NO_NODE for what is part of none
    levels: Array  # (K,) uint8 index into LEVELS of what a node means; never above its parent's
    votes: (
        Array  # (K, 2) uint16 photographs with a mask of just this node, and those that show it without one
    )

    def __post_init__(self) -> None:
        check_array("leaves", self.leaves, ("N",), dtype=np.int32)
        dims = check_array("parents", self.parents, ("K",), dtype=np.int32)
        check_array("levels", self.levels, ("K",), dims, dtype=np.uint8)
        check_array("votes", self.votes, ("K", 2), dims, dtype=np.uint16)
        count, numbers = len(self.parents), np.arange(len(self.parents))
        if ((self.leaves < NO_NODE) | (self.leaves >= count)).any():
            raise ValueError(f"tree: leaves outside the {count} nodes")
        parents, child = self.parents, self.parents != NO_NODE
        if (parents[child] <= numbers[child]).any() or (parents >= count).any() or (parents < NO_NODE).any():
            raise ValueError("tree: every parent must be a later node")
        if (self.levels >= LEVEL_COUNT).any() or (self.levels[child] > self.levels[parents[child]]).any():
            raise ValueError("tree: levels must be 0, 1 or 2 and not above the parent's")

    @property
    def complete(self) -> bool:
        """False for a tree of wholes without parts."""
        return bool((self.levels < LEVEL_COUNT - 1).any()) or self.count == 0

    @property
    def count(self) -> int:
        """Number K of nodes."""
        return len(self.parents)

    def around(self, level: int) -> Array:
        """(K,) int32 the largest node of at most `level` around each node; itself where it is above."""
        owners = np.arange(self.count, dtype=np.int32)
        for node in range(self.count - 1, -1, -1):
            parent = self.parents[node]
            if parent != NO_NODE and self.levels[parent] <= level:
                owners[node] = owners[parent]
        return owners

    def at(self, level: int) -> Array:
        """(N,) int32 node of each Gaussian at a level (index into LEVELS); NO_NODE for those in none."""
        return np.append(self.around(level), np.int32(NO_NODE))[self.leaves]

    def voted(self, level: int) -> Array:
        """`at` a level, NO_NODE where no mask voted for that node."""
        at = self.at(level)
        votes = np.append(self.votes[:, 0] > 0, False)
        return np.where(votes[at], at, np.int32(NO_NODE))

    def path(self, node: int) -> tuple[int, ...]:
        """Return the node, its parent, that one's parent, and so on up to a root."""
        found = [int(node)]
        while self.parents[found[-1]] != NO_NODE:
            found.append(int(self.parents[found[-1]]))
        return tuple(found)

    def children(self, node: int) -> Array:
        """Numbers of the nodes that `node` is the parent of, rising."""
        return np.flatnonzero(self.parents == node)

    def members(self, node: int) -> Array:
        """(N,) bool: the Gaussians of a node, those of its descendants included."""
        inside = np.zeros(self.count + 1, bool)  # the last: in no node
        inside[node] = True
        for other in range(node - 1, -1, -1):
            inside[other] = self.parents[other] != NO_NODE and inside[self.parents[other]]
        return np.asarray(inside[self.leaves])

    def gaussians(self) -> list[Array]:
        """Return the Gaussians of each node, ascending."""
        order = np.argsort(self.leaves, kind="stable")
        firsts = np.searchsorted(self.leaves[order], np.arange(self.count + 1))
        found = [order[a:b] for a, b in pairwise(firsts)]
        for node, parent in enumerate(self.parents):
            if parent != NO_NODE:
                found[parent] = np.union1d(found[parent], found[node])
        return found

    def things(self) -> Array:
        """(3, N) int32 nodes of each level that masks voted for, see `build_tree`."""
        levels = np.append(self.levels, LEVEL_COUNT)
        voted = [self.voted(level) for level in range(LEVEL_COUNT)]
        return np.stack([np.where(levels[row] == level, row, NO_NODE) for level, row in enumerate(voted)])

    def voted_by(self, things: Array) -> "Tree":
        """Return the tree with a vote for each node that is mostly of `things`, see `build_tree`.

        For scenes that do not know how many photographs said so.
        """
        votes = np.zeros((self.count, 2), np.uint16)
        for level, row in enumerate(things):
            at = self.at(level)
            inside = at != NO_NODE
            shares = np.bincount(at[inside], row[inside] != NO_NODE, self.count)
            votes[2 * shares > np.bincount(at[inside], minlength=self.count), 0] = 1
        return replace(self, votes=votes)

    def take(self, rows: Array) -> "Tree":
        """Return the tree of the Gaussians at `rows` (indices or a boolean mask).

        Its nodes keep their numbers.
        """
        return replace(self, leaves=self.leaves[rows])


def tree_of_wholes(things: Array) -> Tree:
    """Return the tree of things alone: (N,) number of the thing of each Gaussian, from 0.

    NO_NODE for none.
    """
    count = int(things.max(initial=NO_NODE)) + 1
    votes = np.tile(np.array([1, 0], np.uint16), (count, 1))
    return Tree(
        things.astype(np.int32), np.full(count, NO_NODE, np.int32), np.full(count, 2, np.uint8), votes
    )
