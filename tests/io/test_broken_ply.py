"""One broken rule of the PLY at a time, and the message of each."""

import os
import tracemalloc
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from langsplat_core.errors import FormatError, InputError
from langsplat_core.io import ply
from langsplat_core.io.ply import read_ply, read_ply_scene, write_ply
from langsplat_core.scene import Gaussians, Scene
from tests.support.file_samples import (
    ascii_ply,
    columns,
    compressed_ply,
    inria_names,
    plain_ply,
    ply_bytes,
    vertex_table,
)
from tests.support.scenes import random_gaussians


@pytest.fixture
def put(tmp_path):
    def write(content: bytes):
        path = tmp_path / "scene.ply"
        path.write_bytes(content)
        return path

    return write


HEADER = ["format binary_little_endian 1.0", "element vertex 2"]
FLOATS = [f"property float {name}" for name in inria_names(0)]
BODY = bytes(2 * 4 * len(FLOATS))


def replaced(lines: list[str], old: str, *new: str) -> list[str]:
    assert old in lines
    return [out for line in lines for out in (new if line == old else (line,))]


BROKEN = {
    "no property": (
        ply_bytes(HEADER + replaced(FLOATS, "property float opacity"), BODY),
        r"property 'opacity' is missing",
    ),
    "a missing rotation": (
        ply_bytes(HEADER + replaced(FLOATS, "property float rot_3"), BODY),
        r"property 'rot_3' is missing",
    ),
    "wrong number of coefficients": (
        ply_bytes([*HEADER, *FLOATS, *(f"property float f_rest_{i}" for i in range(44))], BODY * 9),
        r"44 properties f_rest_\*; expected 0, 9, 24 or 45 \(SH degree 0-3\)",
    ),
    "a gap among the coefficients": (
        ply_bytes([*HEADER, *FLOATS, *(f"property float f_rest_{i}" for i in range(1, 10))], BODY * 9),
        r"'f_rest_0' is missing among 9",
    ),
    "a list for a number": (
        ply_bytes(
            HEADER + replaced(FLOATS, "property float opacity", "property list uchar float opacity"), BODY
        ),
        r"'opacity' of vertex is a list",
    ),
    "truncated body": (
        ply_bytes(HEADER + FLOATS, BODY[:-1]),
        rf"truncated: 2 rows of element vertex need at least {len(BODY)} bytes, the file has {len(BODY) - 1}",
    ),
    "10^12 vertices": (
        ply_bytes(replaced(HEADER, HEADER[1], f"element vertex {10**12}") + FLOATS, BODY),
        r"truncated: 1000000000000 rows",
    ),
    "10^12 vertices in ascii": (
        ply_bytes(["format ascii 1.0", f"element vertex {10**12}", *FLOATS], b"0 " * 99),
        r"truncated: 1000000000000 rows",
    ),
    "a million faces in front": (
        ply_bytes([HEADER[0], "element face 1000000", "property list uchar int i", HEADER[1], *FLOATS], BODY),
        r"truncated: 1000000 rows of element face",
    ),
    "faces that eat the vertices": (
        ply_bytes(
            [HEADER[0], "element face 1", "property list uint int i", HEADER[1], *FLOATS], b"\xff" * 4 + BODY
        ),
        r"truncated",
    ),
    "a negative list length": (
        ply_bytes(
            [HEADER[0], "element face 1", "property list char int i", HEADER[1], *FLOATS], b"\xff" + BODY
        ),
        r"negative list length",
    ),
    "a negative count": (
        ply_bytes(replaced(HEADER, HEADER[1], "element vertex -2") + FLOATS, BODY),
        r"count '-2'; expected a whole number",
    ),
    "a count of a million digits": (
        ply_bytes(replaced(HEADER, HEADER[1], "element vertex " + "9" * 50_000) + FLOATS, BODY),
        r"expected a whole number",
    ),
    "no end of the header": (
        b"ply\n" + b"comment x\n" * 10_000,
        r"truncated: no 'end_header' line in the first 65536 bytes",
    ),
    "header without a format": (ply_bytes([HEADER[1], *FLOATS], BODY), r"no 'format' line"),
    "an unknown format": (
        ply_bytes(["format binary_pdp 1.0", *HEADER[1:], *FLOATS], BODY),
        r"not understood",
    ),
    "an unknown type": (
        ply_bytes(HEADER + replaced(FLOATS, "property float x", "property quad x"), BODY),
        r"'property quad x' is not a valid property",
    ),
    "a property before any element": (ply_bytes([HEADER[0], *FLOATS], b""), r"not understood"),
    "a property twice": (ply_bytes([*HEADER, *FLOATS, FLOATS[0]], BODY * 2), r"'x' is declared twice"),
    "an element twice": (
        ply_bytes([*HEADER, *FLOATS, HEADER[1]], BODY),
        r"element 'vertex' is declared twice",
    ),
    "not a PLY": (b"solid cube\n" * 20, r"is not a PLY file"),
    "an empty file": (b"", r"is not a PLY file"),
    "no vertices": (ply_bytes([HEADER[0], "element face 0"], b""), r"no element 'vertex'"),
    "a mesh": (
        ply_bytes([*HEADER, *(f"property float {n}" for n in ("x", "y", "z", "red"))], BODY),
        r"a mesh or point cloud, not a 3D Gaussian scene",
    ),
    "words in ascii": (
        ply_bytes(["format ascii 1.0", "element vertex 1", *FLOATS], b"one " * len(FLOATS) + b"\n"),
        r"unreadable row",
    ),
    "too few rows in ascii": (
        ply_bytes(["format ascii 1.0", "element vertex 2", *FLOATS], b"0.000000 " * len(FLOATS) + b"\n"),
        r"truncated: element vertex has 1 rows, the header says 2",
    ),
    "no row in ascii": (
        ply_bytes(["format ascii 1.0", "element vertex 1", *FLOATS], b"\n" * 99),
        r"truncated: element vertex has 0 rows",
    ),
    "too many values in ascii": (
        ply_bytes(["format ascii 1.0", "element vertex 1", *FLOATS], b"0 " * (len(FLOATS) + 1) + b"\n"),
        rf"{len(FLOATS) + 1} values in a row of vertex; expected {len(FLOATS)}",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_every_broken_rule_has_its_message(put, case):
    content, message = BROKEN[case]
    with pytest.raises(FormatError, match=message) as caught:
        read_ply(put(content))
    assert str(caught.value).startswith(str(put(content)))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(put(content))) + 200  # whatever a library adds


def test_paths_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.ply: no such file"):
        read_ply(tmp_path / "nowhere.ply")
    with pytest.raises(InputError, match="is a folder"):
        read_ply(tmp_path)
    with pytest.raises(InputError, match="cannot be opened"):
        read_ply("nul\0.ply")
    with pytest.raises(InputError, match="not an ordinary file"):
        read_ply("/dev/null")


# PLY files that are cut, or whose headers lie: one FormatError of one line, memory bounded by the file.

FIELDS = ("means", "log_scales", "quats_wxyz", "opacity_logits", "sh")


def many_types(g: Gaussians) -> bytes:
    """Big endian doubles, an extra property in front and one of another type behind, a further element."""
    names = inria_names(g.sh_degree, normals=False)
    table = vertex_table(g, ["segment", *names], ">f8")
    mixed = np.zeros(len(g), [*table.dtype.descr, ("id", ">u2")])
    for name in table.dtype.names:
        mixed[name] = table[name]
    header = ["format binary_big_endian 1.0", "comment antialiased 1", f"element vertex {len(g)}"]
    header += [f"property double {name}" for name in table.dtype.names]
    header += ["property ushort id", "element camera 1", "property float focal"]
    return ply_bytes(header, mixed.tobytes() + b"\0\0\0\1")


KINDS: dict[str, Callable[[Gaussians], bytes]] = {
    "plain": plain_ply,
    "list in front": lambda g: plain_ply(g, front=b"\x01" + bytes(4) + b"\x00"),
    "many types": many_types,
    "ascii": ascii_ply,
    "compressed": compressed_ply,
}


class Reader:
    """Reads hostile files one after the other, each within the memory that its size allows."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "a.ply"
        self.refused = 0

    def __call__(self, content: bytes) -> Scene | None:
        self.path.write_bytes(content)
        return self.read()

    def read(self) -> Scene | None:
        """The scene, or None where the file was refused."""
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        scene, message = None, ""
        try:
            scene = read_ply_scene(self.path)
        except (FormatError, InputError) as error:
            message = str(error)
        growth = tracemalloc.get_traced_memory()[1] - before
        # An ascii digit and its blank become a float64 in a table that grows, then a float32. What is
        # constant is the header, at most 64 KiB, as text, lines, words and objects.
        assert growth < 30 * self.path.stat().st_size + 4e6
        if scene is None:
            self.refused += 1
            assert message.startswith(str(self.path))
            assert message.isprintable()
            assert len(message) < len(str(self.path)) + 300
        return scene


@pytest.fixture
def reader(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracemalloc.start()
        yield Reader(tmp_path)
        tracemalloc.stop()


# ---- cut ----


def cut_everywhere(reader: Reader, content: bytes, step: int) -> None:
    """Shorter and shorter; the last byte of an ascii file may be a digit that is not missed."""
    assert reader(content) is not None
    places = range(len(content) // step * step, -1, -step)
    for place in places:
        if place < len(content):
            os.truncate(reader.path, place)
            assert reader.read() is None, place


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_cut_at_every_thousandth_byte(reader, kind):
    cut_everywhere(reader, KINDS[kind](random_gaussians(60 if kind == "ascii" else 400, sh_degree=3)), 1000)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["plain", "many types", "compressed"])
def test_a_large_file_cut(reader, kind):
    cut_everywhere(reader, KINDS[kind](random_gaussians(6000, sh_degree=3)), 9973)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "many types", "compressed"])
def test_a_large_file_cut_at_every_thousandth_byte(reader, kind):
    cut_everywhere(reader, KINDS[kind](random_gaussians(31_000, sh_degree=3)), 1000)


# ---- headers ----


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
def test_comments_and_obj_info_anywhere(reader, kind, newline):
    """Between any two lines, also such as look like other lines, and with bytes that are no text."""
    content = KINDS[kind](random_gaussians(7, sh_degree=1))
    want = reader(content)
    header, body = content.split(b"end_header\n", 1)
    lines = [*header.splitlines(), b"end_header"]
    remarks = [b"comment element vertex 3", b"obj_info \xff\xfe\x00", b"comment", b"", b"  ", b"obj_info"]
    for place in range(1, len(lines)):
        remark = remarks[place % len(remarks)]
        got = reader(newline.join([*lines[:place], remark, *lines[place:]]) + newline + body)
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(got.gaussians, field), getattr(want.gaussians, field))


@pytest.mark.parametrize("count", ["-1", "+3", "3.0", "1e3", "0x10", "٣", "9" * 21, "3 3"])
@pytest.mark.parametrize("kind", KINDS)
def test_counts_that_are_no_counts(reader, kind, count):
    content = KINDS[kind](random_gaussians(3))
    assert reader(content.replace(b"element vertex 3", f"element vertex {count}".encode())) is None


@pytest.mark.parametrize("count", [10**12, 2**31, 2**32 + 3, 2**63, 2**64 + 3, 10**19])
@pytest.mark.parametrize("kind", KINDS)
def test_counts_far_beyond_the_file(reader, kind, count):
    content = KINDS[kind](random_gaussians(3))
    assert reader(content.replace(b"element vertex 3", f"element vertex {count}".encode())) is None
    front = f"element other {count}\nproperty double d\nelement vertex 3".encode()
    if kind != "compressed":  # which names all its elements, so that order does not matter to it
        assert reader(content.replace(b"element vertex 3", front)) is None


@pytest.mark.parametrize("kind", KINDS)
def test_a_name_with_control_characters_never_reaches_the_terminal(reader, kind):
    content = KINDS[kind](random_gaussians(3))
    escape = "\x1b]0;title\x07"
    for old, new in (
        ("element vertex 3", f"element {escape} -1\nelement vertex 3"),
        ("element vertex 3", f"element {escape} 1\nelement {escape} 1\nelement vertex 3"),
        ("element vertex 3", f"element vertex 3\nproperty float {escape}"),
        ("element vertex 3", f"element vertex 3\nproperty list float int {escape}"),
        ("element vertex 3", f"element {'x' * 5000} 1000000000000\nproperty int a\nelement vertex 3"),
    ):
        assert reader(content.replace(old.encode(), new.encode())) is None


@pytest.mark.parametrize("rest", [1, 3, 8, 10, 23, 44, 46, 48, 72])
def test_odd_numbers_of_coefficients(reader, rest):
    g = random_gaussians(3)
    names = [*inria_names(0), *(f"f_rest_{i}" for i in range(rest))]
    assert reader(plain_ply(g, names)) is None


def test_every_property_as_a_list_or_missing_or_twice(reader):
    g = random_gaussians(3)
    content = plain_ply(g)
    needed = [name for name in inria_names(0) if not name.startswith("n")]
    for name in needed:
        line = f"property float {name}\n".encode()
        for other in (line.replace(b"float", b"list uchar float"), b"", line + line):
            assert reader(content.replace(line, other)) is None
    for name in columns(g).keys() - needed - {f"f_rest_{i}" for i in range(45)}:
        line = f"property float {name}\n".encode()
        assert reader(content.replace(line, line.replace(b" n", b" m"))) is not None  # an extra property


def test_compressed_files_that_fuzzing_found(reader):
    """An element without properties; doubles and signalling NaN in place of packed numbers and bounds."""
    content = compressed_ply(random_gaussians(3, sh_degree=1))
    bare = content.replace(b"".join(b"property uchar f_rest_%d\n" % i for i in range(9)), b"")
    assert reader(bare).gaussians.sh_degree == 0
    assert reader(content.replace(b"uint packed_color", b"float packed_color")) is None
    header, body = content.split(b"end_header\n")
    nan = b"\x01\x00\xa0\x7f"  # little endian; signalling
    assert not reader(header + b"end_header\n" + nan + body[4:]).gaussians.valid().any()


def assert_survives_writing(scene: Scene, path: Path) -> None:
    """What was read can be written and is read back the same, NaN included."""
    write_ply(path, scene.gaussians, (ply.COMMENT,) * scene.antialiased, scene.extras)
    again = read_ply_scene(path)
    assert again.antialiased == scene.antialiased
    assert list(again.extras) == list(scene.extras)
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(again.gaussians, field), getattr(scene.gaussians, field))
    for name, values in scene.extras.items():
        np.testing.assert_array_equal(again.extras[name], values)


def fuzz(reader: Reader, kind: str, rounds: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sample = KINDS[kind](random_gaussians(20, sh_degree=1))
    for count in range(rounds):
        scene = reader(malformed(sample, rng))
        if scene is not None and count % 5 == 0:
            assert_survives_writing(scene, reader.path.with_name("b.ply"))
    assert rounds / 10 < reader.refused < rounds  # the lies do matter, and some are harmless


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_lying_headers(reader, kind):
    fuzz(reader, kind, rounds=200, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_lying_headers(reader, kind):
    fuzz(reader, kind, rounds=10_000, seed=1)


def test_the_samples_are_good(reader):
    for kind, make in KINDS.items():
        g = random_gaussians(20, sh_degree=1)
        got = reader(make(g))
        assert got is not None, kind
        if kind != "compressed":
            np.testing.assert_array_equal(got.gaussians.sh, g.sh)
    assert list(reader(many_types(g)).extras) == ["segment", "id"]
    assert read_ply(reader.path).sh_degree == 1


# Headers of PLY files that lie: lines removed, doubled, swapped, or saying something else.

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


def malformed(content: bytes, rng: np.random.Generator) -> bytes:
    """One to three changes to lines of the header, then perhaps a mutation to the body."""
    header, _, body = content.partition(b"end_header\n")
    lines = header.splitlines()
    for _ in range(int(rng.integers(1, 4))):
        change_a_line(lines, rng)
    newline = b"\r\n" if rng.random() < 0.1 else b"\n"
    return newline.join([*lines, b"end_header"]) + newline + mutated(body, rng)


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


def mutated(body: bytes, rng: np.random.Generator) -> bytes:
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
