"""Reading and writing the INRIA PLY, in all the variants that are found in the wild."""

import io

import numpy as np
import plyfile
import pytest

from langsplat_core.errors import FormatError, InputError
from langsplat_core.formats import ply, read_ply, write_ply
from langsplat_core.scene import Gaussians
from tests.support.file_samples import (
    ascii_ply,
    columns,
    inria_names,
    plain_ply,
    ply_bytes,
    vertex_table,
)
from tests.support.scenes import random_gaussians

FIELDS = ("means", "log_scales", "quats_wxyz", "opacity_logits", "sh")


def assert_same(got: Gaussians, want: Gaussians) -> None:
    """Bit for bit, NaN included."""
    for field in FIELDS:
        a, b = getattr(got, field), getattr(want, field)
        assert a.dtype == np.float32
        np.testing.assert_array_equal(a.view(np.uint32), b.view(np.uint32), field)


@pytest.fixture
def put(tmp_path):
    def write(content: bytes):
        path = tmp_path / "scene.ply"
        path.write_bytes(content)
        return path

    return write


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [0, 1, 50])
def test_what_is_written_is_read_back_bit_for_bit(tmp_path, degree, count):
    want = random_gaussians(count, sh_degree=degree)
    write_ply(tmp_path / "a.ply", want, comments=("vertical axis: y", "Tür"))
    assert_same(read_ply(tmp_path / "a.ply"), want)


@pytest.mark.parametrize("encode", [plain_ply, ascii_ply])
def test_more_rows_than_one_chunk(tmp_path, encode):
    want = random_gaussians(2 * 8192 + 3)
    (tmp_path / "a.ply").write_bytes(encode(want))
    assert_same(read_ply(tmp_path / "a.ply"), want)


def test_tabs_and_blank_lines_in_the_header(put):
    want = random_gaussians(3)
    content = plain_ply(want).replace(b"property float x\n", b"\nproperty\tfloat \t x\t\ncomment\n")
    assert_same(read_ply(put(content)), want)


def test_rows_that_cannot_be_drawn_are_kept_as_they_are(tmp_path):
    want = random_gaussians(8)
    want.means[0] = np.nan
    want.log_scales[1] = -np.inf
    want.quats_wxyz[2] = 0
    want.opacity_logits[3:5] = np.inf, -np.inf
    want.sh[5] = -0.0
    write_ply(tmp_path / "a.ply", want)
    assert_same(read_ply(tmp_path / "a.ply"), want)


@pytest.mark.parametrize("degree", range(4))
def test_the_file_written_is_what_another_reader_expects(tmp_path, degree):
    scene = random_gaussians(20, sh_degree=degree)
    write_ply(tmp_path / "a.ply", scene)
    other = plyfile.PlyData.read(tmp_path / "a.ply")
    assert [element.name for element in other.elements] == ["vertex"]
    assert [prop.name for prop in other["vertex"].properties] == inria_names(degree)
    for name, values in columns(scene).items():
        np.testing.assert_array_equal(other["vertex"][name], values, name)


@pytest.mark.parametrize("byte_order", ["<", ">"])
@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("code", ["f4", "f8"])
@pytest.mark.parametrize("degree", [0, 3])
def test_files_of_another_writer(tmp_path, byte_order, text, code, degree):
    want = random_gaussians(30, sh_degree=degree)
    names = inria_names(degree, normals=False)
    np.random.default_rng(1).shuffle(names)  # the order of properties means nothing
    vertices = plyfile.PlyElement.describe(vertex_table(want, [*names, "segment"], code), "vertex")
    face = np.array([([0, 1, 2],), ([2, 1, 0],)], dtype=[("vertex_indices", "i4", (3,))])
    extra = np.array([(1.5, 2)], dtype=[("focal", "f4"), ("size", "u2")])
    elements = [
        plyfile.PlyElement.describe(face, "face"),
        vertices,
        plyfile.PlyElement.describe(extra, "camera"),
    ]
    path = tmp_path / "a.ply"
    plyfile.PlyData(elements, text=text, byte_order=byte_order, comments=["end_header is near"]).write(path)
    assert_same(read_ply(path), want)


