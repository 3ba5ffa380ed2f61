"""Checkpoints made by hand to reach memory that is not theirs: each ends `langsplat convert` with a line."""

import io
import struct
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from langsplat_core.extensions.checkpoints.unpickling import load_torch, plain_array
from tests.support.commands import Ended, convert_each
from tests.support.file_samples import geometry, training_state
from tests.support.mutation import mutant
from tests.support.scenes import random_gaussians

pytestmark = pytest.mark.long  # a child for every file
G = random_gaussians(4, sh_degree=0)
F8, S8, U2 = np.dtype("f8"), np.dtype("S8"), np.dtype("U2")
EIGHT = struct.pack("<d", 4.25)
FLOATS = torch.arange(12.0)
FIT = (4, 3)
TYPED = torch.storage.TypedStorage(wrap_storage=FLOATS.untyped_storage(), dtype=torch.float32, _internal=True)


class Crafted:
    """Is pickled as a call, and a state for what the call returns."""

    def __init__(self, function: Any, *args: Any, state: Any = None) -> None:
        self.reduced = (function, args) if state is None else (function, args, state)

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


multiarray = np._core.multiarray  # noqa: SLF001


def kind(code: str, state: Any = None) -> Crafted:
    return Crafted(np.dtype, code, False, True, state=state)


def scalar(of: Any, data: Any = EIGHT) -> Crafted:
    return Crafted(multiarray.scalar, of, data)


def array(*state: Any) -> Crafted:
    return Crafted(multiarray._reconstruct, np.ndarray, (0,), b"b", state=state)  # noqa: SLF001  as pickles say


def rebuilt(
    shape: Any = FIT, stride: Any = (3, 1), offset: int = 0, *more: Any, storage: Any = TYPED
) -> Crafted:
    function = torch._utils._rebuild_tensor_v2  # noqa: SLF001
    return Crafted(function, storage, offset, shape, stride, False, OrderedDict(), *more)


def state(*, order: Any = "<", inside: Any = None, names: Any = None, fields: Any = None, size: Any = -1,
          alignment: Any = -1, flags: Any = 0, version: int = 3) -> tuple[Any, ...]:  # fmt: skip
    return (version, order, inside, names, fields, size, alignment, flags)


