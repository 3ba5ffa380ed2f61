"""Reading and writing the INRIA PLY, in all the variants that are found in the wild."""

import io

import numpy as np
import plyfile
import pytest

from langsplat_core.errors import InputError
from langsplat_core.io import ply, read_ply, write_ply
from tests.support.file_samples import (
    ascii_ply,
    columns,
    inria_names,
    plain_ply,
    ply_bytes,
    vertex_table,
)
from tests.support.same import assert_same
from tests.support.scenes import random_gaussians


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

    monkeypatch.setattr(ply, "sh_to_channel_major", full_disk)
    with pytest.raises(OSError, match="No space"):
        write_ply(path, random_gaussians(9))
    assert_same(read_ply(path), old)
    assert list(tmp_path.iterdir()) == [path]


def test_a_comment_of_two_lines_is_refused(tmp_path):
    with pytest.raises(InputError, match="single line"):
        write_ply(tmp_path / "a.ply", random_gaussians(1), comments=("x\nend_header",))


def test_the_samples_are_what_plyfile_reads():
    """The bytes built by hand for the tests above are themselves good PLY files."""
    scene = random_gaussians(3, sh_degree=1)
    for content in (plain_ply(scene), ascii_ply(scene).replace(b"\n\n", b"\n")):  # it refuses blank lines
        other = plyfile.PlyData.read(io.BytesIO(content))
        np.testing.assert_array_equal(other["vertex"]["rot_3"], scene.quats_wxyz[:, 3])
