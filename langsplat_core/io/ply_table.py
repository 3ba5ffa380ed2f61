"""Tables of a PLY file: its header, the rows of an element in any encoding, clouds of coloured points."""

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, printable_line, quoted
from langsplat_core.io.hostile import open_for_reading

HEADER_LIMIT = 64 * 1024  # bytes; a real header of 62 properties takes about 1.5 KiB
NAME_LIMIT = 64  # characters; the longest of known programs has 17
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONG_NAMES = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
_TYPES = {name: code for code, names in _LONG_NAMES.items() for name in names}
TYPE_NAMES = {code: names[0] for code, names in _LONG_NAMES.items()}  # as they are written


@dataclass(frozen=True)
class PlyProperty:
    """One column of an element."""

    name: str
    code: str  # NumPy code without byte order, e.g. "f4"; of the items if this is a list
    count_code: str = ""  # NumPy code of the list's length; empty for a scalar


@dataclass(frozen=True)
class PlyElement:
    """A table of the file."""

    name: str
    count: int  # rows
    properties: tuple[PlyProperty, ...]

    @property
    def has_lists(self) -> bool:
        return any(prop.count_code for prop in self.properties)

    @property
    def least_row_size(self) -> int:
        """Bytes of a binary row whose lists are all empty."""
        return sum(np.dtype(prop.count_code or prop.code).itemsize for prop in self.properties)

    def dtype(self, byte_order: str) -> np.dtype:
        """Type of a row without lists in a binary file."""
        return np.dtype([(prop.name, byte_order + prop.code) for prop in self.properties])


@dataclass(frozen=True)
class PlyHeader:
    """Header of a PLY file: byte order, elements, comments."""

    byte_order: str  # "<", ">" or "" for ascii
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    size: int  # bytes, which is the offset of the body

    def element(self, name: str) -> PlyElement | None:
        return next((element for element in self.elements if element.name == name), None)


def read_ply_header(file: BinaryIO, path: Path) -> PlyHeader:
    """Parse the header from the start of `file` and leave the file at its body.

    Line ends may be LF or CR LF. `path` is for messages only. Raises FormatError.
    """
    head = file.read(HEADER_LIMIT)
    if head[:4] not in (b"ply\n", b"ply\r"):
        raise FormatError(f"{path}: is not a PLY file (it does not begin with the line 'ply')")
    lines: list[str] = []
    position = 0
    while not lines or lines[-1] != "end_header":
        end = head.find(b"\n", position)
        if end < 0:
            raise FormatError(f"{path}: truncated: no 'end_header' line in the first {len(head)} bytes")
        lines.append(head[position:end].decode("utf-8", "replace").strip())
        position = end + 1
    file.seek(position)
    return _parse(lines[1:-1], position, path)


def _parse(lines: list[str], size: int, path: Path) -> PlyHeader:
    byte_order: str | None = None
    comments: list[str] = []
    elements: list[PlyElement] = []
    for line in lines:
        keyword, *words = line.split() or [""]
        if keyword in ("comment", "obj_info"):
            comments.append(line.removeprefix(keyword).strip())
        elif keyword == "format" and words and words[0] in BYTE_ORDERS:
            byte_order = BYTE_ORDERS[words[0]]
        elif keyword == "element" and len(words) == 2:
            elements.append(PlyElement(_name(words[0], path), _count(words, path), ()))
        elif keyword == "property" and elements:
            last = elements[-1]
            elements[-1] = PlyElement(last.name, last.count, (*last.properties, _property(words, line, path)))
        elif line:
            raise FormatError(f"{path}: header line {quoted(line, 60)} is not understood")
    if byte_order is None:
        raise FormatError(f"{path}: the header has no 'format' line")
    for element in elements:
        _require_unique([prop.name for prop in element.properties], f"property of {element.name}", path)
    _require_unique([element.name for element in elements], "element", path)
    return PlyHeader(byte_order, tuple(elements), tuple(comments), size)


def is_name(word: str) -> bool:
    """Return whether an element or property may be called so: names are shown in messages, in one line."""
    return word.isprintable() and word.split() == [word] and len(word) <= NAME_LIMIT


def _name(word: str, path: Path) -> str:
    if not is_name(word):
        raise FormatError(
            f"{path}: the header has the name {quoted(word, 40)}; expected a short printable word"
        )
    return word


def _count(words: list[str], path: Path) -> int:
    # isdecimal refuses signs, and twenty digits are far beyond any file (int() of a million is slow)
    if not (words[1].isascii() and words[1].isdecimal() and len(words[1]) <= 20):
        raise FormatError(
            f"{path}: element {words[0]} has the count {quoted(words[1], 30)}; expected a whole number from 0"
        )
    return int(words[1])


