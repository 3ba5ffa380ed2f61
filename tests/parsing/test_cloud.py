"""Point clouds: every type of coordinate and colour, and numbers beyond what either can hold."""

from pathlib import Path

import numpy as np
import pytest

from langsplat_core.errors import FormatError
from langsplat_core.io.ply_table import GREY, read_cloud


def ascii_cloud(folder: Path, colour: str, *rows: str) -> Path:
    """Of double positions; `colour` is the type of the colours, none where it is empty."""
    channels = [f"property {colour} {name}" for name in ("red", "green", "blue")] if colour else []
    axes = [f"property double {axis}" for axis in "xyz"]
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *axes, *channels, "end_header"]
    path = folder / "cloud.ply"
    path.write_text("\n".join([*header, *rows]) + "\n")
    return path


def test_colours_of_every_type(tmp_path: Path) -> None:
    points, colours = read_cloud(ascii_cloud(tmp_path, "uchar", "1 2 3 0 128 255", "4 5 6 7 8 9"))
    np.testing.assert_array_equal(points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(colours, [[0, 128, 255], [7, 8, 9]])
    assert read_cloud(ascii_cloud(tmp_path, "float", "0 0 0 0 0.5 1"))[1].tolist() == [[0, 128, 255]]
    assert read_cloud(ascii_cloud(tmp_path, "", "0 0 0"))[1].tolist() == [[GREY] * 3]


@pytest.mark.parametrize(
    ("colour", "shade", "want"), [("int", "300", 255), ("int", "-5", 0), ("float", "1e308", 255)]
)
def test_colours_beyond_a_byte_are_clipped(tmp_path: Path, colour: str, shade: str, want: int) -> None:
    assert read_cloud(ascii_cloud(tmp_path, colour, f"0 0 0 {shade} 0 0"))[1][0, 0] == want


def test_integers_beyond_any_float(tmp_path: Path) -> None:
    points, colours = read_cloud(ascii_cloud(tmp_path, "uchar", f"1{'0' * 400} 0 nan 1{'0' * 30} 0 nan"))
    assert not np.isfinite(points).any(where=[True, False, True])
    assert colours.tolist() == [[255, 0, 0]]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("element vertex", "element corner", "no element 'vertex'"),
        ("property double y", "property double q", "no number 'y'"),
        ("property double z", "property list uchar int l\nproperty double z", "hold lists"),
        ("element vertex 1", "element vertex 1000000000000", "truncated"),
    ],
)
def test_what_is_no_cloud_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = ascii_cloud(tmp_path, "uchar", "1 2 3 4 5 6")
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(FormatError, match=message):
        read_cloud(path)
