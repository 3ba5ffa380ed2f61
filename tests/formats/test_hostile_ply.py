"""PLY files that are cut, or whose headers lie: one FormatError of one line, memory bounded by the file."""

import os
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.errors import FormatError, InputError
from langsplat_core.io import ply, read_ply, read_ply_scene, write_ply
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
from tests.support.ply_lies import lie
from tests.support.scenes import random_gaussians

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
        scene = reader(lie(sample, rng))
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
