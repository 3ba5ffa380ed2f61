"""What is known of every photograph, one compact file each, so that an interrupted run can continue."""

import hashlib
import json
import os
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload
from urllib.parse import quote, unquote

import numpy as np

from langsplat_core.arrays import Array, check_array, unit
from langsplat_core.errors import FormatError
from langsplat_core.files import atomic_path
from langsplat_core.progress import Progress, silent
from langsplat_core.semantics.embed import ImageEncoder, embed_regions
from langsplat_core.semantics.masks import MaskSource, label_maps

VERSION = 1
SUFFIX = ".features.npz"
LONGEST_NAME = 200  # bytes before the suffix; file systems take 255, the suffix and a temporary name more
SHORTENED = "%~"  # percent-encoding never writes this


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
    """A folder with one file per photograph: labels as int16 (int32 from 32768 regions on), vectors as
    float16 (cosine error below 1e-6), deflated. Never pickled, never half written."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)

    def path(self, name: str) -> Path:
        """Where the photograph called `name` is kept: by its name, percent-encoded, or, where that is longer
        than files' names may be, by the beginning of it and a digest. The file itself holds the whole."""
        quoted = quote(name, safe=" ", errors="surrogateescape")
        if len(quoted) > LONGEST_NAME:
            digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
            quoted = f"{quoted[: LONGEST_NAME // 2]}{SHORTENED}{digest}"
        return self.folder / (quoted + SUFFIX)

    def names(self) -> list[str]:
        """Names of the photographs in the store, sorted."""
        return sorted(self._name(path) for path in self.folder.glob(f"*{SUFFIX}"))

    def _name(self, path: Path) -> str:
        stem = path.name.removesuffix(SUFFIX)
        if SHORTENED not in stem:
            return unquote(stem, errors="surrogateescape")
        with np.load(path, allow_pickle=False) as file:
            return bytes(file["name"]).decode(errors="surrogateescape")

    def has(self, name: str, key: str | None = None) -> bool:
        """Whether a readable file for `name` exists; with `key`, only if it was saved with that key."""
        try:
            with np.load(self.path(name), allow_pickle=False) as file:
                return key is None or str(file["key"]) == key
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return False

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
        """The features of one photograph. Raises FormatError for an absent or damaged file."""
        path = self.path(name)
        try:
            with np.load(path, allow_pickle=False) as file:
                labels, vectors = file["labels"].astype(np.int32), file["vectors"].astype(np.float32)
            return ImageFeatures(labels, unit(vectors))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise FormatError(
                f"{path}: no readable image features ({error}); delete it and run again"
            ) from error


def feature_key(image: Array, mask_source: MaskSource, encoder: str) -> str:
    """A short name of everything that the features of `image` depend on; `encoder` is the encoder's
    `fingerprint`."""
    settings = json.dumps([VERSION, mask_source.key, encoder, image.shape])
    return hashlib.sha256(settings.encode() + np.ascontiguousarray(image).tobytes()).hexdigest()[:16]


def fingerprint(encoder: ImageEncoder) -> str:
    """Tells an encoder from others, also from other weights under the same name: what it makes of a ramp."""
    side = encoder.image_size
    ramp = np.linspace(0, 255, side * side * 3).reshape(1, side, side, 3).astype(np.uint8)
    made = np.round(encoder.encode_images(ramp)[0], 2) + 0.0  # minus zero is zero
    return json.dumps([encoder.id, side, made.tolist()])


class StoredFeatures(Sequence[ImageFeatures]):
    """Features of photographs in a store, each read when it is looked at."""

    def __init__(self, store: FeatureStore, names: Sequence[str]) -> None:
        self._store, self._names = store, tuple(names)

    def __len__(self) -> int:
        return len(self._names)

    @overload
    def __getitem__(self, index: int) -> ImageFeatures: ...

    @overload
    def __getitem__(self, index: slice) -> "StoredFeatures": ...

    def __getitem__(self, index: int | slice) -> "ImageFeatures | StoredFeatures":
        if isinstance(index, slice):
            return StoredFeatures(self._store, self._names[index])
        return self._store.load(self._names[index])


def describe_capture(
    images: Sequence[Array],
    names: Sequence[str],
    mask_source: MaskSource,
    encoder: ImageEncoder,
    store: FeatureStore,
    progress: Progress = silent,
) -> StoredFeatures:
    """Masks and CLIP vectors of every photograph, in order; those that `store` has already are not redone.

    images: (H, W, 3) uint8 each; names: unique, one per image. What is finished is in the store even when
    `progress` interrupts the work.
    """
    label = f"masks ({mask_source.name}) and vectors"
    made_by = fingerprint(encoder)
    for index, (image, name) in enumerate(zip(images, names, strict=True)):
        part = _part(progress, f"{label}: {name}", index, len(images))
        part("", 0.0)
        key = feature_key(image, mask_source, made_by)
        if not store.has(name, key):
            labels = label_maps(mask_source(image, part))
            store.save(name, ImageFeatures(labels, embed_regions(image, labels, encoder)), key)
    progress(label, 1.0)
    return StoredFeatures(store, names)


def _part(progress: Progress, label: str, index: int, count: int) -> Progress:
    """Reports the work on item `index` of `count`, as a part of the whole and under one label."""
    return lambda _, fraction: progress(label, (index + fraction) / count)
