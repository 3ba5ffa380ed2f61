"""A scene of another method, put together from the files that people have of it.

Nothing in a file is ever executed, and what a file is tells what it holds. docs/files.md says what to give of
each method and what becomes of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.extensions.checkpoints.features import (
    FEATURE_3DGS,
    LANGSPLAT,
    OCCAM,
    OPEN_GAUSSIAN,
    PLAIN,
    UNNAMED,
    Autoencoder,
    Carrier,
    Clusters,
    Features,
    Part,
    Rearranged,
    all_gaussians,
    levels_of,
    partners,
    read_part,
)
from langsplat_core.io.cameras import SUFFIX as CAMERAS
from langsplat_core.io.cameras import read_cameras
from langsplat_core.io.hostile import exists
from langsplat_core.io.scenes import warn_of_undrawable
from langsplat_core.scene import LEVELS, AutoencoderCodec, Scene

WIDEST_LATENT = 16  # numbers per Gaussian up to which they are an autoencoder's; 1, 2, 3 and 8 were published
PRUNED = (OCCAM,)  # methods that remove what no view saw, so that levels keep different Gaussians
ONE_LEVEL = (OPEN_GAUSSIAN, FEATURE_3DGS)  # methods that know no levels
LARGEST = 1e15  # feature; its square still fits float32
P = TypeVar("P", bound=Part)


@dataclass(frozen=True, eq=False)
class ForeignScene:
    """Gaussians of another method, with its own language features."""

    method: str
    scene: Scene  # without a language field
    levels: tuple[Features | None, ...] = (None, None, None)  # of subpart, part and whole, each for all N
    paths: tuple[Path | None, ...] = (None, None, None)  # the files that these come from
    codec: AutoencoderCodec | None = None  # that the features are latents of; None where they are vectors
    notes: tuple[str, ...] = ()  # what was taken for granted, for people

    @property
    def dim(self) -> int:
        """Length D of the vectors; 0 where there are no features."""
        if self.codec is not None:
            return self.codec.vector_dim
        return next((features.dim for features in self.levels if features is not None), 0)

    def rows(self, level: int, indices: Array) -> Array:
        """(n, D or d) float32 vectors or latents of any length at `level`; zero for no features.

        Raises FormatError where one is not finite, or its square would not be.
        """
        features = self.levels[level]
        if features is None:
            raise ValueError(f"no features of level {LEVELS[level]}")
        with np.errstate(invalid="ignore", over="ignore"):
            rows = features.rows(indices)
        faulty = np.flatnonzero(~(np.abs(rows) <= LARGEST).all(1))
        if len(faulty):
            raise FormatError(
                f"{self.paths[level]}: features are not finite, or huge, as those of Gaussian "
                f"{indices[faulty[0]]}; the training has diverged, take an earlier checkpoint"
            )
        return rows


def read_foreign(paths: Sequence[Path], levels: Sequence[str] = ()) -> ForeignScene:
    """Return the scene in checkpoints of another method and in what belongs to them, in any order.

    `levels` names those of the checkpoints with features, in their order. Raises InputError where a file
    cannot be opened or one is missing, FormatError where one is damaged, unknown, or of another scene.
    """
    parts = [read_part(path) for path in paths]
    carriers = [part for part in parts if isinstance(part, Carrier)]
    plain = _only([carrier for carrier in carriers if not carrier.has_features], "scenes without features")
    clusters = _only([part for part in parts if isinstance(part, Clusters)], "files of clusters")
    autoencoder = _only([part for part in parts if isinstance(part, Autoencoder)], "autoencoders")
    featured = [_named(carrier, autoencoder) for carrier in carriers if carrier.has_features]
    methods = {carrier.method for carrier in featured}
    if len(methods) > 1:
        listed = ", ".join(f"{carrier.path} is of {carrier.method}" for carrier in featured)
        raise InputError(f"{listed}; give the files of one method")
    if clusters is not None and methods <= {OPEN_GAUSSIAN}:
        return _of_clusters(_only([*featured, *([plain] if plain else [])], "scenes"), clusters)
    if not featured:
        return _without_language(plain, [part for part in parts if part is not plain])
    return _of_levels(plain, featured, levels, autoencoder)


def _only(found: list[P], what: str) -> P | None:
    if len(found) > 1:
        raise InputError(f"{found[0].path} and {found[1].path}: two {what}; give those of one scene")
    return found[0] if found else None


def _named(carrier: Carrier, autoencoder: Autoencoder | None) -> Carrier:
    """Return the carrier with the method of its float features: they are latents or vectors."""
    if carrier.method != UNNAMED or carrier.features is None:
        return carrier
    width = carrier.features.dim
    if autoencoder is None and width <= WIDEST_LATENT:
        raise InputError(
            f"{carrier.path}: {width} numbers per Gaussian, latents of LangSplat's autoencoder; "
            "name its best_ckpt.pth too"
        )
    if autoencoder is None or width == autoencoder.codec.vector_dim:
        return replace(carrier, method=OCCAM)
    if width != autoencoder.codec.latent_dim:
        raise FormatError(
            f"{carrier.path}: {width} numbers per Gaussian, but {autoencoder.path} makes "
            f"{autoencoder.codec.latent_dim}; give the autoencoder of this scene"
        )
    return replace(carrier, method=LANGSPLAT)


def _without_language(plain: Carrier | None, others: list[Part]) -> ForeignScene:
    if others or plain is None:
        lone = others[0].path if others else None
        raise InputError(f"{lone}: belongs to checkpoints with features, and none is given; name them too")
    return ForeignScene(PLAIN, _scene(plain), notes=("no language field in it",))


def _of_clusters(carrier: Carrier | None, clusters: Clusters) -> ForeignScene:
    """OpenGaussian's scene, whose one level is taken for the whole."""
    leaves = clusters.leaves
    if carrier is None:
        raise InputError(f"{clusters.path}: has no Gaussians; name the scene's checkpoint or PLY too")
    if len(leaves) != len(carrier.gaussians):
        raise FormatError(
            f"{clusters.path}: clusters of {len(leaves)} Gaussians, "
            f"{carrier.path} has {len(carrier.gaussians)}"
        )
    if not ((leaves.index >= 0) & (leaves.index < len(leaves.vectors))).any():
        raise FormatError(f"{clusters.path}: leaf_ind names none of the {len(leaves.vectors)} clusters")
    note = "OpenGaussian knows no levels: whole is filled, subpart and part are empty"
    return ForeignScene(
        OPEN_GAUSSIAN, _scene(carrier), (None, None, leaves), (None, None, clusters.path), notes=(note,)
    )


