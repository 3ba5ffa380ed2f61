"""One procedural room: photographs, Gaussians, masks, language fields and answers, each made once, by the
ordinary pipeline, and compared with the truth; and the options and files that all reports share."""

import hashlib
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal, TypeVar, cast

import numpy as np
import tyro

from assets.making.dataset import SEED, Size, Truth, TruthMasks, read_truth, write_dataset
from assets.making.objects import EVERYTHING
from assets.making.world import Tier
from langsplat_core.arrays import Array
from langsplat_core.cli.arguments import OutFolder
from langsplat_core.config import (
    ClipConfig,
    CodecConfig,
    Count,
    DatasetConfig,
    LevelChoice,
    LiftConfig,
    MaskConfig,
    PictureConfig,
    RadianceConfig,
    Range,
    Seed,
    TrainConfig,
    check_settings,
)
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks.report import write_report
from langsplat_core.io.hostile import write_npy
from langsplat_core.io.sidecar import means_checksum
from langsplat_core.pipeline.language_field import Stages, Views, agreed_features, language_field
from langsplat_core.pipeline.stages import stage_key
from langsplat_core.pipeline.train import trained_gaussians
from langsplat_core.progress import Progress, TerminalProgress
from langsplat_core.query.answers import AnswerRule
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.lookup import decoded_relevancy, splatted_relevancy
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import LEVELS, Camera, Gaussians, LanguageField, Scene
from langsplat_core.semantics.encoders import Encoder, load_encoder, model_path
from langsplat_core.semantics.features import FeatureStore, ImageFeatures, describe_capture
from langsplat_core.semantics.masks import MaskSource
from langsplat_core.semantics.sam import load_mask_source
from langsplat_core.training.language.codec_fit import CodecReport
from tests.benchmarks.oracles import (
    TruthEncoder,
    moved_to_images,
    oracle_vectors,
    phrase_vectors,
    read_truth_encoder,
    true_labels,
    with_wrong_vectors,
)
from tests.benchmarks.scoring import (
    Asked,
    Measured,
    ask,
    evaluate,
    evaluate_direct,
    measured,
    seconds_of,
)

HOLD_OUT = 8  # every so many views, one is not trained on
FRAMES = 5  # timed images of one phrase; PyTorch's first takes longer
Row = TypeVar("Row")
ViewCount = Annotated[int, Range(8, 100_000)]
Seeds = Annotated[tuple[Seed, ...], Range(0, 2**32 - 1, some=True)]
# The outlines a perfect segmenter would find; the same, but 15 % of the vectors are another region's; the
# weight-free segmenter's.
MaskOrigin = Literal["truth", "wrong", "graph"]


@dataclass(frozen=True)
class RoomSettings:
    """How rooms are photographed, trained and asked."""

    views: ViewCount = 48  # photographs of each room; every eighth is held out
    size: Size = (400, 300)  # width and height, pixels
    steps: Count = 1_500  # of radiance training
    max_gaussians: Count = 50_000  # of a room
    encoder: str = "demo"
    """"demo" for the bundled one, a folder, a hub id; clip-geometry:OWN[,ALIKE], vectors made from truth with
    the geometry of CLIP, OWN being the cosine of an image with its words (0.25, 0.27, 0.29); or
    real:PATH[,RULE], real text vectors, and image vectors from what LangSplat's decoder PATH (.pth, or a
    folder of some) makes of its sphere, by one rule or several (`tests/benchmarks/oracles.py`)."""
    text_vectors: Path | None = None  # .npy of real text vectors for clip-geometry, names in a .txt beside it


@dataclass(frozen=True)
class Variant:
    """One method: each stage the ordinary one, one that makes no mistake, or another's."""

    name: str
    masks: MaskOrigin
    vectors: Literal["image", "text"] = "image"  # text: of every region's true words
    codec: CodecConfig = CodecConfig()  # noqa: RUF009 (frozen)
    lift: LiftConfig = LiftConfig()  # noqa: RUF009
    query: Literal["blend answers", "paper"] = "blend answers"  # paper: blend latents, then decode
    level: LevelChoice = "auto"  # that is asked


def weights_digest(model: str) -> str:
    """Digest of an encoder's weights: a folder may be filled with others under the same name."""
    found, digest = model_path(model, "--encoder"), hashlib.sha256()
    for path in sorted([*found.glob("*.safetensors"), *found.glob("*.bin")]) if found.is_dir() else [found]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


