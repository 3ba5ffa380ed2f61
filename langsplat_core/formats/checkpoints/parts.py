"""One file of what people give to an import, recognised by what it holds, never by its name or length.

A `Carrier` has Gaussians, meanings of one level, or both. What a method keeps beside its checkpoints, an
autoencoder, a quantiser or the vectors of clusters, is of no use alone.
"""

import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.formats.checkpoints.autoencoder_weights import autoencoder_from, is_autoencoder
from langsplat_core.formats.checkpoints.gaussian_tuple import GEOMETRY, gaussians_of, model_tuple
from langsplat_core.formats.checkpoints.meanings import Leaves, SparseCodes, Vectors
from langsplat_core.formats.checkpoints.quantisers import checked_centroids, is_centroids, read_faiss
from langsplat_core.formats.checkpoints.unpickling import load_torch, plain_array, plain_mapping
from langsplat_core.formats.ply import read_ply_scene
from langsplat_core.parsing.npy import MAGIC as NPY
from langsplat_core.parsing.npy import read_npy, read_npz
from langsplat_core.parsing.opening import open_for_reading
from langsplat_core.scene import AutoencoderCodec, Gaussians

PLAIN, UNNAMED = "3D Gaussian Splatting", "LangSplat or Occam's LGS"
LANGSPLAT, OCCAM, V2 = "LangSplat", "Occam's LGS", "LangSplatV2"
DR_SPLAT, FEATURE_3DGS, OPEN_GAUSSIAN = "Dr. Splat", "Feature-3DGS", "OpenGaussian"
FVDB, FVDB_MAGIC = "fVDB's LangSplatV2", "LangSplatV2Checkpoint"
INSTANCE = 6  # numbers per Gaussian that OpenGaussian tells instances by, twice; they mean nothing alone
PICKLE = b"\x80"  # how files of torch began before they were archives
SEMANTIC = re.compile(r"semantic_\d+")


@dataclass(frozen=True, eq=False)
class Carrier:
    """A checkpoint or PLY."""

    path: Path
    method: str
    gaussians: Gaussians | None = None  # None where a method keeps them in another file
    meaning: Vectors | SparseCodes | None = None
    codes: Array | None = None  # (N, M) uint8 of Dr. Splat: they need a quantiser
    level: int | None = None  # as the file says: 0 default, 1 subpart, 2 part, 3 whole
    extras: Mapping[str, Array] = field(default_factory=dict)  # of a PLY, as `Scene.extras`
    antialiased: bool = False

    @property
    def tells(self) -> bool:
        """Whether there is more in it than Gaussians."""
        return self.method != PLAIN


@dataclass(frozen=True, eq=False)
class Centroids:
    """A product quantiser."""

    path: Path
    values: Array  # (M, 256, D / M) float32


@dataclass(frozen=True, eq=False)
class Clusters:
    """OpenGaussian's `cluster_lang.npz`."""

    path: Path
    leaves: Leaves


@dataclass(frozen=True, eq=False)
class Autoencoder:
    """LangSplat's `best_ckpt.pth`."""

    path: Path
    codec: AutoencoderCodec


Part = Carrier | Centroids | Clusters | Autoencoder


def read_part(path: Path) -> Part:
    """What `path` holds. Raises InputError where it cannot be opened, FormatError where it is nothing known
    or damaged."""
    file, _ = open_for_reading(path)
    with file:
        start = file.read(8)
    if start.startswith((b"ply\n", b"ply\r")):
        return _from_ply(path)
    if start.startswith(NPY):
        return _centroids({"": read_npy(path)}, path)
    if start.startswith((b"Ix", b"Iw")):  # as all kinds of faiss's indexes do
        return Centroids(path, read_faiss(path))
    if start.startswith(b"PK") and _is_npz(path):
        return _from_npz(read_npz(path), path)
    if not start.startswith((b"PK", PICKLE)):
        raise FormatError(f"{path}: neither a PLY nor a file of torch, NumPy or faiss; name checkpoints")
    return _from_torch(load_torch(path), path)


