"""The INRIA 3D Gaussian Splatting PLY, read in all its variants and written in its plain form.

Layout: one element `vertex`, one row per Gaussian. As written: binary little endian, float32, in order
``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3``. Opacities are logits, scales natural
logarithms, rotations quaternions w x y z. There are 0, 9, 24 or 45 `f_rest` (SH degree 0 to 3), channel
after channel: all coefficients of red, then of green, then of blue. Normals are zeros that nobody reads.

As read: the properties in any order and of any scalar type, any byte order, ascii, LF or CR LF in the
header, without normals, with further elements (ignored) and properties (kept by `read_ply_scene`), and the
compressed variant of `compressed_ply`. Rows are kept as they are, NaN included. Header comments may say that
the Gaussians are to be drawn antialiased (`antialiasing`), and how long a unit is (`metres`).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.files import atomic_path
from langsplat_core.formats.antialiasing import antialiased_by_comments
from langsplat_core.formats.compressed_ply import is_compressed, read_compressed
from langsplat_core.formats.inria_layout import (
    BASE_COLOUR,
    NORMAL,
    POSITION,
    ROTATION,
    SCALE,
    check_gaussian_properties,
    sh_to_channel_major,
)
from langsplat_core.formats.metres import metres_by_comments
from langsplat_core.parsing.opening import open_for_reading
from langsplat_core.parsing.ply_body import CHUNK_ROWS, fill_columns, iterate_rows
from langsplat_core.parsing.ply_header import TYPE_NAMES, PlyElement, PlyHeader, is_name, read_ply_header
from langsplat_core.scene import Gaussians, Scene

LAYOUT = "the layout"  # NumPy field of all its columns together; no PLY property has a name with a blank


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
            rows[LAYOUT] = _rows(gaussians.take(part))
            for name, values in extras.items():
                rows[name] = values[part]
            file.write(rows.tobytes())


def _check_extras(extras: Mapping[str, Array], names: tuple[str, ...]) -> None:
    for name, values in extras.items():
        if name in names or name.startswith("f_rest_") or not is_name(name):
            raise InputError(f"{name!r} cannot be an extra property of a PLY: rename it")
        if values.dtype.str[1:] not in TYPE_NAMES:
            raise InputError(f"extra property {name!r} is of type {values.dtype}, which no PLY can hold")


def _rows(part: Gaussians) -> Array:
    """(N, properties) float32 in the order of the file."""
    count = len(part)
    table = [
        part.means,
        np.zeros((count, 3), np.float32),
        part.sh[:, 0],
        sh_to_channel_major(part.sh),
        part.opacity_logits[:, None],
        part.log_scales,
        part.quats_wxyz,
    ]
    return np.concatenate(table, axis=1)
