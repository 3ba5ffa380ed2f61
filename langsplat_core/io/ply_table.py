"""Tables of a PLY file: its header, the rows of an element in any encoding, clouds of coloured points.

Our own in place of plyfile, which takes six times as long for a large scene and three times the memory
(`python -m tests.benchmarks scale --only load`): rows are streamed into the arrays that are kept.
"""

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import numpy as np
from numpy.typing import DTypeLike

from langsplat_core.arrays import Array
from langsplat_core.errors import malformed, printable_line, quoted
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import open_for_reading

HEADER_LIMIT = 64 * 1024  # bytes; a real header of 62 properties takes about 1.5 KiB
NAME_LIMIT = 64  # characters; the longest of known programs has 17
CHUNK_ROWS = 2048  # about 0.5 MB of a degree-3 scene: the columns are then picked out of the cache
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
    lists: dict[str, str] = field(default_factory=dict)  # of properties that are lists: code of the length

    def types(self, byte_order: str) -> list[tuple[str, str]]:
        """Return the fields of a binary row in which every list is empty."""
        return [(name, byte_order + self.lists.get(name, code)) for name, code in self.numbers.items()]


class PlyFile:
    """An open PLY file.

    Every size is checked against the file before anything is allocated, so that a header which claims 10^12
    rows costs nothing. All methods raise FormatError.
    """

    def __init__(self, file: BinaryIO, size: int, path: Path) -> None:
        """Parse the header at the beginning of `file`, of `size` bytes; `path` is for messages."""
        self.path = path
        self.comments: list[str] = []
        self.elements: dict[str, PlyElement] = {}
        self._file, self._size = file, size
        head = file.read(HEADER_LIMIT)
        if head[:4] not in (b"ply\n", b"ply\r"):
            raise malformed(path, "is not a PLY file (it does not begin with the line 'ply')")
        end = re.search(rb"\n[ \t]*end_header[ \t\r]*\n", head)
        if end is None:
            raise malformed(path, f"truncated: no 'end_header' line in the first {len(head)} bytes")
        self.header_size = end.end()  # bytes
        self._format = ""
        for line in head[: end.start()].decode("utf-8", "replace").split("\n")[1:]:
            self._parse(line.strip())
        if not self._format:
            raise malformed(path, "the header has no 'format' line")
        self._order = BYTE_ORDERS[self._format]  # "<" or ">"; empty of ascii

    def _parse(self, line: str) -> None:
        match line.split():
            case []:
                pass
            case ["comment" | "obj_info" as keyword, *_]:
                self.comments.append(line.removeprefix(keyword).strip())
            case ["format", name, *_] if name in BYTE_ORDERS:
                self._format = name
            case ["element", name, count]:
                self._add_element(name, count)
            case ["property", kind, name] if kind in _TYPES and self.elements:
                self._add_property(name, _TYPES[kind])
            case ["property", "list", length, kind, name] if (
                kind in _TYPES and _TYPES.get(length, "f")[0] != "f" and self.elements
            ):
                self._add_property(name, _TYPES[kind], _TYPES[length])
            case _:
                raise malformed(self.path, f"header line {quoted(line, 60)} is not understood")

    def _add_element(self, name: str, count: str) -> None:
        # isdecimal refuses signs, and twenty digits are far beyond any file (int() of a million is slow)
        if not (count.isascii() and count.isdecimal() and len(count) <= 20):
            what = f"element {quoted(name, 40)} has the count {quoted(count, 30)}; expected a whole number"
            raise malformed(self.path, what)
        self._check_name(name, self.elements)
        self.elements[name] = PlyElement(name, int(count))

    def _add_property(self, name: str, code: str, length: str = "") -> None:
        element = list(self.elements.values())[-1]
        self._check_name(name, element.numbers)
        element.numbers[name] = code
        if length:
            element.lists[name] = length

    def _check_name(self, name: str, others: Mapping[str, object]) -> None:
        if not is_name(name):
            what = f"the header has the name {quoted(name, 40)}; expected a short printable word"
            raise malformed(self.path, what)
        if name in others:
            raise malformed(self.path, f"{name!r} is declared twice in the header")

    def read(
        self,
        element: PlyElement,
        groups: Sequence[Sequence[str]],
        columns: Sequence[str] = (),
        dtype: DTypeLike = np.float32,
    ) -> tuple[list[Array], dict[str, Array]]:
        """Return a (rows, names) table of `dtype` for each group of properties, and `columns` by name.

        Columns keep their own type. Beside the arrays only a chunk a thread is held. A number beyond its type
        becomes infinite or, in an integer, arbitrary. FormatError for an element without these properties, or
        with lists.
        """
        absent = [name for names in (*groups, columns) for name in names if name not in element.numbers]
        if absent or element.lists:
            lacks = f"has no number {absent[0]!r}" if absent else "has a list"
            raise malformed(self.path, f"element {element.name} {lacks}; expected numbers")
        self._seek(element)
        tables = [np.empty((element.count, len(names)), dtype) for names in groups]
        kept = {name: np.empty(element.count, element.numbers[name]) for name in columns}
        places = {name: place for place, name in enumerate(element.numbers)}
        indices = [np.array([places[name] for name in names], np.intp) for names in groups]
        chunks, taking = self._chunks(element), Lock()

        def work(_: int) -> None:
            while True:
                with taking:
                    start, rows = next(chunks, (0, None))
                if rows is None:
                    return
                at = slice(start, start + len(rows))
                with np.errstate(over="ignore", invalid="ignore"):  # which holds for the calling thread only
                    grid = _as_grid(rows, dtype)
                    for names, picked, table in zip(groups, indices, tables, strict=True):
                        if grid is not None:
                            # `clip` lets NumPy write into the table directly; no index is out of range
                            np.take(grid, picked, axis=1, out=table[at], mode="clip")
                            continue
                        for index, name in enumerate(names):
                            table[at, index] = rows[name]
                    for name, column in kept.items():
                        column[at] = rows[name]

        # Two, which NumPy lets run at once: one core does not use the whole bandwidth of the memory.
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(work, range(2)))
        return tables, kept

    def _seek(self, wanted: PlyElement) -> None:
        """Go to the first row of `wanted`, which the file has room for."""
        self._file.seek(self.header_size)
        for element in self.elements.values():
            left = self._size - self._file.tell()
            least = np.dtype(element.types(self._order)).itemsize
            if not self._order:  # a character and a separator a number; the file's last needs none
                left, least = left + 1, 2 * max(len(element.numbers), 1)
            if element.count * least > left:
                raise malformed(
                    self.path,
                    f"truncated: {element.count} rows of element {element.name} need at least "
                    f"{element.count * least} bytes, the file has {left} left",
                )
            if element is wanted:
                return
            if not self._order:
                skipped = sum(1 for _ in islice((line for line in self._file if line.strip()), element.count))
                if skipped < element.count:
                    raise malformed(self.path, f"truncated: {skipped} rows of element {element.name}")
            elif element.lists:
                self._skip_lists(element)
            else:
                self._file.seek(element.count * least, 1)

    def _skip_lists(self, element: PlyElement) -> None:
        """Walk the rows one by one: only their own lengths tell where they end."""
        for _ in range(element.count):
            for name, code in element.numbers.items():
                step = np.dtype(code).itemsize
                if name in element.lists:
                    length = np.dtype(self._order + element.lists[name])
                    step *= int(np.frombuffer(self._exactly(length.itemsize), length)[0])
                if step < 0:
                    raise malformed(self.path, f"a list of element {element.name} has a negative length")
                self._file.seek(step, 1)

    def _exactly(self, size: int) -> bytes:
        data = self._file.read(size)
        if len(data) < size:
            raise malformed(self.path, f"truncated: {size - len(data)} bytes are missing")
        return data

    def _chunks(self, element: PlyElement) -> Iterator[tuple[int, Array]]:
        """Yield (index of the first row, structured rows) of an element without lists, from its first on."""
        dtype = np.dtype(element.types(self._order))
        for start in range(0, element.count, CHUNK_ROWS):
            count = min(CHUNK_ROWS, element.count - start)
            if self._order:
                yield start, np.frombuffer(self._exactly(count * dtype.itemsize), dtype)
            else:
                yield start, self._ascii_rows(element, start, count)

    def _ascii_rows(self, element: PlyElement, start: int, count: int) -> Array:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # "input contained no data": reported below
                rows = np.loadtxt(self._file, comments=None, max_rows=count, ndmin=2, encoding="latin-1")
        except ValueError as error:
            reason = printable_line(error, 80)  # NumPy tells its own options too
            what = f"unreadable row near {start} of {element.name}: {reason}"
            raise malformed(self.path, what) from None
        if len(rows) < count:
            what = f"element {element.name} has {start + len(rows)} rows, the header says {element.count}"
            raise malformed(self.path, f"truncated: {what}")
        if rows.shape[1] != len(element.numbers):
            what = f"{rows.shape[1]} values in a row of {element.name}; expected {len(element.numbers)}"
            raise malformed(self.path, what)
        # float64 holds every type of a PLY exactly
        return np.ascontiguousarray(rows).view([(name, "f8") for name in element.numbers])[:, 0]


