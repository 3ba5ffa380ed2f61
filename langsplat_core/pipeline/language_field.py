"""From masks with vectors to a language field: mask weights, groups of masks, codec, latents, tree.

Each is kept in the work folder, mask weights view by view and latents block by block: an interrupted or
shared run repeats little, and memory depends on a block of Gaussians, not on all times all photographs.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.config import LiftConfig, RasterSettings, TrainConfig
from langsplat_core.errors import InputError
from langsplat_core.pipeline.stages import (
    Arrays,
    ProcessGroup,
    digest_of,
    kept,
    open_array,
    read_arrays,
    stage_key,
    write_array,
)
from langsplat_core.progress import Progress
from langsplat_core.raster import LiftingRasterizer, load_lifting_rasterizer
from langsplat_core.scene import LEVELS, Camera, Codec, Gaussians, LanguageField, Tree, near_plane
from langsplat_core.scene.codec import KINDS, CodebookCodec, codec_from_tensors
from langsplat_core.scene.language import CANONICAL_PHRASES, phrase_key
from langsplat_core.scene.scene import NEAR_CAMERAS
from langsplat_core.scene.surface import build_surface, build_tree, surface_areas
from langsplat_core.semantics.encoders import Encoder, PhraseEncoder
from langsplat_core.semantics.features import (
    FeatureStore,
    ImageFeatures,
    OnDemand,
    RegionEncoder,
    embed_regions,
    fingerprint,
    masked_crop,
)
from langsplat_core.semantics.relevancy import NARROWEST, bundled_vocabulary, everyday_vectors
from langsplat_core.training.language import codec_fit, lift
from langsplat_core.training.language.lift import MaskGroups, MaskWeights
from langsplat_core.training.language.merge_tree import MergeTree, draw_patches, find_tree, nested_maps

Views = Sequence[tuple[Camera, ImageFeatures]]  # read when needed: they may be more than memory holds
Photographs = Sequence[tuple[Array, Array | None]]  # (H, W, 3) uint8, (H, W) bool of what counts or None
Latents = tuple[Array, Array]  # (3, N, d) of the codec's type, (3, N) float32
FITTED, JUDGED = 12_000, 2_000  # Gaussians whose lifted vectors a codec is fitted to, and evaluated on
LATENT_LIFTS = frozenset({"one-pass", "gradient"})  # modes that average latents, of a codec fitted to masks
MOST_CONFIDENCE = 65_504.0  # pixels; the largest number that float16 holds


def views_of(cameras: Sequence[Camera], features: Sequence[ImageFeatures]) -> Views:
    """Return cameras with their image features, which are read when a view is accessed."""
    return OnDemand(range(len(cameras)), lambda index: (cameras[index], features[index]))


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
        raise InputError("no photograph has masks; try --masks.source graph, or larger photographs")


def language_field(stages: "Stages") -> tuple[LanguageField, codec_fit.CodecReport]:
    """Return the field of the views' masks, and its codec's loss; InputError without any mask."""
    check_masks(features for _, features in stages.views)
    codec, report = stages.codec()
    latents, confidence = stages.latents(codec)
    confidence = confidence.clip(max=MOST_CONFIDENCE).astype(np.float16).astype(np.float32)
    field = field_of((latents, confidence), codec, stages.encoder, stages.config.phrases)
    tree = stages.tree(field)
    if isinstance(codec, CodebookCodec):
        colours = codec_fit.contrasting_colours(field, tree, build_surface(stages.gaussians))
        codec = codec if colours is None else replace(codec, palette=codec_fit.rounded(colours))
    return replace(field, tree=tree, codec=codec), report


def field_of(
    latents: Latents, codec: Codec, encoder: PhraseEncoder, phrases: tuple[str, ...]
) -> LanguageField:
    """Return a field without a tree, with all that queries need of the encoder, and distinct `phrases`."""
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


@dataclass(frozen=True)
class Stages:
    """Results on the way to a field, each made at most once, or read where it was kept in `work`."""

    gaussians: Gaussians
    views: Views
    encoder: Encoder
    config: TrainConfig
    work: Path
    progress: Progress
    processes: ProcessGroup = field(default_factory=ProcessGroup)
    antialiased: bool = False  # as of the scene

    @property
    def by_weights(self) -> bool:
        """True where vectors are lifted by mask weights; False where latents are averaged."""
        return self.config.lift.mode not in LATENT_LIFTS

    @property
    def lift(self) -> LiftConfig:
        """The settings that change the result, so not the backend."""
        mode = self.config.lift.mode
        return LiftConfig(mode=mode) if mode != "gradient" else replace(self.config.lift, backend="auto")

    @cached_property
    def inputs(self) -> tuple[list[Array], tuple[Any, ...]]:
        """The vectors of each view's masks, and digests of all that the results are made from."""
        read = [(features.vectors, digest_of(features)) for _, features in self.views]
        digests = [digest for _, digest in read]
        formed = self.config.radiance.near, *([True] if self.antialiased else [])
        return [own for own, _ in read], (digest_of(self.gaussians), digests, *formed)

    def path(self, name: str, version: int, *settings: Any) -> Path:
        return self.work / f"{stage_key(name, version, *self.inputs[1], *settings)}.npz"

    def kept(self, path: Path, make: Callable[[], Arrays]) -> Arrays:
        """Return the arrays that one process makes, after all have computed the mask weights."""
        if self.by_weights and not path.exists():
            _ = self.mask_weights
        return self.processes.once(lambda: kept(path, make))

    @cached_property
    def mask_weights(self) -> tuple[MaskWeights, MaskGroups]:
        """The mask weights, in files that are read where they are needed, and the groups of masks."""
        vectors, inputs = self.inputs
        folder = self.work / stage_key("memberships", 2, *inputs)  # codespell:ignore memberships
        mask_weights = self.weights_in(folder, list(map(len, vectors)))

        def make() -> Arrays:
            self.progress("grouping masks", 0.0)
            groups = lift.group_masks(vectors)
            return {"of_mask": groups.of_mask, "vectors": groups.vectors}

        made = self.processes.once(lambda: kept(folder / "groups.npz", make))
        return mask_weights, MaskGroups(made["of_mask"], made["vectors"])

    def weights_in(self, folder: Path, mask_counts: Sequence[int]) -> MaskWeights:
        """Return the mask weights of all views, a file in `folder` each, which is read where it is needed."""
        files = [folder / f"{index:05d}.npy" for index in range(len(self.views))]
        drawn = self.rasterizer(), self.gaussians
        for index in self.each(len(files), "lifting masks onto the Gaussians"):
            if not files[index].exists():
                write_array(files[index], lift.view_pairs(*drawn, *self.views[index], self.formation))
        return MaskWeights([open_array(path) for path in files], mask_counts, len(self.gaussians))

    def each(self, count: int, stage: str) -> Iterator[int]:
        """Yield this process's share of `count` items, report each, and wait for all processes."""
        for index in self.processes.share(range(count)):
            self.progress(stage, index / count)
            yield index
        self.progress(stage, 1.0)
        self.processes.barrier()

    @cached_property
    def formation(self) -> RasterSettings:
        """The image formation of the views, from few of them, since reading a view reads its masks."""
        step = max(-(-len(self.views) // NEAR_CAMERAS), 1)
        cameras = [self.views[index][0] for index in range(0, len(self.views), step)]
        formed = self.config.radiance.formation(near_plane(self.gaussians, cameras))
        return replace(formed, antialiased=self.antialiased)

    def rasterizer(self) -> LiftingRasterizer:
        return load_lifting_rasterizer(self.config.lift.backend)

    def codec(self) -> tuple[Codec, codec_fit.CodecReport]:
        """Return the codec, fitted to lifted vectors and, where that helps, to those of masks too."""

        def make() -> Arrays:
            settings, masks = self.config.codec, np.concatenate(self.inputs[0])
            vocabulary = codec_fit.everyday_vocabulary(self.encoder, self.config.phrases)
            fitted, judged = self.lifted_samples() if self.by_weights else (masks, masks)
            further = masks if self.by_weights else None
            codec = codec_fit.fit_codec(fitted, settings, vocabulary, self.progress, further)
            report = codec_fit.codec_report(codec, judged if len(judged) else masks, vocabulary)
            figures = np.array(list(asdict(report).values()))
            return {"kind": np.array(codec.kind), "report": figures, **codec.tensors()}

        fitted_to = self.lift.mode if self.by_weights else "masks"
        made = dict(self.kept(self.path("codec", 2, fitted_to, self.config.codec.own), make))
        kind, figures = str(made.pop("kind")), made.pop("report").tolist()
        return codec_from_tensors(kind, made), codec_fit.CodecReport(*figures)

    def lifted_samples(self) -> tuple[Array, Array]:
        """Return (M, D) float32 vectors of Gaussians for fitting a codec, and of others to evaluate it."""
        order = np.random.default_rng(self.config.codec.seed).permutation(len(self.gaussians))
        robust, samples = self.lift.mode == "median", []
        for rows in (order[:FITTED], order[FITTED : FITTED + JUDGED]):
            vectors, confidence = lift.lift_sample(*self.mask_weights, np.sort(rows), robust, self.progress)
            samples.append(vectors[confidence > 0])
        return samples[0], samples[1]

    def latents(self, codec: Codec) -> Latents:
        """Return the latents of every Gaussian at every level, and the confidence in them."""
        done = self.path("latents", 2, self.lift, self.config.codec.own)
        blocks = done.with_suffix("")
        if self.by_weights and not done.exists():
            self.lift_blocks(codec, blocks)

        def make() -> Arrays:
            scene, shared = (self.gaussians, self.views, codec), (self.formation, self.progress)
            if self.by_weights:
                shape = len(LEVELS), len(self.gaussians)
                latents = np.zeros((*shape, codec.latent_dim), codec.dtype)
                confidence = np.zeros(shape, np.float32)
                for number, (first, last) in enumerate(self.mask_weights[0].blocks):
                    part = read_arrays(blocks / f"{number:05d}.npz")
                    latents[:, first:last], confidence[:, first:last] = part["latents"], part["confidence"]
            elif self.lift.mode == "one-pass":
                latents, confidence = lift.lift_latents(self.rasterizer(), *scene, *shared)
            else:
                settings = self.config.lift
                latents, confidence = lift.lift_by_gradient(self.rasterizer(), *scene, settings, *shared)
            return {"latents": latents, "confidence": confidence}

        made = self.processes.once(lambda: kept(done, make))
        if self.processes.is_main:
            shutil.rmtree(blocks, ignore_errors=True)
        return made["latents"], made["confidence"]

    def lift_blocks(self, codec: Codec, folder: Path) -> None:
        """Lift this process's share of the blocks of Gaussians, each into a file."""
        mask_weights, groups = self.mask_weights

        def lifted(number: int) -> Arrays:
            weights = mask_weights.block(number, groups)
            robust = self.lift.mode == "median"
            vectors, confidence = lift.lift_weights(weights, groups.vectors, robust)
            latents = codec.encode(vectors.reshape(-1, vectors.shape[2])).reshape(*vectors.shape[:2], -1)
            latents = np.where(confidence[..., None] > 0, latents, 0).astype(latents.dtype)
            return {"latents": latents, "confidence": confidence}

        for number in self.each(len(mask_weights.blocks), "averaging mask vectors"):
            kept(folder / f"{number:05d}.npz", partial(lifted, number))

    def tree(self, field: LanguageField) -> Tree:
        """Return the scene's tree, without votes where latents are averaged, which needs no mask weights."""

        def make() -> Arrays:
            self.progress("building the tree", 0.5)
            parts = build_surface(self.gaussians), field.codec, field.latents, field.known
            if not self.by_weights:
                return vars(build_tree(*parts))
            mask_weights, _ = self.mask_weights
            things = [lift.find_instances(mask_weights, level) for level in range(len(LEVELS))]
            tree = build_tree(*parts, np.stack(things))
            return vars(replace(tree, votes=lift.count_votes(tree, mask_weights)))

        return Tree(**self.kept(self.path("nodes", 4, self.lift, self.config.codec.own), make))


# Masks that all photographs agree on, in place of those that each photograph was given.
#
# A segmenter without weights divides every photograph by itself, each one differently. Their consensus is a
# tree of things on the Gaussians (`training.language.merge_tree`); three cuts of it, drawn into each
# photograph, are masks that fit from all sides, and these are shown to the encoder.
#
# No cost tells a whole thing from half of one or from two that touch; its name does. Wholes are the nodes
# that are named best: the sum of what `name_scores` makes of each is the largest.

CUTS = (0.15, 0.4, 0.8)  # costs up to which subparts, parts and wholes grow; chosen in rooms 201 and 203
NAMED = (0.8, 1.3)  # costs between which wholes are those that have a name
UNNAMED = 2.0  # spreads above everyday phrases that the nearest name of any region reaches
AREA = 0.75  # power of a node's share of the area, by which its name counts
VIEWS = 8  # views in which the encoder sees a node alone
OUTLIERS = 0.4  # share of these views, those least like the others, that does not count
LEAST = 2.5e-4  # share of the image: smaller regions are not shown to the encoder
AGREED = "what masks agree on"  # in the names of stages
VERSION = 3


def agreed_features(stages: Stages, photographs: Photographs) -> OnDemand[ImageFeatures]:
    """Describe masks by the consensus of the masks of all `stages.views`, whose vectors are not read."""
    encoder, work = stages.encoder, stages.work
    key, tree, eyes = _agreed_tree(stages)
    drawn = _drawn_patches(stages, tree, photographs, work / key)
    described = stage_key("described", VERSION, key, CUTS, NAMED, VIEWS, LEAST, fingerprint(encoder))
    finer = [tree.cut(cost) for cost in CUTS[:2]]
    whole = isinstance(encoder, RegionEncoder)  # one look at a photograph describes all its regions
    seen = tree.between(*NAMED)
    seen[[] if whole else finer] = True
    vectors = _node_vectors(stages, tree, np.flatnonzero(seen), eyes, drawn, photographs, work / described)
    names = name_scores(tree, surface_areas(stages.gaussians), vectors, encoder)
    cuts = [*finer, tree.cut(CUTS[2]) if names is None else tree.cut(*NAMED, names)]
    store = FeatureStore(work / "features")
    made_by = stage_key(described, VERSION, UNNAMED, AREA)
    for index in stages.each(len(drawn), f"outlining {AGREED}"):
        name = stages.views[index][0].name
        if not store.has(name, made_by):
            maps, nodes = nested_maps(open_array(drawn[index]), cuts, LEAST)
            own = embed_regions(photographs[index][0], maps, encoder) if whole else vectors[nodes]
            store.save(name, ImageFeatures(maps, own), made_by)
    return store.of([camera.name for camera, _ in stages.views])


def _agreed_tree(stages: Stages) -> tuple[str, MergeTree, Array]:
    """Return the key and the tree of the masks of all views, and the (V, 3) positions of their cameras."""
    facts = [(camera.position, len(seen.vectors), digest_of(seen)) for camera, seen in stages.views]
    eyes, counts, digests = zip(*facts, strict=True)
    inputs = digest_of(stages.gaussians), digests, stages.formation
    folder = stages.work / stage_key("rough-memberships", VERSION, *inputs)  # codespell:ignore memberships
    mask_weights = stages.weights_in(folder, counts)

    def make() -> Arrays:
        surface = build_surface(stages.gaussians)
        return vars(find_tree(stages.gaussians, surface, mask_weights, np.stack(eyes), stages.progress))

    key = stage_key("tree", VERSION, *inputs)
    made = stages.processes.once(lambda: kept(stages.work / f"{key}.npz", make))
    return key, MergeTree(**made), np.stack(eyes)


def _drawn_patches(stages: Stages, tree: MergeTree, photographs: Photographs, folder: Path) -> list[Path]:
    """Return files in `folder` of the (H, W) patches of each view, -1 where a pixel does not count."""
    files = [folder / f"{index:05d}.npy" for index in range(len(stages.views))]
    rasterizer = stages.rasterizer()
    for index in stages.each(len(files), f"drawing {AGREED}"):
        if not files[index].exists():
            view = rasterizer.view(stages.gaussians, stages.views[index][0], stages.formation)
            patches = draw_patches(view, stages.gaussians, tree.patches, stages.formation)
            _, mask = photographs[index]
            write_array(files[index], patches if mask is None else np.where(mask, patches, -1))
    return files


def _node_vectors(
    stages: Stages,
    tree: MergeTree,
    nodes: Array,
    eyes: Array,
    drawn: Sequence[Path],
    photographs: Photographs,
    folder: Path,
) -> Array:
    """Return (P + K, D) unit vectors of `nodes`, seen alone in their `best_views`; 0 for other nodes.

    A vector is the mean of those views' that agree most. eyes: (V, 3); drawn: files of (H, W) patches.
    """
    encoder, seen = stages.encoder, [open_array(path) for path in drawn]
    pixels = tree.totals(np.stack([np.bincount(one[one >= 0], minlength=tree.count) for one in seen], 1)).T
    pixels[pixels < [[max(LEAST * one.size, 1)] for one in seen]] = 0
    chosen = best_views(pixels[:, nodes], eyes, VIEWS)
    members = tree.totals(np.eye(tree.count, tree.count + 1, dtype=bool))  # -1, no patch, is the last column
    files = [folder / f"{index:05d}.npz" for index in range(len(drawn))]

    def look(index: int) -> Arrays:
        masks = (members[node][seen[index]] for node in nodes[chosen[index]])
        crops = [masked_crop(photographs[index][0], mask, encoder.image_size) for mask in masks]
        return {"vectors": encoder.encode_images(crops)}

    for index in stages.each(len(drawn), f"describing {AGREED}"):
        kept(files[index], partial(look, index))
    looks = np.concatenate([read_arrays(file)["vectors"] for file in files])
    of, vectors = nodes[np.nonzero(chosen)[1]], np.zeros((len(members), encoder.dim), np.float32)
    for node in np.unique(of):
        own = looks[of == node]
        agreeing = np.argsort(own @ own.sum(0))[int(OUTLIERS * len(own)) :]
        vectors[node] = own[agreeing].sum(0)
    return unit(vectors)


def best_views(pixels: Array, eyes: Array, most: int) -> Array:
    """Return (V, K) bool, up to `most` views of each of K nodes: those that show much of it, from all sides.

    Views are chosen one by one: each time the one with the largest root of its `pixels` (V, K) times the
    distance of its eye, of `eyes` (V, 3), to the nearest chosen one; never one without pixels.
    """
    chosen, apart = np.zeros(pixels.shape, bool), np.ones(pixels.shape)
    distances = np.linalg.norm(eyes[:, None] - eyes, axis=2)
    for number in range(most):
        worth = np.sqrt(pixels) * apart
        best = worth.argmax(0)
        chosen[best, np.arange(len(best))] |= worth.max(0) > 0
        apart = np.minimum(apart, distances[best].T) if number else distances[best].T
    return chosen


def name_scores(tree: MergeTree, areas: Array, vectors: Array, encoder: PhraseEncoder) -> Array | None:
    """Return (P + K,) float64, how well nodes with `vectors` are named; None if the encoder cannot tell.

    The score is the cosine of the nearest name, in spreads above everyday phrases, times a power of the area.
    """
    plain = (name for name in bundled_vocabulary("things") if name.replace(" ", "").isalpha())
    names = [name for name in plain if not encoder.unknown_words(name)]
    everyday, shown = everyday_vectors(encoder), vectors.any(1)
    if not names or everyday is None or (vectors[shown] == vectors[shown][:1]).all():
        return None
    inside, chance = tree.patches >= 0, vectors @ everyday.T
    nearest = (vectors @ encoder.encode_texts(names).T).max(1) - chance.mean(1)
    above = nearest / np.maximum(chance.std(1), NARROWEST) - UNNAMED
    shares = tree.totals(np.bincount(tree.patches[inside], areas[inside], tree.count)) / areas.sum()
    return np.asarray(np.where(shown, above, 0).clip(0) * shares**AREA)
