"""Niantic's .spz: the container, with one block of bytes per attribute, and the quantised Gaussians in it.

Versions 1 to 3 are one gzip stream (a few tools write it without gzip) of a 16-byte header and the blocks
in the order of `_Header.widths`. Version 4 is a header of 32 bytes, extension records up to the byte that the
header names, a table of (compressed, whole) sizes as uint64, and one Zstandard frame per block. In
versions 2 and 3 extension records follow the last block. A record is a uint32 type, a uint32 length and that
number of bytes. Only the record of the axes is read (SPZ_ADOBE_coordinate_system): an index into
LDB RDB LUB RUB LDF RDF LUF RUF (left or right, down or up, back or forward), from 1; axes with z up, from 9,
are not supported. Without this record a file should be RUB (x to the right, y up, z backwards), but
splat-transform, gsply and Niantic's ply_to_spz keep a PLY's RDF.

Source of the layout: README, extensions and loader of nianticlabs/spz; the code here is our own.
"""

import gzip
import io
import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from langsplat_core.arrays import Array, logit, rotation_matrices, sigmoid
from langsplat_core.errors import InputError, Tell, malformed, report_loss, report_losses, unread
from langsplat_core.io.cameras import SUFFIX, read_cameras
from langsplat_core.io.files import write_whole
from langsplat_core.io.hostile import SMALL_RATIO, Allowance, open_for_reading
from langsplat_core.io.quantised import check_steps, mirrored, smallest_three, to_bytes, without_largest
from langsplat_core.scene import SH_COUNTS, Gaussians, Scene
from langsplat_core.scene.surface import surface_areas

MAGIC, GZIP_MAGIC = b"NGSP", b"\x1f\x8b"
ANTIALIASED, EXTENDED = 0x1, 0x2  # flags
AXES_RECORD, AXES = 0xADBE0003, {"rub": 4, "rdf": 6}
SPZ_SH_COUNTS = (1, 4, 9, 16, 25)  # of degree 0 to 4, the base colour included
SLACK = 1024 * 1024  # bytes, at most, of records after the Gaussians
_HEADER = struct.Struct("<4sIIBBBB")


@dataclass(frozen=True)
class _Header:
    """The first 16 bytes of a file, unzipped."""

    magic: bytes
    version: int  # 1 to 4
    count: int  # Gaussians
    sh_degree: int  # 0 to 4
    fractional_bits: int  # of positions, from version 2 on
    flags: int
    streams: int  # of version 4

    @property
    def widths(self) -> dict[str, int]:
        """Attribute -> bytes of one Gaussian, in the order of the file."""
        return {
            "positions": 6 if self.version == 1 else 9,
            "alphas": 1,
            "colours": 3,
            "scales": 3,
            "rotations": 3 if self.version < 3 else 4,
            "sh": 3 * (SPZ_SH_COUNTS[self.sh_degree] - 1),
        }


