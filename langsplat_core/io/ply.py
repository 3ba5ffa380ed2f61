"""PLY files: tables in any encoding, point clouds, and 3D Gaussian scenes in two layouts.

Rows are streamed; plyfile takes six times as long and thrice the memory (tests.benchmarks scale --only load).

INRIA's layout is read in all its variants and written in its plain form: one element `vertex`, one row per
Gaussian, binary little endian, float32, in order ``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2
rot_0..3``. Opacities are logits, scales natural logarithms, rotations quaternions w x y z. There are 0, 9, 24
or 45 `f_rest` (SH degree 0 to 3), channel after channel: all coefficients of red, then of green, then of
blue. Normals are zeros and not used. In a scene with an origin ``x y z`` are double, positions in the world.

Reading accepts properties in any order and of any scalar type, any byte order, ascii, LF or CR LF in the
header, files without normals, further elements (ignored and reported; in binary files with lists only after
the vertices) and further properties (kept as `Scene.extras`). Rows are kept as they are, NaN included;
doubles other than positions are rounded to float32. Of header comments these are read, the last of each:

    metres_per_unit 0.25        length of the world's unit; no positive number: unknown
    SplatRenderMode: mip        trained with Mip-Splatting's compensation: Brush, splat-transform, gsplat
    antialiased 1               the same: Postshot
    train_flags antialiasing    the same: proposed for the INRIA code
"""

import math
import re
import shutil
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import numpy as np
from numpy.typing import DTypeLike

from langsplat_core.arrays import Array, logit
from langsplat_core.errors import InputError, Tell, malformed, printable_line, quoted, report_losses, unread
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import open_for_reading
from langsplat_core.io.quantised import smallest_three
from langsplat_core.scene import SH_COUNTS, Gaussians, Scene, about_origin
from langsplat_core.scene.transform import C0

# ---- tables ----

HEADER_LIMIT = 64 * 1024  # bytes; a real header of 62 properties takes about 1.5 KiB
LINE_LIMIT = 1 << 20  # bytes of a row in an ascii file, five times what the longest header allows
NAME_LIMIT = 64  # characters; the longest of known programs has 17
CHUNK_ROWS = 2048  # about 0.5 MB of a degree-3 scene, which fits the cache
CLOUDCOMPARE = "scalar_"  # prefix of properties in files of CloudCompare
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPE_NAMES = {  # NumPy code -> names, the first of which is written
    "i1": ("char", "int8"), "u1": ("uchar", "uint8"), "i2": ("short", "int16"), "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"), "u4": ("uint", "uint32"), "f4": ("float", "float32"), "f8": ("double", "float64"),
}  # fmt: skip
_TYPES = {name: code for code, names in TYPE_NAMES.items() for name in names}


@dataclass
class PlyElement:
    """A table of the file."""

    name: str
    count: int  # rows
    numbers: dict[str, str] = field(default_factory=dict)  # property -> NumPy code without byte order
    has_lists: bool = False  # True if properties are lists, so that rows differ in length

    def row(self, byte_order: str) -> np.dtype[np.void]:
        """Return the type of a binary row of an element without lists."""
        return np.dtype([(name, byte_order + code) for name, code in self.numbers.items()])


