"""Features of photographs: regions at three levels with a CLIP vector each.

They are kept in a store, one compact file per photograph, so that an interrupted run can continue.
"""

import hashlib
import json
import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable
from urllib.parse import quote

import numpy as np
import scipy
from PIL import Image

from langsplat_core.arrays import Array, check_array, unit
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import read_npz
from langsplat_core.progress import Progress, silent
from langsplat_core.semantics.encoders import Encoder
from langsplat_core.semantics.masks import LevelMasks, MaskSource, label_maps, within

VERSION = 1  # of the stored features
STAGE = "masks and vectors"
K = TypeVar("K")
T = TypeVar("T")

log = logging.getLogger("langsplat")


@dataclass(frozen=True, eq=False)
class ImageFeatures:
    """The regions of one photograph at the levels subpart, part, whole, and their CLIP vectors."""

    labels: Array  # (3, H, W) int32, rows of `vectors`; -1: no region
    vectors: Array  # (M, D) float32 unit vectors

    def __post_init__(self) -> None:
        check_array("labels", self.labels, (3, "H", "W"), dtype=np.int32)
        check_array("vectors", self.vectors, ("M", "D"), dtype=np.float32)
        if self.labels.max(initial=-1) >= len(self.vectors) or self.labels.min(initial=-1) < -1:
            raise ValueError(
                f"labels: rows {self.labels.min()} to {self.labels.max()}, {len(self.vectors)} vectors"
            )


LARGEST_LABELS = 96 << 20  # bytes uncompressed, of photographs of 4000 x 4000 px


class FeatureStore:
    """A folder with one file per photograph, never pickled, written atomically.

    Labels are int16 (int32 from 32768 regions on), vectors float16 (cosine error below 1e-6), deflated.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self._warned: set[str] = set()  # names of damaged files

    def path(self, name: str) -> Path:
        """Return the file of the photograph called `name`: the name percent-encoded, cut if long."""
        quoted = quote(name, safe=" ", errors="surrogateescape")
        if len(quoted) > 200:  # file systems take 255, with the suffix and that of a temporary name
            quoted = f"{quoted[:100]}%~{hashlib.sha256(os.fsencode(name)).hexdigest()[:16]}"
        return self.folder / f"{quoted}.features.npz"

    def has(self, name: str, key: str | None = None) -> bool:
        """Return True if there is a file of `name`, with `key` if given; damage is warned of once."""
        try:
            return os.path.exists(self.path(name)) and key in (None, self._read(name)[1])
        except InputError as error:
            if name not in self._warned:
                log.warning("%s; made again", error)
            self._warned.add(name)
            return False

    def save(self, name: str, features: ImageFeatures, key: str = "") -> None:
        """Write the features of one photograph; `key` is a digest of all that they depend on."""
        rows = np.int16 if len(features.vectors) <= np.iinfo(np.int16).max else np.int32
        with atomic_path(self.path(name)) as temporary:
            np.savez_compressed(
                temporary,
                allow_pickle=False,
                key=np.array(key),
                labels=features.labels.astype(rows),
                vectors=features.vectors.astype(np.float16),
            )

    def load(self, name: str) -> ImageFeatures:
        """Return the features of one photograph. Raises FormatError for an absent or damaged file."""
        try:
            return self._read(name)[0]
        except InputError as error:
            raise FormatError(f"{error}; delete it and run again") from None

    def of(self, names: Sequence[str]) -> "OnDemand[ImageFeatures]":
        """Return the features of photographs, each read on access."""
        return OnDemand(names, self.load)

    def _read(self, name: str) -> tuple[ImageFeatures, str]:
        """Return the features and the key they were saved with. Raises InputError and FormatError."""
        path = self.path(name)
        arrays = read_npz(path, LARGEST_LABELS)
        try:
            key, labels, vectors = arrays["key"], arrays["labels"], arrays["vectors"]
            if (key.dtype.kind, labels.dtype.kind, vectors.dtype.kind) != ("U", "i", "f") or key.ndim:
                raise TypeError("arrays of other types")
            if not np.isfinite(vectors).all():
                raise ValueError("numbers that are not finite")
            features = ImageFeatures(labels.astype(np.int32), unit(vectors.astype(np.float32)))
        except (KeyError, ValueError, TypeError) as error:
            raise FormatError(f"{path}: no readable image features ({error})") from None
        return features, str(key)


class OnDemand(Sequence[T]):
    """Items that are read on access: label maps of all photographs may exceed the memory."""

    def __init__(self, keys: Sequence[K], read: Callable[[K], T]) -> None:
        self._keys, self._read = keys, read

    def __len__(self) -> int:
        return len(self._keys)

    def __getitem__(self, index: Any) -> Any:
        """Return item `index`, a number; slices are not supported."""
        return self._read(self._keys[index])


# Crops of regions for CLIP, and the features of whole captures.


def masked_crop(image: Array, mask: Array, size: int) -> Array:
    """Return one region cropped to its bounding box, black outside the mask, centred on a black square.

    image: (H, W, 3) uint8; mask: (H, W) bool, ValueError if empty. Returns (size, size, 3) uint8, resized
    bilinearly, antialiased when shrunk: LangSplat's crop (`preprocess.py`), also for an encoder's training.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        raise ValueError("masked_crop: the mask is empty")
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    patch = np.where(mask[box][..., None], image[box], np.uint8(0))
    height, width = patch.shape[:2]
    side = max(height, width)
    square = np.zeros((side, side, 3), np.uint8)
    top, left = (side - height) // 2, (side - width) // 2
    square[top : top + height, left : left + width] = patch
    if side == size:
        return square
    return np.asarray(Image.fromarray(square).resize((size, size), Image.Resampling.BILINEAR))


