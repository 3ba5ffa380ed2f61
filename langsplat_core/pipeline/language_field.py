"""From masks with vectors to a language field: mask weights, groups of masks, codec, latents.

Each is kept in the work folder. Mask weights are kept view by view and latents block by block, so that an
interrupted run, or one that is shared by several processes, repeats little, and so that what is held in
memory depends on a block of Gaussians and not on all of them times all photographs.
"""

import shutil
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LiftConfig, TrainConfig
from langsplat_core.errors import InputError
from langsplat_core.pipeline.stages import (
    Arrays,
    ProcessGroup,
    features_digest,
    gaussians_digest,
    kept,
    kept_array,
    open_array,
    read_arrays,
    stage_key,
)
from langsplat_core.progress import Progress
from langsplat_core.raster import LiftingRasterizer, load_lifting_rasterizer
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    LEVELS,
    Camera,
    Codec,
    Gaussians,
    LanguageField,
    Tree,
    codec_from_tensors,
)
from langsplat_core.scene.codec import KINDS, CodebookCodec
from langsplat_core.scene.language import phrase_key
from langsplat_core.scene.surface import build_surface, build_tree
from langsplat_core.semantics.encoder import Encoder, PhraseEncoder
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.semantics.vocabulary import everyday_vectors
from langsplat_core.training.language.codec_fit import (
    CodecReport,
    codec_report,
    everyday_vocabulary,
    fit_codec,
    rounded,
)
from langsplat_core.training.language.lift import (
    Lifted,
    lift_block,
    lift_by_gradient,
    lift_latents,
    lift_sample,
)
from langsplat_core.training.language.mask_weights import (
    MaskGroups,
    MaskWeights,
    count_votes,
    find_instances,
    group_masks,
    view_pairs,
)
from langsplat_core.training.language.palette import contrasting_colours

Views = Sequence[tuple[Camera, ImageFeatures]]  # read when needed: they may be more than memory holds
Latents = tuple[Array, Array]  # (3, N, d) of the codec's type, (3, N) float32
FITTED, JUDGED = 12_000, 2_000  # Gaussians whose lifted vectors a codec is fitted to, and judged on
LATENT_LIFTS = frozenset({"one-pass", "gradient"})  # modes that average latents, of a codec fitted to masks
MOST_CONFIDENCE = 65_504.0  # pixels; the largest number that float16 holds


class StoredViews(Sequence[tuple[Camera, ImageFeatures]]):
    """Cameras with the features of what each saw, read when a view is looked at.

    Hundreds of label maps are more than memory holds.
    """

    def __init__(self, cameras: tuple[Camera, ...], features: Sequence[ImageFeatures]) -> None:
        self.cameras, self.features = cameras, features

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, index: Any) -> Any:
        """Return view `index`, a number; slices are not supported."""
        return self.cameras[index], self.features[index]


def language_field(
    gaussians: Gaussians,
    views: Views,
    encoder: Encoder,
    config: TrainConfig,
    work: Path,
    progress: Progress,
    processes: ProcessGroup | None = None,
) -> tuple[LanguageField, CodecReport]:
    """Return the language field of the views' mask vectors, and what its codec loses.

    Raises InputError where no view has a mask, and for a codebook whose numbers the lifting would average.
    """
    check_lift(config)
    check_masks(features for _, features in views)
    stages = _Stages(gaussians, views, encoder, config, work, processes or ProcessGroup(), progress)
    codec, report = stages.codec()
    latents, confidence = stages.latents(codec)
    confidence = confidence.clip(max=MOST_CONFIDENCE).astype(np.float16).astype(np.float32)
    field = field_of((latents, confidence), codec, encoder, config.phrases)
    tree = stages.tree(field)
    return replace(field, tree=tree, codec=_coloured(field, tree, gaussians)), report


def _coloured(field: LanguageField, tree: Tree, gaussians: Gaussians) -> Codec:
    """Return the codec of a field; a codebook gets colours that differ between neighbours."""
    if not isinstance(field.codec, CodebookCodec):
        return field.codec
    colours = contrasting_colours(field, tree, build_surface(gaussians))
    return field.codec if colours is None else replace(field.codec, palette=rounded(colours))


def check_lift(config: TrainConfig) -> None:
    """Raise InputError for a codec whose latents cannot be averaged with a lifting that averages them."""
    if config.lift.mode in LATENT_LIFTS and not KINDS[config.codec.kind].blends:
        raise InputError(
            f"--lift.mode {config.lift.mode}: a {config.codec.kind} has no latents that can be averaged; "
            "add --codec.kind autoencoder"
        )


def check_masks(features: Iterable[ImageFeatures]) -> None:
    """Raise InputError where no photograph has a mask; only files up to the first with one are read."""
    if not any(len(seen.vectors) for seen in features):
        raise InputError(
            "no masks were found in any photograph; try --masks.source graph, or larger photographs"
        )


