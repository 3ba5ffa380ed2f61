"""Headers of PLY files that lie: lines removed, doubled, swapped, or saying something else."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from tests.support.file_samples import (
    inria_names,
)

T = TypeVar("T")

TYPES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double", "int8", "float64")
INSERTS = [
    b"element face 3",
    b"element face 0",
    b"element a 999999999999",
    b"element vertex 3",
    b"property list uchar int v",
    b"property list char int v",
    b"property list uint double w",
    b"property list float int v",
    b"property double q",
    b"property uchar q",
    b"property float x",
    b"property float f_rest_0",
    b"property float f_rest_45",
    b"property float packed_color",
    b"property char \xff\xfe",
    b"comment SplatRenderMode: mip",
    b"obj_info \x00",
    b"format ascii 1.0",
    b"format binary_big_endian 1.0",
    b"end_header",
    b"ply",
    b"",
    b"\x00",
    b"property",
    b"element",
]
COUNTS = [0, 1, 2, 19, 21, 255, 256, 257, 2**31, 2**32, 2**63, 2**64, 10**12, -1]
NAMES = [*inria_names(1), "chunk", "sh", "vertex", "min_x", "packed_position", "f_rest_9", "f_rest_-1", "ä"]


def lie(content: bytes, rng: np.random.Generator) -> bytes:
    """One to three changes to lines of the header, then perhaps a wound to the body."""
    header, _, body = content.partition(b"end_header\n")
    lines = header.splitlines()
    for _ in range(int(rng.integers(1, 4))):
        change_a_line(lines, rng)
    newline = b"\r\n" if rng.random() < 0.1 else b"\n"
    return newline.join([*lines, b"end_header"]) + newline + wounded(body, rng)


def change_a_line(lines: list[bytes], rng: np.random.Generator) -> None:
    """Remove, double, swap or add a line, or change what one says; in place."""
    place, other = (int(i) for i in rng.integers(1, len(lines), size=2))
    match int(rng.integers(0, 8)):
        case 0 if len(lines) > 3:
            del lines[place]
        case 1:
            lines.insert(other, lines[place])
        case 2:
            lines[place], lines[other] = lines[other], lines[place]
        case 3:
            lines.insert(place, _pick(INSERTS, rng))
        case 4:
            words = lines[place].split(b" ")
            words[min(1, len(words) - 1)] = _pick(TYPES, rng).encode()
            lines[place] = b" ".join(words)
        case 5:
            lines[place] = b" ".join([*lines[place].split(b" ")[:-1], _pick(NAMES, rng).encode()])
        case 6:
            elements = [i for i, line in enumerate(lines) if line.startswith(b"element ")]
            if elements:
                at = _pick(elements, rng)
                lines[at] = b" ".join([*lines[at].split(b" ")[:-1], str(_pick(COUNTS, rng)).encode()])
        case _:
            kinds = [b"ascii", b"binary_little_endian", b"binary_big_endian"]
            lines[1] = b"format " + _pick(kinds, rng)


def wounded(body: bytes, rng: np.random.Generator) -> bytes:
    """Half of the time as it is; else cut, longer, with bytes in between, or several times over."""
    match int(rng.integers(0, 8)):
        case 0:
            return body[: int(rng.integers(0, len(body) + 1))]
        case 1:
            return body + rng.bytes(int(rng.integers(1, 400)))
        case 2:
            place = int(rng.integers(0, len(body)))
            return body[:place] + rng.bytes(int(rng.integers(1, 40))) + body[place:]
        case 3:
            return body * int(rng.integers(2, 5))
    return body


def _pick(choices: Sequence[T], rng: np.random.Generator) -> T:
    return choices[int(rng.integers(len(choices)))]