class PlyFile:
    """An open PLY file.

    Every size is checked against the file before memory is allocated. All methods raise FormatError.
    """

    def __init__(self, file: BinaryIO, size: int, path: Path) -> None:
        """Parse the header at the beginning of `file`, of `size` bytes; `path` is for messages."""
        self.path = path
        self.comments: list[str] = []
        self.elements: dict[str, PlyElement] = {}
        self._file, self._size, self._beyond = file, size, 0  # _beyond: numbers that do not fit their types
        head = file.read(HEADER_LIMIT)
        if head[:4] not in (b"ply\n", b"ply\r"):
            raise malformed(path, "is not a PLY file (it does not begin with the line 'ply')")
        if (end := re.search(rb"\n[ \t]*end_header[ \t\r]*\n", head)) is None:
            raise malformed(path, f"truncated: no 'end_header' line in the first {len(head)} bytes")
        self.header_size = end.end()  # bytes
        self._format = ""
        for line in head[: end.start()].decode("utf-8", "replace").split("\n")[1:]:
            if not self._parse(line.strip()):
                what = f"header line {quoted(line.strip(), 60)} is not understood, or declares a name twice"
                raise malformed(path, what)
        if not self._format:
            raise malformed(path, "the header has no 'format' line")
        for element in self.elements.values():
            plain = [name.removeprefix(CLOUDCOMPARE) for name in element.numbers]
            if len(set(plain)) == len(plain) and not element.has_lists:
                element.numbers = dict(zip(plain, element.numbers.values(), strict=True))
        self.byte_order = BYTE_ORDERS[self._format]  # "<" or ">"; empty of ascii

    def _parse(self, line: str) -> bool:
        last = next(reversed(self.elements.values()), PlyElement("", 0))
        match line.split():
            case []:
                pass
            case ["comment" | "obj_info" as keyword, *_]:
                self.comments.append(line.removeprefix(keyword).strip())
            case ["format", name, *_] if name in BYTE_ORDERS:
                self._format = name
            # isdecimal refuses signs; int() of a million digits is slow
            case ["element", name, count] if (
                is_name(name) and name not in self.elements and count.isdecimal() and len(count) <= 20
            ):
                self.elements[name] = PlyElement(name, int(count))
            case ["property", *length, kind, name] if (
                last.name and kind in _TYPES and is_name(name) and name not in last.numbers
            ):
                last.numbers[name] = _TYPES[kind]
                match length:
                    case []:
                        pass
                    case ["list", code] if _TYPES.get(code, "f")[0] != "f":
                        last.has_lists = True
                    case _:
                        return False
            case _:
                return False
        return True

    @property
    def vertex(self) -> PlyElement:
        """The element of points and Gaussians."""
        if "vertex" not in self.elements:
            raise malformed(self.path, "has no element 'vertex'", "is it a scene or a point cloud?")
        return self.elements["vertex"]

    def read(self, element: PlyElement, *groups: tuple[Sequence[str], DTypeLike]) -> list[Array]:
        """Return a (rows, names) table for each group of properties, of the type given with it.

        Besides the tables only one chunk per thread is in memory. A number beyond its type becomes infinite
        or, as an integer, arbitrary. FormatError for an element without these properties, or with lists.
        """
        absent = [name for names, _ in groups for name in names if name not in element.numbers]
        if absent or element.has_lists:
            lacks = f"has no number {absent[0]!r}" if absent else "has a list"
            raise malformed(self.path, f"element {element.name} {lacks}; expected numbers")
        self._seek(element)
        tables = [np.empty((element.count, len(names)), dtype) for names, dtype in groups]
        order = list(element.numbers)
        indices = [np.array([order.index(name) for name in names], np.intp) for names, _ in groups]
        chunks, taking = self._chunks(element), Lock()

        def work(_: int) -> None:
            while True:
                with taking:
                    start, rows = next(chunks, (0, None))
                if rows is None:
                    return
                kinds = {rows.dtype[name] for name in order}
                kind = kinds.pop() if len(kinds) == 1 else None
                with np.errstate(over="ignore", invalid="ignore"):  # per thread
                    for (names, _dtype), picked, table in zip(groups, indices, tables, strict=True):
                        part = table[start : start + len(rows)]
                        if kind is not None and kind == part.dtype:  # half the time per number
                            # `clip` lets NumPy write into the table directly; no index is out of range
                            grid = rows.view(kind).reshape(len(rows), -1)
                            np.take(grid, picked, axis=1, out=part, mode="clip")
                            continue
                        for index, name in enumerate(names):
                            part[:, index] = rows[name]

        # NumPy releases the interpreter lock; one thread does not use the whole memory bandwidth.
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(work, range(2)))
        return tables

    def losses(self, read: Collection[str]) -> Iterator[str]:
        """Yield lines about ignored parts of the file; read: names of the elements that were read."""
        others = (each for each in self.elements.values() if each.count and each.name not in read)
        yield unread("elements", (f"{each.name} ({each.count} rows)" for each in others))
        if self._beyond:
            yield f"{self._beyond} numbers do not fit the types of their properties"
        if self.byte_order and any(each.has_lists for each in self.elements.values()):
            return  # the end of the last row is not known without reading the lists
        self._seek(None)
        left = (
            self._size - self._file.tell()
            if self.byte_order
            else sum(bool(line.strip()) for line in self._lines())
        )
        if left:
            yield f"{left} {'bytes' if self.byte_order else 'lines'} behind the last row not read"

    def _seek(self, wanted: PlyElement | None) -> None:
        """Seek the first row of `wanted`, whose rows must fit the file; None: the end of all rows."""
        self._file.seek(self.header_size)
        for element in self.elements.values():
            left, least = self._size - self._file.tell(), element.row(self.byte_order).itemsize
            if not self.byte_order:  # a character and a separator per number, except for the last one
                left, least = left + 1, 2 * max(len(element.numbers), 1)
            if element.count * least > left:
                needs = f"{element.count} rows of element {element.name} need {element.count * least} bytes"
                raise malformed(self.path, f"truncated: {needs} at least, the file has {left} left")
            if element is wanted:
                return
            if not self.byte_order:
                lines = (line for line in self._lines() if line.strip())
                if sum(1 for _ in islice(lines, element.count)) < element.count:
                    raise malformed(self.path, f"truncated: it ends in element {element.name}")
            elif element.has_lists:
                what = f"element {element.name} has lists, and lies before what is read"
                raise malformed(self.path, what, "export it with its vertices first")
            else:
                self._file.seek(element.count * least, 1)

    def _lines(self) -> Iterator[bytes]:
        """Yield the following lines; FormatError for one of `LINE_LIMIT` bytes."""
        while line := self._file.readline(LINE_LIMIT):
            if len(line) == LINE_LIMIT:
                raise malformed(self.path, f"has a line of {LINE_LIMIT} bytes or more")
            yield line

    def _chunks(self, element: PlyElement) -> Iterator[tuple[int, Array]]:
        """Yield (index of the first row, structured rows) of an element without lists, from its first on."""
        dtype = element.row(self.byte_order)
        for start in range(0, element.count, CHUNK_ROWS):
            count = min(CHUNK_ROWS, element.count - start)
            if self.byte_order:
                data = self._file.read(count * dtype.itemsize)
                if (missing := count * dtype.itemsize - len(data)) > 0:
                    raise malformed(self.path, f"truncated: {missing} bytes are missing")
                yield start, np.frombuffer(data, dtype)
            else:
                yield start, self._ascii_rows(element, start, count)

    def _ascii_rows(self, element: PlyElement, start: int, count: int) -> Array:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # "input contained no data": reported below
                rows = np.loadtxt(self._lines(), comments=None, max_rows=count, ndmin=2, encoding="latin-1")
        except ValueError as error:  # whose text also has NumPy's options
            what = f"unreadable row near {start} of {element.name}: {printable_line(error, 80)}"
            raise malformed(self.path, what) from None
        if rows.shape != (count, len(element.numbers)):
            found = f"{len(rows)} rows of {rows.shape[1]} values from row {start} of {element.name} on"
            raise malformed(self.path, f"{found}; expected {count} of {len(element.numbers)}")
        for column, code in zip(rows.T, element.numbers.values(), strict=True):
            if code[0] != "f":
                least, most = np.iinfo(code).min, np.iinfo(code).max
                fits = (column >= least) & (column <= most) & (column == np.rint(column))
                self._beyond += int(np.count_nonzero(~fits))
        # float64 holds every type of a PLY exactly
        return np.ascontiguousarray(rows).view([(name, "f8") for name in element.numbers])[:, 0]


