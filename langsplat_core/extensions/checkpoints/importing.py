"""Import of scenes of other methods from their files.

Nothing in a file is executed, and files are recognised by their content; docs/files.md lists those of each
method. Latents of LangSplat's autoencoder are kept with it. CLIP vectors are encoded by a codec fitted to a
sample of them, by default a codebook; vectors of clusters are one already. Vectors are read a block of
Gaussians at a time, as an (N, 512) array may exceed the memory.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os.path import exists
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.config import CodecConfig, check_settings
from langsplat_core.errors import FormatError, InputError, Tell, quoted, report_loss, report_losses, unread
from langsplat_core.extensions.checkpoints.langsplat_files import (
    GEOMETRY,
    autoencoder_from,
    gaussians_of,
    is_autoencoder,
    layer_name,
    model_tuple,
)
from langsplat_core.extensions.checkpoints.unpickling import (
    IgnoredArray,
    load_torch,
    plain_array,
    plain_mapping,
)
from langsplat_core.io.cameras import SUFFIX as CAMERAS
from langsplat_core.io.cameras import read_cameras
from langsplat_core.io.hostile import open_for_reading, opened_archive, read_npz
from langsplat_core.io.ply import read_ply_scene
from langsplat_core.io.scenes import Importer, ImportRequest, read_origin, warn_of_undrawable
from langsplat_core.pipeline.language_field import field_of
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS, NO_ORIGIN, AutoencoderCodec, Codec, Gaussians, Scene, about_origin
from langsplat_core.scene.codec import MOST_CODEWORDS, SHORTEST
from langsplat_core.scene.gaussians import join_gaussians
from langsplat_core.semantics.encoders import OPEN_MODEL, load_text_encoder
from langsplat_core.training.language import codec_fit

TOPK = 4  # codewords of a Gaussian in LangSplatV2


@dataclass(frozen=True, eq=False)
class Features:
    """The vectors, or latents, of N Gaussians at one level."""

    path: Path  # of their file
    dim: int  # numbers per vector
    # (n,) indices below N -> (n, dim) float32 vectors, not normalised; zero for no feature
    rows: Callable[[Array], Array]


def whole_vectors(values: Array, path: Path) -> Features:
    """Return features from (N, D) floats: vectors of Occam's LGS and Feature-3DGS, latents of LangSplat."""
    return Features(path, int(values.shape[1]), lambda indices: np.asarray(values[indices], np.float32))


def sparse_codes(logits: Array, codewords: Array, path: Path) -> Features:
    """Return features of LangSplatV2: mixtures of a few codewords per Gaussian.

    logits: (N, L K) floats, for L layers of codewords one after the other; codewords: (L, K, D) floats. The
    mixtures of the layers are added. Weights are the largest `TOPK` of a softmax, scaled to the sum 1. Logits
    that are all equal were never trained: no feature. FormatError, which names `path`, for other shapes.
    """
    layers, size, dim = codewords.shape
    if logits.ndim != 2 or logits.shape[1] != layers * size or not np.isfinite(codewords).all():
        raise FormatError(
            f"{path}: logits {logits.shape} for codewords {codewords.shape}; expected (N, L K) and finite "
            "(L, K, D)"
        )
    codewords = np.asarray(codewords, np.float32)

    def rows(indices: Array) -> Array:
        chosen = np.asarray(logits[indices], np.float32)
        mixed = np.zeros((len(chosen), dim), np.float32)
        for layer, words in enumerate(codewords):
            mixed += _largest_of_softmax(chosen[:, layer * size : (layer + 1) * size]) @ words
        return np.where(np.ptp(chosen, axis=1, keepdims=True) != 0, mixed, np.float32(0))

    return Features(path, int(dim), rows)


def _largest_of_softmax(logits: Array) -> Array:
    """Return (n, K) weights of (n, K) logits: the `TOPK` largest of their softmax over their sum, else 0."""
    powers = np.exp(logits - logits.max(1, keepdims=True))
    shares = powers / powers.sum(1, keepdims=True)
    largest = np.argsort(-shares, axis=1, kind="stable")[:, :TOPK]
    kept = np.take_along_axis(shares, largest, 1)
    weights = np.zeros_like(shares)
    np.put_along_axis(weights, largest, kept / (kept.sum(1, keepdims=True) + 1e-10), 1)
    return weights


