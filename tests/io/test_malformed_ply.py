"""One broken rule of the PLY at a time, and the message of each."""

from collections.abc import Callable

import pytest

from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.ply import read_ply
from langsplat_core.scene import Gaussians
from tests.support.comparing import assert_same
from tests.support.file_samples import ascii_ply, compressed_ply, inria_names, mixed_ply, plain_ply, ply_bytes
from tests.support.scenes import random_gaussians


@pytest.fixture
def put(tmp_path):
    def write(content: bytes):
        path = tmp_path / "scene.ply"
        path.write_bytes(content)
        return path

    return write


FLOATS = [f"property float {name}" for name in inria_names(0)]
SIZE = 2 * 4 * len(FLOATS)
BINARY = ply_bytes(["format binary_little_endian 1.0", "element vertex 2", *FLOATS], bytes(SIZE))
ASCII = ply_bytes(["format ascii 1.0", "element vertex 1", *FLOATS], b"0 " * (len(FLOATS) - 1) + b"0\n")
COMPRESSED = compressed_ply(random_gaussians(600, sh_degree=1))


def rest(*numbers: int) -> bytes:
    return b"".join(b"property float f_rest_%d\n" % i for i in numbers) + b"end_header\n" + bytes(9 * SIZE)


def face(count: int, kind: str) -> bytes:
    return f"element face {count}\nproperty list {kind} int i\nelement vertex 2".encode()