@contextmanager
def open_ply(path: Path) -> Iterator[PlyFile]:
    """Open a PLY file. Raises InputError if it cannot be opened, FormatError if it breaks a rule."""
    file, size = open_for_reading(path)
    with file:
        yield PlyFile(file, size, path)


def is_name(word: str) -> bool:
    """Return True if a word may be the name of an element or property: printable and short."""
    return word.isprintable() and word.split() == [word] and len(word) <= NAME_LIMIT


def write_table(
    path: Path | str, columns: Mapping[str, Array], faces: Array | None = None, comments: Sequence[str] = ()
) -> None:
    """Write a binary little-endian PLY, atomically.

    columns: of `vertex`, name -> (N,) of a type in `TYPE_NAMES`; faces: (F, 3) rows of these.
    """
    count = len(next(iter(columns.values())))
    kinds = {name: column.dtype.str[1:] for name, column in columns.items()}
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    header += [f"element vertex {count}"]
    header += [f"property {TYPE_NAMES[kind][0]} {name}" for name, kind in kinds.items()]
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        for start in range(0, count, CHUNK_ROWS):
            rows = np.empty(min(CHUNK_ROWS, count - start), [(name, "<" + kinds[name]) for name in columns])
            for name, column in columns.items():
                rows[name] = column[start : start + len(rows)]
            file.write(rows.tobytes())
        if faces is not None:
            corners = np.empty(len(faces), [("count", "u1"), ("vertex_indices", "<i4", (3,))])
            corners["count"], corners["vertex_indices"] = 3, faces
            file.write(corners.tobytes())