def rearranged(features: Features, partner: Array) -> Features:
    """Return features for other Gaussians; partner: (N,) int64 row of each in `features`, -1 for none."""

    def rows(indices: Array) -> Array:
        chosen = partner[indices]
        out = np.zeros((len(chosen), features.dim), np.float32)
        out[chosen >= 0] = features.rows(chosen[chosen >= 0])
        return out

    return replace(features, rows=rows)


# One file of an import, recognised by its content, never by its name or length. A `Carrier` has Gaussians,
# with or without features of one level. Other files of a method, an autoencoder or vectors of clusters,
# belong to a carrier.

PLAIN, UNNAMED = "3D Gaussian Splatting", "LangSplat or Occam's LGS"
LANGSPLAT, OCCAM, V2 = "LangSplat", "Occam's LGS", "LangSplatV2"
FEATURE_3DGS, OPEN_GAUSSIAN = "Feature-3DGS", "OpenGaussian"
INSTANCE = 6  # numbers per Gaussian of OpenGaussian's instance features, stored twice; not used here
PICKLE = b"\x80"  # start of torch files from before they were archives
SEMANTIC = re.compile(r"semantic_\d+")


@dataclass(frozen=True, eq=False)
class Carrier:
    """A checkpoint or PLY."""

    path: Path
    method: str
    scene: Scene  # without cameras and language field
    features: Features | None = None

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians of the scene."""
        return self.scene.gaussians

    def about(self, origin: Array) -> "Carrier":
        """Return the same Gaussians relative to another `origin` (3,)."""
        if np.array_equal(self.scene.origin, origin):
            return self
        gaussians = replace(self.gaussians, means=self.gaussians.means + (self.scene.origin - origin))
        return replace(self, scene=replace(self.scene, gaussians=gaussians, origin=origin))


@dataclass(frozen=True, eq=False)
class Clusters:
    """OpenGaussian's vectors of clusters, and the cluster of each Gaussian: `cluster_lang.npz`."""

    path: Path
    index: Array  # (N,) int64 rows of `vectors`; -1 for Gaussians in no cluster
    vectors: Array  # (K, D) float32, not normalised; zero for a cluster without a vector


@dataclass(frozen=True, eq=False)
class Autoencoder:
    """Autoencoder of LangSplat, `best_ckpt.pth`."""

    path: Path
    codec: AutoencoderCodec


Part = Carrier | Clusters | Autoencoder


def read_part(path: Path) -> Part:
    """Return the content of a method's file; InputError if it cannot be opened, FormatError if unknown."""
    file, _ = open_for_reading(path)
    with file:
        start = file.read(8)
    if start.startswith((b"ply\n", b"ply\r")):
        return _from_ply(path)
    if start.startswith(b"PK") and _is_npz(path):
        return _clusters(read_npz(path), path)
    if not start.startswith((b"PK", PICKLE)):
        raise FormatError(f"{path}: neither a PLY nor a file of torch or NumPy; name checkpoints")
    return _from_torch(load_torch(path), path)


def _is_npz(path: Path) -> bool:
    try:
        with opened_archive(path, "archive") as archive:
            return all(name.endswith(".npy") for name in archive.names)
    except FormatError:  # torch reads some damaged archives that zipfile does not
        return False


def _from_ply(path: Path) -> Carrier:
    scene = read_ply_scene(path)
    names = [name for name in scene.extras if SEMANTIC.fullmatch(name)]
    if not names:
        return Carrier(path, PLAIN, scene)
    ordered = [f"semantic_{index}" for index in range(len(names))]
    if set(ordered) != set(names):
        raise FormatError(f"{path}: {len(names)} properties semantic_*, not counted from 0 without gaps")
    vectors = np.stack([scene.extras[name].astype(np.float32) for name in ordered], axis=1)
    rest = {name: values for name, values in scene.extras.items() if name not in names}
    return Carrier(path, FEATURE_3DGS, replace(scene, extras=rest), whole_vectors(vectors, path))


