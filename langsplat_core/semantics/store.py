"""Store of masks and vectors, one compact file a photograph, so that an interrupted run can continue."""

import hashlib
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from langsplat_core.arrays import Array, check_array, unit
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import exists, read_npz

SUFFIX = ".features.npz"
LONGEST_NAME = 200  # bytes before the suffix; file systems take 255, the suffix and a temporary name more
SHORTENED = "%~"  # percent-encoding never writes this

log = logging.getLogger("langsplat")


@dataclass(frozen=True, eq=False)
class ImageFeatures:
    """The regions of one photograph at the levels subpart, part, whole, and what CLIP sees in them."""

    labels: Array  # (3, H, W) int32, rows of `vectors`; -1 where there is no region
    vectors: Array  # (M, D) float32 unit vectors

    def __post_init__(self) -> None:
        check_array("labels", self.labels, (3, "H", "W"), dtype=np.int32)
        check_array("vectors", self.vectors, ("M", "D"), dtype=np.float32)
        if self.labels.max(initial=-1) >= len(self.vectors) or self.labels.min(initial=-1) < -1:
            raise ValueError(
                f"labels: rows {self.labels.min()} to {self.labels.max()}, {len(self.vectors)} vectors"
            )


class FeatureStore:
    """A folder with one file per photograph, never pickled and never half written.

    Labels are int16 (int32 from 32768 regions on), vectors float16 (cosine error below 1e-6), deflated.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self._warned: set[str] = set()  # names of damaged files

    def path(self, name: str) -> Path:
        """Return the file of the photograph called `name`: its name percent-encoded.

        A name that is longer than files' names may be is cut, and a digest stands in for the rest. The file
        itself holds the whole name.
        """
        quoted = quote(name, safe=" ", errors="surrogateescape")
        if len(quoted) > LONGEST_NAME:
            digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
            quoted = f"{quoted[: LONGEST_NAME // 2]}{SHORTENED}{digest}"
        return self.folder / (quoted + SUFFIX)

    def names(self) -> list[str]:
        """Return the names of the photographs in the store, sorted. Raises FormatError for a damaged file."""
        return sorted(self._name(path) for path in self.folder.glob(f"*{SUFFIX}"))

    def _name(self, path: Path) -> str:
        stem = path.name.removesuffix(SUFFIX)
        if SHORTENED not in stem:
            return unquote(stem, errors="surrogateescape")
        stored = read_npz(path).get("name")
        if stored is None or stored.dtype != np.uint8:
            raise FormatError(f"{path}: does not say which photograph it is of; delete it and run again")
        return os.fsdecode(stored.tobytes())

    def has(self, name: str, key: str | None = None) -> bool:
        """Return True where a whole file for `name` exists; with `key`, only if it was saved with that key.

        A damaged file counts as absent, and is warned of once: what it held is then made again.
        """
        try:
            if not exists(self.path(name)):
                return False
            stored_key = self._read(name)[1]
        except InputError as error:
            if name not in self._warned:
                self._warned.add(name)
                log.warning("%s; made again", error)
            return False
        return key is None or stored_key == key

    def save(self, name: str, features: ImageFeatures, key: str = "") -> None:
        """Keep the features of one photograph; `key` names all that they depend on."""
        rows = np.int16 if len(features.vectors) <= np.iinfo(np.int16).max else np.int32
        with atomic_path(self.path(name)) as temporary:
            np.savez_compressed(
                temporary,
                allow_pickle=False,
                key=np.array(key),
                name=np.frombuffer(os.fsencode(name), np.uint8),
                labels=features.labels.astype(rows),
                vectors=features.vectors.astype(np.float16),
            )

    def load(self, name: str) -> ImageFeatures:
        """Return the features of one photograph. Raises FormatError for an absent or damaged file."""
        try:
            return self._read(name)[0]
        except InputError as error:
            raise FormatError(f"{error}; delete it and run again") from None

    def _read(self, name: str) -> tuple[ImageFeatures, str]:
        """Return the features and the key they were saved with. Raises InputError and FormatError."""
        path = self.path(name)
        arrays = read_npz(path)
        try:
            key, labels, vectors = arrays["key"], arrays["labels"], arrays["vectors"]
            if (key.dtype.kind, labels.dtype.kind, vectors.dtype.kind) != ("U", "i", "f") or key.ndim:
                raise TypeError("arrays of other types")
            if not np.isfinite(vectors).all():
                raise ValueError("numbers that are not finite")
            features = ImageFeatures(labels.astype(np.int32), unit(vectors.astype(np.float32)))
        except KeyError as error:
            raise FormatError(f"{path}: no readable image features ({error} is missing)") from None
        except (ValueError, TypeError) as error:
            raise FormatError(f"{path}: no readable image features ({error})") from None
        return features, str(key)


class StoredFeatures(Sequence[ImageFeatures]):
    """Features of photographs in a store, each read when it is used."""

    def __init__(self, store: FeatureStore, names: Sequence[str]) -> None:
        self._store, self._names = store, tuple(names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, index: Any) -> Any:
        """Return the features of photograph `index`, a number; slices are not supported."""
        return self._store.load(self._names[index])