def _is_npz(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return all(name.endswith(".npy") for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, ValueError):
        return False


def _from_ply(path: Path) -> Carrier:
    scene = read_ply_scene(path)
    names = [name for name in scene.extras if SEMANTIC.fullmatch(name)]
    rest = {name: values for name, values in scene.extras.items() if name not in names}
    if not names:
        return Carrier(path, PLAIN, scene.gaussians, extras=rest, antialiased=scene.antialiased)
    ordered = [f"semantic_{index}" for index in range(len(names))]
    if set(ordered) != set(names):
        raise FormatError(f"{path}: {len(names)} properties semantic_*, not counted from 0 without gaps")
    vectors = np.stack([scene.extras[name].astype(np.float32) for name in ordered], axis=1)
    return Carrier(path, FEATURE_3DGS, scene.gaussians, Vectors(vectors), None, None, rest, scene.antialiased)


def _from_npz(arrays: dict[str, Array], path: Path) -> Part:
    if {"leaf_feat", "leaf_ind"} <= set(arrays):
        return Clusters(path, _leaves(arrays, path))
    return _centroids(arrays, path)


def _leaves(arrays: dict[str, Array], path: Path) -> Leaves:
    vectors, index = arrays["leaf_feat"], arrays["leaf_ind"]
    if vectors.ndim != 2 or vectors.dtype.kind != "f" or index.ndim != 1 or index.dtype.kind not in "iu":
        raise FormatError(
            f"{path}: leaf_feat {vectors.dtype} {vectors.shape}, leaf_ind {index.dtype} {index.shape}; "
            "expected floats (K, D) and whole numbers (N,)"
        )
    counts = arrays.get("occu_count", np.ones(len(vectors)))
    if counts.shape != (len(vectors),):
        raise FormatError(f"{path}: occu_count has the shape {counts.shape}, leaf_feat {vectors.shape}")
    return Leaves(index.astype(np.int64), np.where(counts[:, None] > 0, vectors, 0).astype(np.float32))


def _centroids(arrays: dict[str, Array], path: Path) -> Centroids:
    found = [array for array in arrays.values() if is_centroids(array)]
    if len(found) != 1:
        shapes = ", ".join(str(array.shape) for array in list(arrays.values())[:6])
        raise FormatError(
            f"{path}: holds arrays {shapes or 'of no kind'}; expected leaf_feat and leaf_ind of "
            "OpenGaussian, or the (M, 256, D / M) centroids of Dr. Splat's quantiser"
        )
    return Centroids(path, checked_centroids(found[0], path))


def _from_torch(content: Any, path: Path) -> Part:
    elements = model_tuple(content)
    if elements is not None:
        return _from_tuple(elements, path)
    mapping = plain_mapping(content)
    named = {"": content} if mapping is None else mapping
    if named.get("magic") == FVDB_MAGIC:
        return _from_fvdb(named, path)
    if is_autoencoder(named):
        return Autoencoder(path, autoencoder_from(named, path))
    arrays = {str(name): plain_array(value, path) for name, value in named.items()}
    found = {name: array for name, array in arrays.items() if array is not None}
    if any(is_centroids(array) for array in found.values()):
        return _centroids(found, path)
    if any(array.ndim == 4 for array in found.values()):
        raise FormatError(
            f"{path}: a convolutional decoder, as of Feature-3DGS with its speed-up; it decodes pictures, "
            "not Gaussians, so that such features cannot be imported; train without the speed-up"
        )
    raise FormatError(f"{path}: a torch file, but not a checkpoint or autoencoder of a known method")


def _from_tuple(elements: tuple[Any, ...], path: Path) -> Carrier:
    gaussians = gaussians_of(elements, path)
    method, meaning, codes = _language(elements, len(gaussians), path)
    return Carrier(path, method, gaussians, meaning, codes)


def _language(
    elements: tuple[Any, ...], count: int, path: Path
) -> tuple[str, Vectors | SparseCodes | None, Array | None]:
    """Method, meaning and codes of what follows the geometry."""
    first = plain_array(elements[GEOMETRY], path)
    second = plain_array(elements[GEOMETRY + 1], path) if len(elements) > GEOMETRY + 1 else None
    if first is None or first.ndim != 2:  # (N,) radii of plain 3D Gaussian Splatting
        late = [plain_array(element, path) for element in elements[GEOMETRY + 1 :]]
        wide = [flat for array in late if (flat := _wide(array, count)) is not None]
        return (FEATURE_3DGS, Vectors(wide[0]), None) if wide else (PLAIN, None, None)
    if len(first) != count:
        raise FormatError(f"{path}: features {first.shape} for {count} Gaussians")
    if first.dtype == np.uint8:
        return DR_SPLAT, None, first
    if first.dtype.kind != "f":
        raise FormatError(
            f"{path}: features of the type {first.dtype}; expected floats, or bytes of a quantiser"
        )
    if second is not None and second.ndim == 3:
        return V2, _sparse(first, second, 4, path), None
    if second is not None and first.shape == second.shape == (count, INSTANCE):
        return OPEN_GAUSSIAN, None, None
    return UNNAMED, Vectors(first), None


def _wide(array: Array | None, count: int) -> Array | None:
    """(N, D), (N, 1, D) or (N, D, 1) floats as (N, D) where D > 1; None for anything else."""
    if array is None or array.dtype.kind != "f" or array.ndim not in (2, 3) or len(array) != count:
        return None
    flat = array.reshape(count, -1) if 1 in array.shape[1:] or array.ndim == 2 else array
    return flat if flat.ndim == 2 and flat.shape[1] > 1 else None


def _sparse(logits: Array, codewords: Array, topk: int, path: Path) -> SparseCodes:
    layers, size, _ = codewords.shape
    if logits.ndim != 2 or logits.shape[1] != layers * size or not np.isfinite(codewords).all():
        raise FormatError(
            f"{path}: logits {logits.shape} for codewords {codewords.shape}; expected (N, L K) and finite "
            "(L, K, D)"
        )
    return SparseCodes(logits, np.asarray(codewords, np.float32), topk)


def _from_fvdb(content: Mapping[str, Any], path: Path) -> Carrier:
    config = _mapping(content, "config")
    model = _mapping(content, "model")
    state = _mapping(model, "model_state") or model
    arrays = [array for value in state.values() if (array := plain_array(value, path)) is not None]
    codewords = [array for array in arrays if array.ndim == 3 and array.dtype.kind == "f"]
    wanted = {array.shape[0] * array.shape[1] for array in codewords}
    logits = [array for array in arrays if array.ndim == 2 and array.shape[1] in wanted]
    if len(codewords) != 1 or len(logits) != 1:
        raise FormatError(
            f"{path}: {len(logits)} tensors of logits and {len(codewords)} of codewords; expected one of "
            "each, (N, L K) and (L, K, D)"
        )
    topk = _mapping(config, "model").get("topk", 4)
    level = config.get("feature_level")
    if not isinstance(topk, int) or topk < 1:
        raise FormatError(f"{path}: config.model.topk is not a whole number, 1 or more")
    meaning = _sparse(logits[0], codewords[0], topk, path)
    return Carrier(path, FVDB, None, meaning, None, level if isinstance(level, int) else None)


def _mapping(content: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    return plain_mapping(content.get(name)) or {}
