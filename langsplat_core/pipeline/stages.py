"""Stages that remember: a result is stored under a key made of its settings and inputs."""

import hashlib
import json
import logging
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.files import atomic_path
from langsplat_core.parsing.npy import write_npy
from langsplat_core.scene import Gaussians
from langsplat_core.semantics.store import ImageFeatures

log = logging.getLogger("langsplat")
T = TypeVar("T")
Arrays = Mapping[str, Array]


def stage_key(name: str, version: int, *inputs: Any) -> str:
    """A short name such as ``radiance-7293f2d8d936`` that changes with any setting or input.

    `inputs` are dataclasses, strings, numbers or lists of them; `version` is raised when the stage's
    code changes what it makes.
    """
    plain = [asdict(item) if is_dataclass(item) and not isinstance(item, type) else item for item in inputs]
    text = json.dumps([name, version, plain], sort_keys=True, default=str)
    return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def kept(path: Path, make: Callable[[], T], pack: Callable[[T], Arrays], unpack: Callable[[Arrays], T]) -> T:
    """What a stage makes: taken from `path` (*.npz) where it was made before, else made and stored there,
    whole or not at all. `pack` and `unpack` turn it into named arrays and back."""
    if path.exists():
        log.debug("%s: kept from an earlier run", path.name)
        return unpack(read_arrays(path))
    result = make()
    with atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, **pack(result))
    return result


def kept_array(path: Path, make: Callable[[], Array]) -> None:
    """See to it that `path` (*.npy) holds what `make` gives, which is not called where the file is there."""
    if not path.exists():
        write_npy(path, make())


def open_array(path: Path) -> Array:
    """The array in `path` (*.npy), read where it is looked at; FormatError for a damaged file."""
    try:
        try:
            return np.load(path, mmap_mode="r", allow_pickle=False)
        except ValueError:  # an array without elements cannot be mapped
            return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FormatError(f"{path}: damaged ({error}); delete it and run again") from None


def read_arrays(path: Path) -> dict[str, Array]:
    """The arrays of an .npz file; FormatError for a damaged one."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FormatError(f"{path}: damaged ({error}); delete it and run again") from None


def gaussians_digest(gaussians: Gaussians) -> str:
    """Of every number of the Gaussians."""
    return _digest(*(getattr(gaussians, field.name) for field in fields(gaussians)))


def features_digest(features: list[ImageFeatures]) -> str:
    """Of the masks and vectors of photographs, in their order."""
    return _digest(*(array for item in features for array in (item.labels, item.vectors)))


def _digest(*arrays: Array) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