@runtime_checkable
class RegionEncoder(Protocol):
    """An encoder that computes vectors of regions without crops."""

    def encode_regions(self, image: Array, label_maps: Array) -> Array:
        """See `embed_regions`."""


def embed_regions(image: Array, label_maps: Array, encoder: Encoder) -> Array:
    """Return (M, D) float32 unit vectors of the M regions that `label_maps` numbers.

    image: (H, W, 3) uint8; label_maps: (3, H, W) int32 as of `masks.label_maps`. A crop shows the visible
    part of a region; where masks of one level overlap, LangSplat shows the covered part too.
    """
    if isinstance(encoder, RegionEncoder):
        return encoder.encode_regions(image, label_maps)
    crops = np.zeros((int(label_maps.max()) + 1, encoder.image_size, encoder.image_size, 3), np.uint8)
    for labels in label_maps:
        for row, box in enumerate(scipy.ndimage.find_objects(labels + 1)):
            if box is not None:  # a row of another level
                crops[row] = masked_crop(image[box], labels[box] == row, encoder.image_size)
    number = dict[bytes, int]()  # of each distinct crop: many regions are equal at two levels
    of = [number.setdefault(hashlib.sha256(crop.tobytes()).digest(), len(number)) for crop in crops]
    _, first = np.unique(np.array(of, int), return_index=True)
    return encoder.encode_images(crops[first])[of] if of else encoder.encode_images(crops)


def fingerprint(encoder: Encoder) -> str:
    """Return a text that identifies an encoder: its id, image size and vector of a ramp, as JSON."""
    side = encoder.image_size
    ramp = np.linspace(0, 255, side * side * 3).reshape(1, side, side, 3).astype(np.uint8)
    made = np.round(encoder.encode_images(ramp)[0], 2) + 0.0  # minus zero is zero
    return json.dumps([encoder.id, side, made.tolist()])


def feature_key(image: Array, mask: Array | None, mask_source: MaskSource, encoder: str) -> str:
    """Return a digest of all that features of an image depend on; encoder: its `fingerprint`."""
    settings = json.dumps([VERSION, mask_source.key, encoder, image.shape])
    key = hashlib.sha256(settings.encode() + np.ascontiguousarray(image).tobytes()).hexdigest()[:16]
    return key if mask is None else key + hashlib.sha256(np.packbits(mask).tobytes()).hexdigest()[:12]


def describe_capture(
    images: Sequence[Array],
    names: Sequence[str],
    mask_source: MaskSource,
    encoder: Encoder | None,
    store: FeatureStore,
    progress: Progress = silent,
    counted: Sequence[Array | None] = (),
) -> OnDemand[ImageFeatures]:
    """Return the masks and CLIP vectors of all photographs; those that `store` has are not computed again.

    Without an encoder vectors have length 0. images: (H, W, 3) uint8 each; names: unique, one per image;
    counted: (H, W) bool each, outside of which no mask is kept (None: everywhere). Finished photographs stay
    in the store if `progress` interrupts the work; each is independent of the others.
    """
    made_by = "none" if encoder is None else fingerprint(encoder)

    def keep(finish: Callable[[], LevelMasks], index: int, mask: Array | None, key: str) -> None:
        labels = within(label_maps(finish()), mask)
        if encoder is None:
            vectors = np.zeros((int(labels.max()) + 1, 0), np.float32)
        else:
            vectors = embed_regions(images[index], labels, encoder)
        store.save(names[index], ImageFeatures(labels, vectors), key)

    with ThreadPoolExecutor(1) as worker:  # filters, crops and writes one while the next is segmented
        before: Future[None] | None = None
        for index, (image, name) in enumerate(zip(images, names, strict=True)):
            part = progress.part(index, len(images), STAGE, name)
            part(STAGE, 0.0)
            mask = counted[index] if counted else None
            key = feature_key(image, mask, mask_source, made_by)
            if not store.has(name, key):
                finish = mask_source.begin(image, part)
                if before is not None:  # one photograph's full-size masks at a time
                    before.result()
                before = worker.submit(keep, finish, index, mask, key)
        if before is not None:
            before.result()
    progress(STAGE, 1.0)
    return store.of(names)