def test_integer_columns(put):
    scene = random_gaussians(4)
    table = vertex_table(scene, inria_names(0), "<f4")
    kinds = [(name, "<i2" if name == "opacity" else "<f4") for name in table.dtype.names]
    header = ["format binary_little_endian 1.0", "element vertex 4"]
    header += [f"property {'short' if kind == '<i2' else 'float32'} {name}" for name, kind in kinds]
    table = table.astype(kinds)
    got = read_ply(put(ply_bytes(header, table.tobytes())))
    np.testing.assert_array_equal(got.opacity_logits, table["opacity"])


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("normals", [False, True])
def test_line_ends_and_normals(put, newline, normals):
    want = random_gaussians(9, sh_degree=1)
    # a body that begins with a line feed must not be taken for a part of the header
    want.means[0, 0] = np.frombuffer(b"\n\r\n\x3f", "<f4")[0]
    assert_same(read_ply(put(plain_ply(want, inria_names(1, normals), newline=newline))), want)


def test_lists_in_front_are_skipped(put):
    want = random_gaussians(9)
    front = b"\x02" + bytes(8) + b"\x00"  # two rows: a list of two, an empty one
    assert_same(read_ply(put(plain_ply(want, front=front))), want)


def test_ascii_with_lists_and_blank_lines(put):
    want = random_gaussians(9, sh_degree=2)
    assert_same(read_ply(put(ascii_ply(want))), want)


def test_ascii_infinities(put):
    scene = random_gaussians(3)
    scene.opacity_logits[:] = np.inf, -np.inf, np.nan
    np.testing.assert_array_equal(read_ply(put(ascii_ply(scene))).opacity_logits, scene.opacity_logits)


def test_a_double_beyond_float32_becomes_infinite(put):
    scene = random_gaussians(2)
    table = vertex_table(scene, inria_names(0), "<f8")
    table["scale_0"][1] = 1e300
    header = ["format binary_little_endian 1.0", "element vertex 2"]
    header += [f"property double {name}" for name in table.dtype.names]
    got = read_ply(put(ply_bytes(header, table.tobytes())))
    assert got.log_scales[1, 0] == np.inf
    assert list(got.valid()) == [True, False]


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    old = random_gaussians(5)
    write_ply(path, old)

    def full_disk(part):
        raise OSError("No space left on device")

    monkeypatch.setattr(ply, "_rows", full_disk)
    with pytest.raises(OSError, match="No space"):
        write_ply(path, random_gaussians(9))
    assert_same(read_ply(path), old)
    assert list(tmp_path.iterdir()) == [path]


def test_a_comment_of_two_lines_is_refused(tmp_path):
    with pytest.raises(InputError, match="single line"):
        write_ply(tmp_path / "a.ply", random_gaussians(1), comments=("x\nend_header",))


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


def test_paths_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.ply: no such file"):
        read_ply(tmp_path / "nowhere.ply")
    with pytest.raises(InputError, match="is a folder"):
        read_ply(tmp_path)
    with pytest.raises(InputError, match="cannot be opened"):
        read_ply("nul\0.ply")
    with pytest.raises(InputError, match="not an ordinary file"):
        read_ply("/dev/null")


def test_the_samples_are_what_plyfile_reads():
    """The bytes built by hand for the tests above are themselves good PLY files."""
    scene = random_gaussians(3, sh_degree=1)
    for content in (plain_ply(scene), ascii_ply(scene).replace(b"\n\n", b"\n")):  # it refuses blank lines
        other = plyfile.PlyData.read(io.BytesIO(content))
        np.testing.assert_array_equal(other["vertex"]["rot_3"], scene.quats_wxyz[:, 3])