def _property(words: list[str], line: str, path: Path) -> PlyProperty:
    if len(words) == 2 and words[0] in _TYPES:
        return PlyProperty(_name(words[1], path), _TYPES[words[0]])
    if len(words) == 4 and words[0] == "list" and words[1] in _TYPES and words[2] in _TYPES:
        name = _name(words[3], path)
        if _TYPES[words[1]].startswith("f"):
            raise FormatError(f"{path}: list {name!r} has a length of type {words[1]}; expected int")
        return PlyProperty(name, _TYPES[words[2]], _TYPES[words[1]])
    raise FormatError(f"{path}: header line {quoted(line, 60)} is not a valid property")


def _require_unique(names: list[str], what: str, path: Path) -> None:
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise FormatError(f"{path}: {what} {quoted(twice[0], 40)} is declared twice")


# ---- rows ----
#
# Every size is checked against the file before anything is allocated, so a header that claims 10^12 rows
# costs nothing.

CHUNK_ROWS = 2048  # about 0.5 MB of a degree-3 scene: the columns are then picked out of the cache
THREADS = 2  # which NumPy lets run at once; one core does not use the whole bandwidth of the memory


def iterate_rows(
    file: BinaryIO, file_size: int, header: PlyHeader, wanted: PlyElement, path: Path
) -> Iterator[tuple[int, Array]]:
    """Chunks (index of the first row, structured array of rows) of `wanted`, which has no lists.

    `file` stands at the body. Elements in front of it are skipped, those behind it are not looked at.
    Raises FormatError at once, not at the first chunk, when the file cannot hold the rows its header
    claims: the caller may then allocate room for `wanted.count` of them.
    """
    for element in header.elements:
        _require_room(element, file_size - file.tell(), header, path)
        if element.name == wanted.name:
            break
        if not header.byte_order:
            _skip_ascii(file, element, path)
        elif element.has_lists:
            _skip_lists(file, element, header.byte_order, path)
        else:
            file.seek(element.count * element.least_row_size, 1)
    rows = _ascii_rows if not header.byte_order else _binary_rows
    return rows(file, wanted, header.byte_order, path)


def read_columns(
    file: BinaryIO, file_size: int, header: PlyHeader, element: PlyElement, names: Sequence[str], path: Path
) -> Array:
    """(rows, names) float64, which holds every type of a PLY exactly. Raises FormatError for an element
    without these numbers, or with lists, and as `iterate_rows`."""
    numbers = {prop.name for prop in element.properties if not prop.count_code}
    absent = [name for name in names if name not in numbers]
    if absent or element.has_lists:
        lacks = f"has no number {absent[0]!r}" if absent else "holds lists"
        raise FormatError(f"{path}: element {element.name} {lacks}; expected one number for each property")
    file.seek(header.size)
    chunks = iterate_rows(file, file_size, header, element, path)
    table = np.empty((element.count, len(names)))
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes an ordinary one
        for start, rows in chunks:
            for column, name in enumerate(names):
                table[start : start + len(rows), column] = rows[name]
    return table


def fill_columns(
    chunks: Iterator[tuple[int, Array]],
    element: PlyElement,
    tables: Mapping[tuple[str, ...], Array],
    columns: Mapping[str, Array],
) -> None:
    """Write the properties of `element` from all `chunks` into place.

    `tables`: names -> (rows, names) float32; `columns`: name -> (rows,) of any type. Nothing but one chunk
    is held beside them. A number beyond the type it is written to becomes infinite or, in an integer,
    arbitrary.
    """
    place = {prop.name: index for index, prop in enumerate(element.properties)}
    parts = [(names, np.array([place[name] for name in names]), table) for names, table in tables.items()]
    taking = Lock()

    def work() -> None:
        while True:
            with taking:
                start, rows = next(chunks, (0, None))
            if rows is None:
                return
            _store(rows, slice(start, start + len(rows)), parts, columns)

    with ThreadPoolExecutor(THREADS) as pool:
        for done in [pool.submit(work) for _ in range(THREADS)]:
            done.result()


def _store(
    rows: Array, at: slice, tables: list[tuple[tuple[str, ...], Array, Array]], columns: Mapping[str, Array]
) -> None:
    """One chunk into place; a table comes as (names, their indices among the properties, array)."""
    with np.errstate(over="ignore", invalid="ignore"):  # which holds for the calling thread only
        grid = _as_grid(rows)
        for names, indices, table in tables:
            if grid is not None:
                # `clip` lets NumPy write into the table directly; no index is out of range
                np.take(grid, indices, axis=1, out=table[at], mode="clip")
                continue
            for index, name in enumerate(names):
                table[at, index] = rows[name]
        for name, column in columns.items():
            column[at] = rows[name]


