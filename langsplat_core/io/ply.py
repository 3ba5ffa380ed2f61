"""3D Gaussian scenes as PLY: INRIA's layout, and SuperSplat's compressed one.

INRIA's is read in all its variants and written in its plain form.

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
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array, logit
from langsplat_core.errors import InputError, malformed
from langsplat_core.io.files import atomic_path
from langsplat_core.io.packing import smallest_three
from langsplat_core.io.ply_table import TYPE_NAMES, PlyElement, PlyFile, is_name, open_ply, write_table
from langsplat_core.scene import SH_COUNTS, Gaussians, Scene
from langsplat_core.scene.transform import C0

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")  # zeros that nobody reads
BASE_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = {3 * (count - 1): degree for degree, count in SH_COUNTS.items()}  # f_rest_* -> SH degree
METRES = "metres_per_unit"
COMMENT = "SplatRenderMode: mip"  # the commonest spelling, which `save_scene` writes


def read_ply(path: Path | str) -> Gaussians:
    """Return the Gaussians of a 3DGS PLY file, plain or compressed. Raises as `read_ply_scene` does."""
    return read_ply_scene(path).gaussians


def read_ply_scene(path: Path | str) -> Scene:
    """Return the Gaussians of a 3DGS PLY file, plain or compressed, and what else the file tells of them.

    `extras` are the scalar properties of a plain file that are none of the layout, in its order, each of
    its own type. Raises InputError when the file cannot be opened and FormatError when it breaks a rule of
    the format or holds no Gaussians.
    """
    path = Path(path)
    with open_ply(path) as ply:
        vertex = ply.elements.get("vertex")
        if vertex is None:
            raise malformed(path, "has no element 'vertex'", "is it a 3D Gaussian scene?")
        extras: dict[str, Array] = {}
        if "chunk" in ply.elements and not vertex.numbers.keys().isdisjoint(PACKED):
            gaussians = _read_compressed(ply, vertex)
        else:
            gaussians, extras = _read_plain(ply, vertex)
    antialiased, metres = antialiased_by_comments(ply.comments), metres_by_comments(ply.comments)
    return Scene(gaussians, antialiased=antialiased, extras=extras, metres_per_unit=metres)


def _read_plain(ply: PlyFile, vertex: PlyElement) -> tuple[Gaussians, dict[str, Array]]:
    higher = _rest_count(ply.path, vertex) // 3  # coefficients of a channel beside the constant one
    by_coefficient = [f"f_rest_{k + channel * higher}" for k in range(higher) for channel in range(3)]
    layout = (POSITION, SCALE, ROTATION, ("opacity",), (*BASE_COLOUR, *by_coefficient))
    known = {*NORMAL}.union(*layout)
    tables, extras = ply.read(vertex, layout, [name for name in vertex.numbers if name not in known])
    means, log_scales, quats_wxyz, opacities, sh = tables
    sh = sh.reshape(vertex.count, 1 + higher, 3)
    return Gaussians(means, log_scales, quats_wxyz, opacities[:, 0], sh), extras


def _rest_count(path: Path, vertex: PlyElement) -> int:
    """Require the properties of a Gaussian; return the number of its `f_rest_*`."""
    needed = (*POSITION, *BASE_COLOUR, "opacity", *SCALE, *ROTATION)
    if vertex.numbers.keys().isdisjoint(needed[3:]):
        what = "a mesh or point cloud, not a 3D Gaussian scene: it has no f_dc, opacity, scale and rot"
        raise malformed(path, what, "train a scene with 'langsplat train'")
    count = sum(name.startswith("f_rest_") for name in vertex.numbers)
    if count not in REST_COUNTS:
        raise malformed(path, f"{count} properties f_rest_*; expected 0, 9, 24 or 45 (SH degree 0-3)")
    for name in (*needed, *(f"f_rest_{index}" for index in range(count))):
        if name not in vertex.numbers:
            raise malformed(path, f"property {name!r} is missing; every Gaussian needs it")
    return count


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
    if any("\n" in comment or "\r" in comment for comment in comments):
        raise InputError("a PLY comment must be a single line")
    sh = gaussians.sh
    columns = dict(zip(POSITION, gaussians.means.T, strict=True))
    columns |= dict.fromkeys(NORMAL, np.zeros(len(gaussians), np.float32))
    columns |= dict(zip(BASE_COLOUR, sh[:, 0].T, strict=True))
    rest = [sh[:, k, channel] for channel in range(3) for k in range(1, sh.shape[1])]
    columns |= {f"f_rest_{index}": values for index, values in enumerate(rest)}
    columns["opacity"] = gaussians.opacity_logits
    columns |= dict(zip(SCALE, gaussians.log_scales.T, strict=True))
    columns |= dict(zip(ROTATION, gaussians.quats_wxyz.T, strict=True))
    for name, values in (extras or {}).items():
        if name in columns or name.startswith("f_rest_") or not is_name(name):
            raise InputError(f"{name!r} cannot be an extra property of a PLY: rename it")
        if values.dtype.str[1:] not in TYPE_NAMES:
            raise InputError(f"extra property {name!r} is of type {values.dtype}, which no PLY can hold")
        columns[name] = values
    write_table(path, columns, comments=comments)


# ---- comments ----


def antialiased_by_comments(comments: Iterable[str]) -> bool:
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
    """Return the comment that states the length of the world's unit."""
    return f"{METRES} {float(metres_per_unit)!r}"


