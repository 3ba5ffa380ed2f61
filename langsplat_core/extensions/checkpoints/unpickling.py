"""Reading what torch saved, as plain data: tensors, numbers and containers of them, and never any code.

A pickle is looked through before torch runs it: it may name little more than what dense tensors are made of.
NumPy's own unpickling believes the item sizes, fields and flags that a file states, and then reads and writes
beyond its memory. The unpickler is therefore given nothing of NumPy but stand-ins, which accept a plain code
of numbers or texts and exactly the bytes that belong to it.
"""

import io
import math
import pickletools
import re
import warnings
from pathlib import Path
from typing import IO, Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, optional_imports, quoted
from langsplat_core.io.hostile import open_for_reading

DEEPEST = 100  # tuples in tuples; Python's hash goes down them on the machine's stack, which ends at 100 000
_ARCHIVE = b"PK\x03\x04"  # how torch tells an archive
_PICKLES = 5  # that a file begins with where it is none: magic number, version, system, content, storages
_STORAGES = ("Bool", "Byte", "Char", "Short", "Int", "Long", "Half", "BFloat16", "Float", "Double")
_MARKED = (pickletools.markobject, pickletools.stackslice)
_CODE = re.compile(r"b1|[iu][1248]|f[248]|[SU][1-9]\d{0,3}", re.ASCII)  # no objects, no records


class _Kind:
    """Stand-in for `numpy.dtype`: plain numbers and texts alone."""

    def __init__(self, code: Any, *_: Any) -> None:
        if not isinstance(code, str) or not _CODE.fullmatch(code):
            raise FormatError("holds NumPy data that are neither numbers nor texts; save plain tensors")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        for order in ("<", ">"):
            dtype = self.dtype.newbyteorder(order)
            if state == dtype.__reduce__()[2]:  # what NumPy writes of this type; no other is believed
                self.dtype = dtype
                return
        raise FormatError("holds NumPy data of a type made of others, or damaged; save plain tensors")

    def array(self, shape: tuple[Any, ...], data: Any, order: Any) -> Array:
        """Return a copy of `data` in the machine's byte order.

        Raises FormatError where shape and bytes differ.
        """
        whole = len(shape) <= 32 and all(type(size) is int and size >= 0 for size in shape)
        if not whole or type(data) is not bytes or len(data) != math.prod(shape) * self.dtype.itemsize:
            raise FormatError(f"damaged: an array of {self.dtype} and its bytes differ in size")
        array: Array = np.ndarray(shape, self.dtype, data, order=order)
        return array.astype(self.dtype.newbyteorder("="))


class _Array:
    """Stand-in for `numpy.ndarray`, filled by the state that a file states."""

    values: Array | None = None  # until the file has said what is in it

    def __setstate__(self, state: Any) -> None:
        match state:
            case (1, tuple(shape), _Kind() as kind, by_columns, data):
                self.values = kind.array(shape, data, "F" if by_columns else "C")
            case _:
                raise FormatError("damaged: an array of NumPy in no known form")


def _reconstruct(*_: Any) -> _Array:
    return _Array()


def _scalar(kind: Any, data: Any) -> Any:
    if not isinstance(kind, _Kind):
        raise FormatError("damaged: a number of NumPy in no known form")
    number = kind.array((), data, "C")
    # Texts play no part here, and NumPy would make strings of what are no characters.
    return None if number.dtype.kind in "SU" else number.item()


# NumPy's names before and since its version 2.
_STAND_INS: dict[str, Any] = {"numpy.dtype": _Kind, "numpy.ndarray": _Array}
for _core in ("core", "_core"):
    _STAND_INS[f"numpy.{_core}.multiarray.scalar"] = _scalar
    _STAND_INS[f"numpy.{_core}.multiarray._reconstruct"] = _reconstruct
_NAMED = {
    *_STAND_INS,
    *(f"torch.{kind}Storage" for kind in _STORAGES),
    *(f"torch._utils._rebuild_{what}" for what in ("tensor", "tensor_v2", "parameter")),
    *("torch.Size", "torch.device", "collections.OrderedDict"),
    "_codecs.encode",  # how bytes are written
}