class _Stages:
    """Results on the way to a field, each made at most once, or read where it was kept."""

    def __init__(
        self,
        gaussians: Gaussians,
        views: Views,
        encoder: Encoder,
        config: TrainConfig,
        work: Path,
        processes: ProcessGroup,
        progress: Progress,
    ) -> None:
        self._gaussians, self._views, self._encoder = gaussians, views, encoder
        self._config, self._work, self._processes, self._progress = config, work, processes, progress
        self._lift = _settings_in_key(config.lift)
        self._robust = self._lift.mode == "median"
        self._vectors, digests = [], []
        for _, features in views:
            self._vectors.append(features.vectors)
            digests.append(features_digest(features))
        self._inputs = (gaussians_digest(gaussians), digests)
        self._made: tuple[MaskWeights, MaskGroups] | None = None

    def codec(self) -> tuple[Codec, CodecReport]:
        """Return the codec, fitted to lifted vectors and, where that helps, to the masks' own.

        Where latents are averaged themselves it is fitted to the masks' vectors alone.
        """
        fitted_to = "masks" if self._lift.mode in LATENT_LIFTS else self._lift.mode
        path = self._work / f"{stage_key('codec', 2, *self._inputs, fitted_to, self._config.codec)}.npz"
        if self._lift.mode not in LATENT_LIFTS and not path.exists():
            self._mask_weights()  # everyone's work, unlike the fit
        return self._processes.once(lambda: kept(path, self._fit, _pack_codec, _unpack_codec))

    def latents(self, codec: Codec) -> Latents:
        """Return the latents of every Gaussian at every level, and the confidence in them."""
        blocks = self._work / stage_key("latents", 2, *self._inputs, self._lift, self._config.codec)
        done = blocks.with_name(f"{blocks.name}.npz")
        if self._lift.mode not in LATENT_LIFTS and not done.exists():
            self._lift_blocks(codec, blocks)
            self._processes.barrier()
        made = self._processes.once(
            lambda: kept(done, lambda: self._all_latents(codec, blocks), _pack, _unpack)
        )
        if self._processes.is_main:
            shutil.rmtree(blocks, ignore_errors=True)
        return made

    def tree(self, field: LanguageField) -> Tree:
        """Return the tree of the scene.

        It has no votes where latents are averaged themselves, which needs no mask weights.
        """
        surface = partial(build_surface, self._gaussians)
        if self._lift.mode in LATENT_LIFTS:
            return self._processes.once(
                lambda: build_tree(surface(), field.codec, field.latents, field.known)
            )
        path = self._work / f"{stage_key('nodes', 4, *self._inputs, self._lift, self._config.codec)}.npz"
        if not path.exists():
            self._mask_weights()  # everyone's work

        def make() -> Tree:
            self._progress("building the tree", 0.5)
            counts, mask_weights = [len(vectors) for vectors in self._vectors], self._mask_weights()[0]
            things = np.stack([find_instances(mask_weights, counts, level) for level in range(len(LEVELS))])
            tree = build_tree(surface(), field.codec, field.latents, field.known, things)
            return replace(tree, votes=count_votes(tree, mask_weights, counts))

        return self._processes.once(lambda: kept(path, make, vars, lambda arrays: Tree(**arrays)))

    def _fit(self) -> tuple[Codec, CodecReport]:
        config, vocabulary = self._config.codec, everyday_vocabulary(self._encoder, self._config.phrases)
        masks = np.concatenate(self._vectors)
        if self._lift.mode in LATENT_LIFTS:
            codec = fit_codec(masks, config, vocabulary, self._progress)
            return codec, codec_report(codec, masks, vocabulary)
        fitted, judged = self._lifted_samples()
        codec = fit_codec(fitted, config, vocabulary, self._progress, further=masks)
        return codec, codec_report(codec, judged if len(judged) else masks, vocabulary)

    def _lifted_samples(self) -> tuple[Array, Array]:
        """(M, D) float32 vectors of Gaussians that a codec is fitted to, and of others that judge it."""
        mask_weights, groups = self._mask_weights()
        order = np.random.default_rng(self._config.codec.seed).permutation(len(self._gaussians))
        samples = []
        for rows in (order[:FITTED], order[FITTED : FITTED + JUDGED]):
            lifted = lift_sample(mask_weights, groups, np.sort(rows), self._robust, self._progress)
            samples.append(lifted.vectors[lifted.confidence > 0])
        return samples[0], samples[1]

    def _lift_blocks(self, codec: Codec, folder: Path) -> None:
        """Lift this process's share of the blocks of Gaussians, each into a file."""
        mask_weights, groups = self._mask_weights()

        def lift(number: int) -> Latents:
            return _encoded(codec, lift_block(mask_weights, groups, number, self._robust))

        for number in self._processes.share(range(len(mask_weights.blocks))):
            kept(folder / f"{number:05d}.npz", partial(lift, number), _pack, _unpack)
            self._progress("averaging mask vectors", (number + 1) / len(mask_weights.blocks))

    def _all_latents(self, codec: Codec, folder: Path) -> Latents:
        if self._lift.mode in LATENT_LIFTS:
            scene = (self._rasterizer(), self._gaussians, self._views, codec)
            if self._lift.mode == "one-pass":
                return lift_latents(*scene, progress=self._progress)
            return lift_by_gradient(*scene, config=self._config.lift, progress=self._progress)
        shape = (len(LEVELS), len(self._gaussians), codec.latent_dim)
        latents, confidence = np.zeros(shape, codec.dtype), np.zeros(shape[:2], np.float32)
        for number, (first, last) in enumerate(self._mask_weights()[0].blocks):
            latents[:, first:last], confidence[:, first:last] = _unpack(
                read_arrays(folder / f"{number:05d}.npz")
            )
        return latents, confidence

    def _mask_weights(self) -> tuple[MaskWeights, MaskGroups]:
        """Return the mask weights, in files that are read where they are needed, and the groups of masks."""
        if self._made is None:
            # Named as in older work folders.
            folder = self._work / stage_key("memberships", 2, *self._inputs)  # codespell:ignore memberships
            shared = self._rasterizer(), self._processes, self._progress
            mask_weights = kept_mask_weights(self._gaussians, self._views, folder, *shared)
            path = folder / "groups.npz"
            groups = self._processes.once(
                lambda: kept(path, lambda: group_masks(self._vectors), _pack_groups, self._unpack_groups)
            )
            self._made = mask_weights, groups
        return self._made

    def _rasterizer(self) -> LiftingRasterizer:
        return load_lifting_rasterizer(self._config.lift.backend)

    def _unpack_groups(self, arrays: Arrays) -> MaskGroups:
        edges = np.cumsum([len(view) for view in self._vectors])[:-1]
        return MaskGroups(tuple(np.split(arrays["of_mask"], edges)), arrays["vectors"])


