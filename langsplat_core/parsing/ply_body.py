"""The rows of one PLY element as chunks of a structured array, whatever the file's encoding.

Every size is checked against the file before anything is allocated, so a header that claims 10^12 rows
costs nothing.
"""

import warnings
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, printable_line
from langsplat_core.parsing.ply_header import PlyElement, PlyHeader

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