def _of_levels(
    plain: Carrier | None,
    featured: list[Carrier],
    asked: Sequence[str],
    autoencoder: Autoencoder | None,
) -> ForeignScene:
    method = featured[0].method
    if len(featured) > len(LEVELS):
        raise InputError(f"{featured[-1].path}: a fourth checkpoint with features; there are three levels")
    if method == OPEN_GAUSSIAN:
        raise InputError(
            f"{featured[0].path}: of OpenGaussian; its features are in cluster_lang.npz, name it too"
        )
    numbers, how = _numbers(featured, asked)
    base = _geometry(plain, featured)
    levels: list[Features | None] = [None] * len(LEVELS)
    paths: list[Path | None] = [None] * len(LEVELS)
    pruned = 0
    for number, carrier in zip(numbers, featured, strict=True):
        features = carrier.features
        assert features is not None
        rows = partners(base.gaussians.means, carrier, method in PRUNED)
        pruned += rows is not None
        levels[number] = features if rows is None else Rearranged(features, rows)
        paths[number] = carrier.path
    return ForeignScene(
        method,
        _scene(base),
        tuple(levels),
        tuple(paths),
        autoencoder.codec if autoencoder is not None and method == LANGSPLAT else None,
        _notes(numbers, featured, how, pruned),
    )


def _numbers(featured: list[Carrier], asked: Sequence[str]) -> tuple[list[int], str]:
    """Return the level of each checkpoint, and by what it was told, as `levels_of` does."""
    method = featured[0].method
    if method not in ONE_LEVEL or asked:
        return levels_of(featured, asked)
    _only(featured, f"scenes of {method}, which knows no levels")
    return [len(LEVELS) - 1], f"{method} knows none, whole is filled"


def _geometry(plain: Carrier | None, featured: list[Carrier]) -> Carrier:
    """Return the carrier of the scene's Gaussians: the one without features, else the first checkpoint."""
    carriers = [plain] if plain else featured
    if carriers[0].method not in PRUNED:
        return carriers[0]
    return replace(carriers[0], gaussians=all_gaussians(carriers))


def _notes(numbers: list[int], featured: list[Carrier], how: str, pruned: int) -> tuple[str, ...]:
    named = [
        f"{LEVELS[number]} from {carrier.path}" for number, carrier in zip(numbers, featured, strict=True)
    ]
    notes = [f"levels ({how}): {', '.join(named)}"]
    empty = [name for number, name in enumerate(LEVELS) if number not in numbers]
    if empty:
        notes.append(f"without features: {', '.join(empty)}")
    if pruned:
        notes.append(
            f"{pruned} of the checkpoints lack some Gaussians, which have no features at their levels"
        )
    return tuple(notes)


def _scene(carrier: Carrier) -> Scene:
    """Return the carrier's Gaussians, with the cameras in the model's folder."""
    warn_of_undrawable(carrier.path, carrier.gaussians)
    folder = carrier.path.resolve().parent
    model = folder.parent.parent if carrier.path.name == "point_cloud.ply" else folder
    cameras = [path for path in (carrier.path.with_suffix(CAMERAS), model / "cameras.json") if exists(path)]
    return Scene(
        carrier.gaussians,
        cameras=read_cameras(cameras[0]) if cameras else (),
        antialiased=carrier.antialiased,
        extras=carrier.extras,
    )
