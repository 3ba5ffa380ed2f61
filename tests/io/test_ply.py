"""The INRIA PLY in all its variants, SuperSplat's compressed one, and one broken rule of either at a time."""

import os
import tracemalloc
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import plyfile
import pytest

from langsplat_core.arrays import rotation_matrices, sigmoid
from langsplat_core.errors import InputError
from langsplat_core.io.ply import read_ply, read_ply_scene, write_metres, write_ply
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.scene import Gaussians, Scene
from tests.support.fakes import blob_scene
from tests.support.file_samples import (
    C0,
    ascii_ply,
    assert_refused,
    assert_same,
    assert_same_extras,
    columns,
    compressed_ply,
    inria_names,
    mixed_ply,
    plain_ply,
)
from tests.support.scenes import random_extras, random_gaussians


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [0, 1, 50])
def test_written_files_are_read_back_bit_for_bit(tmp_path, degree, count):
    """And is what another reader expects."""
    want, extras = random_gaussians(count, sh_degree=degree), random_extras(50)
    extras = {name: values[:count] for name, values in extras.items()}
    write_ply(tmp_path / "a.ply", Scene(want, extras=extras))
    assert_same(read_ply(tmp_path / "a.ply"), want)
    (element,) = plyfile.PlyData.read(tmp_path / "a.ply").elements
    assert element.name == "vertex"
    assert [prop.name for prop in element.properties] == [*inria_names(degree), *extras]
    for name, values in (columns(want) | extras).items():
        np.testing.assert_array_equal(element[name], values, name)


@pytest.mark.parametrize("encode", [plain_ply, ascii_ply])
def test_rows_of_several_chunks_are_read(put, encode):
    want = random_gaussians(2 * 8192 + 3)
    assert_same(read_ply(put(encode(want))), want)


def test_names_of_cloudcompare_are_read(put):
    want = random_gaussians(20, sh_degree=1)
    data = plain_ply(want)
    for name in inria_names(1)[6:]:
        data = data.replace(f" {name}\n".encode(), f" scalar_{name}\n".encode(), 1)
    assert data.count(b"scalar_") == len(inria_names(1)) - 6
    assert_same(read_ply(put(data)), want)


def test_rows_that_cannot_be_drawn_are_kept(tmp_path):
    want = random_gaussians(8)
    want.means[0], want.log_scales[1], want.quats_wxyz[2] = np.nan, -np.inf, 0
    want.opacity_logits[3:5] = np.inf, -np.inf
    want.sh[5] = -0.0
    write_ply(tmp_path / "a.ply", want)
    assert_same(read_ply(tmp_path / "a.ply"), want)
    (tmp_path / "b.ply").write_bytes(ascii_ply(want))
    for name in ("opacity_logits", "log_scales", "means"):
        np.testing.assert_array_equal(getattr(read_ply(tmp_path / "b.ply"), name), getattr(want, name))


@pytest.mark.parametrize("byte_order", ["<", ">"])
@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("code", ["f4", "f8"])
@pytest.mark.parametrize("degree", [0, 3])
def test_files_of_another_writer_are_read(tmp_path, byte_order, text, code, degree):
    """Properties in any order, those of no layout among them, between elements of other kinds."""
    want, extras = random_gaussians(30, sh_degree=degree), random_extras(30)
    values = {name: column.astype(code) for name, column in columns(want).items()} | extras
    values["opacity"] = np.round(values["opacity"]).astype("i2")  # a column of integers
    want = replace(want, opacity_logits=values["opacity"])
    names = [name for name in values if name not in ("nx", "nz")]
    np.random.default_rng(1).shuffle(names)
    table = np.zeros(30, [(name, values[name].dtype) for name in names])
    for name in names:
        table[name] = values[name]
    face = np.array([([0, 1, 2],), ([2, 1, 0],)], dtype=[("vertex_indices", "i4", (3,))])
    camera = np.array([(1.5, 2)], dtype=[("focal", "f4"), ("size", "u2")])
    rows = {"camera": camera, "vertex": table, "face": face}
    elements = [plyfile.PlyElement.describe(data, name) for name, data in rows.items()]
    path = tmp_path / "a.ply"
    plyfile.PlyData(elements, text=text, byte_order=byte_order, comments=["end_header is near"]).write(path)
    got = read_ply_scene(path)
    assert_same(got.gaussians, want)
    assert_same_extras(got.extras, {name: extras[name] for name in names if name in extras})


# ---- comments: antialiasing, and how long a unit is ----