def _clusters(arrays: dict[str, Array], path: Path) -> Clusters:
    if not {"leaf_feat", "leaf_ind"} <= set(arrays):
        shapes = ", ".join(str(array.shape) for array in list(arrays.values())[:6])
        raise FormatError(
            f"{path}: holds arrays {shapes or 'of no kind'}; expected leaf_feat and leaf_ind of OpenGaussian"
        )
    vectors, index = arrays["leaf_feat"], arrays["leaf_ind"]
    if vectors.ndim != 2 or vectors.dtype.kind != "f" or index.ndim != 1 or index.dtype.kind not in "iu":
        raise FormatError(
            f"{path}: leaf_feat {vectors.dtype} {vectors.shape}, leaf_ind {index.dtype} {index.shape}; "
            "expected floats (K, D) and whole numbers (N,)"
        )
    counts = arrays.get("occu_count", np.ones(len(vectors)))
    if counts.shape != (len(vectors),):
        raise FormatError(f"{path}: occu_count has the shape {counts.shape}, leaf_feat {vectors.shape}")
    known = np.where(counts[:, None] > 0, vectors, 0).astype(np.float32)
    index = index.astype(np.int64)
    told = [unread("arrays", arrays.keys() - {"leaf_feat", "leaf_ind", "leaf_score", "occu_count"})]
    if beyond := np.count_nonzero((index > len(vectors)) | (index < -1)):  # -1 and K stand for none
        told.append(f"{beyond} Gaussians are of clusters that are not there, and get none")
    report_losses(path, told)
    return Clusters(path, np.where((index >= 0) & (index < len(vectors)), index, -1), known)


def _from_torch(content: Any, path: Path) -> Part:
    elements = model_tuple(content)
    if elements is not None:
        gaussians, told = gaussians_of(elements, path), list[str]()
        method, features = _language(elements, len(gaussians), path, told.append)
        if elements[0] < gaussians.sh_degree and gaussians.sh[:, (elements[0] + 1) ** 2 :].any():
            told.append(f"its active degree is {elements[0]}, and all {gaussians.sh_degree} are taken")
        ignored = [index for index, element in enumerate(elements) if isinstance(element, IgnoredArray)]
        told.append(unread("arrays of NumPy, elements", ignored))
        report_losses(path, told)
        beside = read_origin(path)
        scene = Scene(gaussians, origin=NO_ORIGIN if beside is None else np.array(beside.origin))
        return Carrier(path, method, scene, features)
    mapping = plain_mapping(content)
    named = {"": content} if mapping is None else mapping
    if is_autoencoder(named):
        others = [name for name in named if not layer_name(name)]
        said = (quoted(name if isinstance(name, str) else type(name), 40) for name in others)
        report_losses(path, [unread("entries", said)])
        return Autoencoder(path, autoencoder_from(named, path))
    arrays = [plain_array(value, path) for value in named.values()]
    if any(array is not None and array.ndim == 4 for array in arrays):
        raise FormatError(
            f"{path}: a convolutional decoder, as of Feature-3DGS with its speed-up; it decodes pictures, "
            "not Gaussians, so that such features cannot be imported; train without the speed-up"
        )
    raise FormatError(f"{path}: a torch file, but not a checkpoint or autoencoder of a known method")


def _language(elements: tuple[Any, ...], count: int, path: Path, tell: Tell) -> tuple[str, Features | None]:
    """Return the method and the features in the elements after the geometry, without training's state."""
    first = plain_array(elements[GEOMETRY], path)
    second = plain_array(elements[GEOMETRY + 1], path) if len(elements) > GEOMETRY + 1 else None
    if first is None or first.ndim != 2:  # (N,) radii of plain 3D Gaussian Splatting
        late = [plain_array(element, path) for element in elements[GEOMETRY + 1 :]]
        wide = [flat for array in late if (flat := _wide(array, count)) is not None]
        if len(wide) > 1:
            tell(f"it has vectors {len(wide)} times, and the first are taken")
        return (FEATURE_3DGS, whole_vectors(wide[0], path)) if wide else (PLAIN, None)
    if len(first) != count:
        raise FormatError(f"{path}: features {first.shape} for {count} Gaussians")
    if first.dtype.kind != "f":
        raise FormatError(f"{path}: features of the type {first.dtype}; expected floats")
    if second is not None and second.ndim == 3:
        return V2, sparse_codes(first, second, path)
    if second is not None and first.shape == second.shape == (count, INSTANCE):
        return OPEN_GAUSSIAN, None
    return UNNAMED, whole_vectors(first, path)