def _read(file: BinaryIO, size: int, path: Path, room: Allowance, axes: int, tell: Tell) -> tuple[Scene, int]:
    """Return the scene in a file of `size` bytes, and the axes, 1 to 8, that it names, 0 for none.

    Sizes are checked before anything is unpacked. axes: of a file that does not name them.
    """
    zipped = file.read(2) == GZIP_MAGIC
    file.seek(0)
    stream: Any = gzip.GzipFile(fileobj=file) if zipped else file
    try:
        start = stream.read(_HEADER.size)
        if len(start) < _HEADER.size or not start.startswith(MAGIC):
            what = f"neither it nor its unzipped content begins with {MAGIC.decode()}"
            raise malformed(path, f"not an .spz file: {what}")
        header = _Header(*_HEADER.unpack(start))
        if not 1 <= header.version <= 4 or header.sh_degree >= len(SPZ_SH_COUNTS):
            what = f".spz version {header.version}, SH degree {header.sh_degree}"
            raise malformed(path, what, "only versions 1 to 4 of degree 0 to 4 are read: export it again")
        sizes = [header.count * width for width in header.widths.values()]
        room.take_gaussians(header.count, min(header.sh_degree, 3))
        if header.version == 4:
            blocks, records = _read_streams(file, size, header, sizes, path, tell)
        elif not zipped and sum(sizes) > size:
            raise malformed(path, f"truncated: {header.count} Gaussians need {sum(sizes)} bytes of {size}")
        else:
            blocks = [stream.read(size) for size in sizes]
            records = stream.read(SLACK + 1)  # to the end, where gzip checks its checksum
    except (OSError, EOFError, zlib.error) as error:
        raise malformed(path, f"not a whole gzip stream ({str(error)[:80]})", "fetch it again") from None
    if [*map(len, blocks)] != sizes or len(records) > SLACK:
        raise malformed(path, f"truncated, or too long for its {header.count} Gaussians")
    named = zip(header.widths.items(), blocks, strict=True)
    arrays = {name: np.frombuffer(b, np.uint8).reshape(header.count, width) for (name, width), b in named}
    if unknown := header.flags & ~(ANTIALIASED | EXTENDED):
        tell(f"flags {unknown:#x} not known")
    if records and not header.flags & EXTENDED:
        tell(f"{len(records)} bytes beside its Gaussians not read")
    stated = _axes(records if header.flags & EXTENDED else b"", path, tell)
    return _scene(header, arrays, stated or axes, tell), stated


def _read_streams(
    file: BinaryIO, size: int, header: _Header, wholes: list[int], path: Path, tell: Tell
) -> tuple[list[bytes], bytes]:
    """Return blocks of `wholes` bytes, and records, of version 4 after its first 16 bytes."""
    content = file.read(size)
    (table_at,) = struct.unpack_from("<I", content.ljust(4))
    records, table = content[16 : table_at - 16], content[max(table_at - 16, 16) :][: 16 * header.streams]
    at = table_at - 16 + len(table)
    if table_at < 32 or len(table) < 16 * header.streams:
        raise malformed(path, f"truncated: its table at byte {table_at} of {size}")
    entries = np.frombuffer(table, "<u8").reshape(-1, 2).tolist()
    stored = [whole for whole in wholes if whole]  # empty blocks have no stream
    if [whole for _, whole in entries if whole] != stored:
        raise malformed(path, f"the sizes in its table are not those of {header.count} Gaussians")
    end = at + sum(zipped for zipped, _ in entries)
    if end > len(content):
        raise malformed(path, f"truncated: its streams do not fit into {size} bytes")
    if end < len(content):
        tell(f"{len(content) - end} bytes behind its last stream not read")
    streams = []
    for zipped, whole in entries:
        if whole:
            streams.append(_unpacked(content[at : at + zipped], whole, path))
        at += zipped
    return [streams.pop(0) if whole else b"" for whole in wholes], records


def _unpacked(data: bytes, size: int, path: Path) -> bytes:
    """Return the content of a Zstandard frame; at most `size` + 1 bytes are unpacked."""
    import zstandard  # only for version 4

    try:
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data) as reader:
            return bytes(reader.read(size + 1))
    except zstandard.ZstdError as error:
        raise malformed(path, f"a stream cannot be unpacked ({str(error)[:80]})") from None


def _axes(records: bytes, path: Path, tell: Tell) -> int:
    """Return the axes that an extension record names, 0 without one; an incomplete record ends the search."""
    at, axes, others = 0, 0, set[str]()
    while at + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, at)
        if at + 8 + length > len(records):
            break
        if kind == AXES_RECORD and length == 4 and not axes:
            axes = int(struct.unpack_from("<I", records, at + 8)[0]) or AXES["rub"]
        else:
            others.add(f"{kind:#010x}")
        at += 8 + length
    if axes > 8:
        raise malformed(path, f"its axes are of kind {axes}", "export the scene with axes RUB")
    tell(unread("extension records", others))
    if at < len(records):
        tell(f"{len(records) - at} bytes of extension records not understood")
    return axes