@contextmanager
def open_ply(path: Path) -> Iterator[PlyFile]:
    """Open a PLY file. Raises InputError where it cannot be opened, FormatError where it breaks a rule."""
    file, size = open_for_reading(path)
    with file:
        yield PlyFile(file, size, path)


def is_name(word: str) -> bool:
    """Return whether an element or property may be called so: names are shown in messages, in one line."""
    return word.isprintable() and word.split() == [word] and len(word) <= NAME_LIMIT


def _as_grid(rows: Array, dtype: DTypeLike) -> Array | None:
    """Rows whose properties are all of one type as (rows, properties): half the time per number."""
    kinds = {rows.dtype[name] for name in rows.dtype.names or ()}
    if len(kinds) != 1:
        return None
    return rows.view(kinds.pop()).reshape(len(rows), -1).astype(dtype, copy=False)


def write_table(
    path: Path | str,
    columns: Mapping[str, Array],
    faces: Array | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary little-endian PLY, atomically.

    columns: of the element `vertex`, name -> (N,) of a type in `TYPE_NAMES`. faces: (F, 3) numbers of
    vertices. comments: of one line each.
    """
    count = len(next(iter(columns.values())))
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    header += [f"element vertex {count}"]
    header += [f"property {TYPE_NAMES[col.dtype.str[1:]][0]} {name}" for name, col in columns.items()]
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        dtype = np.dtype([(name, "<" + column.dtype.str[1:]) for name, column in columns.items()])
        for start in range(0, count, CHUNK_ROWS):
            rows = np.empty(min(CHUNK_ROWS, count - start), dtype)
            for name, column in columns.items():
                rows[name] = column[start : start + len(rows)]
            file.write(rows.tobytes())
        if faces is not None:
            corners = np.empty(len(faces), [("count", "u1"), ("vertex_indices", "<i4", (3,))])
            corners["count"], corners["vertex_indices"] = 3, faces
            file.write(corners.tobytes())


# ---- coloured points, as structure from motion and scanners write them ----

CHANNELS = ("red", "green", "blue")
GREY = 128  # of points without colours


def read_cloud(path: Path) -> tuple[Array, Array]:
    """Return (M, 3) float64 positions and (M, 3) uint8 colours of the element `vertex`.

    A position may be infinite or NaN. Colours are whole numbers from 0 to 255, or floats from 0 to 1; what
    lies beyond is clipped. Raises InputError when the file cannot be opened and FormatError when it breaks a
    rule of the format.
    """
    with open_ply(path) as ply:
        vertex = ply.elements.get("vertex")
        if vertex is None:
            raise malformed(path, "has no element 'vertex', so it is no point cloud")
        coloured = all(channel in vertex.numbers for channel in CHANNELS)
        (table,), _ = ply.read(vertex, [(*"xyz", *CHANNELS * coloured)], dtype=np.float64)
    points = table[:, :3]
    scale = 255 if coloured and vertex.numbers["red"].startswith("f") else 1
    shades = table[:, 3:] if coloured else np.full(points.shape, GREY)
    # clipped first, so that nothing overflows; NaN becomes black
    colours = np.rint(np.clip(np.nan_to_num(shades), 0, 255 / scale) * scale).astype(np.uint8)
    return points, colours
