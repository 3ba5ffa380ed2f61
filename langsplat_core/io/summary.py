"""Summary of a scene in numbers: the health of its rows and where its bytes go."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.config import INRIA
from langsplat_core.io import cameras, sidecar
from langsplat_core.io.scenes import companion_path
from langsplat_core.io.sog import LOD_NAME, META_NAME
from langsplat_core.scene import LEVELS, SH_COUNTS, Gaussians, LanguageField, Scene

NEEDLE = 1e3  # longest over shortest axis from which a Gaussian counts as extremely stretched
OPACITY_EDGES = (0.0, INRIA.alpha_min, 0.1, 0.5, 0.9, 1.0)


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
    """Counts are of rows; shares are of valid rows, in [0, 1]."""

    gaussians: int
    invalid: Mapping[str, int]  # reason -> rows, each under its first
    invalid_rows: int
    duplicates: int  # valid rows that repeat another in every number
    needles: int  # valid rows stretched by more than `NEEDLE`
    # median, 99 % quantile and largest ratio of the longest axis to the shortest; None: a flat axis, infinite
    anisotropy: tuple[float | None, ...]
    opacity_shares: tuple[float, ...]  # between successive `OPACITY_EDGES`; the first can never be drawn
    bounds: tuple[tuple[float, ...], tuple[float, ...]]  # 1 % and 99 % quantiles of the means, world units
    sh_degree: int
    sh_energy: tuple[float, ...]  # per degree: share of the squared coefficients, of 1
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
    drawn = gaussians.take(valid)
    ratios = axis_ratios(drawn)
    quantiles = np.quantile(ratios, [0.5, 0.99, 1.0], method="lower") if len(drawn) else np.ones(3)
    corners = np.quantile(drawn.means, [0.01, 0.99], axis=0) if len(drawn) else np.zeros((2, 3))
    low, high = corners.astype(float).tolist()
    return SceneSummary(
        gaussians=len(gaussians),
        invalid=gaussians.invalid_rows(),
        invalid_rows=int((~valid).sum()),
        duplicates=duplicates(drawn),
        needles=int((ratios > NEEDLE).sum()),
        anisotropy=tuple(float(q) if np.isfinite(q) else None for q in quantiles),
        opacity_shares=_opacity_shares(drawn),
        bounds=(tuple(low), tuple(high)),
        sh_degree=gaussians.sh_degree,
        sh_energy=_sh_energy(drawn),
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
    arrays += list(scene.extras.values())
    if scene.language is not None:
        arrays += _arrays(scene.language)
    return sum(array.nbytes for array in arrays)


def disk_bytes(scene: Path) -> int:
    """Return the size of a scene file, or of a folder's files, with the companions beside it."""
    path = scene.parent if scene.name in (META_NAME, LOD_NAME) else scene
    own = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    companions = [companion_path(scene, suffix) for suffix in (sidecar.SUFFIX, cameras.SUFFIX)]
    return sum(file.stat().st_size for file in [*own, *companions] if file.is_file())


def duplicates(gaussians: Gaussians) -> int:
    """Return the number of rows that could go because an earlier one equals them bit for bit."""
    if len(gaussians) == 0:
        return 0
    columns = [getattr(gaussians, field.name).reshape(len(gaussians), -1) for field in fields(gaussians)]
    rows = np.ascontiguousarray(np.concatenate(columns, axis=1))
    keys = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1])))
    return len(rows) - len(np.unique(keys))


def axis_ratios(gaussians: Gaussians) -> Array:
    """Return (N,) float64 >= 1: longest over shortest axis; infinite where one is flat and another not."""
    log_scales = gaussians.log_scales.astype(np.float64)
    longest, shortest = log_scales.max(1, initial=-np.inf), log_scales.min(1, initial=np.inf)
    point = np.isneginf(longest)  # flat in every direction
    with np.errstate(over="ignore"):
        return np.exp(np.where(point, 0, longest) - np.where(point, 0, shortest))


def _opacity_shares(gaussians: Gaussians) -> tuple[float, ...]:
    opacities = sigmoid(gaussians.opacity_logits.astype(np.float64))
    counts, _ = np.histogram(opacities, OPACITY_EDGES)
    return tuple((counts / max(len(gaussians), 1)).tolist())


def _sh_energy(gaussians: Gaussians) -> tuple[float, ...]:
    """Return the share of each degree in the squared coefficients.

    The basis is orthonormal: squares are energy over the sphere of directions. The base colour counts with
    its offset of 0.5, else a grey scene would seem all highlights.
    """
    squares = gaussians.sh.astype(np.float64) ** 2
    squares[:, 0] = (gaussians.sh[:, 0].astype(np.float64) + 0.5 * np.sqrt(4 * np.pi)) ** 2
    per_coefficient = squares.sum((0, 2))
    total = per_coefficient.sum() or 1.0
    edges = [0, *(SH_COUNTS[degree] for degree in range(gaussians.sh_degree + 1))]
    return tuple(float(per_coefficient[a:b].sum() / total) for a, b in pairwise(edges))


def _arrays(field: LanguageField) -> list[Array]:
    """Arrays with a row for each Gaussian."""
    leaves = () if field.tree is None else (field.tree.leaves,)
    return [field.latents, field.confidence, *leaves]


def _language(field: LanguageField) -> LanguageSummary:
    observed = {
        name: float((confidence > 0).mean()) if len(field) else 0.0
        for name, confidence in zip(LEVELS, field.confidence, strict=True)
    }
    return LanguageSummary(
        codec=field.codec.kind,
        size=field.codec.size,
        encoder=field.encoder_id,
        vector_dim=field.codec.vector_dim,
        phrases=len(field.phrasebook),
        taught=tuple(word.name for word in field.taught),
        observed=observed,
        nodes=None
        if field.tree is None
        else tuple(int((field.tree.levels == level).sum()) for level in range(3)),
        calibrated=field.calibration is not None,
        bytes=sum(array.nbytes for array in _arrays(field)),
    )
