"""Import of scenes of other methods from their files.

Nothing in a file is executed, and files are recognised by their content. docs/files.md lists the files of
each method and what is imported. Latents of LangSplat's autoencoder are kept with it. CLIP vectors are
encoded by a codec fitted to a sample of them, by default a codebook; vectors of clusters are a codebook
already. Vectors are read a block of Gaussians at a time, as all of them may exceed the memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os.path import exists
from pathlib import Path
from typing import TypeVar

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.config import CodecConfig, check_settings
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
    all_gaussians,
    levels_of,
    partners,
    read_part,
    rearranged,
    whole_vectors,
)
from langsplat_core.io.cameras import SUFFIX as CAMERAS
from langsplat_core.io.cameras import read_cameras
from langsplat_core.io.scenes import warn_of_undrawable
from langsplat_core.pipeline.language_field import field_of
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS, AutoencoderCodec, Codec, Scene, about_origin
from langsplat_core.scene.codec import MOST_CODEWORDS, SHORTEST
from langsplat_core.semantics.encoders import OPEN_MODEL, load_text_encoder
from langsplat_core.training.language.codec_fit import (
    CodecReport,
    Vocabulary,
    codebook_of,
    codec_report,
    everyday_vocabulary,
    fit_codec,
)

WIDEST_LATENT = 16  # numbers per Gaussian up to which they are an autoencoder's; 1, 2, 3 and 8 were published
ONE_LEVEL = (OPEN_GAUSSIAN, FEATURE_3DGS)  # methods without levels
HUGE = 1e15  # largest feature, whose square fits float32
FITTED, JUDGED = 12_000, 2_000  # Gaussians of each level that a codec is fitted to, and judged on
BLOCK = 16_384  # Gaussians read at a time: 32 MB at 512 float32 numbers
P = TypeVar("P", bound=Part)


@dataclass(frozen=True, eq=False)
class ForeignScene:
    """Gaussians of another method, with its own language features."""

    method: str
    scene: Scene  # without a language field
    levels: tuple[Features | None, ...] = (None, None, None)  # of subpart, part and whole, each for all N
    codec: AutoencoderCodec | None = None  # if the features are its latents; None: they are vectors
    clusters: Clusters | None = None  # if the features are vectors of clusters
    notes: tuple[str, ...] = ()  # assumptions, for the user

    @property
    def told(self) -> dict[int, Features]:
        """The features by level, without empty levels."""
        return {level: features for level, features in enumerate(self.levels) if features is not None}

    @property
    def dim(self) -> int:
        """Length D of the vectors; 0 without features."""
        if self.codec is not None:
            return self.codec.vector_dim
        return next((features.dim for features in self.told.values()), 0)

    @property
    def first_path(self) -> Path:
        """The file of the first features, for messages."""
        return next(features.path for features in self.told.values())

    def rows(self, level: int, indices: Array) -> Array:
        """Return (n, D or d) float32 features at `level`, zero for none; FormatError if infinite or huge."""
        features = self.told[level]
        with np.errstate(invalid="ignore", over="ignore"):
            rows = features.rows(indices)
        faulty = np.flatnonzero(~(np.abs(rows) <= HUGE).all(1))
        if len(faulty):
            raise FormatError(
                f"{features.path}: features are not finite, or huge, as those of Gaussian "
                f"{indices[faulty[0]]}; the training has diverged, take an earlier checkpoint"
            )
        return rows


def read_foreign(paths: Sequence[Path], levels: Sequence[str] = ()) -> ForeignScene:
    """Return the scene in checkpoints and other files of another method, in any order.

    levels: names of the levels of the checkpoints with features, in their order. Raises InputError if a file
    cannot be opened or is missing, FormatError if one is damaged, unknown, or of another scene.
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
        if lone := [part for part in parts if part is not plain]:
            what = "belongs to checkpoints with features, and none is given; name them too"
            raise InputError(f"{lone[0].path}: {what}")
        assert plain is not None
        return ForeignScene(PLAIN, _scene(plain), notes=("no language field in it",))
    return _of_levels(plain, featured, levels, autoencoder)


def _only(found: list[P], what: str) -> P | None:
    if len(found) > 1:
        raise InputError(f"{found[0].path} and {found[1].path}: two {what}; give those of one scene")
    return found[0] if found else None


