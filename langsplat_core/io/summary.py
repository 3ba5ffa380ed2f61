"""Summary of a scene in numbers: the health of its rows and where its bytes go."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.io.scenes import scene_files
from langsplat_core.scene import LEVELS, LanguageField, Scene


@dataclass(frozen=True)
class LanguageSummary:
    """The language field in short."""

    codec: str
    size: int  # codewords of a codebook, numbers per latent of other kinds
    encoder: str
    vector_dim: int
    phrases: int
    taught: tuple[str, ...]  # names of taught words
    observed: Mapping[str, float]  # level -> share of the Gaussians with a meaning
    nodes: tuple[int, ...] | None  # of the tree, at each level; None: the scene keeps no tree
    calibrated: bool  # whether answers come with a probability
    bytes: int  # latents, confidences and leaves of the tree


@dataclass(frozen=True)
class SceneSummary:
    """Counts are of rows."""

    gaussians: int
    invalid: Mapping[str, int]  # reason -> rows, each under its first
    invalid_rows: int
    bounds: tuple[tuple[float, ...], tuple[float, ...]]  # 1 % and 99 % quantiles of the means, in the world
    origin: tuple[float, ...]  # what the means in memory are relative to, in the world
    sh_degree: int
    antialiased: bool
    metres_per_unit: float | None
    extras: tuple[str, ...]
    cameras: int
    memory_bytes: int
    language: LanguageSummary | None


def summarise(scene: Scene) -> SceneSummary:
    """Return every figure of `SceneSummary` for a scene of any size, an empty one included."""
    gaussians = scene.gaussians
    valid = gaussians.valid()
    means = gaussians.means[valid] if valid.any() else np.zeros((1, 3))
    low, high = scene.in_world(np.quantile(means, [0.01, 0.99], axis=0)).tolist()
    return SceneSummary(
        gaussians=len(gaussians),
        invalid=gaussians.invalid_rows(),
        invalid_rows=int((~valid).sum()),
        bounds=(tuple(low), tuple(high)),
        origin=tuple(scene.origin.tolist()),
        sh_degree=gaussians.sh_degree,
        antialiased=scene.antialiased,
        metres_per_unit=scene.metres_per_unit,
        extras=tuple(scene.extras),
        cameras=len(scene.cameras),
        memory_bytes=memory_bytes(scene),
        language=None if scene.language is None else _language(scene.language),
    )


def memory_bytes(scene: Scene) -> int:
    """Return the bytes in memory of the arrays that grow with the number of Gaussians."""
    arrays = [getattr(scene.gaussians, field.name) for field in fields(scene.gaussians)]
    own = sum(array.nbytes for array in (*arrays, *scene.extras.values()))
    return own + (0 if scene.language is None else _bytes(scene.language))


def disk_bytes(scene: Path) -> int:
    """Return the size of a scene file, or of a folder's files, with the companions beside it."""
    return sum(file.stat().st_size for file in scene_files(scene) if file.is_file())


def _bytes(field: LanguageField) -> int:
    leaves: tuple[Array, ...] = () if field.tree is None else (field.tree.leaves,)
    return sum(array.nbytes for array in (field.latents, field.confidence, *leaves))


def _language(field: LanguageField) -> LanguageSummary:
    shares = (field.confidence > 0).mean(axis=1) if len(field) else np.zeros(len(LEVELS))
    levels = range(len(LEVELS))
    return LanguageSummary(
        codec=field.codec.kind,
        size=field.codec.size,
        encoder=field.encoder_id,
        vector_dim=field.codec.vector_dim,
        phrases=len(field.phrasebook),
        taught=tuple(word.name for word in field.taught),
        observed=dict(zip(LEVELS, shares.tolist(), strict=True)),
        nodes=None if field.tree is None else tuple(int((field.tree.levels == n).sum()) for n in levels),
        calibrated=field.calibration is not None,
        bytes=_bytes(field),
    )