# ---- point clouds of structure from motion and scanners ----

CHANNELS = ("red", "green", "blue")
GREY = 128  # of points without colours


def read_cloud(path: Path) -> tuple[Array, Array]:
    """Return (M, 3) float64 positions and (M, 3) uint8 colours of the element `vertex`.

    A position may be infinite or NaN. Colours are whole numbers from 0 to 255, or floats from 0 to 1; others
    are clipped, points without colours are grey; both are reported. FormatError if it breaks a rule.
    """
    with open_ply(path) as ply:
        vertex = ply.vertex
        coloured = all(channel in vertex.numbers for channel in CHANNELS)
        points, shades = ply.read(vertex, (POSITION, "f8"), (CHANNELS * coloured, "f8"))
        told = list(ply.losses(ply.elements))  # faces of a mesh are no loss
    if not coloured:
        shades = np.full(points.shape, GREY)
        told.append("its points have no colours, and grey is taken")
    scale = 255 if coloured and vertex.numbers["red"].startswith("f") else 1
    # clipped first, so that nothing overflows; NaN becomes black
    clipped = np.clip(np.nan_to_num(shades), 0, 255 / scale)
    if cut := np.count_nonzero((clipped != shades).any(1)):
        told.append(f"the colours of {cut} points are beyond 0 to {255 // scale} and were cut")
    report_losses(path, told)
    return points, np.rint(clipped * scale).astype(np.uint8)


# ---- Gaussians, in INRIA's layout ----

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")  # zeros
BASE_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = {3 * (count - 1): degree for degree, count in SH_COUNTS.items()}  # f_rest_* -> SH degree
METRES = "metres_per_unit"


def read_ply(path: Path | str) -> Gaussians:
    """Return the Gaussians of a 3DGS PLY file in world coordinates; raises as `read_ply_scene`."""
    return read_ply_scene(path).world_gaussians()


