"""The columns of the INRIA 3DGS layout, which PLY and compressed PLY share."""

from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.parsing.ply_header import PlyElement
from langsplat_core.scene import SH_COUNTS

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")  # zeros that nobody reads
BASE_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
SH_C0 = 0.5 / np.sqrt(np.pi)  # the constant spherical harmonic: colour = 0.5 + SH_C0 * f_dc
REST_COUNTS = {3 * (count - 1): degree for degree, count in SH_COUNTS.items()}  # f_rest_* -> SH degree


def sh_from_channel_major(base: Array, rest: Array) -> Array:
    """(N, 3) base colours and (N, 3 (K - 1)) channel-major coefficients -> (N, K, 3)."""
    by_channel = rest.reshape(len(rest), 3, rest.shape[1] // 3)
    return np.concatenate([base[:, None], by_channel.transpose(0, 2, 1)], axis=1)


def sh_to_channel_major(sh: Array) -> Array:
    """(N, K, 3) -> (N, 3 (K - 1)): the `f_rest_*` columns."""
    return sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * (sh.shape[1] - 1))


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
