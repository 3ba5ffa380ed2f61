"""The INRIA 3D Gaussian Splatting PLY, read in all its variants and written in its plain form.

Layout: one element `vertex`, one row per Gaussian. As written: binary little endian, float32, in order
``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3``. Opacities are logits, scales natural
logarithms, rotations quaternions w x y z. There are 0, 9, 24 or 45 `f_rest` (SH degree 0 to 3), channel
after channel: all coefficients of red, then of green, then of blue. Normals are zeros that nobody reads.

As read: the properties in any order and of any scalar type, any byte order, ascii, LF or CR LF in the
header, without normals, with further properties and elements (ignored), and the compressed variant of
`compressed_ply`. Rows are kept as they are, NaN included.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.files import atomic_path
from langsplat_core.formats.compressed_ply import is_compressed, read_compressed
from langsplat_core.formats.inria_layout import (
    BASE_COLOUR,
    POSITION,
    ROTATION,
    SCALE,
    check_gaussian_properties,
    sh_from_channel_major,
    sh_to_channel_major,
)
from langsplat_core.formats.opening import open_for_reading
from langsplat_core.formats.ply_body import CHUNK_ROWS, iterate_rows
from langsplat_core.formats.ply_header import PlyElement, PlyHeader, read_ply_header
from langsplat_core.scene import Gaussians


def read_ply(path: Path | str) -> Gaussians:
    """The Gaussians of a 3DGS PLY file, plain or compressed.

    Raises InputError when the file cannot be opened and FormatError when it breaks a rule of the format
    or holds no Gaussians.
    """
    path = Path(path)
    file, size = open_for_reading(path)
    with file:
        header = read_ply_header(file, path)
        vertex = header.element("vertex")
        if is_compressed(header):
            return read_compressed(file, size, header, path)
        if vertex is None:
            raise FormatError(f"{path}: has no element 'vertex', so it is not a 3D Gaussian scene")
        return _read_vertices(file, size, header, vertex, path)


def _read_vertices(file: BinaryIO, size: int, header: PlyHeader, vertex: PlyElement, path: Path) -> Gaussians:
    rest = check_gaussian_properties(vertex, path)
    columns = {
        "means": POSITION,
        "log_scales": SCALE,
        "quats_wxyz": ROTATION,
        "opacity": ("opacity",),
        "sh": (*BASE_COLOUR, *rest),
    }
    chunks = iterate_rows(file, size, header, vertex, path)  # has checked the count against the size
    out = {key: np.empty((vertex.count, len(names)), np.float32) for key, names in columns.items()}
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, and the row invalid
        for start, rows in chunks:
            for key, names in columns.items():
                for column, name in enumerate(names):
                    out[key][start : start + len(rows), column] = rows[name]
    return Gaussians(
        means=out["means"],
        log_scales=out["log_scales"],
        quats_wxyz=out["quats_wxyz"],
        opacity_logits=out["opacity"][:, 0],
        sh=sh_from_channel_major(out["sh"][:, :3], out["sh"][:, 3:]),
    )


def write_ply(path: Path | str, gaussians: Gaussians, comments: tuple[str, ...] = ()) -> None:
    """Write the plain INRIA form, atomically. `comments` become header lines of one line each."""
    rest_count = 3 * (gaussians.sh.shape[1] - 1)
    rest = tuple(f"f_rest_{index}" for index in range(rest_count))
    names = (*POSITION, "nx", "ny", "nz", *BASE_COLOUR, *rest, "opacity", *SCALE, *ROTATION)
    if any("\n" in comment or "\r" in comment for comment in comments):
        raise InputError("a PLY comment must be a single line")
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(gaussians)}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(lines).encode())
        for start in range(0, len(gaussians), CHUNK_ROWS):
            file.write(
                _rows(gaussians.take(np.arange(start, min(start + CHUNK_ROWS, len(gaussians))))).tobytes()
            )


def _rows(part: Gaussians) -> Array:
    """(N, properties) little-endian float32 in the order of the file."""
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
    return np.concatenate(table, axis=1).astype("<f4", copy=False)