def read_ply_scene(path: Path | str) -> Scene:
    """Return the scene in a 3DGS PLY file, plain or compressed.

    `extras` are the scalar properties of a plain file that are not in the layout, in order, each in its own
    type. Ignored content is reported. FormatError for a file that breaks a rule or has no Gaussians.
    """
    extras, told = dict[str, Array](), list[str]()
    with open_ply(Path(path)) as ply:
        if "chunk" in ply.elements and not ply.vertex.numbers.keys().isdisjoint(PACKED):
            gaussians, origin = _read_compressed(ply, ply.vertex, told.append)
            told += ply.losses(("chunk", "vertex", "sh"))
        else:
            gaussians, origin, extras = _read_plain(ply, ply.vertex, told.append)
            told += ply.losses(("vertex",))
    antialiased, metres = _said(ply.comments, told.append)
    report_losses(path, told)
    return Scene(gaussians, antialiased=antialiased, extras=extras, metres_per_unit=metres, origin=origin)


def _read_plain(ply: PlyFile, vertex: PlyElement, tell: Tell) -> tuple[Gaussians, Array, dict[str, Array]]:
    needed = (*BASE_COLOUR, "opacity", *SCALE, *ROTATION)
    if vertex.numbers.keys().isdisjoint(needed):
        what = "a mesh or point cloud, not a 3D Gaussian scene: it has no f_dc, opacity, scale and rot"
        raise malformed(ply.path, what, "train a scene with 'langsplat train'")
    count = sum(name.startswith("f_rest_") for name in vertex.numbers)
    if count not in REST_COUNTS:
        raise malformed(ply.path, f"{count} properties f_rest_*; expected 0, 9, 24 or 45 (SH degree 0-3)")
    higher = count // 3  # coefficients of a channel beside the constant one
    by_coefficient = [f"f_rest_{k + channel * higher}" for k in range(higher) for channel in range(3)]
    layout = (SCALE, ROTATION, ("opacity",), (*BASE_COLOUR, *by_coefficient))
    others = [name for name in vertex.numbers if name not in {*POSITION, *NORMAL}.union(*layout)]
    normals = [name for name in NORMAL if name in vertex.numbers]
    single = bool(ply.byte_order) and all(vertex.numbers.get(axis) == "f4" for axis in POSITION)
    tables = ply.read(
        vertex,
        (POSITION, "f4" if single else "f8"),
        (normals, "?"),
        *((names, "f4") for names in layout),
        *(((name,), vertex.numbers[name]) for name in others),
    )
    means, pointing, log_scales, quats_wxyz, opacities, sh, *kept = tables
    if pointing.any():
        tell(f"normals of {np.count_nonzero(pointing.any(1))} Gaussians not kept")
    means, origin = about_origin(means)
    sh = sh.reshape(vertex.count, 1 + higher, 3)
    extras = {name: table[:, 0] for name, table in zip(others, kept, strict=True)}
    return Gaussians(means, log_scales, quats_wxyz, opacities[:, 0], sh), origin, extras


def write_ply(path: Path | str, content: Scene | Gaussians) -> None:
    """Write Gaussians, or a scene without language field and cameras, as a plain INRIA PLY, atomically.

    Extras become properties after those of the layout; InputError for names and types that no PLY can hold.
    """
    scene = Scene(content) if isinstance(content, Gaussians) else content
    gaussians = scene.gaussians
    comments = ["SplatRenderMode: mip"] if scene.antialiased else []  # the most common of several spellings
    if scene.metres_per_unit is not None:
        comments.append(f"{METRES} {float(scene.metres_per_unit)!r}")
    sh, means = gaussians.sh, gaussians.means if not scene.origin.any() else scene.in_world(gaussians.means)
    columns = dict(zip(POSITION, means.T, strict=True))
    columns |= dict.fromkeys(NORMAL, np.zeros(len(gaussians), np.float32))
    columns |= dict(zip(BASE_COLOUR, sh[:, 0].T, strict=True))
    rest = [sh[:, k, channel] for channel in range(3) for k in range(1, sh.shape[1])]
    columns |= {f"f_rest_{index}": values for index, values in enumerate(rest)}
    columns["opacity"] = gaussians.opacity_logits
    columns |= dict(zip(SCALE, gaussians.log_scales.T, strict=True))
    columns |= dict(zip(ROTATION, gaussians.quats_wxyz.T, strict=True))
    for name, values in scene.extras.items():
        if name in columns or name.startswith("f_rest_") or not is_name(name):
            raise InputError(f"{name!r} cannot be an extra property of a PLY: rename it")
        if values.dtype.str[1:] not in TYPE_NAMES:
            raise InputError(f"extra property {name!r} is of type {values.dtype}, which no PLY can hold")
        columns[name] = values
    write_table(path, columns, comments=comments)


