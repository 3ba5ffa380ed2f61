"""Reading what torch saved, as plain data: tensors, numbers and containers of them, and never any code."""

import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.parsing.opening import open_for_reading

_FOREIGN_CLASS = re.compile(r"(?:GLOBAL |but got <class ')([A-Za-z_][\w.]*)")  # as torch's messages name it
_PLAIN_TYPES = "?bBhHiIlLqQefdUS"  # NumPy's numbers and texts; no objects


def load_torch(path: Path) -> Any:
    """What a file of `torch.save` holds; tensors are on the CPU and, where the file allows, read when used.

    Only weights are unpickled: tensors, containers, and NumPy's numbers and arrays, which training code
    leaves among them. Raises InputError where the file cannot be opened; FormatError where it is damaged,
    of another kind, or would need any class beside these to be run.
    """
    import torch  # a second to import, and only a checkpoint needs it

    open_for_reading(path)[0].close()  # the same messages for a missing file as everywhere
    with warnings.catch_warnings(), torch.serialization.safe_globals(_numpy_globals()):
        warnings.simplefilter("ignore")
        try:
            return torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
        except Exception as error:  # noqa: BLE001  a damaged file raises whatever it hits first
            raise FormatError(f"{path}: {_reason(str(error))}") from None


def _reason(message: str) -> str:
    wanted = _FOREIGN_CLASS.search(message)
    if wanted:
        return (
            f"needs {wanted[1][:60]!r}, which would run code of whoever made the file; "
            "save it again as plain tensors"
        )
    return "not a whole file of torch.save; was the download complete?"


def _numpy_globals() -> list[Any]:
    """How pickles name NumPy's numbers and arrays, before and since its version 2."""
    multiarray = np._core.multiarray  # type: ignore[attr-defined]  # noqa: SLF001  where pickles look
    functions = [
        (getattr(multiarray, name), f"numpy.{core}.multiarray.{name}")
        for name in ("scalar", "_reconstruct")
        for core in ("core", "_core")
    ]
    return [*functions, np.ndarray, np.dtype, *{type(np.dtype(code)) for code in _PLAIN_TYPES}]


def plain_array(value: Any, path: Path) -> Array | None:
    """A tensor (or array) as a NumPy array, not copied where it need not be; None for anything else.

    Raises FormatError for a tensor that is not one of plain numbers on the CPU, or that claims more
    numbers than the file holds.
    """
    import torch

    if isinstance(value, np.ndarray):
        return value if value.dtype.kind in "fiub" else None
    if not isinstance(value, torch.Tensor):
        return None
    if (
        value.layout != torch.strided
        or value.device.type != "cpu"
        or value.is_quantized
        or value.is_complex()
    ):
        raise FormatError(f"{path}: holds a tensor of the kind {value.layout}, {value.device}, {value.dtype}")
    if value.numel() * value.element_size() > path.stat().st_size:
        raise FormatError(f"{path}: holds a tensor {tuple(value.shape)}, more numbers than the file has")
    value = value.detach()
    array: Array = (value.float() if value.dtype == torch.bfloat16 else value).numpy()
    return array