OBJECT = kind("O", state(order="|", flags=63))
FIELDS = {"a": (OBJECT, 0)}
KINDS = {  # states of a type that are not the type's own
    **{f"S8 of size {size}": ("S8", state(order="|", size=size, alignment=1)) for size in
       (-8, 0, -1, 7, 9, 2**31 - 1, -(2**31), 2**40, 2**70, None, 8.5, "8")},
    **{f"U2 of size {size}": ("U2", state(size=size, alignment=4, flags=8)) for size in (-8, 7)},
    **{f"f8 of size {size}": ("f8", state(size=size)) for size in (-8, 0, 4, 2**31 - 1)},
    **{f"f8 with flags {flags}": ("f8", state(flags=flags)) for flags in (1, 2, 4, 16, 63, -1, 2**40)},
    **{f"f8 aligned to {by}": ("f8", state(alignment=by)) for by in (0, -8, 2**31 - 1)},
    **{f"f8 in order {order!r}": ("f8", state(order=order)) for order in ("|", "x", "", 1, None, "<>")},
    "f8 of objects": ("f8", state(inside=(OBJECT, (1,)))),
    "f4 of objects": ("f4", state(inside=(OBJECT, (1,)))),
    "f8 of many f8": ("f8", state(inside=(kind("f8"), (2**40,)))),
    "f8 of fewer than none": ("f8", state(inside=(kind("f8"), (-1,)))),
    "f8 of one f8": ("f8", state(inside=(kind("f8"), 1))),
    "f8 of nothing": ("f8", state(inside=())),
    "f8 with an object in a field": ("f8", state(names=("a",), fields=FIELDS)),
    "f8 with a field before it": ("f8", state(names=("a",), fields={"a": (kind("f8"), -8)})),
    "f8 with a field far away": ("f8", state(names=("a",), fields={"a": (kind("f8"), 2**40)})),
    "f8 with names alone": ("f8", state(names=("a",))),
    "V8 with an object in a field": ("V8", state(order="|", names=("a",), fields=FIELDS, size=8)),
    "f8 of another version": ("f8", state(version=4)),
    "f8 with metadata": ("f8", (*state(version=4), {"a": OBJECT})),
    "f8 in a short state": ("f8", (3, "<")),
    "f8 in no state": ("f8", {"dtype": OBJECT, "itemsize": -8}),
    "f8 and attributes": ("f8", (None, {"dtype": OBJECT, "itemsize": -8})),
}  # fmt: skip
NUMBERS = {
    **{name: scalar(kind(*of)) for name, of in KINDS.items()},
    **{f"scalar {code}": scalar(kind(code)) for code in
       ("O", "V8", "M8", "m8", "f16", "c8", "S-8", "i3", "f8,O", "(2,)f8", "S99999999999", "", "٤")},
    "scalar of a list": scalar(Crafted(np.dtype, [("a", "O")], False, True)),
    "scalar of the class": scalar(np.dtype),
    "scalar of a string": scalar("f8"),
    "scalar of nothing": scalar(None),
    "scalar of an object": scalar(OBJECT),
    "scalar of 4 bytes": scalar(kind("f8"), EIGHT[:4]),
    "scalar of 9 bytes": scalar(kind("f8"), EIGHT + b"x"),
    "scalar of a text": scalar(kind("f8"), "12345678"),
    "scalar without data": scalar(kind("f8"), None),
}  # fmt: skip
ARRAYS = {
    **{f"array of {name}": array(1, FIT, kind(*of), False, EIGHT * 12)
       for name, of in KINDS.items() if "-8" in name or "object" in name or "many" in name},
    **{f"array {shape}": array(1, shape, F8, False, EIGHT * 12) for shape in
       ((-4, -3), (2**62, 4), (2**32, 2**32), (4, 2), (4, 4), (2**64,), (-1,), (3.0, 4), (True, 12), 12)},
    "array of a hundred dimensions": array(1, (1,) * 100, F8, False, EIGHT),
    "array without numbers": array(1, (0, 2**62, 2**62), F8, False, S8),
    "array of a list": array(1, (1,), OBJECT, False, [EIGHT]),
    "array of addresses": array(1, (1,), OBJECT, False, EIGHT),
    "array of a text": array(1, (1,), F8, False, "12345678"),
    "array of an array": array(1, FIT, array(1, FIT, F8, False, EIGHT * 12), False, EIGHT * 12),
    "array of the class": array(1, FIT, np.dtype, False, EIGHT * 12),
    "array of another version": array(2, FIT, F8, False, EIGHT * 12),
    "array in a short state": array(1, FIT),
    "array in no state": Crafted(multiarray._reconstruct, np.ndarray, (0,), b"b"),  # noqa: SLF001
    "array with attributes": Crafted(np.ndarray, FIT, state={"values": 1, "data": EIGHT, "shape": (2**40,)}),
    "array of a shape": Crafted(np.ndarray, (2**40,)),
}  # fmt: skip
TENSORS = {
    **{f"offset {offset}": rebuilt(offset=offset) for offset in (1, -1, 12, 2**62, -(2**63), 2**63)},
    **{f"stride {stride}": rebuilt(stride=stride) for stride in
       ((4, 1), (-3, 1), (3, -1), (2**62, 1), (2**63 - 1, 2**63 - 1), (-(2**63), 1), (1,), (3, 1, 1))},
    **{f"shape {shape}": rebuilt(shape, (0,) * len(shape)) for shape in
       ((-4, -3), (2**32, 2**32), (2**62, 4), (2**40, 3), (2**63, 1), (1,) * 70)},
    **{f"shape {shape} by ones": rebuilt(shape, (1,) * len(shape)) for shape in
       ((13,), (2**63 - 1,), (2**62, 2**62))},
    "negated": rebuilt(FIT, (3, 1), 0, {"neg": True}),
    "conjugated": rebuilt(FIT, (3, 1), 0, {"conj": True}),
    "of a tensor": rebuilt(storage=FLOATS),
    "of a number": rebuilt(storage=12),
    "storage of another kind": rebuilt(storage=torch.zeros(6).double().untyped_storage()),
    "set anew": Crafted(torch._utils._rebuild_tensor, TYPED, 0, FIT, (3, 1),  # noqa: SLF001
        state=(FLOATS, 2**40, FIT, (3, 1))),
    "a parameter of a list": Crafted(torch._utils._rebuild_parameter, [1], False, OrderedDict()),  # noqa: SLF001
}  # fmt: skip


