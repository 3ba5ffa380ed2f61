"""Reading the compressed PLY of SuperSplat and splat-transform.

Three elements. `chunk`: for every 256 Gaussians the least and greatest position, logarithm of scale and,
in files of 18 columns, base colour. `vertex`: four uint32 per Gaussian,

    packed_position   x 11 bits, y 10, z 11, from the top, as fractions between the chunk's bounds
    packed_scale      likewise, of the scales' logarithms
    packed_rotation   2 bits: which of w x y z is largest and left out (it is positive); then the other
                      three in 10 bits each, as fractions of [-sqrt(1/2), sqrt(1/2)]
    packed_color      red, green, blue, opacity in 8 bits each; the opacity is not a logit here

`sh`, optional: `f_rest_*` in 8 bits each over [-4, 4], channel after channel. Opacities of 0 and 1 become
logits of -infinity and +infinity.

Source of the layout: the public writer in PlayCanvas' splat-transform; the code here is our own.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from langsplat_core.arrays import Array, logit
from langsplat_core.errors import FormatError
from langsplat_core.formats.inria_layout import REST_COUNTS, SH_C0, sh_from_channel_major
from langsplat_core.parsing.ply_body import iterate_rows
from langsplat_core.parsing.ply_header import PlyElement, PlyHeader
from langsplat_core.scene import Gaussians

CHUNK_SIZE = 256
POSITION_BOUNDS = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
SCALE_BOUNDS = ("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z")
COLOUR_BOUNDS = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

# Code c stands for the middle of its 1/256 interval, but the two ends are exact (-4 and 4).
_SH_VALUES = ((np.arange(256) + 0.5) / 256 - 0.5) * 8
_SH_VALUES[[0, 255]] = -4, 4


def is_compressed(header: PlyHeader) -> bool:
    """Whether the header announces packed Gaussians."""
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
    bounds = _read_columns(file, file_size, header, chunk, bound_names, path).astype(np.float64)
    packed = _read_columns(file, file_size, header, vertex, PACKED, path)
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
            sh=sh_from_channel_major((rgb - 0.5) / SH_C0, _read_rest(file, file_size, header, vertex, path)),
        )


def _read_columns(
    file: BinaryIO, file_size: int, header: PlyHeader, element: PlyElement, names: tuple[str, ...], path: Path
) -> Array:
    """(rows, names) as float64, which holds every uint32 exactly."""
    properties = {prop.name: prop for prop in element.properties}
    for name in names:
        if name not in properties or properties[name].count_code:
            raise FormatError(f"{path}: compressed PLY without the number {name!r} in element {element.name}")
    if element.has_lists:
        raise FormatError(f"{path}: compressed PLY with a list in element {element.name}")
    file.seek(header.size)
    chunks = iterate_rows(file, file_size, header, element, path)
    out = np.empty((element.count, len(names)))
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes an ordinary one
        for start, rows in chunks:
            for column, name in enumerate(names):
                out[start : start + len(rows), column] = rows[name]
    return out


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
    codes = _read_columns(file, file_size, header, element, names, path)
    if not ((codes >= 0) & (codes <= 255)).all():
        raise FormatError(f"{path}: element sh holds values beyond 0..255; expected uchar")
    return _SH_VALUES[codes.astype(np.uint8)]


def _between(bounds: Array, of_chunk: Array, fractions: Array) -> Array:
    """(chunks, 6) least and greatest, (N,) chunk of each row, (N, 3) fractions -> (N, 3) values."""
    least, greatest = bounds[of_chunk, :3], bounds[of_chunk, 3:]
    return least * (1 - fractions) + greatest * fractions


def _fractions_11_10_11(packed: Array) -> Array:
    """(N,) uint32 -> (N, 3) in [0, 1]."""
    return np.stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _quaternions(packed: Array) -> Array:
    """(N,) uint32 -> (N, 4) unit quaternions w x y z."""
    three = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023
    return smallest_three((three - 0.5) * np.sqrt(2), packed >> 30)


def smallest_three(three: Array, largest: Array) -> Array:
    """(N, 3) components other than the largest, (N,) index of the largest -> (N, 4) unit quaternions."""
    out = np.empty((len(three), 4))
    rows = np.arange(len(three))[:, None]
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    out[rows, others[largest]] = three
    out[rows[:, 0], largest] = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
    return out
