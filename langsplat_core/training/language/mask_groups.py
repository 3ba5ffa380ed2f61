"""Groups of masks that say the same: one vector for hundreds of crops of one thing.

A Gaussian is seen by a hundred masks in a hundred photographs, and most say one of a few things; grouped
first, its median is taken over a few vectors instead.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.training.language.clustering import nearest_centres, spherical_kmeans

GROUPS = 2_048
ROUNDS = 6
SAMPLE = 16_384  # masks that the groups are found with


@dataclass(frozen=True, eq=False)
class MaskGroups:
    """To which of G groups every mask of every view belongs."""

    of_mask: tuple[Array, ...]  # of each view, (M,) int32
    vectors: Array  # (G, D) float32 unit vectors


def group_masks(vectors: Sequence[Array], groups: int = GROUPS, seed: int = 0) -> MaskGroups:
    """vectors: of each view, (M, D) float32 unit CLIP vectors. At most `groups` groups; where there are not
    more masks than that, each is its own."""
    counts = [len(view) for view in vectors]
    joined = np.concatenate(vectors)
    if len(joined) <= groups:
        return MaskGroups(_per_view(np.arange(len(joined)), counts), joined)
    generator = np.random.default_rng(seed)
    sample = joined[np.sort(generator.permutation(len(joined))[:SAMPLE])]
    centres = spherical_kmeans(sample, groups, ROUNDS, generator=generator)
    return MaskGroups(_per_view(nearest_centres(joined, centres)[0], counts), centres)


def _per_view(groups: Array, counts: list[int]) -> tuple[Array, ...]:
    return tuple(np.split(groups.astype(np.int32), np.cumsum(counts)[:-1]))