def _named(carrier: Carrier, autoencoder: Autoencoder | None) -> Carrier:
    """Return the carrier with its method, by whether its features are latents or vectors."""
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


def _of_clusters(carrier: Carrier | None, clusters: Clusters) -> ForeignScene:
    """Return OpenGaussian's scene, whose only level is taken for "whole"."""
    if carrier is None:
        raise InputError(f"{clusters.path}: has no Gaussians; name the scene's checkpoint or PLY too")
    if len(clusters.index) != len(carrier.gaussians):
        raise FormatError(
            f"{clusters.path}: clusters of {len(clusters.index)} Gaussians, "
            f"{carrier.path} has {len(carrier.gaussians)}"
        )
    if not (clusters.index >= 0).any():
        raise FormatError(f"{clusters.path}: leaf_ind names none of the {len(clusters.vectors)} clusters")
    whole = rearranged(whole_vectors(clusters.vectors, clusters.path), clusters.index)
    note = "OpenGaussian knows no levels: whole is filled, subpart and part are empty"
    return ForeignScene(OPEN_GAUSSIAN, _scene(carrier), (None, None, whole), clusters=clusters, notes=(note,))


def _of_levels(
    plain: Carrier | None, featured: list[Carrier], asked: Sequence[str], autoencoder: Autoencoder | None
) -> ForeignScene:
    method = featured[0].method
    if len(featured) > len(LEVELS):
        raise InputError(f"{featured[-1].path}: a fourth checkpoint with features; there are three levels")
    if method == OPEN_GAUSSIAN:
        raise InputError(f"{featured[0].path}: of OpenGaussian; name its features, cluster_lang.npz, too")
    if method in ONE_LEVEL and not asked:
        _only(featured, f"scenes of {method}, which knows no levels")
        numbers, how = [len(LEVELS) - 1], f"{method} knows none, whole is filled"
    else:
        numbers, how = levels_of(featured, asked)
    featured = [carrier.about((plain or featured[0]).scene.origin) for carrier in featured]
    carriers = [plain] if plain else featured  # the scene's Gaussians: those without features, or the first's
    base = carriers[0]
    if base.method == OCCAM:  # it removes unseen Gaussians, so levels have different ones
        base = replace(base, scene=replace(base.scene, gaussians=all_gaussians(carriers)))
    levels: list[Features | None] = [None] * len(LEVELS)
    pruned = 0
    for number, carrier in zip(numbers, featured, strict=True):
        features = carrier.features
        assert features is not None
        rows = partners(base.gaussians.means, carrier, method == OCCAM)
        pruned += rows is not None
        levels[number] = features if rows is None else rearranged(features, rows)
    told = ", ".join(f"{name} from {own.path}" for name, own in zip(LEVELS, levels, strict=True) if own)
    notes = [f"levels ({how}): {told}"]
    empty = [name for name, own in zip(LEVELS, levels, strict=True) if own is None]
    if empty:
        notes.append(f"without features: {', '.join(empty)}")
    if pruned:
        notes.append(f"{pruned} of the checkpoints lack some Gaussians, which have no features there")
    codec = autoencoder.codec if autoencoder is not None and method == LANGSPLAT else None
    return ForeignScene(method, _scene(base), tuple(levels), codec, notes=tuple(notes))


def _scene(carrier: Carrier) -> Scene:
    """Return the carrier's Gaussians, with the cameras in the model's folder."""
    warn_of_undrawable(carrier.path, carrier.gaussians)
    folder = carrier.path.resolve().parent
    model = folder.parent.parent if carrier.path.name == "point_cloud.ply" else folder
    cameras = [path for path in (carrier.path.with_suffix(CAMERAS), model / "cameras.json") if exists(path)]
    scene = carrier.scene
    if not scene.origin.any():
        means, origin = about_origin(scene.gaussians.means)
        scene = replace(scene, gaussians=replace(scene.gaussians, means=means), origin=origin)
    read = read_cameras(cameras[0]) if cameras else ()
    return replace(scene, cameras=tuple(camera.moved(-scene.origin) for camera in read))


# Features as a language field.