@dataclass(frozen=True)
class InRooms:
    """Options of every report that is measured in rooms with known truth."""

    tiers: tuple[Tier, ...] = ("clutter",)  # how crowded the rooms are
    seeds: Seeds = (301, 302, 303, 304, 305)
    """One room of every tier each; never the bundled scene's. 201 to 203 calibrate the demo encoder."""
    settings: Annotated[RoomSettings, tyro.conf.arg(name="")] = field(default_factory=RoomSettings)
    work: OutFolder = Path("eval_out")
    """Folder for the rooms and all intermediate results: an interrupted run goes on."""
    out: OutFolder = Path("bench_out")
    """Folder for the report: its tables (.md) and figures (.json, some .png)."""

    def rooms(self, progress: Progress) -> "Iterator[Room]":
        """Every room, not yet made. Raises InputError for settings without a room that can be measured."""
        check_settings(self)
        if not self.tiers:
            raise InputError("name at least one of --tiers")
        if SEED in self.seeds:
            raise InputError(
                f"--seeds {SEED} is the bundled scene's room, on which things were tuned; take another seed"
            )
        model = self.settings.encoder
        told = read_truth_encoder(model, self.settings.text_vectors)
        encoder: tuple[Encoder | TruthEncoder, str] = (
            (load_encoder(model), weights_digest(model)) if told is None else (told, told.digest)
        )
        for tier, seed in product(self.tiers, self.seeds):
            own = labelled(progress, f"{tier} {seed}, ")
            yield Room(self.settings, tier, seed, self.work, encoder, own)

    def each(self, measure: "Callable[[Room], Iterable[Row]]") -> list[Row]:
        """What is measured in every room, one after another."""
        with TerminalProgress() as progress:
            return [row for room in self.rooms(progress) for row in measure(room)]


