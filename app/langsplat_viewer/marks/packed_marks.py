"""Marks as history keeps them: one bit each, and none for what is not marked at all."""

from dataclasses import dataclass, fields

import numpy as np

from langsplat_core.arrays import Array
from langsplat_viewer.marks.selecting import Marks

NAMES = tuple(field.name for field in fields(Marks))


@dataclass(frozen=True, eq=False)
class PackedMarks:
    """The three masks of `Marks`, of `count` Gaussians each."""

    count: int
    masks: tuple[Array | None, ...]  # ceil(count / 8) bytes, in the order of NAMES; None: nothing is marked


@dataclass(frozen=True, eq=False)
class Pair:
    """The same marks, packed and as they are."""

    marks: Marks
    packed: PackedMarks


def pack(marks: Marks, before: Pair | None) -> Pair:
    """`before`, the pair that was made last, lends the masks that are the same objects."""
    if before is not None and before.marks is marks:
        return before
    masks = tuple(_packed(getattr(marks, name), name, before) for name in NAMES)
    return Pair(marks, PackedMarks(len(marks.selected), masks))


def _packed(mask: Array, name: str, before: Pair | None) -> Array | None:
    if before is not None and getattr(before.marks, name) is mask:
        return before.packed.masks[NAMES.index(name)]
    return np.packbits(mask) if mask.any() else None


def unpack(packed: PackedMarks, now: Pair) -> Marks:
    """The marks again; `now`, of the same scene, lends the masks that are the same, so that nothing is drawn
    anew for those."""
    if now.packed is packed:
        return now.marks
    return Marks(*(_unpacked(packed, place, now) for place in range(len(NAMES))))


def _unpacked(packed: PackedMarks, place: int, now: Pair) -> Array:
    bits, current = packed.masks[place], now.packed.masks[place]
    if bits is current:
        mask: Array = getattr(now.marks, NAMES[place])
        return mask
    if bits is None:
        return np.zeros(packed.count, bool)
    return np.unpackbits(bits, count=packed.count).astype(bool)
