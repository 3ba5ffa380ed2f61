"""Damaged versions of good files: seeded wounds of every kind, for binary and text formats alike."""

import re
import struct
from collections.abc import Callable, Sequence

import numpy as np

HEADER = 600  # bytes at the beginning in which half of the wounds fall
INTEGERS = (
    0,
    1,
    -1,
    127,
    128,
    255,
    256,
    2**15,
    2**16 - 1,
    2**24,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**53,
    2**63 - 1,
)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e-38, 1e9, 1e20, 3.4e38, float("inf"), float("-inf"), float("nan"))
TOKENS = (
    *(
        b"0",
        b"-1",
        b"1",
        b"256",
        b"65536",
        b"4294967296",
        b"18446744073709551616",
        b"9" * 30,
        b"1" + b"0" * 400,
    ),
    *(
        b"9" * 5000,
        b"1e308",
        b"1e999",
        b"-1e999",
        b"1e-320",
        b"nan",
        b"NaN",
        b"inf",
        b"-Infinity",
        b"0x10",
        b"1_0",
    ),
    *(
        b"null",
        b"true",
        b"[]",
        b"{}",
        b'""',
        b'"a"',
        b"[[[[",
        b"\x00",
        b"\x1b[2J",
        b"\xff\xfe",
        b"\n",
        b"\r",
        b"#",
    ),
    *("٣".encode(), "\u2028".encode(), b"\\ud800", b"../../x", b"/dev/zero", b"%s%n", b"a" * 5000),
)
_WORD = re.compile(rb"[^\s,:\[\]{}\"]+")
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


def mutant(sample: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """`sample` with one to four wounds; `others` are files of the same kind to splice with."""
    data = sample
    for _ in range(int(rng.choice([1, 1, 1, 2, 2, 3, 4]))):
        data = WOUNDS[int(rng.integers(len(WOUNDS)))](data, others, rng)
    return data


Wound = Callable[[bytes, Sequence[bytes], np.random.Generator], bytes]


def _place(data: bytes, rng: np.random.Generator) -> int:
    inside = min(len(data), HEADER) if rng.random() < 0.5 else len(data)
    return int(rng.integers(0, max(inside, 1)))


def _flip_bits(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 9)) if data else 0):
        out[_place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _truncate(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _cut_out(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    place = _place(data, rng)
    return data[:place] + data[place + int(2 ** rng.uniform(0, 8)) :]


def _insert(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    place, length = _place(data, rng), int(2 ** rng.uniform(0, 8))
    new = rng.bytes(length) if rng.random() < 0.5 else data[place : place + length]
    return data[:place] + new + data[place:]


def _fill(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A run of one byte."""
    place, length = _place(data, rng), int(2 ** rng.uniform(0, 8))
    value = bytes([int(rng.choice([0, 255, 127, 128, 32, 9]))])
    return data[:place] + value * min(length, len(data) - place) + data[place + length :]


def _extreme_number(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A binary number of any width, either byte order, at any place or an aligned one."""
    order = "<>"[int(rng.integers(2))]
    if rng.random() < 0.6:
        width = int(rng.choice([1, 2, 4, 8]))
        value = int(rng.choice(np.array(INTEGERS, object))) + int(rng.integers(-1, 2))
        new = (value % 256**width).to_bytes(width, "little" if order == "<" else "big")
    else:
        new = struct.pack(f"{order}{rng.choice(['f', 'd'])}", float(rng.choice(FLOATS)))
    place = _place(data, rng)
    place -= place % len(new) if rng.random() < 0.5 else 0
    return data[:place] + new + data[place + len(new) :]


def _inflate(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A number in text becomes another."""
    return _replace(data, _NUMBER, rng)


def _other_word(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    return _replace(data, _WORD, rng)


def _replace(data: bytes, what: re.Pattern[bytes], rng: np.random.Generator) -> bytes:
    start = _place(data, rng)
    match = what.search(data, start) or what.search(data)
    if match is None:
        return data
    return data[: match.start()] + TOKENS[int(rng.integers(len(TOKENS)))] + data[match.end() :]


def _swap_lines(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """Two lines, or blocks of 16 bytes where there are none, in each other's place; or one of them twice."""
    lines = data[:20_000].splitlines(keepends=True)
    if len(lines) < 4:
        lines = [data[i : i + 16] for i in range(0, len(data[:20_000]), 16)]
    if len(lines) < 2:
        return data
    a, b = (int(i) for i in rng.integers(0, len(lines), 2))
    if rng.random() < 0.5:
        lines[a], lines[b] = lines[b], lines[a]
    else:
        lines[a] = lines[b]
    return b"".join(lines) + data[20_000:]


def _splice(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """The beginning of one file and the end of another."""
    other = others[int(rng.integers(len(others)))] if others else data
    place = _place(data, rng)
    shift = int(rng.choice([0, 0, -1, 1, 4, -8]))
    return data[:place] + other[max(place + shift, 0) :]


WOUNDS: tuple[Wound, ...] = (
    *(_flip_bits, _flip_bits, _truncate, _cut_out, _insert, _fill),
    *(_extreme_number, _extreme_number, _inflate, _inflate, _other_word, _swap_lines, _splice),
)