def _as_grid(rows: Array) -> Array | None:
    """Rows whose properties are all of one type as (rows, properties) float32: half the time per number."""
    kinds = {rows.dtype[name] for name in rows.dtype.names or ()}
    if len(kinds) != 1:
        return None
    return rows.view(kinds.pop()).reshape(len(rows), -1).astype(np.float32, copy=False)


def _require_room(element: PlyElement, remaining: int, header: PlyHeader, path: Path) -> None:
    """In ascii a value takes at least one character and one separator; the last one may end the file."""
    if header.byte_order:
        row_size, available = element.least_row_size, remaining
    else:
        row_size, available = 2 * max(len(element.properties), 1), remaining + 1
    if element.count * row_size > available:
        raise FormatError(
            f"{path}: truncated: {element.count} rows of element {element.name} need at least "
            f"{element.count * row_size} bytes, the file has {remaining} left; copy it again"
        )


def _binary_rows(
    file: BinaryIO, element: PlyElement, byte_order: str, path: Path
) -> Iterator[tuple[int, Array]]:
    dtype = element.dtype(byte_order)
    for start in range(0, element.count, CHUNK_ROWS):
        count = min(CHUNK_ROWS, element.count - start)
        block = file.read(count * dtype.itemsize)
        if len(block) < count * dtype.itemsize:  # the file shrank since its size was asked for
            raise FormatError(f"{path}: truncated while it was read; copy it again")
        yield start, np.frombuffer(block, dtype)


def _ascii_rows(
    file: BinaryIO, element: PlyElement, byte_order: str, path: Path
) -> Iterator[tuple[int, Array]]:
    names = [prop.name for prop in element.properties]
    dtype = np.dtype([(name, "f8") for name in names])  # holds every PLY type exactly
    for start in range(0, element.count, CHUNK_ROWS):
        count = min(CHUNK_ROWS, element.count - start)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # "input contained no data": reported below
                rows = np.loadtxt(file, comments=None, max_rows=count, ndmin=2, encoding="latin-1")
        except ValueError as error:
            reason = printable_line(error, 80)  # NumPy tells its own options too
            raise FormatError(f"{path}: unreadable row near {start} of {element.name}: {reason}") from None
        if len(rows) < count:
            raise FormatError(
                f"{path}: truncated: element {element.name} has {start + len(rows)} rows, "
                f"the header says {element.count}; copy it again"
            )
        if rows.shape[1] != len(names):
            raise FormatError(
                f"{path}: {rows.shape[1]} values in a row of {element.name}; expected {len(names)}"
            )
        yield start, np.ascontiguousarray(rows).view(dtype)[:, 0]


def _skip_ascii(file: BinaryIO, element: PlyElement, path: Path) -> None:
    skipped = sum(1 for _ in islice((line for line in file if line.strip()), element.count))
    if skipped < element.count:
        raise FormatError(f"{path}: truncated: element {element.name} has {skipped} of {element.count} rows")


def _skip_lists(file: BinaryIO, element: PlyElement, byte_order: str, path: Path) -> None:
    """Walk the rows one by one: only their own lengths tell where they end."""
    for row in range(element.count):
        for prop in element.properties:
            step = np.dtype(prop.code).itemsize
            if prop.count_code:
                length_type = np.dtype(byte_order + prop.count_code)
                raw = file.read(length_type.itemsize)
                if len(raw) < length_type.itemsize:
                    raise FormatError(f"{path}: truncated in row {row} of element {element.name}")
                step *= int(np.frombuffer(raw, length_type)[0])
            if step < 0:
                raise FormatError(f"{path}: negative list length in row {row} of element {element.name}")
            file.seek(step, 1)


# ---- coloured points, as structure from motion and scanners write them ----

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
        coloured = all(channel in kinds for channel in CHANNELS)
        table = read_columns(file, size, header, vertex, AXES + CHANNELS * coloured, path)
    points = table[:, :3]
    scale = 255 if coloured and kinds["red"] == "f" else 1
    shades = table[:, 3:] if coloured else np.full(points.shape, GREY)
    # clipped first, so that nothing overflows; NaN becomes black
    colours = np.rint(np.clip(np.nan_to_num(shades), 0, 255 / scale) * scale).astype(np.uint8)
    return points, colours
