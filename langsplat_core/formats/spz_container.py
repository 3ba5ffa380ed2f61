"""The container of .spz files (Niantic): from the file to one block of bytes per attribute, and back.

Versions 1 to 3 are one gzip stream (a few tools write it without gzip) of a 16-byte header and the blocks
in the order of `widths`. Version 4 is a header of 32 bytes, extension records up to the byte that the
header names, a table of (compressed, whole) sizes as uint64, and one Zstandard frame per block. In
versions 2 and 3 extension records lie behind the last block. A record is a uint32 type, a uint32 length
and so many bytes; the only one that changes how a file is to be read is the axes', an index into
LDB RDB LUB RUB LDF RDF LUF RUF (left or right, down or up, back or forward), from 1. Without it a file is
RUB: x to the right, y up, z backwards.

Source of the layout: README, extensions and loader of nianticlabs/spz; the code here is our own.
"""

import gzip
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.files import atomic_path
from langsplat_core.parsing.opening import open_for_reading

MAGIC, GZIP_MAGIC = b"NGSP", b"\x1f\x8b"
HEADER_SIZE, HEADER_SIZE_4 = 16, 32
ANTIALIASED, EXTENDED = 0x1, 0x2  # flags
AXES_RECORD, AXES_RUB = 0xADBE0003, 4
SH_COUNTS = (1, 4, 9, 16, 25)  # of degree 0 to 4, the base colour included
# Quantised Gaussians compress 3 to 1 at best. A file that claims to have gained 64 to 1 is made to
# exhaust memory.
BYTES_PER_BYTE = 64
PIECE = 65536  # bytes read at once behind the blocks; extension records have some tens
SLACK = 1024 * 1024  # bytes, for small files of equal Gaussians


@dataclass(frozen=True, eq=False)
class Packed:
    """The content of a .spz file, unpacked but still quantised."""

    version: int  # 1 to 4
    sh_degree: int  # 0 to 4
    fractional_bits: int  # of positions, from version 2 on
    antialiased: bool
    axes: int  # 1 to 8, see above
    blocks: dict[str, Array]  # attribute -> (N, bytes of one Gaussian) uint8


def widths(version: int, sh_degree: int) -> dict[str, int]:
    """Attribute -> bytes of one Gaussian, in the order of the file."""
    return {
        "positions": 6 if version == 1 else 9,
        "alphas": 1,
        "colours": 3,
        "scales": 3,
        "rotations": 3 if version < 3 else 4,
        "sh": 3 * (SH_COUNTS[sh_degree] - 1),
    }


def read_packed(path: Path) -> Packed:
    """Raises InputError when the file cannot be opened and FormatError when it breaks a rule."""
    file, size = open_for_reading(path)
    with file:
        start = file.read(8)
        file.seek(0)
        if start.startswith(GZIP_MAGIC):
            try:
                with gzip.GzipFile(fileobj=file) as unzipped:
                    return _read_one_stream(unzipped, BYTES_PER_BYTE * size + SLACK, path)  # type: ignore[arg-type]
            except (OSError, EOFError, zlib.error) as error:
                raise FormatError(
                    f"{path}: not a whole gzip stream ({str(error)[:80]}); fetch it again"
                ) from None
        if start == MAGIC + b"\x04\0\0\0":
            return _read_streams(file, size, path)
        return _read_one_stream(file, size, path)


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int
    streams: int  # of version 4

    def packed(self, axes: int, blocks: list[bytes]) -> Packed:
        named = zip(widths(self.version, self.sh_degree).items(), blocks, strict=True)
        arrays = {name: np.frombuffer(b, np.uint8).reshape(self.count, width) for (name, width), b in named}
        antialiased = bool(self.flags & ANTIALIASED)
        return Packed(self.version, self.sh_degree, self.fractional_bits, antialiased, axes, arrays)


def _header(data: bytes, path: Path) -> _Header:
    if len(data) < HEADER_SIZE or not data.startswith(MAGIC):
        raise FormatError(
            f"{path}: not an .spz file: it does not begin with {MAGIC.decode()}, nor does what is zipped"
        )
    header = _Header(*struct.unpack_from("<IIBBBB", data, 4))
    if not 1 <= header.version <= 4 or header.sh_degree >= len(SH_COUNTS):
        raise FormatError(
            f"{path}: .spz version {header.version}, SH degree {header.sh_degree}; only versions 1 to 4 "
            "of degree 0 to 4 are read, export the scene again"
        )
    return header


