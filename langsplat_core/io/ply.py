"""3D Gaussian scenes as PLY: INRIA's layout in all its variants, written in its plain form, and SuperSplat's
compressed PLY.

One element `vertex`, one row per Gaussian. As written: binary little endian, float32, in order
``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3``. Opacities are logits, scales natural
logarithms, rotations quaternions w x y z. There are 0, 9, 24 or 45 `f_rest` (SH degree 0 to 3), channel
after channel: all coefficients of red, then of green, then of blue. Normals are zeros that nobody reads.

As read: the properties in any order and of any scalar type, any byte order, ascii, LF or CR LF in the
header, without normals, with further elements (ignored) and properties (kept as `Scene.extras`). Rows are
kept as they are, NaN included. Of comments in the header two kinds mean something; of several of a kind the
last one counts:

    metres_per_unit 0.25        length of the world's unit; no positive number: unknown
    SplatRenderMode: mip        trained with Mip-Splatting's compensation: Brush, splat-transform, gsplat
    antialiased 1               the same: Postshot
    train_flags antialiasing    the same: proposed for the INRIA code
"""

import math
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from langsplat_core.arrays import Array, logit, number
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import open_for_reading
from langsplat_core.io.ply_table import (
    CHUNK_ROWS,
    TYPE_NAMES,
    PlyElement,
    PlyHeader,
    fill_columns,
    is_name,
    iterate_rows,
    read_columns,
    read_ply_header,
)
from langsplat_core.scene import SH_COUNTS, Gaussians, Scene
from langsplat_core.scene.transform import C0

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")  # zeros that nobody reads
BASE_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = {3 * (count - 1): degree for degree, count in SH_COUNTS.items()}  # f_rest_* -> SH degree
LAYOUT = "the layout"  # NumPy field of all its columns together; no PLY property has a name with a blank
METRES = "metres_per_unit"
COMMENT = "SplatRenderMode: mip"  # the commonest spelling, which `save_scene` writes


def read_ply(path: Path | str) -> Gaussians:
    """The Gaussians of a 3DGS PLY file, plain or compressed. Raises as `read_ply_scene` does."""
    return read_ply_scene(path).gaussians


def read_ply_scene(path: Path | str) -> Scene:
    """The Gaussians of a 3DGS PLY file, plain or compressed, and what else the file tells of them.

    `extras` are the scalar properties of a plain file that are none of the layout, in its order, each of
    its own type. Raises InputError when the file cannot be opened and FormatError when it breaks a rule of
    the format or holds no Gaussians.
    """
    path = Path(path)
    file, size = open_for_reading(path)
    with file:
        header = read_ply_header(file, path)
        antialiased = antialiased_by_comments(header.comments)
        metres = metres_by_comments(header.comments)
        vertex = header.element("vertex")
        if is_compressed(header):
            gaussians = read_compressed(file, size, header, path)
            return Scene(gaussians, antialiased=antialiased, metres_per_unit=metres)
        if vertex is None:
            raise FormatError(f"{path}: has no element 'vertex', so it is not a 3D Gaussian scene")
        gaussians, extras = _read_vertices(file, size, header, vertex, path)
        return Scene(gaussians, antialiased=antialiased, extras=extras, metres_per_unit=metres)


def _read_vertices(
    file: BinaryIO, size: int, header: PlyHeader, vertex: PlyElement, path: Path
) -> tuple[Gaussians, dict[str, Array]]:
    rest = check_gaussian_properties(vertex, path)
    chunks = iterate_rows(file, size, header, vertex, path)  # has checked the count against the size
    higher = len(rest) // 3  # coefficients of a channel beside the constant one
    by_coefficient = (rest[k + channel * higher] for k in range(higher) for channel in range(3))
    layout = (POSITION, SCALE, ROTATION, ("opacity",), (*BASE_COLOUR, *by_coefficient))
    tables = {names: np.empty((vertex.count, len(names)), np.float32) for names in layout}
    known = {*NORMAL}.union(*layout)
    extras = {
        prop.name: np.empty(vertex.count, prop.code) for prop in vertex.properties if prop.name not in known
    }
    fill_columns(chunks, vertex, tables, extras)
    means, log_scales, quats_wxyz, opacities, sh = tables.values()
    gaussians = Gaussians(
        means, log_scales, quats_wxyz, opacities[:, 0], sh.reshape(vertex.count, 1 + higher, 3)
    )
    return gaussians, extras


