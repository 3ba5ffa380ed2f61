"""The tree of a scene: nested sets of Gaussians, wholes with their parts and these with their subparts."""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array, check_array

NO_NODE = -1


@dataclass(frozen=True, eq=False)
class Tree:
    """K nodes, each a set of Gaussians within its parent's. Children come before their parents."""

    leaves: Array  # (N,) int32 smallest node that each Gaussian is in; NO_NODE for those in none
    parents: Array  # (K,) int32 node that each is part of, a later one; NO_NODE for what is part of none
    levels: Array  # (K,) uint8 index into LEVELS of what a node means; never above its parent's
    votes: Array  # (K, 2) uint16 photographs with a mask of just this node, and those that show it without one

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
        if (self.levels > 2).any() or (self.levels[child] > self.levels[parents[child]]).any():
            raise ValueError("tree: levels must be 0, 1 or 2 and not above the parent's")

    @property
    def count(self) -> int:
        """Number K of nodes."""
        return len(self.parents)

    def around(self, level: int) -> Array:
        """(K,) int32 the largest node of at most `level` around each node; itself where it is of a higher one."""
        owners = np.arange(self.count, dtype=np.int32)
        for node in range(self.count - 1, -1, -1):
            parent = self.parents[node]
            if parent != NO_NODE and self.levels[parent] <= level:
                owners[node] = owners[parent]
        return owners

    def at(self, level: int) -> Array:
        """(N,) int32 node of each Gaussian at a level (index into LEVELS); NO_NODE for those in none."""
        return np.append(self.around(level), np.int32(NO_NODE))[self.leaves]

    def path(self, node: int) -> tuple[int, ...]:
        """The node, its parent, that one's parent, ... up to a root."""
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

    def take(self, rows: Array) -> "Tree":
        """The tree of the Gaussians at `rows` (indices or a boolean mask); its nodes keep their numbers."""
        return replace(self, leaves=self.leaves[rows])