def kept_mask_weights(
    gaussians: Gaussians,
    views: Views,
    folder: Path,
    rasterizer: LiftingRasterizer,
    processes: ProcessGroup,
    progress: Progress,
) -> MaskWeights:
    """Return the mask weights of all views, a file in `folder` each, which is read where it is needed."""

    def pairs(index: int) -> Array:
        camera, features = views[index]
        return view_pairs(rasterizer, gaussians, camera, features)

    files = [folder / f"{index:05d}.npy" for index in range(len(views))]
    for index in processes.share(range(len(views))):
        kept_array(files[index], partial(pairs, index))
        progress("lifting masks onto the Gaussians", (index + 1) / len(views))
    processes.barrier()
    return MaskWeights([open_array(path) for path in files], len(gaussians))


def _settings_in_key(config: LiftConfig) -> LiftConfig:
    """Return the settings that change the result: not the backend and batches, which change who computes."""
    if config.mode != "gradient":
        return LiftConfig(mode=config.mode)
    return replace(config, backend="auto")


def _encoded(codec: Codec, lifted: Lifted) -> Latents:
    """Encode lifted vectors: (3, n, d) latents, zero where unobserved, and (3, n) confidence."""
    levels, count, dim = lifted.vectors.shape
    latents = codec.encode(lifted.vectors.reshape(-1, dim)).reshape(levels, count, -1)
    return np.where(lifted.confidence[..., None] > 0, latents, 0).astype(latents.dtype), lifted.confidence


def _pack(latents: Latents) -> Arrays:
    return {"latents": latents[0], "confidence": latents[1]}


def _unpack(arrays: Arrays) -> Latents:
    return arrays["latents"], arrays["confidence"]


def _pack_groups(groups: MaskGroups) -> Arrays:
    return {"of_mask": np.concatenate(groups.of_mask), "vectors": groups.vectors}


def _pack_codec(made: tuple[Codec, CodecReport]) -> Arrays:
    codec, report = made
    return {
        "kind": np.array(codec.kind),
        "report": np.array(list(asdict(report).values())),
        **codec.tensors(),
    }


def _unpack_codec(arrays: Arrays) -> tuple[Codec, CodecReport]:
    tensors = {name: array for name, array in arrays.items() if name not in ("kind", "report")}
    return codec_from_tensors(str(arrays["kind"]), tensors), CodecReport(*arrays["report"].tolist())


def field_of(
    latents: Latents, codec: Codec, encoder: PhraseEncoder, phrases: tuple[str, ...]
) -> LanguageField:
    """Return the field of latents and confidences, without a tree.

    It holds all that a query needs of the encoder; its phrasebook has each of `phrases` once.
    """
    names = list(dict.fromkeys(phrase_key(phrase) for phrase in phrases))
    return LanguageField(
        *latents,
        codec=codec,
        canonical=encoder.encode_texts(list(CANONICAL_PHRASES)),
        encoder_id=encoder.id,
        phrasebook=dict(zip(names, encoder.encode_texts(names), strict=True)),
        temperature=encoder.temperature,
        found=encoder.found,
        calibration=encoder.calibration,
        everyday=everyday_vectors(encoder),
    )