def metres_by_comments(comments: Iterable[str]) -> float | None:
    """Return metres per world unit, > 0 and finite, as the header's comments say; None where they do not."""
    found = None
    for comment in comments:
        match comment.replace(":", " ").split():
            case [key, text] if key == METRES:
                try:
                    value = float(text)
                except ValueError:
                    value = math.nan
                found = value if 0 < value < math.inf else None
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
    with open_ply(path) as ply:
        size = ply.header_size
    with path.open("rb") as file, atomic_path(path) as temporary, temporary.open("wb") as out:
        *lines, last = file.read(size).splitlines(keepends=True)
        end = b"\r\n" if last.endswith(b"\r\n") else b"\n"
        ours = [b"comment", METRES.encode()]
        out.writelines(line for line in lines if line.replace(b":", b" ").split()[:2] != ours)
        out.write(b"comment " + metres_comment(metres_per_unit).encode() + end + last)
        shutil.copyfileobj(file, out)


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


def _read_compressed(ply: PlyFile, vertex: PlyElement) -> Gaussians:
    path, chunk = ply.path, ply.elements["chunk"]
    if chunk.count * CHUNK_SIZE < vertex.count:
        what = f"{chunk.count} chunks for {vertex.count} Gaussians; expected one for every {CHUNK_SIZE}"
        raise malformed(path, what)
    colours = (COLOUR_BOUNDS,) if COLOUR_BOUNDS[0] in chunk.numbers else ()
    bounds, _ = ply.read(chunk, (POSITION_BOUNDS, SCALE_BOUNDS, *colours), dtype=np.float64)
    packed = _codes(ply, vertex, PACKED, np.uint32)
    rest = _read_rest(ply, vertex.count)
    position, rotation, scale, colour = packed.T
    rgba = np.stack([colour >> shift & 255 for shift in (24, 16, 8, 0)], axis=1) / 255
    three = np.stack([rotation >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023
    of_chunk = np.arange(vertex.count) // CHUNK_SIZE

    def between(table: Array, fractions: Array) -> Array:
        least, greatest = table[of_chunk, :3], table[of_chunk, 3:]
        return least * (1 - fractions) + greatest * fractions

    with np.errstate(invalid="ignore", over="ignore"):  # infinite bounds make rows that are dropped later
        rgb = between(bounds[2], rgba[:, :3]) if colours else rgba[:, :3]
        return Gaussians(
            means=between(bounds[0], _fractions_11_10_11(position)),
            log_scales=between(bounds[1], _fractions_11_10_11(scale)),
            quats_wxyz=smallest_three((three - 0.5) * np.sqrt(2), rotation >> 30),
            opacity_logits=logit(rgba[:, 3]),
            sh=np.concatenate([((rgb - 0.5) / C0)[:, None], rest], axis=1),
        )


def _read_rest(ply: PlyFile, count: int) -> Array:
    """(N, K - 1, 3) coefficients; K = 1 without the element `sh`."""
    element = ply.elements.get("sh")
    if element is None or not element.numbers:
        return np.zeros((count, 0, 3))
    width = len(element.numbers)
    if element.count != count or width not in REST_COUNTS:
        what = f"element sh has {element.count} rows of {width}; expected {count} rows of 9, 24 or 45"
        raise malformed(ply.path, what)
    codes = _codes(ply, element, [f"f_rest_{index}" for index in range(width)], np.uint8)
    return _SH_VALUES[codes].reshape(count, 3, width // 3).transpose(0, 2, 1)


def _codes(ply: PlyFile, element: PlyElement, names: Sequence[str], kind: type[np.unsignedinteger]) -> Array:
    """(rows, names) whole numbers of a type, which the file may hold as numbers of another."""
    (table,), _ = ply.read(element, [names], dtype=np.float64)
    if not ((table >= 0) & (table <= np.iinfo(kind).max)).all():  # NaN compares False
        what = f"element {element.name} holds numbers beyond those of {np.dtype(kind)}"
        raise malformed(ply.path, what)
    return table.astype(kind)


def _fractions_11_10_11(packed: Array) -> Array:
    """(N,) uint32 of 11, 10 and 11 bits -> (N, 3) fractions in [0, 1]."""
    return np.stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], axis=1)
