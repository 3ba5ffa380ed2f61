"""Masks at three levels: what every source of masks gives, and how they become one map per level."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.progress import Progress


@dataclass(frozen=True, eq=False)
class LevelMasks:
    """Masks of one photograph at the levels subpart, part, whole; a level may have none."""

    masks: tuple[Array, Array, Array]  # (M_l, H, W) bool each; may overlap, later ones lie on top
    scores: tuple[Array, Array, Array]  # (M_l,) float32 each, in [0, 1]

    def __post_init__(self) -> None:
        dims: dict[str, int] = {}
        for level, (masks, scores) in enumerate(zip(self.masks, self.scores, strict=True)):
            count = f"M{level}"
            dims = check_array(f"masks[{level}]", masks, (count, "H", "W"), dims, dtype=np.bool_)
            dims = check_array(f"scores[{level}]", scores, (count,), dims, dtype=np.float32)


class MaskSource(Protocol):
    """Finds the masks of a photograph."""

    @property
    def name(self) -> str:
        """What the user is told, such as "graph (no weights)"."""

    @property
    def key(self) -> str:
        """Everything that its masks depend on besides the photograph: stored masks with another are stale."""

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Masks of an image (H, W, 3) uint8."""


@runtime_checkable
class SplitMaskSource(MaskSource, Protocol):
    """One whose work has two parts: a model sees the next photograph while the second is done."""

    def begin(self, image: Array, progress: Progress) -> Callable[[], LevelMasks]:
        """Do the model's part; what is returned does the rest, in any thread."""


def label_maps(levels: LevelMasks) -> Array:
    """(3, H, W) int32: the row of the mask that is on top at each pixel, -1 where there is none.

    Rows count through all three levels, subpart first, as in LangSplat's `*_s.npy` (without its "default"
    level); within a level later masks cover earlier ones. Unlike there, a mask that ends with no visible
    pixel has no row, so every row from 0 to the maximum occurs, each in one level.
    """
    maps = np.full((len(levels.masks), *levels.masks[0].shape[1:]), -1, np.int32)
    first = 0
    for level, masks in enumerate(levels.masks):
        for row, mask in enumerate(masks):
            maps[level][mask] = row
        visible = np.unique(maps[level][maps[level] >= 0])
        compact = np.full(len(masks) + 1, -1, np.int32)  # the last entry is what -1 indexes
        compact[visible] = np.arange(first, first + len(visible))
        maps[level] = compact[maps[level]]
        first += len(visible)
    return maps