def import_scene(
    foreign: ForeignScene,
    encoder_id: str | None = None,
    phrases: tuple[str, ...] = (),
    config: CodecConfig | None = None,
    progress: Progress = silent,
) -> tuple[Scene, CodecReport | None]:
    """Return the scene with its language field, and the errors of its codec on vectors not fitted to.

    Without features there is no field, and no errors are measured for the method's own codec. encoder_id: the
    text encoder of the method's vectors, by default that of LangSplat; phrases: to encode and store. The
    confidence of a Gaussian is 1 if it has a feature, else 0. Raises EncoderError if the encoder cannot be
    loaded, InputError if its vectors have another length or no Gaussian has a feature, FormatError for
    features that are not finite.
    """
    config = config or CodecConfig()
    check_settings(config, "--codec.")
    if foreign.dim == 0:
        return foreign.scene, None
    encoder = load_text_encoder(encoder_id or OPEN_MODEL)
    if encoder.dim != foreign.dim:
        raise InputError(
            f"{foreign.first_path}: vectors of {foreign.dim} numbers, those of the encoder {encoder.id} "
            f"have {encoder.dim}; name the encoder they were made with by --encoder"
        )
    vocabulary = everyday_vocabulary(encoder, phrases)
    codec, loss = _codec(foreign, config, vocabulary, progress)
    latents, confidence = _latents(foreign, codec, progress)
    field = field_of((latents, confidence), codec, encoder, phrases)
    return replace(foreign.scene, language=replace(field, calibration=None)), loss


def _codec(
    foreign: ForeignScene, config: CodecConfig, vocabulary: Vocabulary, progress: Progress
) -> tuple[Codec, CodecReport | None]:
    if foreign.codec is not None:
        return foreign.codec, None
    clusters = foreign.clusters
    if clusters is not None and len(clusters.vectors) <= MOST_CODEWORDS and config.kind == "codebook":
        counts = np.bincount(clusters.index[clusters.index >= 0], minlength=len(clusters.vectors))
        used = np.flatnonzero((counts > 0) & _has_feature(clusters.vectors))
        if len(used) == 0:
            raise InputError("no cluster that Gaussians belong to has a meaning; there is nothing to search")
        return codebook_of(unit(clusters.vectors[used]), counts[used].astype(np.float64)), None
    fitted, judged = _samples(foreign, config.seed)
    codec = fit_codec(fitted, config, vocabulary, progress)
    return codec, codec_report(codec, judged if len(judged) else fitted, vocabulary)


def _samples(foreign: ForeignScene, seed: int) -> tuple[Array, Array]:
    """Return (M, D) float32 unit vectors of all levels to fit a codec to, and others to judge it."""
    order = np.random.default_rng(seed).permutation(len(foreign.scene.gaussians))
    judges = min(JUDGED, len(order) // 6)
    samples = []
    for rows in (order[judges : judges + FITTED], order[:judges]):
        parts = [_unit_rows(foreign, level, np.sort(rows)) for level in foreign.told]
        samples.append(np.concatenate([vectors[known] for vectors, known in parts]))
    if len(samples[0]) == 0:
        raise InputError(f"{foreign.first_path}: no Gaussian has a meaning, all features are zero")
    return samples[0], samples[1]


def _has_feature(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=1) > SHORTEST)


def _unit_rows(foreign: ForeignScene, level: int, rows: Array) -> tuple[Array, Array]:
    """Return (n, D or d) float32 vectors or latents of length 1, and (n,) bool: it is a feature."""
    values = foreign.rows(level, rows)
    known = _has_feature(values)
    return unit(values, SHORTEST).astype(np.float32), known


def _latents(foreign: ForeignScene, codec: Codec, progress: Progress) -> tuple[Array, Array]:
    """Return (3, N, d) latents of the codec's type, and (3, N) float32: 1 if a Gaussian has a feature."""
    count = len(foreign.scene.gaussians)
    latents = np.zeros((len(LEVELS), count, codec.latent_dim), codec.dtype)
    confidence = np.zeros((len(LEVELS), count), np.float32)
    for done, level in enumerate(foreign.told):
        for start in range(0, count, BLOCK):
            rows = np.arange(start, min(start + BLOCK, count))
            values, known = _unit_rows(foreign, level, rows)
            made = values if foreign.codec is not None else codec.encode(values)
            latents[level, rows[known]] = made[known]
            confidence[level, rows] = known
            progress("reading features", (done + (start + len(rows)) / count) / len(foreign.told))
    return latents, confidence
