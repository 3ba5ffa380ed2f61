"""The masks and vectors of one photograph as the original LangSplat stores them."""

import io
import pickle

import numpy as np
import pytest

from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.langsplat_files import read_features, write_features

rng = np.random.default_rng(0)
VECTORS = rng.normal(size=(9, 512)).astype(np.float32)
MAPS = rng.integers(-1, 9, size=(4, 6, 8)).astype(np.int32)


def save(folder, vectors=VECTORS, maps=MAPS):
    np.save(folder / "view.01_f.npy", vectors)
    np.save(folder / "view.01_s.npy", maps)
    return folder


def test_what_is_written_is_read_back(tmp_path):
    write_features(tmp_path / "new", "view.01", VECTORS, MAPS)
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["view.01_f.npy", "view.01_s.npy"]
    vectors, maps = read_features(tmp_path / "new", "view.01")
    np.testing.assert_array_equal(vectors, VECTORS)
    np.testing.assert_array_equal(maps, MAPS)
    assert (vectors.dtype, maps.dtype) == (np.float32, np.int32)
    np.testing.assert_array_equal(np.load(tmp_path / "new" / "view.01_s.npy"), MAPS)


@pytest.mark.parametrize("kind", ["f4", "i8", "i2", ">i4"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_maps_of_other_writers(tmp_path, kind, order):
    save(tmp_path, VECTORS[:, :3].astype(np.float16), np.asarray(MAPS, kind, order=order))
    vectors, maps = read_features(tmp_path, "view.01")
    np.testing.assert_array_equal(maps, MAPS)
    assert vectors.shape == (9, 3)


def test_a_photograph_without_masks(tmp_path):
    write_features(tmp_path, "a", VECTORS[:0], np.full((4, 6, 8), -1, np.int32))
    vectors, maps = read_features(tmp_path, "a")
    assert vectors.shape == (0, 512)
    assert (maps == -1).all()


def with_value(value, kind="f4"):
    maps = MAPS.astype(kind)
    maps[3, 5, 7] = value
    return maps


def npy(shape, data=b"", kind="<f4"):
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": kind, "fortran_order": False, "shape": shape})
    return buffer.getvalue() + data


BROKEN = {
    "an id beyond the table": (
        {"maps": with_value(9)},
        r"ids from -1.* to 9.*expected -1 to 8, the rows of view",
    ),
    "an id below -1": ({"maps": with_value(-2)}, "ids from -2"),
    "an id that is none": ({"maps": with_value(np.nan)}, "ids from nan"),
    "half an id": ({"maps": with_value(1.5)}, "ids that are not whole"),
    "three maps": ({"maps": MAPS[:3]}, r"\(3, 6, 8\); expected numbers of shape \(4, H, W\)"),
    "one map": ({"maps": MAPS[0]}, "expected numbers of shape"),
    "maps without pixels": ({"maps": MAPS[:, :0]}, "expected numbers of shape"),
    "maps of text": ({"maps": MAPS.astype("U2")}, "expected numbers of shape"),
    "flat vectors": ({"vectors": VECTORS[0]}, r"expected floats of shape \(M, D\)"),
    "whole vectors": ({"vectors": VECTORS.astype(np.int32)}, "expected floats of shape"),
    "vectors that are none": ({"vectors": VECTORS * np.float32(np.nan)}, "not finite"),
    "pickled objects": ({"vectors": np.array([{}], dtype=object)}, "not a .npy file of plain numbers"),
    "complex vectors": ({"vectors": VECTORS.astype(complex)}, "not a .npy file of plain numbers"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_every_broken_rule_has_its_message(tmp_path, case):
    arrays, message = BROKEN[case]
    with pytest.raises(FormatError, match=message) as caught:
        read_features(save(tmp_path, **arrays), "view.01")
    assert str(caught.value).startswith(str(tmp_path / "view.01_"))


@pytest.mark.parametrize(
    "content",
    [
        npy((10**12, 512)),
        npy((2**40, 2**40)),
        npy((9, 512), VECTORS.tobytes()[:-1]),
        npy((9, 512), VECTORS.tobytes() + b"x"),
    ],
    ids=["a trillion rows", "2^80 numbers", "truncated", "too long"],
)
def test_shapes_that_the_file_does_not_hold(tmp_path, content):
    save(tmp_path)
    (tmp_path / "view.01_f.npy").write_bytes(content)
    with pytest.raises(FormatError, match="truncated or damaged"):
        read_features(tmp_path, "view.01")


@pytest.mark.parametrize(
    "content",
    [b"", b"\x93NUMPY", b"\x93NUMPY\x09\x00aa", pickle.dumps([1]), npy((-9, -8)), npy((9,), kind="|O")],
)
def test_files_of_another_kind(tmp_path, content):
    save(tmp_path)
    (tmp_path / "view.01_s.npy").write_bytes(content)
    with pytest.raises(FormatError, match=r"view\.01_s\.npy: not a \.npy file"):
        read_features(tmp_path, "view.01")


def test_missing_files(tmp_path):
    save(tmp_path)
    (tmp_path / "view.01_s.npy").unlink()
    with pytest.raises(InputError, match=r"view\.01_s\.npy: no such file"):
        read_features(tmp_path, "view.01")


def test_nothing_is_written_that_could_not_be_read(tmp_path):
    with pytest.raises(ValueError, match="beyond the 8 vectors"):
        write_features(tmp_path, "a", VECTORS[:8], np.full((4, 1, 1), 8, np.int32))
    with pytest.raises(TypeError):
        write_features(tmp_path, "a", VECTORS.astype(np.float64), MAPS)
    assert not list(tmp_path.iterdir())
