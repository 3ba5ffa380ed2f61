"""A scene of another method, put together from the files that people have of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.cameras import SUFFIX as CAMERAS
from langsplat_core.io.cameras import read_cameras
from langsplat_core.io.foreign_language import (
    DR_SPLAT,
    FEATURE_3DGS,
    FVDB,
    LANGSPLAT,
    OCCAM,
    OPEN_GAUSSIAN,
    PLAIN,
    UNNAMED,
    Autoencoder,
    Carrier,
    Centroids,
    Clusters,
    Leaves,
    Meaning,
    Part,
    ProductCodes,
    Rearranged,
    all_gaussians,
    levels_of,
    partners,
    read_part,
)
from langsplat_core.io.hostile import exists
from langsplat_core.io.langsplat_files import write_autoencoder, write_checkpoint
from langsplat_core.scene import LEVELS, AutoencoderCodec, Scene

WIDEST_LATENT = 16  # numbers per Gaussian up to which they are an autoencoder's; 1, 2, 3 and 8 were published
PRUNED = (OCCAM,)  # methods that remove what no view saw, so that levels keep different Gaussians
ONE_LEVEL = (OPEN_GAUSSIAN, FEATURE_3DGS)  # methods that know no levels
P = TypeVar("P", bound=Part)


@dataclass(frozen=True, eq=False)
class ForeignScene:
    """Gaussians, and what they mean in the method's own numbers."""

    method: str
    scene: Scene  # without a language field
    levels: tuple[Meaning | None, ...] = (None, None, None)  # of subpart, part and whole, each for all N
    paths: tuple[Path | None, ...] = (None, None, None)  # the files that these come from
    codec: AutoencoderCodec | None = None  # that the meanings are latents of; None where they are vectors
    notes: tuple[str, ...] = field(default=())  # what was taken for granted, for people

    @property
    def dim(self) -> int:
        """D, of the vectors; 0 where nothing has a meaning."""
        if self.codec is not None:
            return self.codec.vector_dim
        return next((meaning.dim for meaning in self.levels if meaning is not None), 0)

    def rows(self, level: int, indices: Array) -> Array:
        """(n, D or d) float32 vectors or latents of any length at `level`; zero for no meaning.

        Raises FormatError where one is not finite.
        """
        meaning = self.levels[level]
        if meaning is None:
            raise ValueError(f"no meanings of level {LEVELS[level]}")
        with np.errstate(invalid="ignore", over="ignore"):
            rows = meaning.rows(indices)
        faulty = np.flatnonzero(~np.isfinite(rows).all(1))
        if len(faulty):
            raise FormatError(
                f"{self.paths[level]}: features are not finite, as those of Gaussian {indices[faulty[0]]}; "
                "the training has diverged, take an earlier checkpoint"
            )
        return rows


def read_foreign(paths: Sequence[Path], levels: Sequence[str] = ()) -> ForeignScene:
    """The scene in checkpoints of another method and in what belongs to them, in any order.

    `levels` names those of the checkpoints with features, in their order. Raises InputError where a file
    cannot be opened or one is missing, FormatError where one is damaged, unknown, or of another scene.
    """
    parts = [read_part(path) for path in paths]
    carriers = [part for part in parts if isinstance(part, Carrier)]
    plain = _only([carrier for carrier in carriers if not carrier.tells], "scenes without features")
    clusters = _only([part for part in parts if isinstance(part, Clusters)], "files of clusters")
    centroids = _only([part for part in parts if isinstance(part, Centroids)], "quantisers")
    autoencoder = _only([part for part in parts if isinstance(part, Autoencoder)], "autoencoders")
    tellers = [_named(carrier, autoencoder) for carrier in carriers if carrier.tells]
    methods = {teller.method for teller in tellers}
    if len(methods) > 1:
        listed = ", ".join(f"{teller.path} is of {teller.method}" for teller in tellers)
        raise InputError(f"{listed}; give the files of one method")
    if clusters is not None and methods <= {OPEN_GAUSSIAN}:
        return _of_clusters(_only([*tellers, *([plain] if plain else [])], "scenes"), clusters)
    if not tellers:
        return _without_language(plain, [part for part in parts if part is not plain])
    return _of_levels(plain, tellers, levels, centroids, autoencoder)


def _only(found: list[P], what: str) -> P | None:
    if len(found) > 1:
        raise InputError(f"{found[0].path} and {found[1].path}: two {what}; give those of one scene")
    return found[0] if found else None