BROKEN = {  # a good file, what of it is replaced by what, and the message
    "no opacity": (BINARY, b"float opacity", b"float opaque", "property 'opacity' is missing"),
    "no rotation": (BINARY, b"property float rot_3\n", b"", "property 'rot_3' is missing"),
    "44 coefficients": (BINARY, b"end_header\n", rest(*range(44)), r"44 properties f_rest_\*; expected 0, 9"),
    "a gap among them": (BINARY, b"end_header\n", rest(*range(1, 10)), "'f_rest_0' is missing among 9"),
    "a list for a number": (BINARY, b"float opacity", b"list uchar float opacity",
        "'opacity' of vertex is a list"),
    "a truncated body": (BINARY, b"end_header\n\0", b"end_header\n",
        f"2 rows of element vertex need at least {SIZE} bytes, the file has {SIZE - 1}"),
    "10^12 vertices": (BINARY, b"vertex 2", b"vertex 1000000000000", "truncated: 1000000000000 rows"),
    "10^12 in ascii": (ASCII, b"vertex 1", b"vertex 1000000000000", "truncated: 1000000000000 rows"),
    "a million faces in front": (BINARY, b"element vertex 2", face(10**6, "uchar"),
        "truncated: 1000000 rows of element face"),
    "faces that eat the vertices": (BINARY.replace(b"\0" * 4, b"\xff" * 4, 1), b"element vertex 2",
        face(1, "uint"), "truncated"),
    "a negative list length": (BINARY.replace(b"\0", b"\xff", 1), b"element vertex 2", face(1, "char"),
        "negative list length"),
    "a negative count": (BINARY, b"vertex 2", b"vertex -2", "count '-2'; expected a whole number"),
    "a count of many digits": (BINARY, b"vertex 2", b"vertex " + b"9" * 50_000, "expected a whole number"),
    "an endless header": (BINARY, b"end_header", b"comment x\n" * 10_000,
        "no 'end_header' line in the first 65536"),
    "no format": (BINARY, b"format binary_little_endian 1.0\n", b"", "no 'format' line"),
    "an unknown format": (BINARY, b"binary_little", b"binary_pdp", "not understood"),
    "an unknown type": (BINARY, b"float x", b"quad x", "'property quad x' is not a valid property"),
    "a property before any element": (BINARY, b"element vertex 2\n", b"", "not understood"),
    "a property twice": (BINARY, b"float y", b"float x", "'x' is declared twice"),
    "an element twice": (BINARY, b"end_header", b"element vertex 2\nend_header", "'vertex' is declared tw"),
    "not a PLY": (BINARY, b"ply\n", b"solid cube\n", "is not a PLY file"),
    "an empty file": (BINARY, BINARY, b"", "is not a PLY file"),
    "no vertices": (BINARY, b"element vertex", b"element corner", "no element 'vertex'"),
    "a mesh": (BINARY, "\n".join(FLOATS[3:]).encode(), b"property float red",
        "a mesh or point cloud, not a 3D Gaussian scene"),
    "words in ascii": (ASCII, b"\n0 0", b"\none two", "unreadable row"),
    "too few rows in ascii": (ASCII.replace(b"0 ", b"0.000 "), b"vertex 1", b"vertex 2",
        "has 1 rows, the header says 2"),
    "no row in ascii": (ASCII, b"0 " * (len(FLOATS) - 1) + b"0", b"\n" * 99,
        "truncated: element vertex has 0 rows"),
    "too many values in ascii": (ASCII, b"\n0 0", b"\n0 0 0",
        f"{len(FLOATS) + 1} values in a row of vertex; expected {len(FLOATS)}"),
    "too few chunks": (COMPRESSED, b"chunk 3\n", b"chunk 2\n", "2 chunks for 600 Gaussians"),
    "a bound missing": (COMPRESSED, b"max_y\n", b"ceiling\n", "element chunk has no number 'max_y'"),
    "a word missing": (COMPRESSED, b"packed_scale", b"size", "element vertex has no number 'packed_scale'"),
    "a list of bounds": (COMPRESSED, b"float max_y", b"list uchar float max_y", "no number 'max_y'"),
    "coefficients of fewer": (COMPRESSED, b"sh 600\n", b"sh 599\n", "element sh has 599 rows of 9"),
    "a coefficient missing": (COMPRESSED, b"property uchar f_rest_8\n", b"", "element sh has 600 rows of 8"),
    "coefficients of chars": (COMPRESSED, b"uchar f_rest_3", b"char f_rest_3", "beyond 0..255"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_every_broken_rule_has_its_message(put, case):
    good, old, new, message = BROKEN[case]
    assert old in good
    path = put(good.replace(old, new, 1))
    with pytest.raises(FormatError, match=message) as caught:
        read_ply(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 200  # whatever a library adds


def test_paths_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.ply: no such file"):
        read_ply(tmp_path / "nowhere.ply")
    with pytest.raises(InputError, match="is a folder"):
        read_ply(tmp_path)
    with pytest.raises(InputError, match="cannot be opened"):
        read_ply("nul\0.ply")
    with pytest.raises(InputError, match="not an ordinary file"):
        read_ply("/dev/null")


# Every encoding of a PLY: headers that say what is not so, and remarks anywhere.

KINDS: dict[str, Callable[[Gaussians], bytes]] = {
    "plain": plain_ply,
    "list in front": lambda g: plain_ply(g, front=b"\x01" + bytes(4) + b"\x00"),
    "mixed": mixed_ply,
    "ascii": ascii_ply,
    "compressed": compressed_ply,
}
ESCAPE = "\x1b]0;title\x07"
VERTICES = "element vertex 3"
FALSE = {  # what stands in place of the number of vertices
    **{f"count {n}": f"element vertex {n}" for n in ("-1", "+3", "3.0", "1e3", "0x10", "٣", "9" * 21, "3 3")},
    **{f"count {n}": f"element vertex {n}" for n in (10**12, 2**31, 2**32 + 3, 2**63, 2**64 + 3, 10**19)},
    "rows in front": f"element other {10**12}\nproperty double d\n{VERTICES}",
    "a name of an escape": f"element {ESCAPE} -1\n{VERTICES}",
    "such a name twice": f"element {ESCAPE} 1\nelement {ESCAPE} 1\n{VERTICES}",
    "a property of such a name": f"{VERTICES}\nproperty float {ESCAPE}",
    "a list of such a name": f"{VERTICES}\nproperty list float int {ESCAPE}",
    "a name of 5000 letters": f"element {'x' * 5000} 1000000000000\nproperty int a\n{VERTICES}",
}


@pytest.mark.parametrize("case", FALSE)
@pytest.mark.parametrize("kind", KINDS)
def test_headers_that_say_what_is_not_so(put, bounded, kind, case):
    content = KINDS[kind](random_gaussians(3))
    assert VERTICES.encode() in content
    path = put(content.replace(VERTICES.encode(), FALSE[case].encode()))
    if (kind, case) == ("compressed", "rows in front"):  # it names its elements: their order plays no part
        return
    with pytest.raises(FormatError) as caught:
        read_ply(path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(path)) + 300


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
def test_comments_and_obj_info_anywhere(put, kind, newline):
    """Between any two lines, also such as look like other lines, and with bytes that are no text."""
    content = KINDS[kind](random_gaussians(7, sh_degree=1))
    want = read_ply(put(content))
    header, body = content.split(b"end_header\n", 1)
    lines = [*header.splitlines(), b"end_header"]
    remarks = [b"comment element vertex 3", b"obj_info \xff\xfe\x00", b"comment", b"", b"  ", b"obj_info"]
    for place in range(1, len(lines)):
        remark = remarks[place % len(remarks)]
        path = put(newline.join([*lines[:place], remark, *lines[place:]]) + newline + body)
        assert_same(read_ply(path), want)


def test_odd_numbers_of_coefficients_and_every_property_as_a_list_missing_or_twice(put):
    g = random_gaussians(3)
    hostile = [
        plain_ply(g, [*inria_names(0), *(f"f_rest_{i}" for i in range(n))]) for n in (1, 3, 8, 23, 46, 72)
    ]
    for name in (name for name in inria_names(0) if not name.startswith("n")):
        line = f"property float {name}\n".encode()
        others = (line.replace(b"float", b"list uchar float"), b"", line + line)
        hostile += [plain_ply(g).replace(line, other) for other in others]
    for content in hostile:
        with pytest.raises(FormatError):
            read_ply(put(content))


def test_compressed_files_that_fuzzing_found(put):
    """An element without properties; doubles and signalling NaN in place of packed numbers and bounds."""
    content = compressed_ply(random_gaussians(3, sh_degree=1))
    bare = content.replace(b"".join(b"property uchar f_rest_%d\n" % i for i in range(9)), b"")
    assert read_ply(put(bare)).sh_degree == 0
    with pytest.raises(FormatError):
        read_ply(put(content.replace(b"uint packed_color", b"float packed_color")))
    header, body = content.split(b"end_header\n")
    nan = b"\x01\x00\xa0\x7f"  # little endian; signalling
    assert not read_ply(put(header + b"end_header\n" + nan + body[4:])).valid().any()
