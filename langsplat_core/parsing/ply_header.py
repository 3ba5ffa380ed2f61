"""The header of a PLY file: what its elements and properties are and where the body begins."""

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from langsplat_core.errors import FormatError, quoted

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
        """Of a row without lists in a binary file."""
        return np.dtype([(prop.name, byte_order + prop.code) for prop in self.properties])


@dataclass(frozen=True)
class PlyHeader:
    """A parsed header."""

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
    """Whether an element or property may be called so: names are shown in messages, in one line."""
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
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise FormatError(f"{path}: {what} {quoted(name, 40)} is declared twice")
        seen.add(name)