COMMENTS = [  # of other programs and our own, whether the scene is antialiased, and its metres per unit
    ((), False, None),
    (("Exported from Brush", "  SPLATRENDERMODE:   MIP "), True, None),
    (("SplatRenderMode: default",), False, None),
    (("antialiased 1",), True, None),
    (("antialiased 0",), False, None),
    (("the antialiased 1 of them",), False, None),
    (("train_flags exposure antialiasing",), True, None),
    (("antialiased 1", "SplatRenderMode: default"), False, None),
    (("SplatRenderMode: default", "antialiased 1", "metres_per_unit: 2.5e-1"), True, 0.25),
    (("metres_per_unit 2", "metres_per_unit 3"), False, 3.0),
    *(((f"metres_per_unit {text}",), False, None) for text in ("0", "-1", "nan", "inf", "none", "2 3")),
]


@pytest.mark.parametrize(("comments", "antialiased", "metres"), COMMENTS)
def test_comments_say_antialiased_and_metres(put, comments, antialiased, metres):
    marks = "\ncomment ".join(comments).encode()
    scene = read_ply_scene(put(compressed_ply(random_gaussians(3)).replace(b"made by a test", marks)))
    assert (scene.antialiased, scene.metres_per_unit) == (antialiased, metres)


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.nan, np.inf])
def test_a_length_that_is_not_positive_is_refused(wrong, tmp_path):
    with pytest.raises(ValueError, match="must be above 0"):
        Scene(random_gaussians(2), metres_per_unit=wrong)
    save_scene(tmp_path / "a.ply", Scene(random_gaussians(2)))
    with pytest.raises(InputError, match="must be above 0"):
        write_metres(tmp_path / "a.ply", wrong)


def test_writing_metres_changes_the_header_alone(tmp_path):
    path = tmp_path / "a.ply"
    save_scene(path, blob_scene())
    plain = path.read_bytes()
    write_metres(path, 0.5)
    write_metres(path, 0.25)
    head, body = path.read_bytes().split(b"end_header\n", 1)
    assert head.count(b"metres_per_unit") == 1
    assert head.replace(b"comment metres_per_unit 0.25\n", b"") + b"end_header\n" + body == plain
    scene = load_scene(path)
    assert scene.metres_per_unit == 0.25
    assert scene.language is not None  # the sidecar still fits


def test_other_encodings_keep_metres(tmp_path):
    path = tmp_path / "a.compressed.ply"
    path.write_bytes(compressed_ply(random_gaussians(300)))
    before = load_scene(path).gaussians
    write_metres(path, 2)
    after = load_scene(path)
    assert after.metres_per_unit == 2
    np.testing.assert_array_equal(after.gaussians.means, before.means)

    save_scene(path, Scene(random_gaussians(3)))
    head, body = path.read_bytes().split(b"end_header\n", 1)
    path.write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    write_metres(path, 3)
    assert b"comment metres_per_unit 3.0\r\nend_header\r\n" in path.read_bytes()
    assert load_scene(path).metres_per_unit == 3


# ---- extra properties ----


@pytest.mark.parametrize(
    ("name", "dtype"),
    [*((name, "f4") for name in ("x", "f_rest_3", "two words", "a\nb", "")), ("a", "i8"), ("a", "?")],
)
def test_writer_refuses_what_no_header_can_hold(tmp_path, name, dtype):
    with pytest.raises(InputError):
        write_ply(tmp_path / "a.ply", Scene(random_gaussians(3), extras={name: np.zeros(3, dtype)}))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("extra", ["", "f4", "u1"])
def test_loading_holds_little_beside_the_arrays_it_keeps(tmp_path, extra):
    gaussians = random_gaussians(50_000, sh_degree=3)
    extras = {"extra": np.zeros(len(gaussians), extra)} if extra else {}
    write_ply(tmp_path / "a.ply", Scene(gaussians, extras=extras))
    tracemalloc.start()
    scene = load_scene(tmp_path / "a.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    arrays = [getattr(scene.gaussians, field.name) for field in fields(scene.gaussians)]
    kept = sum(array.nbytes for array in (*arrays, *scene.extras.values()))
    assert kept > 50_000 * 4 * 58
    assert kept < peak < kept + 4e6  # a few chunks; a copy of the coefficients would be 10 MB


# ---- SuperSplat's compressed PLY ----


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("colours", [True, False])
def test_compressed_files_are_exact_to_the_quantisation(put, degree, colours):
    want = random_gaussians(600, sh_degree=degree)  # two chunks and a part of one
    got = read_ply(put(compressed_ply(want, colours=colours)))
    assert len(got) == 600
    assert got.sh_degree == degree
    # Half a step of the coarsest field, with bounds over at most the whole scene; 10 % for float32.
    for name in ("means", "log_scales"):
        step = np.ptp(getattr(want, name), axis=0) / (2**10 - 1)
        assert (np.abs(getattr(got, name) - getattr(want, name)) <= 0.55 * step).all()
    step = (np.ptp(want.sh[:, 0], axis=0) if colours else 1 / C0) / 255
    if not colours:  # without bounds the colours are 0..1
        want.sh[:, 0] = (np.clip(0.5 + C0 * want.sh[:, 0], 0, 1) - 0.5) / C0
    assert (np.abs(got.sh[:, 0] - want.sh[:, 0]) <= 0.55 * step).all()
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(want.opacity_logits)).max() <= 0.5 / 255 + 1e-6
    # 10 bits over [-0.71, 0.71]: 7e-4 a component, amplified at most 2.5 times in the matrix and in the
    # component that is reconstructed
    axes, want_axes = (rotation_matrices(g.quats_wxyz.astype(float)) for g in (got, want))
    assert np.abs(axes - want_axes).max() <= 6e-3
    # 8 bits over [-4, 4]: half a step is 1/64
    assert np.abs(got.sh[:, 1:] - want.sh[:, 1:]).max(initial=0) <= 1 / 64 + 1e-6


