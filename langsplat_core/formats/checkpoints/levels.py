"""Which of the three levels a checkpoint is of, and how its Gaussians go with those of the others."""

import re
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.formats.checkpoints.parts import Carrier
from langsplat_core.scene import LEVELS, Gaussians

# `chkpnt30000_langfeat_2`, `scene_level_2`, the folders `teatime_2` and, of Dr. Splat, `teatime_2_pq_...`
_NUMBER = re.compile(r"_(?:level_?)?([1-3])(?:_pq_.*)?$")
LEAST_SHARED = 0.5  # of the Gaussians of a pruned checkpoint; with fewer in common it is another scene's


def levels_of(carriers: Sequence[Carrier], asked: Sequence[str]) -> tuple[list[int], str]:
    """0, 1 or 2 for each checkpoint, and by what they were told apart.

    As `asked` (names of levels, in the order of the checkpoints); else as the files say, or their names or
    those of their folders; else three in their order, and one alone is the whole. Raises InputError where
    that leaves a doubt.
    """
    if asked:
        return _as_asked(carriers, asked), "as asked"
    said = [carrier.level for carrier in carriers]
    told = any(number is not None for number in said)
    numbers = said if told else [_numbered(carrier.path) for carrier in carriers]
    chosen = [number - 1 for number in numbers if number]  # 0 is SAM's default masks, all levels in one
    if len(set(chosen)) == len(carriers):
        return chosen, "as the files say" if told else "by the names of files and folders"
    if not told and len(carriers) == len(LEVELS) and len(set(numbers)) == 1:
        return list(range(len(LEVELS))), "by their order"
    if numbers == [None]:
        return [len(LEVELS) - 1], "one alone is taken for the whole"
    paths = ", ".join(str(carrier.path) for carrier in carriers)
    raise InputError(
        f"{paths}: of which levels? Say, for example, --levels {' '.join(LEVELS[: len(carriers)])}"
    )


def _as_asked(carriers: Sequence[Carrier], asked: Sequence[str]) -> list[int]:
    if len(asked) != len(carriers) or len(set(asked)) != len(asked):
        raise InputError(
            f"--levels {' '.join(asked)}: {len(carriers)} checkpoints have features; name a level for each, "
            "each once"
        )
    return [LEVELS.index(name) for name in asked]


def _numbered(path: Path) -> int | None:
    """The number at the end of a file's name, or of its folder's."""
    for name in (path.stem, path.resolve().parent.name):
        found = _NUMBER.search(name)
        if found:
            return int(found[1])
    return None


def all_gaussians(carriers: Sequence[Carrier]) -> Gaussians:
    """Of checkpoints that lack different ones: those of the first, then what each further one has beside
    them. Raises FormatError where they are not of one scene."""
    found: Gaussians | None = None
    for carrier in carriers:
        theirs = carrier.gaussians
        if found is None or theirs is None:
            found = theirs if found is None else found
            continue
        if found.sh.shape[1] != theirs.sh.shape[1]:
            raise FormatError(f"{carrier.path}: SH degree {theirs.sh_degree}, others have {found.sh_degree}")
        row = _row_of(theirs.means, found.means)
        _require_shared(row, min(len(found), len(theirs)), carrier)
        new = theirs.take(row < 0)
        arrays = [(getattr(found, item.name), getattr(new, item.name)) for item in fields(Gaussians)]
        found = Gaussians(*map(np.concatenate, arrays))
    assert found is not None
    return found


def partners(means: Array, carrier: Carrier, may_lack: bool) -> Array | None:
    """(N,) row of the `carrier`'s Gaussian at each of (N, 3) `means`, -1 where it has none; None where they
    are the same Gaussians. Raises FormatError where they are not of one scene.

    A checkpoint without Gaussians of its own has as many features. One that `may_lack` some has them removed:
    Gaussians at the same position, bit for bit, are the same.
    """
    if carrier.gaussians is None:
        count = 0 if carrier.meaning is None else len(carrier.meaning)
        if count != len(means):
            raise FormatError(f"{carrier.path}: features of {count} Gaussians, the scene has {len(means)}")
        return None
    theirs = carrier.gaussians.means
    if np.array_equal(means, theirs, equal_nan=True):
        return None
    if not may_lack:
        raise FormatError(
            f"{carrier.path}: its {len(theirs)} Gaussians are not the {len(means)} of the other files; "
            "give checkpoints that were trained from one scene"
        )
    row = _row_of(means, theirs)
    _require_shared(row, len(theirs), carrier)
    return row


def _require_shared(row: Array, count: int, carrier: Carrier) -> None:
    shared = int((row >= 0).sum())
    if shared < LEAST_SHARED * count or shared == 0:
        raise FormatError(
            f"{carrier.path}: {shared} of {count} Gaussians are at positions of the other files'; "
            "give checkpoints that were trained from one scene"
        )


def _row_of(means: Array, theirs: Array) -> Array:
    """(N,) row of `theirs` at the same position; the k-th of several at one place goes with the k-th."""
    keys = np.concatenate([_keys(means), _keys(theirs)])
    order = np.lexsort(
        keys.T
    )  # stable: of two equal keys, which are one of each side, that of `means` is first
    ordered = keys[order]
    same = (ordered[1:] == ordered[:-1]).all(1)
    row = np.full(len(means), -1, np.int64)
    row[order[:-1][same]] = order[1:][same] - len(means)
    return row


def _keys(means: Array) -> Array:
    """(N, 3) float32 -> (N, 4) uint32: the bits of a position, and the how manieth at that place it is."""
    bits = np.ascontiguousarray(means, np.float32).view(np.uint32).reshape(len(means), 3)
    order = np.lexsort(bits.T)
    first = np.ones(len(means), bool)
    first[1:] = (bits[order][1:] != bits[order][:-1]).any(1)
    starts = np.flatnonzero(first)
    turn = np.empty(len(means), np.uint32)
    turn[order] = np.arange(len(means)) - np.repeat(starts, np.diff(np.append(starts, len(means))))
    return np.concatenate([bits, turn[:, None]], axis=1)
