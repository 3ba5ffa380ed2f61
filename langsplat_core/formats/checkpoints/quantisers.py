"""The centroids of a product quantiser, which Dr. Splat keeps beside its checkpoints.

`pq_index.faiss` is an `IndexPQ` as faiss writes it, little endian, of which only the quantiser is of use:

    bytes  4        "IxPq"
    int32, int64    D, vectors in the index
    int64 x 2, u8   not used; whether it is trained
    int32           metric; behind one above 1 a float32
    uint64 x 3      D, M parts, bits per part
    uint64          float32 numbers that follow: the centroids (M, 2^bits, D / M)

The same centroids are also taken as a .npy, .npz or torch file with one array of that shape.
"""

import struct
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.parsing.opening import open_for_reading

MAGIC = b"IxPq"
CENTROIDS = 256  # of a part: what a byte can name
_INDEX = struct.Struct("<iqqq?i")
_QUANTISER = struct.Struct("<QQQQ")


def is_centroids(array: Array) -> bool:
    """Whether these may be the (M, 256, D / M) centroids of a product quantiser."""
    return array.ndim == 3 and array.shape[1] == CENTROIDS and array.dtype.kind == "f"


def checked_centroids(array: Array, path: Path) -> Array:
    """(M, 256, D / M) float32. Raises FormatError for numbers that are not finite."""
    if not np.isfinite(array).all():
        raise FormatError(f"{path}: the quantiser's centroids are not finite")
    return np.ascontiguousarray(array, np.float32)


def read_faiss(path: Path) -> Array:
    """(M, 256, D / M) float32 centroids. Raises InputError and FormatError."""
    file, size = open_for_reading(path)
    with file:
        kind = file.read(4)
        if kind != MAGIC:
            name = kind.decode("ascii", "replace")
            raise FormatError(
                f"{path}: a faiss index of the kind {name!r}, expected {MAGIC.decode()!r}; "
                "give the centroids (M, 256, D / M) as a .npy file"
            )
        index = file.read(_INDEX.size)
        if len(index) == _INDEX.size and _INDEX.unpack(index)[-1] > 1:
            file.read(4)  # the metric's argument
        head = file.read(_QUANTISER.size)
        if len(head) < _QUANTISER.size:
            raise FormatError(f"{path}: truncated: the index ends in its header")
        dim, parts, bits, count = _QUANTISER.unpack(head)
        if bits != 8 or not 0 < parts <= dim or dim % parts or count != dim * CENTROIDS:
            raise FormatError(
                f"{path}: a quantiser of {dim} numbers in {parts} parts of {bits} bits; expected 8 bits"
            )
        if size - file.tell() < 4 * count:
            raise FormatError(f"{path}: truncated: {count} centroid numbers do not fit the file")
        centroids = np.frombuffer(file.read(4 * count), "<f4").reshape(parts, CENTROIDS, dim // parts)
    return checked_centroids(centroids, path)