# ---- what is malformed, beyond what tests/io/test_hostile.py mutates ----

PLAIN, ASCII = plain_ply(random_gaussians(2)), ascii_ply(random_gaussians(2))
LONG = PLAIN + bytes(400)  # room for more properties
OPACITY = b"property float opacity"
PACKED = compressed_ply(random_gaussians(600, sh_degree=1))
REST = b"".join(b"property float f_rest_%d\n" % index for index in range(1, 10))
CHARS = b"".join(b"property char a%d\n" % index for index in range(900))
MALFORMED = {  # a good file, and what of it is replaced by what
    "a point cloud": (PLAIN, PLAIN[PLAIN.index(b"f_dc_0") : PLAIN.index(b"rot_3")], b"red\nproperty float "),
    "ten coefficients": (LONG, OPACITY, b"property float f_rest_0\n" + REST + OPACITY),
    "10^12 vertices": (PLAIN, b"vertex 2", b"vertex 1000000000000"),
    "10^12 lines": (ASCII, b"vertex 2", b"vertex 1000000000000"),
    "a name that clears the screen": (PLAIN, b"element", b"element \x1b[2J 0\nelement"),
    "properties that eat the vertices": (PLAIN, b"property float x", CHARS + b"property float x"),
    "lists before the vertices": (
        PLAIN, b"element vertex", b"element face 1\nproperty list uint float i\nelement vertex"),
    "a row less in ascii": (ASCII, b"vertex 2", b"vertex 3"),
    "too few chunks": (PACKED, b"chunk 3\n", b"chunk 2\n"),
    "coefficients of chars": (PACKED, b"uchar f_rest_3", b"char f_rest_3"),
}  # fmt: skip


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_files_are_refused_in_a_line(put, bounded, case):
    good, old, new = MALFORMED[case]
    assert old in good
    assert_refused(read_ply, put(good.replace(old, new, 1)))


ENCODINGS: dict[str, Callable[[Gaussians], bytes]] = {
    "plain": plain_ply,
    "mixed": mixed_ply,
    "ascii": ascii_ply,
    "compressed": compressed_ply,
}


@pytest.mark.parametrize("kind", ENCODINGS)
@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
def test_comments_and_blank_lines_change_nothing(put, kind, newline):
    """Before every line at once, also such as look like other lines, and with bytes that are no text."""
    scene = random_gaussians(7, sh_degree=1)
    # a body that begins with a line feed must not be taken for a part of the header
    scene.means[0, 0] = np.frombuffer(b"\n\r\n\x3f", "<f4")[0]
    content = ENCODINGS[kind](scene)
    want = read_ply(put(content))
    if kind != "compressed":
        assert_same(want, scene)
    header, body = content.split(b"end_header\n", 1)
    header = header.replace(b"property float x", b"property\tfloat \t x\t")
    remarks = [b"comment element vertex 3", b"obj_info \xff\xfe\x00", b"", b"  ", b"comment end_header"]
    lines = [b"ply"]
    for number, line in enumerate([*header.splitlines()[1:], b"end_header"]):
        lines += [remarks[number % len(remarks)], line]
    assert_same(read_ply(put(newline.join(lines) + newline + body)), want)


def test_bounds_that_are_no_numbers_drop_their_chunk(put):
    header, body = compressed_ply(random_gaussians(300)).split(b"end_header\n", 1)
    for bound in (np.float32(np.inf).tobytes(), b"\x01\x00\xa0\x7f"):  # little endian NaN; signalling
        valid = read_ply(put(header + b"end_header\n" + bound + body[4:])).valid()
        assert not valid[:256].any()
        assert valid[256:].all()


@pytest.mark.parametrize("before", ["", "element face 9\nproperty uchar a\n"])
def test_a_line_without_end_is_refused(tmp_path, bounded, before):
    """Of a file of which the disk holds the header alone: all the rest reads as zeros."""
    path, properties = tmp_path / "a.ply", "".join(f"property float {name}\n" for name in inria_names(3))
    path.write_text(f"ply\nformat ascii 1.0\n{before}element vertex 10\n{properties}end_header\n")
    os.truncate(path, 3 << 30)
    assert_refused(read_ply, path)