def _wide(array: Array | None, count: int) -> Array | None:
    """Return (N, D), (N, 1, D) or (N, D, 1) floats as (N, D) if D > 1; None for anything else."""
    if array is None or array.dtype.kind != "f" or array.ndim not in (2, 3) or len(array) != count:
        return None
    flat = array.reshape(count, -1) if 1 in array.shape[1:] or array.ndim == 2 else array
    return flat if flat.ndim == 2 and flat.shape[1] > 1 else None


# The level of a checkpoint, and how its Gaussians match those of others.

_NUMBER = re.compile(r"_(?:level_?)?([1-3])$")  # `chkpnt30000_langfeat_2`, `scene_level_2`, `teatime_2/`
LEAST_SHARED = 0.5  # least share of Gaussians in common of two checkpoints of one scene


def levels_of(carriers: Sequence[Carrier], asked: Sequence[str]) -> tuple[list[int], str]:
    """Return the level 0, 1 or 2 of each checkpoint, and how it was determined.

    It is as `asked` (names of levels, in the order of the checkpoints), else by names of files or folders;
    else three are in order, and a single one is "whole". Raises InputError if none of these applies.
    """
    if asked and (len(asked) != len(carriers) or len(set(asked)) != len(asked)):
        raise InputError(
            f"--levels {' '.join(asked)}: {len(carriers)} checkpoints have features; name a level for each, "
            "each once"
        )
    if asked:
        return [LEVELS.index(name) for name in asked], "as asked"
    numbers = [_numbered(carrier.path) for carrier in carriers]
    chosen = [number - 1 for number in numbers if number is not None]
    if len(set(chosen)) == len(carriers):
        return chosen, "by the names of files and folders"
    if len(carriers) == len(LEVELS) and len(set(numbers)) == 1:
        chosen, guess = list(range(len(LEVELS))), "by their order"
    elif numbers == [None]:
        chosen, guess = [len(LEVELS) - 1], "one alone is taken for the whole"
    else:
        paths, names = ", ".join(str(carrier.path) for carrier in carriers), " ".join(LEVELS[: len(carriers)])
        raise InputError(f"{paths}: of which levels? Say them, as --levels {names}")
    report_loss("%s: its level is a guess; --levels says which it is", carriers[0].path)
    return chosen, guess


def _numbered(path: Path) -> int | None:
    """Return the number at the end of a file's name, or of its folder's name; None without one."""
    found = _NUMBER.search(path.stem) or _NUMBER.search(path.resolve().parent.name)
    return int(found[1]) if found else None


def all_gaussians(carriers: Sequence[Carrier]) -> Gaussians:
    """Return the union of the Gaussians of checkpoints that lack different ones.

    Those of the first checkpoint come first, then the additional ones of each further checkpoint. Raises
    FormatError if they are not of one scene.
    """
    found = carriers[0].gaussians
    for carrier in carriers[1:]:
        theirs = carrier.gaussians
        if found.sh.shape[1] != theirs.sh.shape[1]:
            raise FormatError(f"{carrier.path}: SH degree {theirs.sh_degree}, others have {found.sh_degree}")
        row = _row_of(theirs.means, found.means, min(len(found), len(theirs)), carrier)
        found = join_gaussians([found, theirs.take(row < 0)])
    return found


def partners(means: Array, carrier: Carrier, may_lack: bool) -> Array | None:
    """Return the (N,) rows of the `carrier`'s Gaussians at (N, 3) `means`, -1: none; None if all are equal.

    may_lack: the checkpoint may have removed Gaussians; those at bitwise equal positions are then the same.
    Raises FormatError if they are not of one scene.
    """
    theirs = carrier.gaussians.means
    if np.array_equal(means, theirs, equal_nan=True):
        return None
    if not may_lack:
        raise FormatError(
            f"{carrier.path}: its {len(theirs)} Gaussians are not the {len(means)} of the other files; "
            "give checkpoints that were trained from one scene"
        )
    return _row_of(means, theirs, len(theirs), carrier)