# ---- quantised Gaussians, about ten times smaller than the PLY ----
#
#     positions   three 24-bit fixed-point numbers, with the header's number of fractional bits
#                 (version 1: three float16)
#     alphas      opacity in 8 bits
#     colours     0.5 + 0.15 f_dc in 8 bits each
#     scales      16 (logarithm + 10) in 8 bits each
#     rotations   from version 3 on: 2 bits for the index in x y z w of the largest, which is omitted (it is
#                 positive), and a sign and 9 bits of magnitude over sqrt(1/2) for each of the others; before:
#                 x y z in 8 bits over [-1, 1] each (w is positive)
#     sh          128 + 128 times the coefficient, red green blue of one coefficient after the other
#
# Versions 1 to 4 are read; coefficients of degree 4, which nothing here draws, are dropped and reported.
#
# Version 3 is written by default. Its rotations are exact to 0.1 degrees; those of version 2 err by up to a
# degree. Version 4 differs only in the container. Programs that read it also read 3, except PlayCanvas's
# engine, and many read only 3. Both have the record of the axes.

COLOUR_SCALE = 0.15
SMALLEST, LARGEST = -10, 255 / 16 - 10  # logarithms of sizes
FRACTIONAL_BITS = 12  # as in other writers: steps of 1/4096, up to 2048


def read_spz_scene(path: Path | str, axes: str = "", note: Tell = lambda line: None) -> Scene:
    """Return the scene of a .spz file; InputError if it cannot be opened, else FormatError.

    axes: in `AXES`, of a file that names none; "": RUB, with a warning if upside down. note: is told of it.
    """
    path = Path(path)
    file, size = open_for_reading(path)
    with file:
        told, room = list[str](), Allowance(path, size, SMALL_RATIO)
        scene, stated = _read(file, size, path, room, AXES[axes or "rub"], told.append)
    if stated and axes and stated != AXES[axes]:
        told.append(f"its own record of its axes is followed, not --axes {axes}")
    if not stated:
        note(f"{path}: names no axes; read as {(axes or 'rub').upper()}")
    if not stated and not axes and _floor_is_above(path, scene):
        told.append("taken for RUB, as no record names its axes, but its floor is above; try --axes rdf")
    report_losses(path, told)
    return scene


def decode_spz(data: bytes, path: Path, room: Allowance, tell: Tell) -> Scene:
    """Return the scene of an .spz file in memory, in the axes of the PLY.

    path: for messages; room: of the file that contains it. Raises FormatError.
    """
    return _read(io.BytesIO(data), len(data), path, room, AXES["rub"], tell)[0]


