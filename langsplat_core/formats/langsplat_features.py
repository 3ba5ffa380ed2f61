"""The exchange format of the original LangSplat: the masks and CLIP vectors of one photograph.

    <stem>_f.npy   float32 (M, D)      one CLIP vector per mask; D = 512, or 3 after its autoencoder
    <stem>_s.npy   integer (4, H, W)   row of `_f` per pixel, -1 where there is no mask; maps in order
                                       default, subpart (s), part (m), whole (l). Floats are read too.

Rows are global: they count on from one map to the next.
"""

from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.errors import FormatError
from langsplat_core.parsing.npy import read_npy, write_npy

MAP_COUNT = 4
NO_MASK = -1


def read_features(folder: Path | str, stem: str) -> tuple[Array, Array]:
    """(M, D) float32 vectors and (4, H, W) int32 rows of them, of the photograph `stem`.

    Raises InputError when a file cannot be opened and FormatError when one breaks a rule.
    """
    vectors_path, maps_path = _paths(folder, stem)
    vectors, maps = read_npy(vectors_path), read_npy(maps_path)
    if vectors.ndim != 2 or vectors.shape[1] < 1 or vectors.dtype.kind != "f":
        raise FormatError(f"{vectors_path}: {vectors.dtype} {vectors.shape}; expected floats of shape (M, D)")
    if not np.isfinite(vectors).all():
        raise FormatError(f"{vectors_path}: holds numbers that are not finite")
    if maps.ndim != 3 or len(maps) != MAP_COUNT or 0 in maps.shape or maps.dtype.kind not in "iuf":
        raise FormatError(f"{maps_path}: {maps.dtype} {maps.shape}; expected numbers of shape (4, H, W)")
    least, greatest = maps.min(), maps.max()
    if not (least >= NO_MASK and greatest < len(vectors)):  # NaN fails both
        raise FormatError(
            f"{maps_path}: ids from {least} to {greatest}; expected {NO_MASK} to {len(vectors) - 1}, "
            f"the rows of {vectors_path.name}"
        )
    rows = maps.astype(np.int32)
    if not np.array_equal(rows, maps):
        raise FormatError(f"{maps_path}: holds ids that are not whole numbers")
    return vectors.astype(np.float32), rows


def write_features(folder: Path | str, stem: str, vectors: Array, maps: Array) -> None:
    """Write both files, the maps last: whoever waits for `_s.npy` finds the vectors it points into."""
    check_array("vectors", vectors, ("M", "D"), dtype=np.float32)
    check_array("maps", maps, (MAP_COUNT, "H", "W"), dtype=np.int32)
    if maps.size and not (maps.min() >= NO_MASK and maps.max() < len(vectors)):
        raise ValueError(f"maps: ids beyond the {len(vectors)} vectors")
    for path, array in zip(_paths(folder, stem), (vectors, maps), strict=True):
        write_npy(path, array)


def _paths(folder: Path | str, stem: str) -> tuple[Path, Path]:
    return Path(folder) / f"{stem}_f.npy", Path(folder) / f"{stem}_s.npy"