def _row_of(means: Array, theirs: Array, count: int, carrier: Carrier) -> Array:
    """Return the (N,) rows of `theirs` at the same positions, -1: none; of several the k-th match the k-th.

    FormatError if too few of `count` match.
    """
    bits = np.concatenate([means, theirs]).astype(np.float32).view(np.uint32)
    places = np.unique(bits, axis=0, return_inverse=True)[1].reshape(-1)
    ours, others = _ranked(places[: len(means)]), _ranked(places[len(means) :])
    _, mine, other = np.intersect1d(ours, others, assume_unique=True, return_indices=True)
    if len(mine) < max(LEAST_SHARED * count, 1):
        raise FormatError(
            f"{carrier.path}: {len(mine)} of {count} Gaussians are at positions of the other files'; "
            "give checkpoints that were trained from one scene"
        )
    row = np.full(len(means), -1, np.int64)
    row[mine] = other
    return row


def _ranked(places: Array) -> Array:
    """Return (N,) distinct integers: the given ones in the upper bits, the rank among equals in the lower."""
    order = np.argsort(places, kind="stable")
    ordered = places[order]
    rank = np.empty(len(places), np.int64)
    rank[order] = np.arange(len(places)) - np.searchsorted(ordered, ordered)
    return places * np.int64(2**32) + rank