def _floor_is_above(path: Path, scene: Scene) -> bool:
    """Return True if a height near the top has twice the horizontal surface of any near the bottom.

    Up is that of its cameras, or of a .ply's of its name. Upright, a floor has 3 to 200 times the top's.
    """
    for beside in (path.with_suffix(SUFFIX), path.with_name(path.name + SUFFIX)):
        with suppress(InputError):  # reported when the scene's cameras are read
            scene = replace(scene, cameras=read_cameras(beside)) if beside.exists() else scene
    count, up = len(scene.gaussians), scene.up()
    some = scene.gaussians.take(np.arange(0, count, count // 20_000 + 1))
    some = some.take(some.valid())
    normals = np.einsum("i,nij->nj", up, rotation_matrices(some.quats_wxyz.astype(np.float64)))
    level = np.take_along_axis(np.abs(normals), some.log_scales.argmin(axis=1)[:, None], axis=1)[:, 0] > 0.9
    heights = some.means @ up
    if len(some) < 1000:  # too few for a floor
        return False
    low, high = np.quantile(heights, [0.02, 0.98])
    counts, _ = np.histogram(heights, 32, (low, high), weights=surface_areas(some) * level)
    return bool(counts[-10:].max() > max(2 * counts[:10].max(), 0.05 * counts.sum()))


def _scene(header: _Header, blocks: dict[str, Array], axes: int, tell: Tell) -> Scene:
    """Return the scene in `blocks`: attribute -> (N, bytes of one Gaussian) uint8."""
    degree = min(header.sh_degree, 3)
    if degree < header.sh_degree:
        tell(f"its spherical harmonics of degree {header.sh_degree} are cut to {degree}")
    count, width = blocks["sh"].shape
    rest = blocks["sh"].reshape(count, width // 3, 3)[:, : SH_COUNTS[degree] - 1]
    base = (blocks["colours"] / 255 - 0.5) / COLOUR_SCALE
    gaussians = Gaussians(
        means=_positions(header, blocks["positions"]),
        log_scales=blocks["scales"].astype(np.float32) / 16 - 10,
        quats_wxyz=_rotations(header, blocks["rotations"], tell),
        opacity_logits=logit(blocks["alphas"][:, 0] / 255),
        sh=np.concatenate([base[:, None], (rest.astype(np.float32) - 128) / 128], axis=1),
    )
    return Scene(mirrored(gaussians, _signs_to_rdf(axes)), antialiased=bool(header.flags & ANTIALIASED))


def write_spz(path: Path | str, scene: Scene, version: int = 3, axes: str = "rub") -> None:
    """Write .spz version 3 or 4 in axes of `AXES`, which it records, atomically; rows keep their order.

    Positions are rounded to 1/4096 world unit, or finer for smaller Gaussians; scales to 1/16 in the
    logarithm, within e^-10 to e^5.9; coefficients to 1/128, within -1 to 1; colours and opacities to 1/255.
    Values beyond are cut and reported; a row that cannot be drawn gets opacity 0. InputError for a scene too
    large for 24 bits per coordinate, or if most sizes are beyond the range.
    """
    gaussians, valid = scene.gaussians, scene.gaussians.valid()
    drawn = mirrored(gaussians.take(valid), _signs_to_rdf(AXES[axes]))  # the map is its own inverse
    bits = _fractional_bits(drawn, Path(path))
    sizes = drawn.log_scales.max(axis=1, initial=-np.inf)
    cut = (sizes > LARGEST + 0.1) | (sizes < SMALLEST - 0.1)  # 0.1 is within rounding
    if 2 * np.count_nonzero(cut) > len(sizes):
        what = f"sizes around {np.exp(np.median(sizes)):.2g} are beyond .spz, 4.5e-5 to 380"
        raise InputError(f"{path}: {what} world units; write .ply or .sog")
    if cut.any():
        report_loss(".spz: the sizes of %d of %d Gaussians are beyond it and are cut", cut.sum(), len(sizes))
    codes = np.rint(drawn.means.astype(np.float64) * 2.0**bits).astype("<i4")
    rest = drawn.sh[:, 1:]
    coded = {
        "positions": codes[..., None].view(np.uint8)[..., :3].reshape(-1, 9),
        "alphas": to_bytes(sigmoid(drawn.opacity_logits) * 255)[:, None],
        "colours": to_bytes((drawn.sh[:, 0] * COLOUR_SCALE + 0.5) * 255, ".spz: the colours"),
        "scales": to_bytes((drawn.log_scales.clip(SMALLEST, LARGEST) + 10) * 16),
        "rotations": _rotation_codes(drawn.quats_wxyz),
        "sh": to_bytes(rest.reshape(len(rest), 3 * rest.shape[1]) * 128 + 128, ".spz: the coefficients"),
    }
    flags = EXTENDED | (ANTIALIASED if scene.antialiased else 0)
    widths = _Header(MAGIC, version, 0, gaussians.sh_degree, 0, 0, 0).widths
    blocks = []
    for name, width in widths.items():
        block = np.zeros((len(valid), width), np.uint8)
        block[valid] = coded[name]
        blocks += [block.tobytes()] if block.size else []
    streams = 0 if version == 3 else len(blocks)
    head = _HEADER.pack(MAGIC, version, len(valid), gaussians.sh_degree, bits, flags, streams)
    record = struct.pack("<III", AXES_RECORD, 4, AXES[axes])
    if version == 3:  # without a time, so that equal scenes give equal bytes
        content = gzip.compress(b"".join([head, *blocks, record]), mtime=0)
    else:
        import zstandard

        frames = [zstandard.ZstdCompressor(12).compress(block) for block in blocks]
        sizes = [len(part) for pair in zip(frames, blocks, strict=True) for part in pair]
        head += struct.pack("<I12x", 32 + len(record)) + record
        content = b"".join([head, struct.pack(f"<{len(sizes)}Q", *sizes), *frames])
    write_whole(path, content)


def _fractional_bits(drawn: Gaussians, path: Path) -> int:
    """Return the fractional bits of positions: `FRACTIONAL_BITS`, more in small scenes, fewer in large."""
    if len(drawn) == 0:
        return FRACTIONAL_BITS
    reach = max(float(np.abs(drawn.means).max()), 1e-30)
    most = int(np.floor(np.log2((2**23 - 1) / reach)))
    size = float(np.median(drawn.log_scales.max(axis=1)))  # logarithm of a typical Gaussian's longest axis
    least = int(np.ceil(-size / np.log(2))) if np.isfinite(size) else 0  # a step of its size
    if most < FRACTIONAL_BITS:
        check_steps(path, drawn, np.full(len(drawn), 2.0**-most))
    if most < 0:  # steps of more than a unit do not exist, however large the Gaussians are
        raise InputError(f"{path}: positions up to {reach:.3g} are beyond the 24 bits of .spz; write .ply")
    # The median Gaussian's position is exact to a sixteenth of its size. 24 bits hold the scene; with more
    # than 30 fractional bits other readers overflow.
    return max(0, min(most, max(FRACTIONAL_BITS, least + 4), 30))


def _positions(header: _Header, data: Array) -> Array:
    if header.version == 1:
        return np.ascontiguousarray(data).view("<f2").astype(np.float32)
    # 24 bits each, padded below to int32, which multiplies them by 256
    codes = np.pad(data.reshape(len(data), 3, 3), ((0, 0), (0, 0), (1, 0))).view("<i4")[..., 0] >> 8
    return codes / 2.0**header.fractional_bits


def _rotations(header: _Header, data: Array, tell: Tell) -> Array:
    """Return (N, 4) unit quaternions w x y z."""
    if header.version < 3:
        return smallest_three(data / 127.5 - 1, np.zeros(len(data), np.intp), tell)  # w is omitted
    words = np.ascontiguousarray(data).view("<u4")[:, 0]
    three = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    magnitudes = (three & 511) / 511 * np.sqrt(0.5)
    xyzw = smallest_three(np.where(three & 512, -magnitudes, magnitudes), words >> 30, tell)
    return xyzw[:, [3, 0, 1, 2]]


def _rotation_codes(quats_wxyz: Array) -> Array:
    """Return the (N, 4) bytes of version 3 for (N, 4) quaternions of any length."""
    three, largest = without_largest(quats_wxyz[:, [1, 2, 3, 0]])
    codes = np.rint(np.abs(three) * np.sqrt(2) * 511).clip(0, 511).astype(np.uint32)
    codes |= (three < 0) * np.uint32(512)
    words = largest.astype("<u4") << 30 | codes[:, 0] << 20 | codes[:, 1] << 10 | codes[:, 2]
    return words.astype("<u4")[:, None].view(np.uint8)


def _signs_to_rdf(axes: int) -> Array:
    """Return (3,) signs from `axes` (axes - 1 has bits right, up, front) to right, down, front of the PLY."""
    right, up, front = (axes - 1 >> bit & 1 for bit in range(3))
    return np.array([1 if right else -1, -1 if up else 1, 1 if front else -1])