@optional_imports()
def load_torch(path: Path) -> Any:
    """Return the content of a file of `torch.save`.

    Tensors are on the CPU and, where the file allows, read when used.

    Tensors, containers, and NumPy's numbers and arrays, which training code leaves among them; `plain_array`
    and `plain_mapping` say what they are. Raises InputError where the file cannot be opened; FormatError
    where it is damaged, of another kind, or names any class or function beside these.
    """
    import torch  # a second to import, and only a checkpoint needs it

    open_for_reading(path)[0].close()  # the same messages for a missing file as everywhere
    with warnings.catch_warnings(), torch.serialization.safe_globals([(s, n) for n, s in _STAND_INS.items()]):
        warnings.simplefilter("ignore")
        try:
            archived = _look_through(path)
            return torch.load(path, map_location="cpu", weights_only=True, mmap=archived)
        except FormatError as error:
            raise FormatError(f"{path}: {error}") from None
        except Exception:  # noqa: BLE001  a damaged file raises whatever it hits first
            reason = "not a whole file of torch.save; was the download complete?"
            raise FormatError(f"{path}: {reason}") from None


def _look_through(path: Path) -> bool:
    """Return whether a file is an archive. Raises FormatError for what its pickles may not hold."""
    from torch._C import PyTorchFileReader

    with open_for_reading(path)[0] as file:
        archived = file.read(len(_ARCHIVE)) == _ARCHIVE
        file.seek(0)
        if archived:  # by torch's own reader: another could find another pickle in the same file
            _check_pickle(io.BytesIO(PyTorchFileReader(file).get_record("data.pkl")))
        for _ in range(0 if archived else _PICKLES):
            _check_pickle(file)
    return archived


def _check_pickle(stream: IO[bytes]) -> None:
    """Raise FormatError for a name that is not of `_NAMED`, and for tuples in more than DEEPEST others."""
    depths: list[int] = []  # of what would lie on the unpickler's stack: tuples in one another
    below: list[list[int]] = []  # at each mark
    memo: dict[Any, int] = {}
    for opcode, argument, _ in pickletools.genops(stream):
        if opcode.name == "MARK":
            below.append(depths)
            depths = []
            continue
        if opcode.name == "GLOBAL" and (name := str(argument).replace(" ", ".", 1)) not in _NAMED:
            raise FormatError(
                f"needs {quoted(name)}; only tensors, arrays and numbers are read, as all else could run "
                "code of whoever made the file; save it again as plain tensors"
            )
        taken: list[int] = []
        if pickletools.markobject in opcode.stack_before:
            taken, depths = depths, below.pop()
        taken += [depths.pop() for kind in opcode.stack_before if kind not in _MARKED]
        depth = max(taken, default=0) + opcode.name.startswith("TUPLE")
        if depth > DEEPEST:
            raise FormatError(f"damaged: more than {DEEPEST} tuples in one another")
        depths += [memo[argument] if opcode.name.endswith("GET") else depth] * len(opcode.stack_after)
        if opcode.name.endswith("PUT"):
            memo[argument] = depths[-1]


def plain_array(value: Any, path: Path) -> Array | None:
    """Return a tensor (or array) of numbers as a NumPy array, not copied where it need not be.

    None for anything else.

    Raises FormatError for a tensor that no array can be, or that claims more numbers than the file holds.
    """
    import torch

    if isinstance(value, _Array):
        return value.values if value.values is not None and value.values.dtype.kind in "fiub" else None
    if not isinstance(value, torch.Tensor):
        return None
    if value.numel() * value.element_size() > path.stat().st_size:
        raise FormatError(f"{path}: holds a tensor {tuple(value.shape)}, more numbers than the file has")
    value = value.detach()
    try:
        array: Array = (value.float() if value.dtype == torch.bfloat16 else value).numpy()
    except (RuntimeError, ValueError):  # more dimensions than NumPy has, marks of lazy operations
        raise FormatError(f"{path}: holds a tensor that is no array of numbers") from None
    return array


def plain_mapping(value: Any) -> dict[Any, Any] | None:
    """Return a dictionary, without what a file may have set in place of its methods.

    None for anything else.
    """
    return dict(dict.items(value)) if isinstance(value, dict) else None
