"""Files of plain NumPy arrays of numbers or texts, .npy and .npz, read without pickles and without belief in
their headers; and .npy written."""

import io
import math
import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, quoted
from langsplat_core.files import atomic_path
from langsplat_core.parsing.archives import opened_archive
from langsplat_core.parsing.opening import open_for_reading

MAGIC = b"\x93NUMPY"
HEADER_LIMIT = 10_000  # bytes; NumPy writes 118
MEMBER_LIMIT = 2**31  # bytes of one array in an .npz: packed ones may be a thousand times their file
# What NumPy writes, to the letter. Its own reader evaluates the text as a Python literal, and on damaged
# headers raises tokenizer errors and warnings. A comma stands between two sizes: were it optional, a run of a
# hundred digits could be divided in so many ways that trying them takes minutes.
_HEADER = re.compile(
    rb"\{'descr': '(?P<dtype>[<>|](?:[iu][1248]|f[248]|U[1-9]\d{0,3}))', "
    rb"'fortran_order': (?P<order>True|False), "
    rb"'shape': \((?P<shape>(?:\d{1,18}(?:, ?\d{1,18}){0,7},?)?)\), ?\} *\n?$"
)


def write_npy(path: Path, array: Array) -> None:
    """Write an array of numbers, whole or not at all.

    `np.save` hands the numbers to C's library, and where the disk takes all but the end nobody is told.
    """
    whole = np.asarray(array, order="C")
    header = np.lib.format.header_data_from_array_1_0(whole)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        file.write(whole.reshape(-1).view(np.uint8).data)


def read_npy(path: Path) -> Array:
    """The array of numbers in a .npy file. Raises InputError where it cannot be opened, else FormatError."""
    file, size = open_for_reading(path)
    with file:
        return _parse(file, size, str(path))


def read_npz(path: Path) -> dict[str, Array]:
    """The arrays in an .npz file, by their names without .npy. Raises as `read_npy` does."""
    arrays = {}
    with opened_archive(path, ".npz file") as archive:
        for member in archive.names:
            data = archive.read(member, MEMBER_LIMIT)
            name = member.removesuffix(".npy")
            arrays[name] = _parse(io.BytesIO(data), len(data), f"{path}: {quoted(name, 60)}")
    return arrays


def _parse(file: BinaryIO, size: int, name: str) -> Array:
    """`numpy.load` that believes the header only as far as `size` bytes of `file` go; `name` for messages."""
    prefix = file.read(8)
    version = prefix[6] if len(prefix) == 8 and prefix.startswith(MAGIC) else 0
    length_size = {1: 2, 2: 4, 3: 4}.get(version, 0)
    length = int.from_bytes(file.read(length_size), "little")
    header = _HEADER.match(file.read(min(length, HEADER_LIMIT)))
    if header is None:
        raise FormatError(f"{name}: not a .npy file of plain numbers; was it made by another program?")
    dtype = np.dtype(header["dtype"].decode())
    shape = tuple(int(number) for number in header["shape"].split(b",") if number.strip())
    needed = math.prod(shape) * dtype.itemsize
    if file.tell() + needed != size:
        raise FormatError(
            f"{name}: truncated or damaged: shape {shape} needs {needed} bytes, "
            f"the file has {size - file.tell()}"
        )
    data = np.frombuffer(file.read(), dtype)
    if dtype.kind == "U" and data.size and not _is_text(data):
        raise FormatError(f"{name}: holds a text that is not Unicode")
    return data.reshape(shape, order="F" if header["order"] == b"True" else "C")


def _is_text(data: Array) -> bool:
    """Whether every code point of a text array exists; NumPy raises SystemError over one that does not."""
    codes = data.view(data.dtype.byteorder.replace("|", "=") + "u4")
    return bool(((codes < 0xD800) | (codes > 0xDFFF) & (codes <= 0x10FFFF)).all())
