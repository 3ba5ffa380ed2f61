"""Small changes of the lifting that others report gains from, one at a time (`langsplat bench gains`).

Each is a function of what the masks say, tried on rooms that it was not made for; the ones that gain become
part of `training.language`, the others stay here as the record that they were tried.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.scene import LEVELS, Gaussians
from langsplat_core.training.language.lift import Lifted, lift_block
from langsplat_core.training.language.mask_weights import (
    MaskGroups,
    MaskWeights,
    group_masks,
    masks_of_things,
)

TINY = 1.0  # pixels: largest weight in any view below which a Gaussian is taken for an accident
GATE = 0.1  # share of its largest weight in a view below which a Gaussian does not count as seen there
OUTLIER = -1.5  # standard deviations of its masks' cosines below which a mask is not believed


@dataclass(frozen=True, eq=False)
class Material:
    """What vectors are lifted from."""

    gaussians: Gaussians
    members: MaskWeights
    vectors: tuple[Array, ...]  # of each view, (M, D) float32 unit vectors of its masks

    def lifted(self) -> Lifted:
        """Of all Gaussians, by the geometric median."""
        groups = group_masks(self.vectors)
        return joined(lift_block(self.members, groups, n, True) for n in range(len(self.members.blocks)))


def joined(parts: Iterable[Lifted]) -> Lifted:
    """Blocks of Gaussians, one after the other."""
    blocks = list(parts)
    return Lifted(
        np.concatenate([block.vectors for block in blocks], axis=1),
        np.concatenate([block.confidence for block in blocks], axis=1),
    )


def as_it_is(material: Material) -> Lifted:
    """The method."""
    return material.lifted()


def gate_accidents(material: Material) -> Lifted:
    """No meaning for a Gaussian that hardly paints anything in any view."""
    largest = _weights_per_view(material.members).max(0)
    lifted = material.lifted()
    return replace(lifted, confidence=np.where(largest > TINY, lifted.confidence, 0).astype(np.float32))


def visibility_gate(material: Material) -> Lifted:
    """A view in which a Gaussian paints far less than in its best one does not speak for it."""
    per_view = _weights_per_view(material.members)
    seen = per_view >= GATE * per_view.max(0)
    pairs = [pairs[seen[v][pairs["row"]]] for v, pairs in enumerate(material.members.pairs)]
    return replace(material, members=MaskWeights(pairs, material.members.count)).lifted()


def root_weights(material: Material) -> Lifted:
    """Masks count by the square root of their pixels: near views outvote far ones less."""
    pairs = [_reweighted(pairs, np.sqrt(pairs["weight"])) for pairs in material.members.pairs]
    return replace(material, members=MaskWeights(pairs, material.members.count)).lifted()


def gate_faint(material: Material) -> Lifted:
    """No meaning for what one can hardly see."""
    opacity = sigmoid(material.gaussians.opacity_logits.astype(np.float64))
    lifted = material.lifted()
    return replace(lifted, confidence=np.where(opacity >= 0.05, lifted.confidence, 0).astype(np.float32))


def outlier_views(material: Material) -> Lifted:
    """Masks far below the others in cosine to the median are left out, and the median taken again."""
    lifted = material.lifted()
    pairs = []
    for view, vectors in zip(material.members.pairs, material.vectors, strict=True):
        cosine = _cosines(view, vectors, lifted)
        pairs.append((view, cosine))
    mean, spread = _statistics(pairs, material.members.count)
    kept = []
    for view, cosine in pairs:
        row, level = view["row"], view["level"]
        kept.append(view[cosine >= mean[level, row] + OUTLIER * spread[level, row]])
    return replace(material, members=MaskWeights(kept, material.members.count)).lifted()


def merged_masks(material: Material) -> Lifted:
    """Masks of several views that claim the same Gaussians become one thing, whose vector is the mean."""
    things = same_things(material.members, [len(view) for view in material.vectors])
    everything = np.concatenate(material.vectors)
    sums = np.zeros((things.max(initial=-1) + 1, everything.shape[1]), np.float32)
    np.add.at(sums, things, everything)
    groups = np.split(things.astype(np.int32), np.cumsum([len(v) for v in material.vectors])[:-1])
    merged = MaskGroups(tuple(groups), unit(sums).astype(np.float32))
    blocks = range(len(material.members.blocks))
    return joined(lift_block(material.members, merged, number, True) for number in blocks)


GAINS: Mapping[str, Callable[[Material], Lifted]] = MappingProxyType(
    {
        "as it is": as_it_is,
        "Gaussians that paint < 1 px in every view have no meaning": gate_accidents,
        "views where a Gaussian paints < 10 % of its best are left out": visibility_gate,
        "masks weigh by the root of their pixels": root_weights,
        "Gaussians below 5 % opacity have no meaning": gate_faint,
        "masks 1.5 deviations below the others' cosine are left out": outlier_views,
        "masks that claim the same Gaussians are merged": merged_masks,
    }
)


def same_things(members: MaskWeights, counts: Sequence[int]) -> Array:
    """(M,) number of the thing that each mask of all views shows, at every level."""
    labels = np.arange(sum(counts))
    for level in range(len(LEVELS)):
        found = masks_of_things(members, counts, level)
        labels = np.where(found >= 0, len(labels) * (level + 1) + found, labels)
    return np.unique(labels, return_inverse=True)[1]


def _weights_per_view(members: MaskWeights) -> Array:
    """(V, N) float32 weight of every Gaussian in the masks of each view, all levels together."""
    return np.stack([
        np.bincount(pairs["row"], pairs["weight"], members.count).astype(np.float32)
        for pairs in members.pairs
    ])  # fmt: skip


def _reweighted(pairs: Array, weights: Array) -> Array:
    changed = pairs.copy()
    changed["weight"] = weights
    return changed


def _cosines(pairs: Array, vectors: Array, lifted: Lifted, chunk: int = 65_536) -> Array:
    """(P,) cosine of every pair's mask with what its Gaussian means."""
    cosines = np.empty(len(pairs), np.float32)
    for start in range(0, len(pairs), chunk):
        part = pairs[start : start + chunk]
        meant = lifted.vectors[part["level"], part["row"]]
        cosines[start : start + chunk] = (meant * vectors[part["mask"]]).sum(1)
    return cosines


def _statistics(pairs: Sequence[tuple[Array, Array]], count: int) -> tuple[Array, Array]:
    """(3, N) weighted mean and standard deviation of the cosines at every Gaussian and level."""
    sums = np.zeros((3, len(LEVELS), count))
    for view, cosine in pairs:
        index = view["level"].astype(np.int64) * count + view["row"]
        for power in range(3):
            values = view["weight"] * cosine.astype(np.float64) ** power
            sums[power] += np.bincount(index, values, len(LEVELS) * count).reshape(len(LEVELS), count)
    total = np.maximum(sums[0], 1e-12)
    mean = sums[1] / total
    return mean, np.sqrt(np.maximum(sums[2] / total - mean**2, 0)) + 1e-3  # rounding is no outlier