def sparse(layout: torch.layout, *parts: Any) -> Crafted:
    return Crafted(torch._utils._rebuild_sparse_tensor, layout, parts)  # noqa: SLF001


FAR = torch.tensor([[10**12, -5, 3], [7, 10**15, -1]])
NAMES = {  # of other tensors, and of what makes them, all of which torch alone would call
    "COO": sparse(torch.sparse_coo, FAR, torch.ones(3), FIT),
    "CSR": sparse(torch.sparse_csr, FAR.ravel()[:5], FAR.ravel()[:3], torch.ones(3), FIT),
    "sparse class": Crafted(torch.sparse.FloatTensor, FAR, torch.ones(3), FIT),
    "quantised": Crafted(torch._utils._rebuild_qtensor, FLOATS, 0, FIT, (3, 1), (), False, None),  # noqa: SLF001
    "nested": Crafted(torch._utils._rebuild_nested_tensor, FLOATS, FAR, FAR, FAR[0]),  # noqa: SLF001
    "meta": torch.ones(FIT, device="meta"),
    "complex": torch.ones(FIT, dtype=torch.complex64),
    "wide": torch.ones(FIT, dtype=torch.uint16),
    "uninitialised": Crafted(torch.FloatTensor, 4, 3),
    "huge": Crafted(bytearray, 2**40),
    "renamed": Crafted(torch._tensor._rebuild_from_type_v2, complex, torch.Tensor, (), {"numel": complex}),  # noqa: SLF001
}  # fmt: skip


def model(**elements: Any) -> tuple[tuple[Any, ...], int]:
    """A checkpoint of 3D Gaussian Splatting; `means` and `extent` are two of its elements."""
    whole = {"means": geometry(G)[1], "extent": 4.25} | elements
    return (0, whole["means"], *geometry(G)[2:], *training_state(G)[:-1], whole["extent"]), 1


def saved(content: Any, **how: Any) -> bytes:
    out = io.BytesIO()
    torch.save(content, out, **how)
    return out.getvalue()


def pickle_of(file: bytes) -> bytes:
    return zipfile.ZipFile(io.BytesIO(file)).read("archive/data.pkl")