def write_ply(
    path: Path | str,
    gaussians: Gaussians,
    comments: tuple[str, ...] = (),
    extras: Mapping[str, Array] | None = None,
) -> None:
    """Write the plain INRIA form, atomically.

    `comments` become header lines of one line each. `extras`, name -> (N,) of a type that PLY has, become
    properties behind those of the layout, where readers that do not know them pass over them. Raises
    InputError for what a header cannot hold.
    """
    extras = extras or {}
    rest_count = 3 * (gaussians.sh.shape[1] - 1)
    rest = tuple(f"f_rest_{index}" for index in range(rest_count))
    names = (*POSITION, *NORMAL, *BASE_COLOUR, *rest, "opacity", *SCALE, *ROTATION)
    if any("\n" in comment or "\r" in comment for comment in comments):
        raise InputError("a PLY comment must be a single line")
    _check_extras(extras, names)
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(gaussians)}",
        *(f"property float {name}" for name in names),
        *(f"property {TYPE_NAMES[values.dtype.str[1:]]} {name}" for name, values in extras.items()),
        "end_header\n",
    ]
    columns = [(name, "<" + values.dtype.str[1:]) for name, values in extras.items()]
    dtype = np.dtype([(LAYOUT, "<f4", (len(names),)), *columns])
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(lines).encode())
        for start in range(0, len(gaussians), CHUNK_ROWS):
            part = np.arange(start, min(start + CHUNK_ROWS, len(gaussians)))
            rows = np.empty(len(part), dtype)
            drawn = gaussians.take(part)
            rows[LAYOUT] = np.concatenate(
                [
                    drawn.means,
                    np.zeros((len(part), 3), np.float32),
                    drawn.sh[:, 0],
                    drawn.sh[:, 1:].transpose(0, 2, 1).reshape(len(part), rest_count),
                    drawn.opacity_logits[:, None],
                    drawn.log_scales,
                    drawn.quats_wxyz,
                ],
                axis=1,
            )
            for name, values in extras.items():
                rows[name] = values[part]
            file.write(rows.tobytes())


def _check_extras(extras: Mapping[str, Array], names: tuple[str, ...]) -> None:
    for name, values in extras.items():
        if name in names or name.startswith("f_rest_") or not is_name(name):
            raise InputError(f"{name!r} cannot be an extra property of a PLY: rename it")
        if values.dtype.str[1:] not in TYPE_NAMES:
            raise InputError(f"extra property {name!r} is of type {values.dtype}, which no PLY can hold")