class Room:
    """One room and everything that is derived from it; each part is made once, when it is first needed."""

    def __init__(
        self,
        config: RoomSettings,
        tier: Tier,
        seed: int,
        work: Path,
        encoder: tuple[Encoder | TruthEncoder, str],
        progress: Progress,
    ) -> None:
        width, height = config.size
        self.config, self.tier, self.seed, self.progress = config, tier, seed, progress
        self._encoder, self.weights = encoder
        self.folder = work / f"{tier}-{seed}-{config.views}x{width}x{height}"
        self.settings = TrainConfig(
            dataset=DatasetConfig(max_side=max(config.size), test_every=HOLD_OUT, hold_out="every"),
            radiance=RadianceConfig(steps=config.steps, sh_degree=1, max_gaussians=config.max_gaussians),
            clip=ClipConfig(model=config.encoder),
        )
        self.seconds: dict[str, float] = {}

    @cached_property
    def photographs(self) -> Path:
        """Folder of the photographs, rendered if need be, with the truth in it."""
        folder, config = self.folder / "photographs", self.config
        if not (folder / "transforms.json").exists():
            with self._timed("photographs"):
                write_dataset(folder, self.seed, config.views, config.size, self.progress, self.tier)
        return folder

    @cached_property
    def capture(self) -> Capture:
        photographs = self.photographs
        with self._timed("photographs"):
            return load_capture(photographs, self.settings.dataset, self.folder, self.progress)

    @cached_property
    def truth(self) -> Truth:
        return read_truth(self.photographs)

    @cached_property
    def encoder(self) -> Encoder | TruthEncoder:
        """The encoder; one that looks at the truth as it is in this room."""
        known = self._encoder
        return known.in_room(self.truth, self.seed) if isinstance(known, TruthEncoder) else known

    @cached_property
    def gaussians(self) -> Gaussians:
        """Gaussians that were trained without the held-out views."""
        train, _ = self.capture.split(HOLD_OUT)
        with self._timed("radiance"):
            settings = self.settings.radiance
            return trained_gaussians(self.capture, train, settings, self.folder, self.progress)

    @cached_property
    def labels(self) -> Array:
        """The (3, N) truth ids of every Gaussian."""
        path = self.folder / f"{stage_key('labels', 1, means_checksum(self.gaussians.means))}.npy"
        if not path.exists():
            views = [(camera, self.truth.labels(camera.name)) for camera in self.capture.cameras]
            with self._timed("labels of the Gaussians"):
                write_npy(path, true_labels(CpuRasterizer(), self.gaussians, views))
        stored: Array = np.load(path, allow_pickle=False)
        return stored

    def views(self, variant: Variant) -> Views:
        """The training views with masks and vectors."""
        train, _ = self.capture.split(HOLD_OUT)
        cameras = [self.capture.cameras[i] for i in train]
        with self._timed(f"masks ({variant.masks}) and vectors"):
            features = self._features("truth" if variant.masks == "wrong" else variant.masks, train, cameras)
        ids = [self.truth.labels(camera.name) for camera in cameras]
        if isinstance(self.encoder, TruthEncoder):
            seen = enumerate(zip(features, ids, strict=True))
            features = [self.encoder.describe(item, true, self.truth, row) for row, (item, true) in seen]
        if variant.masks == "wrong":
            features = [with_wrong_vectors(item, seed) for seed, item in enumerate(features)]
        if variant.vectors == "text":
            words = phrase_vectors(self.truth, self.encoder)
            told = [oracle_vectors(item, true, words) for item, true in zip(features, ids, strict=True)]
            features = moved_to_images(told, features)
        return list(zip(cameras, features, strict=True))

    def _features(
        self, outlines: MaskOrigin, train: Sequence[int], cameras: Sequence[Camera]
    ) -> Sequence[ImageFeatures]:
        source: MaskSource = TruthMasks(self.capture, self.truth)
        if outlines == "graph":
            source = load_mask_source(MaskConfig(source="graph"))
        photographs, names = [self.capture.images[i] for i in train], [camera.name for camera in cameras]
        encoder, shared = cast(Encoder, self.encoder), self.progress
        if source.agrees:
            store = FeatureStore(self.folder / f"features-{outlines}-{self.weights}")
            return describe_capture(photographs, names, source, encoder, store, shared)
        store = FeatureStore(self.folder / f"features-{outlines}-none")
        rough = zip(cameras, describe_capture(photographs, names, source, None, store, shared), strict=True)
        images, work = [(image, None) for image in photographs], self.folder / f"agreed-{self.weights}"
        stages = Stages(self.gaussians, list(rough), encoder, self.settings, work, shared)
        return agreed_features(stages, images)

    def field(self, variant: Variant, fresh: bool = False) -> tuple[LanguageField, CodecReport, float]:
        """The language field, what its codec loses, and seconds; `fresh` takes nothing that was kept."""
        views, start = self.views(variant), time.perf_counter()
        settings = replace(self.settings, codec=variant.codec, lift=variant.lift)
        with TemporaryDirectory(dir=self.folder) as empty, self._timed(f"language field ({variant.name})"):
            work = Path(empty) if fresh else self.folder
            encoder = cast(Encoder, self.encoder)
            made = language_field(Stages(self.gaussians, views, encoder, settings, work, self.progress))
        return *made, round(time.perf_counter() - start, 1)

    def engine(self, variant: Variant, cameras: Sequence[Camera] = ()) -> QueryEngine:
        """Questions to the scene with a variant's field."""
        scene = Scene(self.gaussians, self.field(variant)[0], tuple(cameras))
        return QueryEngine(scene, lambda _: self.encoder)

    def measure(self, variant: Variant, fresh: bool = False) -> Measured:
        """Ask everything of a variant's field, and compare the answers with the truth.

        fresh: take nothing that was kept, so that seconds count.
        """
        field, loss, seconds = self.field(variant, fresh)
        paper_order = variant.query == "paper"
        rule: AnswerRule = "peak" if paper_order else "regions"
        # What is no codec has its numbers at hand; going through a codec's interface takes seconds a phrase.
        whole = field.codec.latent_dim == field.codec.vector_dim
        engine = QueryEngine(Scene(self.gaussians, field), lambda _: self.encoder, exact=whole, rule=rule)
        absent, progress = self.truth.absent(EVERYTHING), labelled(self.progress, f"{variant.name}: ")
        with self._timed(f"queries ({variant.name})"):
            asked = ask(engine, self.texts, variant.level)
            scores = evaluate(asked, CpuRasterizer(), self.held_out, self.truth, paper_order, progress)
            direct = evaluate_direct(asked, self.labels, self.truth)
        return replace(
            measured(asked, self.truth, absent, scores, direct),
            **{key: getattr(variant, key) for key in ("name", "masks", "vectors", "query")},
            codec=f"{field.codec.kind} {field.codec.size}",
            codec_loss=loss,
            fit_seconds=seconds,
            bytes_per_gaussian=field.latents.nbytes / max(len(field), 1),
            frame_ms=1000 * median(seconds_of(lambda: self._frame(asked, variant)) for _ in range(FRAMES)),
        )

    @cached_property
    def texts(self) -> list[str]:
        """Phrases that are asked: everything that is there, and things that are not."""
        return [*(phrase.text for phrase in self.truth.phrases), *self.truth.absent(EVERYTHING)]

    @cached_property
    def held_out(self) -> list[Camera]:
        return [self.capture.cameras[i] for i in self.capture.split(HOLD_OUT)[1]]

    def _frame(self, asked: Asked, variant: Variant) -> None:
        """Project one held-out view and draw one phrase into it; in the paper's order its best level of
        three, which takes all three of them."""
        view, gate = CpuRasterizer().view(self.gaussians, self.held_out[0]), PictureConfig().alpha_gate
        answer = next(iter(asked.answers.values()))
        if variant.query != "paper":
            splatted_relevancy(view, answer.relevancy[answer.level][:, None], gate)
            return
        vector = asked.engine.texts.of([answer.phrase])
        for level in range(len(LEVELS)):
            decoded_relevancy(view, asked.engine.field, level, vector, gate)

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = round(self.seconds.get(name, 0.0) + time.perf_counter() - start, 1)


def labelled(progress: Progress, prefix: str) -> Progress:
    """`progress` under labels that begin with `prefix`."""
    return Progress(lambda at: progress.show(replace(at, stage=prefix + at.stage)))


def publish(command: Any, name: str, title: str, text: str, rows: Sequence[Any]) -> None:
    """Print a report's tables, and write them and all figures into `command.out`.

    The figures are those of its rows, dataclasses, and the settings of its command, another one.
    """
    line = f"python -m tests.benchmarks {shlex.join(sys.argv[1:])}"
    figures = {"settings": asdict(command), "rows": [asdict(row) for row in rows]}
    write_report(command.out, name, f"# {title}\n\n    {line}\n\n{text}", figures)
    print(text)
