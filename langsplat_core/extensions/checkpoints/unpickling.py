"""Reading of torch files as plain data: tensors, numbers and containers of them, without running code.

A pickle is checked before torch runs it: it may name little more than the parts of dense tensors, since of
sparse, quantised and nested ones torch trusts the file's sizes, and reads beyond its memory. NumPy objects of
training code have stand-ins. Archives are mapped into memory, so that torch knows where they end.
"""

import io
import pickletools
import warnings
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, optional_imports, quoted
from langsplat_core.io.hostile import open_for_reading, opened_archive

DEEPEST = 1_000  # tuples in one another: Python's hash of a key recurses on the machine's stack
_ARCHIVE = b"PK\x03\x04"  # by which torch recognises an archive
_PICKLES = 5  # at the start of a file that is no archive: magic number, version, system, content, storages
_STORAGES = ("Bool", "Byte", "Char", "Short", "Int", "Long", "Half", "BFloat16", "Float", "Double")


class _Ignored:
    """Stand-in for any NumPy object, whose state is ignored."""

    def __init__(self, *_: Any) -> None:
        pass

    def __setstate__(self, _: Any) -> None:
        pass


class IgnoredArray(_Ignored):
    """Stand-in for a NumPy array, which readers report as ignored."""


# NumPy's names before and since its version 2.
_CORES = ("numpy.core.multiarray", "numpy._core.multiarray")
_ARRAYS = {f"{core}._reconstruct" for core in _CORES}
_OF_NUMPY = {*_ARRAYS, *(f"{core}.scalar" for core in _CORES), "numpy.dtype", "numpy.ndarray"}
_NAMED = {
    *_OF_NUMPY,
    *(f"torch.{kind}Storage" for kind in _STORAGES),
    *(f"torch._utils._rebuild_{what}" for what in ("tensor", "tensor_v2", "parameter")),
    *("torch.Size", "torch.device", "collections.OrderedDict"),
    "_codecs.encode",  # in pickles of bytes
}


@optional_imports()
def load_torch(path: Path) -> Any:
    """Return the content of a file of `torch.save`.

    Tensors are on the CPU and, in archives, read on access; see `plain_array` and `plain_mapping`. Raises
    InputError if the file cannot be opened; FormatError if it is damaged, of another kind, or names any class
    or function other than those of dense tensors.
    """
    import torch  # takes a second; only checkpoints need it

    open_for_reading(path)[0].close()  # the same messages for a missing file as everywhere
    stand_ins: Any = [(IgnoredArray if name in _ARRAYS else _Ignored, name) for name in _OF_NUMPY]
    with warnings.catch_warnings(), torch.serialization.safe_globals(stand_ins):
        warnings.simplefilter("ignore")
        try:
            archived = _look_through(path)
            return torch.load(path, map_location="cpu", weights_only=True, mmap=archived)
        except FormatError as error:
            raise FormatError(f"{path}: {error}") from None
        except Exception:  # noqa: BLE001  a damaged file may raise anything
            reason = "not a whole file of torch.save; was the download complete?"
            raise FormatError(f"{path}: {reason}") from None


def _look_through(path: Path) -> bool:
    """Return True if a file is an archive. Raises FormatError for forbidden content of its pickles."""
    from torch._C import PyTorchFileReader

    packed = False
    with suppress(FormatError), opened_archive(path, "archive") as archive:  # torch reads some damaged ones
        packed = archive.deflated  # torch would take compressed bytes for numbers
    if packed:
        raise FormatError("its archive is compressed, which torch.save does not; save it again by that")
    with open_for_reading(path)[0] as file:
        archived = file.read(len(_ARCHIVE)) == _ARCHIVE
        file.seek(0)
        if archived:  # with torch's own reader, as another might find another pickle in the file
            _check_pickle(io.BytesIO(PyTorchFileReader(file).get_record("data.pkl")))
        for _ in range(0 if archived else _PICKLES):
            _check_pickle(file)
    return archived


def _check_pickle(stream: IO[bytes]) -> None:
    """Raise FormatError for a name that is not in `_NAMED`, and for tuples nested deeper than `DEEPEST`."""
    stack, memo = list[int](), dict[Any, int]()  # of each object at most how deep its tuples are; -1: a mark
    for opcode, argument, _ in pickletools.genops(stream):
        if opcode.name == "GLOBAL" and (name := str(argument).replace(" ", ".", 1)) not in _NAMED:
            raise FormatError(
                f"needs {quoted(name)}; only tensors, arrays and numbers are read, as all else could run "
                "code of whoever made the file; save it again as plain tensors"
            )
        depth = 0
        for part in reversed(opcode.stack_before):
            while part is pickletools.stackslice and stack[-1] >= 0:
                depth = max(depth, stack.pop())
            if part is not pickletools.stackslice:
                depth = max(depth, stack.pop())
        depth = memo[argument] if "GET" in opcode.name else depth + opcode.name.startswith("TUPLE")
        stack += [-1 if opcode.name == "MARK" else depth] * len(opcode.stack_after)
        if "PUT" in opcode.name or opcode.name == "MEMOIZE":
            memo[len(memo) if argument is None else argument] = stack[-1]
        if depth > DEEPEST:
            raise FormatError(f"tuples nested deeper than {DEEPEST}, as no training writes; copy it again")


def plain_array(value: Any, path: Path) -> Array | None:
    """Return a tensor as a NumPy array, without a copy if possible; None for anything else.

    Raises FormatError for a tensor that cannot be an array, or claims more numbers than its storage has.
    """
    import torch

    if not isinstance(value, torch.Tensor):
        return None
    if value.numel() * value.element_size() > value.untyped_storage().nbytes():
        raise FormatError(f"{path}: holds a tensor {tuple(value.shape)}, more numbers than the file has")
    value = value.detach()
    try:
        return np.asarray((value.float() if value.dtype == torch.bfloat16 else value).numpy())
    except (RuntimeError, ValueError):  # more dimensions than NumPy allows, flags of lazy operations
        raise FormatError(f"{path}: holds a tensor that is no array of numbers") from None


def plain_mapping(value: Any) -> dict[Any, Any] | None:
    """Return a plain copy of a dictionary, whose methods a file may have replaced; None for anything else."""
    return dict(dict.items(value)) if isinstance(value, dict) else None
