"""Headers of .npy files: what NumPy writes is read, anything else refused, whatever it looks like."""

from pathlib import Path

import numpy as np
import pytest

from langsplat_core.errors import FormatError
from langsplat_core.io.hostile import read_npy


def npy(shape: str, values: int = 0) -> bytes:
    """A .npy file of float32 with a header that says `shape`."""
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({shape}), }}".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(4 * values)


@pytest.mark.parametrize("shape", [(), (3,), (0,), (2, 3), (1, 2, 1, 2, 1, 2, 1, 2)])
def test_what_numpy_writes_is_read(tmp_path: Path, shape: tuple[int, ...]) -> None:
    array = np.arange(np.prod(shape, dtype=int), dtype=np.float32).reshape(shape)
    np.save(tmp_path / "a.npy", array)
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), array)


@pytest.mark.parametrize(
    "shape",
    [
        "9" * 400 + "x",  # may be divided in so many ways that trying all of them would never end
        "1, " * 400 + "x",
        "1, 1, 1, 1, 1, 1, 1, 1, 1",
        "1" * 19 + ",",
        "1 1,",
        ",",
        "-1,",
    ],
)
def test_other_shapes_are_refused_at_once(tmp_path: Path, shape: str) -> None:
    (tmp_path / "a.npy").write_bytes(npy(shape, 1))
    with pytest.raises(FormatError, match=r"not a \.npy file of plain numbers"):
        read_npy(tmp_path / "a.npy")