def _said(comments: Sequence[str], tell: Tell) -> tuple[bool, float | None]:
    """Return whether comments say antialiased, and metres per unit if that is a positive number."""
    marks, lengths = list[bool](), list[float]()
    for comment in comments:
        match comment.lower().replace(":", " ").split():
            case [key, *texts] if key == METRES:
                try:
                    lengths.append(float(" ".join(texts)))
                except ValueError:
                    lengths.append(math.nan)
            case ["splatrendermode", ("mip" | "default") as mode, *_]:
                marks.append(mode == "mip")
            case ["antialiased", ("0" | "1") as value]:
                marks.append(value == "1")
            case ["train_flags", *flags]:
                marks.append("antialiasing" in flags)
            case ["splatrendermode", *_] | ["antialiased", _]:
                tell(f"comment {quoted(comment)} not understood")
    if any(len(set(said)) > 1 for said in (marks, lengths)):
        tell("its comments differ, and the last of a kind counts")
    metres = lengths[-1] if lengths else None
    if metres is not None and not 0 < metres < math.inf:
        tell(f"{METRES} is no positive number, and counts as unknown")
        metres = None
    return bool(marks and marks[-1]), metres


def write_metres(path: Path | str, metres_per_unit: float) -> None:
    """Write metres per unit into the header of the PLY `path`; all other bytes stay as they are.

    Raises InputError for another kind of file or a length that is not positive, FormatError for a bad header.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: a scale is given to a .ply; make one with 'langsplat convert'")
    if not 0 < metres_per_unit < math.inf:
        raise InputError(f"{metres_per_unit:g} metres per unit: must be above 0 and finite")
    with open_ply(path) as ply:
        size = ply.header_size
    with atomic_path(path) as temporary, path.open("rb") as file, temporary.open("wb") as out:
        *lines, last = file.read(size).splitlines(keepends=True)
        end = b"\r\n" if last.endswith(b"\r\n") else b"\n"
        ours = [b"comment", METRES.encode()]
        out.writelines(line for line in lines if line.replace(b":", b" ").split()[:2] != ours)
        out.write(f"comment {METRES} {float(metres_per_unit)!r}".encode() + end + last)
        shutil.copyfileobj(file, out)


# ---- Gaussians, in the compressed layout of SuperSplat and splat-transform ----
#
# Three elements. `chunk`: for every 256 Gaussians the least and greatest position, logarithm of scale and,
# in files of 18 columns, base colour. `vertex`: four uint32 per Gaussian,
#
#     packed_position   x 11 bits, y 10, z 11, from the top, as fractions between the chunk's bounds
#     packed_scale      likewise, of the scales' logarithms
#     packed_rotation   2 bits: index in w x y z of the largest, which is omitted (it is positive); then the
#                       other three in 10 bits each, as fractions of [-sqrt(1/2), sqrt(1/2)]
#     packed_color      red, green, blue, opacity (not a logit) in 8 bits each
#
# `sh`, optional: `f_rest_*` in 8 bits each over [-4, 4], channel after channel. Opacities of 0 and 1 become
# logits of -infinity and +infinity.
#
# Source of the layout: the public writer in PlayCanvas' splat-transform; the code here is our own.

CHUNK_SIZE = 256
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = [
    [f"{end}_{part}{axis}" for end in ("min", "max") for axis in axes]
    for part, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
]

# Code c is the middle of its 1/256 interval, except that both ends are exact (-4 and 4).
_SH_VALUES = ((np.arange(256) + 0.5) / 256 - 0.5) * 8
_SH_VALUES[[0, 255]] = -4, 4


def _read_compressed(ply: PlyFile, vertex: PlyElement, tell: Tell) -> tuple[Gaussians, Array]:
    chunk = ply.elements["chunk"]
    if chunk.count * CHUNK_SIZE >= vertex.count + CHUNK_SIZE:
        tell(f"it has {chunk.count} chunks for {vertex.count} Gaussians, and the last ones are not used")
    if chunk.count * CHUNK_SIZE < vertex.count:
        what = f"{chunk.count} chunks for {vertex.count} Gaussians; expected one for every {CHUNK_SIZE}"
        raise malformed(ply.path, what)
    coloured = _BOUNDS[2][0] in chunk.numbers  # else of the range 0 to 1
    bounds = ply.read(chunk, *((names, "f8") for names in _BOUNDS[: 2 + coloured]))
    others = chunk.numbers.keys() - set().union(*_BOUNDS[: 2 + coloured]) | vertex.numbers.keys() - {*PACKED}
    tell(unread("properties", others))
    position, rotation, scale, colour = _codes(ply, vertex, PACKED, "u4").T
    rest = np.zeros((vertex.count, 3, 0))
    if (element := ply.elements.get("sh")) is not None and element.numbers:
        width = len(element.numbers)
        if element.count != vertex.count or width not in REST_COUNTS:
            what = f"element sh has {element.count} rows of {width}"
            raise malformed(ply.path, f"{what}; expected {vertex.count} rows of 9, 24 or 45")
        codes = _codes(ply, element, [f"f_rest_{index}" for index in range(width)], "u1")
        rest = _SH_VALUES[codes].reshape(vertex.count, 3, width // 3)
    of_chunk = np.arange(vertex.count) // CHUNK_SIZE

    def between(table: Array, fractions: Array) -> Array:
        least, greatest = table[of_chunk, :3], table[of_chunk, 3:]
        return least * (1 - fractions) + greatest * fractions

    three, rgba = _fractions(rotation, 2, 10, 10, 10)[:, 1:], _fractions(colour, 8, 8, 8, 8)
    with np.errstate(invalid="ignore", over="ignore"):  # rows with infinite bounds are dropped later
        rgb = between(bounds[2], rgba[:, :3]) if coloured else rgba[:, :3]
        base = ((rgb - 0.5) / C0)[:, None]
        means, origin = about_origin(between(bounds[0], _fractions(position, 11, 10, 11)))
        gaussians = Gaussians(
            means=means,
            log_scales=between(bounds[1], _fractions(scale, 11, 10, 11)),
            quats_wxyz=smallest_three((three - 0.5) * np.sqrt(2), rotation >> 30, tell),
            opacity_logits=logit(rgba[:, 3]),
            sh=np.concatenate([base, rest.transpose(0, 2, 1)], axis=1),
        )
    return gaussians, origin


def _codes(ply: PlyFile, element: PlyElement, names: Sequence[str], kind: str) -> Array:
    """Return (rows, names) whole numbers; FormatError if they are of another type than `kind`."""
    if others := [name for name in names if element.numbers.get(name, kind) != kind]:
        raise malformed(ply.path, f"{others[0]!r} is not of the type {TYPE_NAMES[kind][0]}")
    return ply.read(element, (names, kind))[0]


def _fractions(packed: Array, *bits: int) -> Array:
    """Return the (N, fields) fractions in [0, 1] in (N,) uint32; bits: of each field, from the top."""
    most = 2 ** np.array(bits) - 1
    return (packed[:, None] >> 32 - np.cumsum(bits) & most) / most