def with_pickle(file: bytes, stream: bytes) -> bytes:
    """The archive with another pickle."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(file)) as source, zipfile.ZipFile(out, "w") as target:
        for info in source.infolist():
            content = stream if info.filename.endswith("data.pkl") else source.read(info)
            target.writestr(info.filename, content)
    return out.getvalue()


def by_hand(opcodes: bytes) -> bytes:
    return with_pickle(saved(0), b"\x80\x02" + opcodes + b".")


def ends(files: dict[str, bytes], folder: Path) -> dict[str, Ended]:
    """What became of each, by its name."""
    for number, content in enumerate(files.values()):
        (folder / f"{number:04}.pth").write_bytes(content)
    ended = convert_each(folder)
    return {name: ended[f"{number:04}"] for number, name in enumerate(files)}


def refused(how: Ended) -> bool:
    line = how.said.removesuffix("\n")
    return how.code == 2 and line.startswith("langsplat: /") and line.isprintable() and not how.wrote


def numpy_1(file: bytes) -> bytes:
    """The same file as a NumPy before 2 would have named its parts."""
    assert b"numpy._core.multiarray" in pickle_of(file)
    return with_pickle(file, pickle_of(file).replace(b"numpy._core.", b"numpy.core."))


OLD = {"_use_new_zipfile_serialization": False}


def hostile_files() -> dict[str, bytes]:
    plain, legacy = saved(model()), saved(model(), **OLD)
    tuples = b"\x85" * 300_000  # in one another; a hash goes down all of them
    return {
        **{name: saved(model(extent=crafted)) for name, crafted in NUMBERS.items()},
        **{name: saved(model(means=crafted)) for name, crafted in (ARRAYS | TENSORS).items()},
        **{f"{name}, old": saved(model(means=crafted), **OLD) for name, crafted in [*TENSORS.items()][::4]},
        **{f"{name} tensor": saved(model(means=crafted)) for name, crafted in NAMES.items()},
        **{f"with another {name}": saved(Crafted(OrderedDict, state={name: 5})) for name in ("get", "items")},
        "type without a call": by_hand(b"cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\n)\x81U\x00\x86R"),
        "key in many tuples": by_hand(b"})" + tuples + b"K\x00s"),
        "key in remembered tuples": by_hand(b"})" + b"\x85q\x000h\x00" * 150_000 + b"K\x00s"),
        "storage key in tuples": by_hand(b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\n)" + tuples +
                                         b"X\x03\x00\x00\x00cpuK\x0ctQ"),
        **{f"cut at {place}": plain[:place] for place in range(0, len(plain), len(plain) // 8)},
        **{f"old, cut at {place}": legacy[:place] for place in range(2, len(legacy), len(legacy) // 8)},
    }  # fmt: skip


def mutants() -> dict[str, bytes]:
    rng = np.random.default_rng(0)
    good = saved(model(means=array(1, FIT, F8, False, EIGHT * 12), extent=np.float64(4.25)))
    stream = pickle_of(good)
    return {f"mutant {number}": with_pickle(good, mutant(stream, [stream], rng)) for number in range(20)}


def harmless_files() -> dict[str, bytes]:
    return {
        "untouched": saved(model()),
        "untouched, old": saved(model(), **OLD),
        "an array for means": saved(model(means=array(1, FIT, F8, False, EIGHT * 12))),
        "a text of no characters": saved(model(extent=scalar(kind("U2"), b"\xff" * 8))),
        "a view of one number": saved(model(means=rebuilt(stride=(0, 0)))),
    }


def test_every_crafted_file_is_refused_in_a_line_and_nothing_else(tmp_path):
    hostile, damaged, harmless = hostile_files(), mutants(), harmless_files()
    ended = ends(hostile | damaged | harmless, tmp_path)
    assert {name: ended[name] for name in harmless} == dict.fromkeys(harmless, Ended(0, "", True))
    loaded = [name for name in damaged if ended[name].code == 0]
    assert len(loaded) < len(damaged) / 2
    others = {name: how for name, how in ended.items() if name not in harmless and name not in loaded}
    assert {name: how for name, how in others.items() if not refused(how)} == {}


VALUES = [
    *(np.dtype(code).type(7) for code in ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")),
    *(np.bool_(True), np.float64("nan"), np.float32(1e-45), np.int64(-(2**63)), np.uint64(2**64 - 1)),
]
FLOAT_ROWS = np.random.default_rng(1).normal(size=(3, 4))
ROWS = [
    *(FLOAT_ROWS.astype(code) for code in ("f2", "<f4", ">f4", "<f8", ">f8")),
    *((100 * FLOAT_ROWS).astype(code) for code in ("i1", ">i2", "i4", ">i8")),
    *(np.asfortranarray(FLOAT_ROWS), FLOAT_ROWS > 0, np.array(3.5), np.arange(6, dtype=np.uint8)[::2]),
]


FORMS = {"numpy 2": saved((VALUES, ROWS)), "numpy 1": numpy_1(saved((VALUES, ROWS)))}
FORMS["no archive"] = saved((VALUES, ROWS), **OLD)


@pytest.mark.parametrize("form", FORMS)
def test_numbers_and_arrays_of_numpy(form, tmp_path):
    (tmp_path / "a.pth").write_bytes(FORMS[form])
    values, rows = load_torch(tmp_path / "a.pth")
    assert [repr(value) for value in values] == [repr(value.item()) for value in VALUES]
    for value, expected in zip(rows, ROWS, strict=True):
        found = plain_array(value, tmp_path / "a.pth")
        assert found is not None
        assert found.dtype == expected.dtype.newbyteorder("=")
        assert found.flags.writeable
        np.testing.assert_array_equal(found, expected)


def test_texts_of_numpy_are_passed_over(tmp_path):
    torch.save([np.str_("a"), np.bytes_(b"a"), np.array(["a", "bc"])], tmp_path / "a.pth")
    found = load_torch(tmp_path / "a.pth")
    assert found[:2] == [None, None]
    assert plain_array(found[2], tmp_path / "a.pth") is None