# The scene in the files of one method.

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
    levels: Mapping[int, Features] = field(default_factory=dict)  # those it has, ascending, each for all N
    codec: AutoencoderCodec | None = None  # if the features are its latents; None: they are vectors
    clusters: Clusters | None = None  # if the features are vectors of clusters
    notes: tuple[str, ...] = ()  # assumptions, for the user

    @property
    def dim(self) -> int:
        """Length D of the vectors; 0 without features."""
        if self.codec is not None:
            return self.codec.vector_dim
        return next((features.dim for features in self.levels.values()), 0)

    @property
    def first_path(self) -> Path:
        """The file of the first features, for messages."""
        return next(features.path for features in self.levels.values())

    def rows(self, level: int, indices: Array) -> Array:
        """Return (n, D or d) float32 features at `level`, zero for none; FormatError if infinite or huge."""
        features = self.levels[level]
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
    plain = _only([carrier for carrier in carriers if carrier.method == PLAIN], "scenes without features")
    clusters = _only([part for part in parts if isinstance(part, Clusters)], "files of clusters")
    autoencoder = _only([part for part in parts if isinstance(part, Autoencoder)], "autoencoders")
    featured = [_named(carrier, autoencoder) for carrier in carriers if carrier.method != PLAIN]
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
    return ForeignScene(
        OPEN_GAUSSIAN, _scene(carrier), {LEVELS.index("whole"): whole}, clusters=clusters, notes=(note,)
    )


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
    levels: dict[int, Features] = {}
    pruned = 0
    for number, carrier in zip(numbers, featured, strict=True):
        features = carrier.features
        assert features is not None
        rows = partners(base.gaussians.means, carrier, method == OCCAM)
        pruned += rows is not None
        levels[number] = features if rows is None else rearranged(features, rows)
    levels = dict(sorted(levels.items()))
    told = ", ".join(f"{LEVELS[level]} from {features.path}" for level, features in levels.items())
    notes = [f"levels ({how}): {told}"]
    empty = [name for level, name in enumerate(LEVELS) if level not in levels]
    if empty:
        notes.append(f"without features: {', '.join(empty)}")
    if pruned:
        notes.append(f"{pruned} of the checkpoints lack some Gaussians, which have no features there")
    codec = autoencoder.codec if autoencoder is not None and method == LANGSPLAT else None
    return ForeignScene(method, _scene(base), levels, codec, notes=tuple(notes))


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
) -> tuple[Scene, codec_fit.CodecReport | None]:
    """Return the scene with its language field, and the errors of its codec on vectors not fitted to.

    Without features there is no field, and no errors are measured for the method's own codec. encoder_id: the
    text encoder of the vectors, by default that of LangSplat; phrases: to encode and store. Confidences are 1
    with a feature, else 0. EncoderError for an encoder that cannot be loaded, InputError if its vectors have
    another length or no Gaussian has a feature, FormatError for features that are not finite.
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
    vocabulary = codec_fit.everyday_vocabulary(encoder, phrases)
    codec, loss = _codec(foreign, config, vocabulary, progress)
    latents, confidence = _latents(foreign, codec, progress)
    field = field_of((latents, confidence), codec, encoder, phrases)
    return replace(foreign.scene, language=replace(field, calibration=None)), loss


def _codec(
    foreign: ForeignScene, config: CodecConfig, vocabulary: codec_fit.Vocabulary, progress: Progress
) -> tuple[Codec, codec_fit.CodecReport | None]:
    if foreign.codec is not None:
        return foreign.codec, None
    clusters = foreign.clusters
    if clusters is not None and len(clusters.vectors) <= MOST_CODEWORDS and config.kind == "codebook":
        counts = np.bincount(clusters.index[clusters.index >= 0], minlength=len(clusters.vectors))
        used = np.flatnonzero((counts > 0) & _has_feature(clusters.vectors))
        if len(used) == 0:
            raise InputError("no cluster that Gaussians belong to has a meaning; there is nothing to search")
        return codec_fit.codebook_of(unit(clusters.vectors[used]), counts[used].astype(np.float64)), None
    fitted, judged = _samples(foreign, config.seed)
    codec = codec_fit.fit_codec(fitted, config, vocabulary, progress)
    return codec, codec_fit.codec_report(codec, judged if len(judged) else fitted, vocabulary)


def _samples(foreign: ForeignScene, seed: int) -> tuple[Array, Array]:
    """Return (M, D) float32 unit vectors of all levels to fit a codec to, and others to judge it."""
    order = np.random.default_rng(seed).permutation(len(foreign.scene.gaussians))
    judges = min(JUDGED, len(order) // 6)
    samples = []
    for rows in (order[judges : judges + FITTED], order[:judges]):
        parts = [_unit_rows(foreign, level, np.sort(rows)) for level in foreign.levels]
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
    for done, level in enumerate(foreign.levels):
        for start in range(0, count, BLOCK):
            rows = np.arange(start, min(start + BLOCK, count))
            values, known = _unit_rows(foreign, level, rows)
            made = values if foreign.codec is not None else codec.encode(values)
            latents[level, rows[known]] = made[known]
            confidence[level, rows] = known
            progress("reading features", (done + (start + len(rows)) / count) / len(foreign.levels))
    return latents, confidence


def _import(request: ImportRequest, progress: Progress) -> tuple[Scene, tuple[str, ...]]:
    """Return the scene in a method's files, and lines that report what was imported."""
    foreign = read_foreign(request.paths, request.levels)
    if not foreign.levels and (request.encoder is not None or request.phrases or request.levels):
        what = "--encoder, --levels and --phrases are of features, and it has none; leave them out"
        raise InputError(f"{request.paths[0]}: {what}")
    scene, loss = import_scene(foreign, request.encoder, request.phrases, request.codec, progress)
    lines = [f"{foreign.method}: {'; '.join(foreign.notes)}"]
    field = scene.language
    if field is not None:
        shares = ", ".join(f"{share:.0%}" for share in field.confidence.mean(1))
        lines.append(
            f"with language features at subpart, part, whole: {shares} of the Gaussians; "
            f"codec {field.codec.kind} of {field.codec.size}, encoder {field.encoder_id}"
        )
    if foreign.codec is not None:
        every = np.arange(len(scene.gaussians))
        latents = np.concatenate([foreign.rows(level, every) for level in foreign.levels])
        lengths = np.linalg.norm(latents, axis=1)
        lengths = lengths[lengths > SHORTEST]
        if (np.abs(lengths - 1) > 0.01).any():
            low, high = lengths.min(), lengths.max()
            lines.append(
                f"latents {low:.3g} to {high:.3g} long, brought to length 1 as LangSplat does to draw"
            )
    if loss is not None:
        lines.append(
            f"relevancy error of the codec: mean {loss.error_mean:.4f}, "
            f"99 % below {loss.error_p99:.4f}; mean cosine {loss.cosine:.4f}"
        )
    return scene, tuple(lines)


IMPORTER = Importer((".pth", ".pt", ".ckpt", ".npz"), _import)
