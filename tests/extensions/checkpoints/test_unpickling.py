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

from langsplat_core.extensions.checkpoints.importing import read_foreign
from langsplat_core.io.ply import write_ply
from tests.support.file_kinds import FileKind, drawable_share, few_and_many, in_zip
from tests.support.file_samples import autoencoder, geometry, save_model, tensor, training_state
from tests.support.processes import Ended, convert_each
from tests.support.scenes import random_gaussians

G = random_gaussians(4, sh_degree=0)
F8 = np.dtype("f8")
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


NUMBERS = {  # of NumPy, which are passed over whatever they state
    "scalar of objects": scalar(kind("O", (3, "|", None, None, None, -1, -1, 63))),
    "scalar of many": scalar(kind("f8", (3, "<", (kind("f8"), (2**40,)), None, None, -1, -1, 0))),
    "scalar of the class": scalar(np.dtype),
    "scalar without data": scalar(kind("f8"), None),
    "array of 2^40": Crafted(np.ndarray, (2**40,)),
    "array of addresses": array(1, (1,), kind("O"), False, EIGHT),
    "array of attributes": Crafted(np.ndarray, FIT, state={"values": 1, "shape": (2**40,)}),
    "array of less": array(1, (-4, -3), F8, False, EIGHT),
}
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


FAR = torch.tensor([[10**12, -5, 3], [7, 10**15, -1]]), torch.ones(3), FIT
NAMES = {  # of other tensors, and of what makes them, all of which torch alone would call
    "COO": Crafted(torch._utils._rebuild_sparse_tensor, torch.sparse_coo, FAR),  # noqa: SLF001
    "meta": torch.ones(FIT, device="meta"),
    "complex": torch.ones(FIT, dtype=torch.complex64),
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
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(file)) as source, zipfile.ZipFile(out, "w") as target:
        for info in source.infolist():
            content = stream if info.filename.endswith("data.pkl") else source.read(info)
            target.writestr(info.filename, content)
    return out.getvalue()


def by_hand(opcodes: bytes) -> bytes:
    return with_pickle(saved(0), b"\x80\x02" + opcodes + b".")


def ends(files: dict[str, bytes], folder: Path) -> dict[str, Ended]:
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
        **{f"means: {name}": saved(model(means=crafted)) for name, crafted in (NUMBERS | TENSORS).items()},
        **{f"{name}, old": saved(model(means=crafted), **OLD) for name, crafted in [*TENSORS.items()][::4]},
        **{f"{name} tensor": saved(model(means=crafted)) for name, crafted in NAMES.items()},
        **{f"with another {name}": saved(Crafted(OrderedDict, state={name: 5})) for name in ("get", "items")},
        "type without a call": by_hand(b"cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\n)\x81U\x00\x86R"),
        "key in many tuples": by_hand(b"})" + tuples + b"K\x00s"),
        "key in some tuples": by_hand(b"})" + tuples[:9_000] + b"K\x00s"),
        "key in remembered tuples": by_hand(b"})" + b"\x85q\x000h\x00" * 150_000 + b"K\x00s"),
        "storage key in tuples": by_hand(b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\n)" + tuples +
                                         b"X\x03\x00\x00\x00cpuK\x0ctQ"),
        **{f"cut at {place}": plain[:place] for place in range(0, len(plain), len(plain) // 8)},
        **{f"old, cut at {place}": legacy[:place] for place in range(2, len(legacy), len(legacy) // 8)},
    }  # fmt: skip


def harmless_files() -> dict[str, bytes]:
    return {
        "untouched": saved(model()),
        "untouched, old": saved(model(), **OLD),
        **{name: saved(model(extent=crafted)) for name, crafted in NUMBERS.items()},
        "many tensors": saved(model(extent=[*torch.zeros(4_000, 1)])),
        "numpy 1": numpy_1(saved(model(extent=np.float64(4.25)))),
        "a view of one number": saved(model(means=rebuilt(stride=(0, 0)))),
    }


@pytest.mark.long
def test_every_crafted_file_is_refused_in_a_line_and_nothing_else(tmp_path):
    hostile, harmless = hostile_files(), harmless_files()
    ended = ends(hostile | harmless, tmp_path)
    told = {name for name in harmless if "elements 11 not read" in ended[name].said}
    assert told == {"array of addresses", "array of less"}
    quiet = harmless.keys() - told
    assert {name: ended[name] for name in quiet} == dict.fromkeys(quiet, Ended(0, "", True))
    assert {name: ended[name] for name in hostile if not refused(ended[name])} == {}


# Damaged checkpoints of other methods: read, or refused in one line.

SCENE = random_gaussians(20, sh_degree=1)


def checkpoints(folder: Path) -> list[bytes]:
    """Of Occam's LGS, and without features."""
    vectors = np.random.default_rng(0).normal(size=(20, 24)).astype(np.float32)
    paths = [save_model(folder / "made", SCENE, tensor(vectors)), save_model(folder / "plain", SCENE)]
    return [path.read_bytes() for path in paths]


def autoencoders(folder: Path) -> list[bytes]:
    """Of LangSplat; the checkpoint that goes with it lies beside."""
    save_model(folder / "latents_1.pth", SCENE, tensor(np.ones((20, 3), np.float32)))
    torch.save(autoencoder(24, (8, 3), (5,)).state_dict(), folder / "made")
    return [(folder / "made").read_bytes()]


def clusters(folder: Path) -> list[bytes]:
    """Of OpenGaussian; the scene lies beside."""
    write_ply(folder / "plain.ply", SCENE)
    index = np.arange(20) % 7 - 1
    np.savez(folder / "made.npz", leaf_feat=np.eye(6, 24, dtype=np.float32), leaf_ind=index)
    return [(folder / "made.npz").read_bytes()]


def imported(path: Path) -> float:
    beside = (path.with_name(name) for name in ("latents_1.pth", "plain.ply"))
    scene = read_foreign([path, *(other for other in beside if other.exists())])
    for level in scene.levels:
        scene.rows(level, np.arange(len(scene.scene.gaussians)))
    return drawable_share(scene.scene.gaussians)


KINDS = {
    "checkpoint": FileKind("a.pth", checkpoints, imported, in_zip, told=1),  # its level is a guess
    "autoencoder": FileKind("a.pth", autoencoders, imported, in_zip),
    "clusters": FileKind("a.npz", clusters, imported, in_zip),
}
test_a_few_mutants_are_read_or_refused, test_many_mutants_are_read_or_refused = few_and_many(KINDS)
