"""Scenes and features as other methods' tools read them."""

from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import InputError
from langsplat_core.extensions.checkpoints.langsplat_files import (
    read_features,
    write_autoencoder,
    write_checkpoint,
    write_features,
)
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS, AutoencoderCodec, LanguageField, Scene
from langsplat_core.semantics.store import SUFFIX, FeatureStore, ImageFeatures

LANGSPLAT_LATENT = 3  # numbers per Gaussian that its rasterizer is compiled for
SHORTEST_VECTOR = 17  # numbers; shorter "vectors" are latents of an autoencoder, which mean nothing alone
BLOCK = 16_384  # Gaussians decoded at a time
VECTORS_ENDING = "_f.npy"


def export_langsplat(scene: Scene, folder: Path, name: str) -> list[Path]:
    """`NAME_{1,2,3}/chkpnt30000.pth` with latents and `best_ckpt.pth` in `folder`; returns what was written.

    Raises InputError for a scene whose codec is not an autoencoder of 3 numbers.
    """
    language = _language(scene)
    codec = language.codec
    if not isinstance(codec, AutoencoderCodec) or codec.latent_dim != LANGSPLAT_LATENT:
        raise InputError(
            f"{scene.path}: its codec, {codec.kind} of {codec.size}, is not "
            "LangSplat's autoencoder of 3 numbers; write vectors by --to occam, or train with "
            "--codec.kind autoencoder"
        )
    latents = np.where(language.known[..., None], language.latents, np.float32(0))
    written = [folder / f"{name}_{level + 1}" / "chkpnt30000.pth" for level in range(len(LEVELS))]
    for level, path in enumerate(written):
        write_checkpoint(path, scene.gaussians, latents[level])
    write_autoencoder(folder / "best_ckpt.pth", codec.encoder, codec.decoder)
    return [*written, folder / "best_ckpt.pth"]


def export_occam(scene: Scene, folder: Path, progress: Progress = silent) -> list[Path]:
    """`chkpnt30000_langfeat_{1,2,3}.pth` with (N, D) unit vectors, zero for no meaning, in `folder`.

    Returns what was written. One level is held in memory at a time: 5 GB for 2.5 million Gaussians.
    """
    language = _language(scene)
    written = []
    for level in range(len(LEVELS)):
        path = folder / f"chkpnt30000_langfeat_{level + 1}.pth"
        progress("decoding", level / len(LEVELS))
        write_checkpoint(path, scene.gaussians, _vectors(language, level))
        written.append(path)
    progress("decoding", 1.0)
    return written


def _language(scene: Scene) -> LanguageField:
    if scene.language is None:
        raise InputError(f"{scene.path}: has no language field to write; 'langsplat train' makes one")
    return scene.language


def _vectors(language: LanguageField, level: int) -> Array:
    """(N, D) float32 unit vectors of one level, zero for no meaning."""
    vectors = np.zeros((len(language), language.codec.vector_dim), np.float32)
    known = np.flatnonzero(language.known[level])
    for start in range(0, len(known), BLOCK):
        rows = known[start : start + BLOCK]
        vectors[rows] = language.codec.decode(language.latents[level, rows])
    return vectors


def features_to_langsplat(store: FeatureStore, folder: Path, progress: Progress = silent) -> int:
    """`<photograph>_s.npy` and `_f.npy` in `folder` of every photograph in `store`; returns how many.

    LangSplat cuts a photograph's name at its first dot. Its map of default masks is left empty: no level
    is trained from it. Raises InputError where there are none, or two would have one name.
    """
    names = store.names()
    stems = {name.split(".")[0]: name for name in names}
    if not names or len(stems) < len(names):
        problem = "two photographs have one name up to its first dot" if names else f"holds no *{SUFFIX}"
        raise InputError(f"{store.folder}: {problem}; give the folder 'features' of a training's work folder")
    for done, (stem, name) in enumerate(stems.items()):
        features = store.load(name)
        default = np.full((1, *features.labels.shape[1:]), -1, np.int32)
        write_features(folder, stem, features.vectors, np.concatenate([default, features.labels]))
        progress("writing features", (done + 1) / len(stems))
    return len(stems)


def features_from_langsplat(folder: Path, store: FeatureStore, progress: Progress = silent) -> int:
    """Store every photograph's `_s.npy` and `_f.npy` in `folder` under its stem; return how many.

    Raises InputError where there are none, or latents in place of vectors.
    """
    stems = langsplat_stems(folder)
    if not stems:
        raise InputError(f"{folder}: holds no *{VECTORS_ENDING}; give LangSplat's folder language_features")
    for done, stem in enumerate(stems):
        vectors, maps = read_features(folder, stem)
        if len(vectors) and vectors.shape[1] < SHORTEST_VECTOR:
            raise InputError(
                f"{folder / (stem + VECTORS_ENDING)}: {vectors.shape[1]} numbers per mask, latents of an "
                "autoencoder; give the folder language_features"
            )
        store.save(stem, _of_levels(vectors, maps[1:]))
        progress("reading features", (done + 1) / len(stems))
    return len(stems)


def langsplat_stems(folder: Path) -> list[str]:
    """Names of the photographs whose vectors lie in `folder`, sorted."""
    return sorted(path.name.removesuffix(VECTORS_ENDING) for path in folder.glob(f"*{VECTORS_ENDING}"))


def _of_levels(vectors: Array, labels: Array) -> ImageFeatures:
    """Return the features of (3, H, W) labels, without vectors that only default masks name."""
    used, compact = np.unique(labels, return_inverse=True)
    empty = int(used[0] == -1) if len(used) else 0
    rows = compact.reshape(labels.shape).astype(np.int32) - empty
    return ImageFeatures(rows, unit(vectors[used[empty:]]).astype(np.float32))
