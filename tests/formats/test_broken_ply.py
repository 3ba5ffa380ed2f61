"""One broken rule of the PLY at a time, and the message of each."""

import pytest

from langsplat_core.errors import FormatError, InputError
from langsplat_core.io import read_ply
from tests.support.file_samples import (
    inria_names,
    ply_bytes,
)


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