def _read_one_stream(file: BinaryIO, limit: int, path: Path) -> Packed:
    """Versions 1 to 3, unzipped; `limit` is the most bytes that the stream can honestly have."""
    header = _header(file.read(HEADER_SIZE), path)
    sizes = [header.count * width for width in widths(header.version, header.sh_degree).values()]
    if HEADER_SIZE + sum(sizes) > limit:
        raise FormatError(
            f"{path}: truncated: {header.count} Gaussians need {sum(sizes)} bytes, the file can hold {limit}"
        )
    blocks = [file.read(size) for size in sizes]
    if sum(map(len, blocks)) < sum(sizes):
        raise FormatError(f"{path}: truncated: {header.count} Gaussians need {sum(sizes)} bytes")
    behind = file.read(PIECE)
    _read_to_the_end(file, limit - HEADER_SIZE - sum(sizes) - len(behind), path)
    return header.packed(_axes(behind if header.flags & EXTENDED else b"", path), blocks)


def _read_to_the_end(file: BinaryIO, limit: int, path: Path) -> None:
    """Where gzip has its checksum. Other programs' data may lie before it, of at most `limit` bytes."""
    while piece := file.read(PIECE):
        limit -= len(piece)
        if limit < 0:
            raise FormatError(f"{path}: too many bytes behind its Gaussians; the file is damaged")


def _read_streams(file: BinaryIO, file_size: int, path: Path) -> Packed:
    """Version 4."""
    start = file.read(HEADER_SIZE_4)
    header = _header(start, path)
    if len(start) < HEADER_SIZE_4:
        raise FormatError(f"{path}: truncated: an .spz of version 4 has a header of {HEADER_SIZE_4} bytes")
    table_at = struct.unpack_from("<I", start, 16)[0]
    records_size = table_at - HEADER_SIZE_4
    if not 0 <= records_size <= file_size:
        raise FormatError(f"{path}: its table at byte {table_at} of {file_size}; the file is damaged")
    records = file.read(records_size)
    sizes = [header.count * width for width in widths(4, header.sh_degree).values()]
    stored = [size for size in sizes if size]  # blocks without a byte have no stream
    table = np.frombuffer(_exactly(file, 16 * header.streams, path), "<u8").reshape(-1, 2).tolist()
    if [whole for _, whole in table if whole] != stored:
        raise FormatError(f"{path}: the sizes in its table are not those of {header.count} Gaussians")
    if sum(stored) > BYTES_PER_BYTE * file_size + SLACK:
        raise FormatError(f"{path}: {sum(stored)} bytes cannot be in a file of {file_size}; it is damaged")
    left = file_size - file.tell()
    if sum(zipped for zipped, _ in table) > left:
        raise FormatError(f"{path}: truncated: its streams do not fit into the {left} bytes behind its table")
    streams = iter([_unpacked(file.read(zipped), whole, path) for zipped, whole in table if whole])
    blocks = [next(streams) if size else b"" for size in sizes]
    return header.packed(_axes(records if header.flags & EXTENDED else b"", path), blocks)


def _exactly(file: BinaryIO, size: int, path: Path) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise FormatError(f"{path}: truncated: {size - len(data)} bytes are missing")
    return data


def _unpacked(data: bytes, size: int, path: Path) -> bytes:
    """A Zstandard frame that holds exactly `size` bytes; never more of it is unpacked than one byte more."""
    import zstandard  # needed by version 4 alone

    try:
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data) as reader:
            out = reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise FormatError(f"{path}: a stream cannot be unpacked ({str(error)[:80]})") from None
    if len(out) != size:
        raise FormatError(f"{path}: a stream holds fewer or more than the {size} bytes of the table")
    return bytes(out)


def _axes(records: bytes, path: Path) -> int:
    """What the extension records say about the axes. Records of other layouts, which older programs wrote,
    end the search."""
    at = 0
    while at + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, at)
        if kind == AXES_RECORD and length == 4 and at + 12 <= len(records):
            axes = int(struct.unpack_from("<I", records, at + 8)[0]) or AXES_RUB
            if axes > 8:
                raise FormatError(f"{path}: its axes are of kind {axes}; export the scene with axes RUB")
            return axes
        at += 8 + length
    return AXES_RUB


def write_packed(path: Path | str, packed: Packed) -> None:
    """Write version 2 or 3, atomically, without extensions: axes RUB."""
    count = len(packed.blocks["alphas"])
    flags = ANTIALIASED if packed.antialiased else 0
    numbers = (packed.version, count, packed.sh_degree, packed.fractional_bits, flags, 0)
    blocks = [packed.blocks[name].tobytes() for name in widths(packed.version, packed.sh_degree)]
    content = b"".join([MAGIC, struct.pack("<IIBBBB", *numbers), *blocks])
    with atomic_path(path) as temporary:
        temporary.write_bytes(gzip.compress(content, mtime=0))  # mtime: the same scene, the same bytes