def sh_from_channel_major(base: Array, rest: Array) -> Array:
    """(N, 3) base colours and (N, 3 (K - 1)) channel-major coefficients -> (N, K, 3)."""
    by_channel = rest.reshape(len(rest), 3, rest.shape[1] // 3)
    return np.concatenate([base[:, None], by_channel.transpose(0, 2, 1)], axis=1)


def check_gaussian_properties(vertex: PlyElement, path: Path) -> tuple[str, ...]:
    """Require the scalar properties of a Gaussian; returns the names of its `f_rest_*` in order."""
    names = {prop.name for prop in vertex.properties}
    needed = (*POSITION, *BASE_COLOUR, "opacity", *SCALE, *ROTATION)
    missing = [name for name in needed if name not in names]
    if not names & set(needed[3:]):
        raise FormatError(
            f"{path}: a mesh or point cloud, not a 3D Gaussian scene: its vertices have no f_dc, opacity, "
            "scale and rot; train one with 'langsplat train'"
        )
    if missing:
        raise FormatError(f"{path}: property {missing[0]!r} is missing; every Gaussian needs it")
    rest_count = sum(name.startswith("f_rest_") for name in names)
    if rest_count not in REST_COUNTS:
        raise FormatError(
            f"{path}: {rest_count} properties f_rest_*; expected 0, 9, 24 or 45 (SH degree 0-3)"
        )
    rest = tuple(f"f_rest_{index}" for index in range(rest_count))
    absent = [name for name in rest if name not in names]
    if absent:
        raise FormatError(f"{path}: property {absent[0]!r} is missing among {rest_count} f_rest_*")
    lists = [prop.name for prop in vertex.properties if prop.count_code]
    if lists:
        raise FormatError(f"{path}: property {lists[0]!r} of vertex is a list; expected one number")
    return rest


# ---- comments ----


def antialiased_by_comments(comments: tuple[str, ...]) -> bool:
    """Return whether a header's comments say that its scene was trained with Mip-Splatting's compensation."""
    said = False
    for comment in comments:
        match comment.lower().replace(":", " ").split():
            case ["splatrendermode", mode, *_]:
                said = mode == "mip"
            case ["antialiased", value]:
                said = value == "1"
            case ["train_flags", *flags]:
                said = "antialiasing" in flags
    return said


def metres_comment(metres_per_unit: float) -> str:
    """The comment that states the length of the world's unit."""
    return f"{METRES} {float(metres_per_unit)!r}"


def metres_by_comments(comments: tuple[str, ...]) -> float | None:
    """Metres per world unit, > 0 and finite, as the header's comments say; None where they do not."""
    found = None
    for comment in comments:
        match comment.replace(":", " ").split():
            case [key, value] if key == METRES:
                found = _positive(value)
    return found


def write_metres(path: Path | str, metres_per_unit: float) -> None:
    """Say in the header of the PLY `path` how long its unit is; all else stays as it is, byte for byte.

    Raises InputError for another kind of file and a length that is not positive, FormatError for a header
    that breaks the rules.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: only a .ply keeps a scale; make one with 'langsplat convert'")
    if not 0 < metres_per_unit < math.inf:
        raise InputError(f"{metres_per_unit:g} metres per unit: must be above 0 and finite")
    file, _ = open_for_reading(path)
    with atomic_path(path) as temporary, file, temporary.open("wb") as out:
        size = read_ply_header(file, path).size
        file.seek(0)
        *lines, last = file.read(size).splitlines(keepends=True)
        end = b"\r\n" if last.endswith(b"\r\n") else b"\n"
        out.writelines(line for line in lines if not _is_ours(line))
        out.write(b"comment " + metres_comment(metres_per_unit).encode() + end + last)
        shutil.copyfileobj(file, out)


def _is_ours(line: bytes) -> bool:
    return line.replace(b":", b" ").split()[:2] == [b"comment", METRES.encode()]


def _positive(text: str) -> float | None:
    try:
        value = number(text)
    except ValueError:
        return None
    return value if 0 < value < math.inf else None


# ---- the compressed PLY of SuperSplat and splat-transform ----
#
# Three elements. `chunk`: for every 256 Gaussians the least and greatest position, logarithm of scale and,
# in files of 18 columns, base colour. `vertex`: four uint32 per Gaussian,
#
#     packed_position   x 11 bits, y 10, z 11, from the top, as fractions between the chunk's bounds
#     packed_scale      likewise, of the scales' logarithms
#     packed_rotation   2 bits: which of w x y z is largest and left out (it is positive); then the other
#                       three in 10 bits each, as fractions of [-sqrt(1/2), sqrt(1/2)]
#     packed_color      red, green, blue, opacity in 8 bits each; the opacity is not a logit here
#
# `sh`, optional: `f_rest_*` in 8 bits each over [-4, 4], channel after channel. Opacities of 0 and 1 become
# logits of -infinity and +infinity.
#
# Source of the layout: the public writer in PlayCanvas' splat-transform; the code here is our own.

CHUNK_SIZE = 256
POSITION_BOUNDS = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
SCALE_BOUNDS = ("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z")
COLOUR_BOUNDS = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

# Code c stands for the middle of its 1/256 interval, but the two ends are exact (-4 and 4).
_SH_VALUES = ((np.arange(256) + 0.5) / 256 - 0.5) * 8
_SH_VALUES[[0, 255]] = -4, 4


def is_compressed(header: PlyHeader) -> bool:
    """Return whether the header announces packed Gaussians."""
    vertex = header.element("vertex")
    return (
        header.element("chunk") is not None
        and vertex is not None
        and any(prop.name in PACKED for prop in vertex.properties)
    )


def read_compressed(file: BinaryIO, file_size: int, header: PlyHeader, path: Path) -> Gaussians:
    """Decode a file for which `is_compressed` holds. Raises FormatError."""
    chunk, vertex = header.element("chunk"), header.element("vertex")
    assert chunk is not None  # is_compressed
    assert vertex is not None
    has_colours = any(prop.name == COLOUR_BOUNDS[0] for prop in chunk.properties)
    bound_names = POSITION_BOUNDS + SCALE_BOUNDS + (COLOUR_BOUNDS if has_colours else ())
    if chunk.count * CHUNK_SIZE < vertex.count:
        raise FormatError(
            f"{path}: {chunk.count} chunks for {vertex.count} Gaussians; expected one for every {CHUNK_SIZE}"
        )
    bounds = read_columns(file, file_size, header, chunk, bound_names, path)
    packed = read_columns(file, file_size, header, vertex, PACKED, path)
    if not ((packed >= 0) & (packed < 2**32)).all():  # NaN compares False
        raise FormatError(f"{path}: packed numbers beyond 32 bits; expected uint")
    packed = packed.astype(np.uint32)
    position, rotation, scale, colour = packed.T
    of_chunk = np.arange(vertex.count) // CHUNK_SIZE
    rgba = np.stack([colour >> shift & 255 for shift in (24, 16, 8, 0)], axis=1) / 255
    with np.errstate(invalid="ignore", over="ignore"):  # infinite bounds make rows that are dropped later
        rgb = _between(bounds[:, 12:18], of_chunk, rgba[:, :3]) if has_colours else rgba[:, :3]
        return Gaussians(
            means=_between(bounds[:, 0:6], of_chunk, _fractions_11_10_11(position)),
            log_scales=_between(bounds[:, 6:12], of_chunk, _fractions_11_10_11(scale)),
            quats_wxyz=_quaternions(rotation),
            opacity_logits=logit(rgba[:, 3]),
            sh=sh_from_channel_major((rgb - 0.5) / C0, _read_rest(file, file_size, header, vertex, path)),
        )


def _read_rest(file: BinaryIO, file_size: int, header: PlyHeader, vertex: PlyElement, path: Path) -> Array:
    """(N, 3 (K - 1)) channel-major coefficients; K = 1 without the element `sh`."""
    element = header.element("sh")
    if element is None or not element.properties:
        return np.zeros((vertex.count, 0))
    if element.count != vertex.count or len(element.properties) not in REST_COUNTS:
        raise FormatError(
            f"{path}: element sh has {element.count} rows of {len(element.properties)}; expected "
            f"{vertex.count} rows of 9, 24 or 45"
        )
    names = tuple(f"f_rest_{index}" for index in range(len(element.properties)))
    codes = read_columns(file, file_size, header, element, names, path)
    if not ((codes >= 0) & (codes <= 255)).all():
        raise FormatError(f"{path}: element sh holds values beyond 0..255; expected uchar")
    return _SH_VALUES[codes.astype(np.uint8)]


def _between(bounds: Array, of_chunk: Array, fractions: Array) -> Array:
    """(chunks, 6) least and greatest, (N,) chunk of each row, (N, 3) fractions -> (N, 3) values."""
    least, greatest = bounds[of_chunk, :3], bounds[of_chunk, 3:]
    return least * (1 - fractions) + greatest * fractions


def _fractions_11_10_11(packed: Array) -> Array:
    """(N,) uint32 of 11, 10 and 11 bits -> (N, 3) fractions in [0, 1]."""
    return np.stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _quaternions(packed: Array) -> Array:
    """(N,) uint32 -> (N, 4) unit quaternions w x y z."""
    three = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023
    return smallest_three((three - 0.5) * np.sqrt(2), packed >> 30)


OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # components beside the largest, by its index


def smallest_three(three: Array, largest: Array) -> Array:
    """(N, 3) components other than the largest, (N,) index of the largest -> (N, 4) unit quaternions."""
    out = np.empty((len(three), 4))
    rows = np.arange(len(three))[:, None]
    out[rows, OTHERS[largest]] = three
    out[rows[:, 0], largest] = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
    return out
