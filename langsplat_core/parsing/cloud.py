"""Coloured points in a PLY, as structure from motion and scanners write them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.parsing.opening import open_for_reading
from langsplat_core.parsing.ply_body import iterate_rows
from langsplat_core.parsing.ply_header import PlyElement, read_ply_header

AXES = ("x", "y", "z")
CHANNELS = ("red", "green", "blue")
GREY = 128  # of points without colours


def read_cloud(path: Path) -> tuple[Array, Array]:
    """(M, 3) float64 positions and (M, 3) uint8 colours of the element `vertex`, as they are: a
    position may be infinite or NaN.

    Colours are whole numbers from 0 to 255, or floats from 0 to 1; what lies beyond is clipped. Raises
    InputError when the file cannot be opened and FormatError when it breaks a rule of the format.
    """
    file, size = open_for_reading(path)
    with file:
        header = read_ply_header(file, path)
        vertex = header.element("vertex")
        if vertex is None:
            raise FormatError(f"{path}: has no element 'vertex', so it is no point cloud")
        kinds = {prop.name: prop.code[0] for prop in vertex.properties if not prop.count_code}
        missing = [axis for axis in AXES if axis not in kinds]
        if missing or vertex.has_lists:
            raise FormatError(
                f"{path}: its points have no number {missing[0]!r}"
                if missing
                else f"{path}: its points hold lists, so it is no point cloud"
            )
        coloured = all(channel in kinds for channel in CHANNELS)
        wanted = AXES + CHANNELS * coloured
        rows = iterate_rows(file, size, header, vertex, path)  # has checked the count against the size
        table = _columns(rows, vertex, wanted)
    points = table[:, :3]
    scale = 255 if coloured and kinds["red"] == "f" else 1
    shades = table[:, 3:] if coloured else np.full(points.shape, GREY)
    # clipped first, so that nothing overflows; NaN becomes black
    colours = np.rint(np.clip(np.nan_to_num(shades), 0, 255 / scale) * scale).astype(np.uint8)
    return points, colours


def _columns(rows: Iterator[tuple[int, Array]], element: PlyElement, names: tuple[str, ...]) -> Array:
    """(rows, names) float64."""
    table = np.empty((element.count, len(names)))
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes an ordinary one
        for start, part in rows:
            for column, name in enumerate(names):
                table[start : start + len(part), column] = part[name]
    return table