def _named(carrier: Carrier, autoencoder: Autoencoder | None) -> Carrier:
    """With the method of float features known: they are latents or vectors."""
    if carrier.method != UNNAMED or carrier.meaning is None:
        return carrier
    width = carrier.meaning.dim
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
    """OpenGaussian: one level, which is taken for the whole."""
    leaves = clusters.leaves
    if carrier is None or carrier.gaussians is None:
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
    tellers: list[Carrier],
    asked: Sequence[str],
    centroids: Centroids | None,
    autoencoder: Autoencoder | None,
) -> ForeignScene:
    method = tellers[0].method
    if len(tellers) > len(LEVELS):
        raise InputError(f"{tellers[-1].path}: a fourth checkpoint with features; there are three levels")
    if method == OPEN_GAUSSIAN:
        raise InputError(
            f"{tellers[0].path}: of OpenGaussian; name its cluster_lang.npz too, it has the meanings"
        )
    numbers, how = _numbers(tellers, asked)
    carrier = _geometry(plain, tellers)
    assert carrier.gaussians is not None
    levels: list[Meaning | None] = [None] * len(LEVELS)
    paths: list[Path | None] = [None] * len(LEVELS)
    pruned = 0
    for number, teller in zip(numbers, tellers, strict=True):
        meaning = _meaning(teller, centroids)
        rows = partners(carrier.gaussians.means, teller, method in PRUNED)
        pruned += rows is not None
        levels[number] = meaning if rows is None else Rearranged(meaning, rows)
        paths[number] = teller.path
    return ForeignScene(
        method,
        _scene(carrier),
        tuple(levels),
        tuple(paths),
        autoencoder.codec if autoencoder is not None and method == LANGSPLAT else None,
        _notes(numbers, tellers, how, pruned),
    )


def _numbers(tellers: list[Carrier], asked: Sequence[str]) -> tuple[list[int], str]:
    """As `levels_of`."""
    method = tellers[0].method
    if method not in ONE_LEVEL or asked:
        return levels_of(tellers, asked)
    _only(tellers, f"scenes of {method}, which knows no levels")
    return [len(LEVELS) - 1], f"{method} knows none, whole is filled"


def _geometry(plain: Carrier | None, tellers: list[Carrier]) -> Carrier:
    """Whose Gaussians the scene has: those without features; else those of the checkpoints."""
    carriers = [plain] if plain else [teller for teller in tellers if teller.gaussians is not None]
    if not carriers:
        raise InputError(f"{tellers[0].path}: of {FVDB}, which keeps no Gaussians; name the scene's PLY too")
    if carriers[0].method not in PRUNED:
        return carriers[0]
    return replace(carriers[0], gaussians=all_gaussians(carriers))


def _meaning(carrier: Carrier, centroids: Centroids | None) -> Meaning:
    if carrier.codes is None:
        assert carrier.meaning is not None  # a carrier that tells has one or the other
        return carrier.meaning
    if centroids is None:
        raise InputError(
            f"{carrier.path}: quantised codes of {DR_SPLAT}; name its pq_index.faiss too, "
            "or the centroids as .npy"
        )
    if carrier.codes.shape[1] != len(centroids.values):
        raise FormatError(
            f"{carrier.path}: {carrier.codes.shape[1]} codes per Gaussian, {centroids.path} has "
            f"{len(centroids.values)} parts; give the quantiser of this scene"
        )
    return ProductCodes(carrier.codes, centroids.values)


def _notes(numbers: list[int], tellers: list[Carrier], how: str, pruned: int) -> tuple[str, ...]:
    named = [f"{LEVELS[number]} from {teller.path}" for number, teller in zip(numbers, tellers, strict=True)]
    notes = [f"levels ({how}): {', '.join(named)}"]
    empty = [name for number, name in enumerate(LEVELS) if number not in numbers]
    if empty:
        notes.append(f"without meanings: {', '.join(empty)}")
    if pruned:
        notes.append(f"{pruned} of the checkpoints lack some Gaussians, which mean nothing at their levels")
    return tuple(notes)


def _scene(carrier: Carrier) -> Scene:
    """Its Gaussians, and the cameras that 3D Gaussian Splatting puts into the model's folder."""
    assert carrier.gaussians is not None
    folder = carrier.path.resolve().parent
    model = folder.parent.parent if carrier.path.name == "point_cloud.ply" else folder
    cameras = [path for path in (carrier.path.with_suffix(CAMERAS), model / "cameras.json") if exists(path)]
    return Scene(
        carrier.gaussians,
        cameras=read_cameras(cameras[0]) if cameras else (),
        antialiased=carrier.antialiased,
        extras=carrier.extras,
    )


# Checkpoints of other methods: read as plain data, and written where another method's tools are to go on.
#
# Nothing in a file is ever executed, and what a file is tells what it holds. See docs/files.md for what to
# give of each method and what becomes of it.

__all__ = ["ForeignScene", "Leaves", "read_foreign", "write_autoencoder", "write_checkpoint"]
