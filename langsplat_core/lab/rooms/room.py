"""One procedural room: photographs, Gaussians, masks, meanings and answers, each made once, by the ordinary
pipeline, and compared with the truth."""

import hashlib
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import (
    ClipConfig,
    DatasetConfig,
    MaskConfig,
    PictureConfig,
    RadianceConfig,
    TrainConfig,
)
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.capture import Capture
from langsplat_core.io.hostile import write_npy
from langsplat_core.io.language import means_checksum
from langsplat_core.lab.config import BenchmarkConfig, MaskOrigin, Tier
from langsplat_core.lab.rooms.clip_geometry import ClipGeometry, read_geometry
from langsplat_core.lab.rooms.oracles import (
    TruthMasks,
    moved_to_pictures,
    oracle_vectors,
    phrase_vectors,
    true_labels,
    with_wrong_vectors,
)
from langsplat_core.lab.rooms.report import Measured, RoomReport, codec_name, measured
from langsplat_core.lab.rooms.scoring import (
    Asked,
    Judge,
    Reading,
    ask,
    evaluate,
    evaluate_direct,
)
from langsplat_core.lab.rooms.tiles import TileMasks
from langsplat_core.lab.rooms.truth import Truth, read_truth
from langsplat_core.lab.rooms.variants import Variant, variants
from langsplat_core.lab.world.objects.catalogue import EVERYTHING
from langsplat_core.lab.world.photographs import write_dataset
from langsplat_core.pipeline.language import Views, language_field
from langsplat_core.pipeline.stages import stage_key
from langsplat_core.pipeline.train import trained_gaussians
from langsplat_core.progress import Progress
from langsplat_core.query.answers import AnswerRule
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.lookup import decoded_relevancy, splatted_relevancy
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import LEVELS, Camera, Gaussians, LanguageField, Scene
from langsplat_core.semantics.encoder import Encoder
from langsplat_core.semantics.encoders import load_encoder, model_path
from langsplat_core.semantics.masks import MaskSource
from langsplat_core.semantics.sam import load_mask_source
from langsplat_core.semantics.store import FeatureStore, ImageFeatures, describe_capture
from langsplat_core.training.language.codec_fit import CodecReport
from langsplat_core.training.radiance.train import evaluate_views

HOLD_OUT = 8  # every so many views, one is not trained on
FRAMES = 5  # timed pictures of one phrase


def weights_digest(model: str) -> str:
    """Of an encoder's weights: a folder may be filled with others under the same name."""
    found, digest = model_path(model, "--encoder"), hashlib.sha256()
    for path in sorted([*found.glob("*.safetensors"), *found.glob("*.bin")]) if found.is_dir() else [found]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def room_encoder(model: str, text_vectors: Path | None = None) -> tuple[Encoder | ClipGeometry, str]:
    """An encoder, simulated ones included (`read_geometry`), and the digest of its weights."""
    geometry = read_geometry(model, text_vectors)
    if geometry is None:
        return load_encoder(model), weights_digest(model)
    return geometry, geometry.digest


def train_config(config: BenchmarkConfig) -> TrainConfig:
    """The settings with which every room is trained."""
    return TrainConfig(
        dataset=DatasetConfig(max_side=max(config.size), test_every=HOLD_OUT),
        radiance=RadianceConfig(steps=config.steps, sh_degree=1, max_gaussians=config.max_gaussians),
        clip=ClipConfig(model=config.encoder),
    )


class Room:
    """One room and everything that is derived from it, each made once, when it is first needed."""

    def __init__(
        self,
        config: BenchmarkConfig,
        tier: Tier,
        seed: int,
        work: Path,
        encoder: tuple[Encoder | ClipGeometry, str],
        progress: Progress,
    ) -> None:
        width, height = config.size
        self.config, self.tier, self.seed, self.progress = config, tier, seed, progress
        self.encoder, self.weights = encoder
        self.folder = work / f"{tier}-{seed}-{config.views}x{width}x{height}"
        self.settings = train_config(config)
        self.seconds: dict[str, float] = {}

    @cached_property
    def photographs(self) -> Path:
        """Their folder, rendered if need be, with the truth in it."""
        folder, start = self.folder / "photographs", time.perf_counter()
        if not (folder / "transforms.json").exists():
            write_dataset(folder, self.seed, self.config.views, self.config.size, self.progress, self.tier)
            self._lap("photographs", start)
        return folder

    @cached_property
    def capture(self) -> Capture:
        """The photographs."""
        start = time.perf_counter()
        capture = load_capture(self.photographs, self.settings.dataset, self.folder, self.progress)
        self._lap("photographs", start)
        return capture

    @cached_property
    def truth(self) -> Truth:
        """What is in them."""
        return read_truth(self.photographs)

    @cached_property
    def gaussians(self) -> Gaussians:
        """Trained without the held-out views."""
        train, _ = self.capture.split(HOLD_OUT)
        start = time.perf_counter()
        gaussians = trained_gaussians(self.capture, train, self.settings, self.folder, self.progress)
        self._lap("radiance", start)
        return gaussians

    @cached_property
    def labels(self) -> Array:
        """(3, N) what every Gaussian truly is."""
        path = self.folder / f"{stage_key('labels', 1, means_checksum(self.gaussians.means))}.npy"
        if not path.exists():
            start = time.perf_counter()
            views = [(camera, self.truth.labels(camera.name)) for camera in self.capture.cameras]
            labels = true_labels(CpuRasterizer(), self.gaussians, views, self.progress)
            write_npy(path, labels)
            self._lap("labels of the Gaussians", start)
        stored: Array = np.load(path, allow_pickle=False)
        return stored

    def views(self, variant: Variant) -> Views:
        """The training views with masks and vectors."""
        outlines = "truth" if variant.masks == "wrong" else variant.masks
        source = self._masks(outlines)
        train, _ = self.capture.split(HOLD_OUT)
        cameras = [self.capture.cameras[i] for i in train]
        start = time.perf_counter()
        features: Sequence[ImageFeatures] = describe_capture(
            [self.capture.images[i] for i in train],
            [camera.name for camera in cameras],
            source,
            self.encoder,
            FeatureStore(self.folder / f"features-{outlines}-{self.weights}"),
            self.progress,
        )
        self._lap(f"masks ({variant.masks}) and vectors", start)
        if isinstance(self.encoder, ClipGeometry):
            features = [
                self.encoder.describe(item, self.truth.labels(camera.name), self.truth, row)
                for row, (item, camera) in enumerate(zip(features, cameras, strict=True))
            ]
        if variant.masks == "wrong":
            features = [with_wrong_vectors(item, seed) for seed, item in enumerate(features)]
        if variant.vectors == "text":
            words = phrase_vectors(self.truth, self.encoder)
            told = [
                oracle_vectors(item, self.truth.labels(camera.name), words)
                for item, camera in zip(features, cameras, strict=True)
            ]
            features = moved_to_pictures(told, features)
        return list(zip(cameras, features, strict=True))

    def _masks(self, outlines: MaskOrigin) -> MaskSource:
        if outlines == "graph":
            return load_mask_source(MaskConfig(source="graph"))
        return TileMasks() if outlines == "tiles" else TruthMasks(self.capture, self.truth)

    def field(self, variant: Variant, fresh: bool = False) -> tuple[LanguageField, CodecReport, float]:
        """What the Gaussians mean, what the codec loses, and seconds; `fresh` takes nothing that was kept."""
        views, start = self.views(variant), time.perf_counter()
        settings = replace(self.settings, codec=variant.codec, lift=variant.lift)
        with TemporaryDirectory(dir=self.folder) as empty:
            work = Path(empty) if fresh else self.folder
            encoder = cast(Encoder, self.encoder)
            made = language_field(self.gaussians, views, encoder, settings, work, self.progress)
        self._lap(f"language field ({variant.name})", start)
        return *made, round(time.perf_counter() - start, 1)

    def measure(self, variant: Variant, fresh: bool = False) -> Measured:
        """Ask everything; the method's own order of work but for what `variant` says. fresh: see `field`."""
        field, loss, seconds = self.field(variant, fresh)
        return replace(self.measure_field(field, variant), codec_loss=loss, fit_seconds=seconds)

    def rule(self, variant: Variant) -> AnswerRule:
        """How answers are read; the paper's own ones by their peak."""
        return "regions" if self.config.cut == "regions" and variant.query != "paper" else "peak"

    def measure_field(self, field: LanguageField, variant: Variant) -> Measured:
        """Ask everything of what the Gaussians are said to mean."""
        start = time.perf_counter()
        # What is no codec has its numbers at hand; going through a codec's interface takes seconds a phrase.
        whole = field.codec.latent_dim == field.codec.vector_dim
        engine = QueryEngine(
            Scene(self.gaussians, field), lambda _: self.encoder, exact=whole, rule=self.rule(variant)
        )
        asked = ask(engine, self.texts, variant.level)
        self._lap(f"queries ({variant.name})", start)
        frame_ms = 1000 * median_seconds(lambda: self._frame(asked, variant))
        return replace(
            self.measure_asked(asked, variant),
            codec=codec_name(field.codec),
            bytes_per_gaussian=field.latents.nbytes / max(len(field), 1),
            frame_ms=frame_ms,
        )

    @cached_property
    def texts(self) -> list[str]:
        """What is asked: everything that is there, and things that are not."""
        return [*(phrase.text for phrase in self.truth.phrases), *self.truth.absent(EVERYTHING)]

    def measure_asked(self, asked: Asked, variant: Variant, judge: Judge | None = None) -> Measured:
        """Compare answers to `texts` with the truth. judge: see `scoring.evaluate`; the answers are then cut
        half way between the floor and their peak among the Gaussians too."""
        start = time.perf_counter()
        reading = Reading(variant.query == "paper", self.config.cut)
        progress = labelled(self.progress, f"{variant.name}: ")
        scores = evaluate(asked, CpuRasterizer(), self.held_out, self.truth, reading, progress, judge)
        direct = evaluate_direct(asked, self.labels, self.truth, "floor" if judge else self.config.cut)
        result = measured(asked, self.truth, self.truth.absent(EVERYTHING), scores, direct)
        self._lap(f"queries ({variant.name})", start)
        return replace(
            result, **{key: getattr(variant, key) for key in ("name", "masks", "vectors", "query")}
        )

    @cached_property
    def held_out(self) -> list[Camera]:
        """Cameras of the views that nothing was trained on."""
        return [self.capture.cameras[i] for i in self.capture.split(HOLD_OUT)[1]]

    def _frame(self, asked: Asked, variant: Variant) -> None:
        """Project one held-out view and draw one phrase into it; in the paper's order its best level of
        three, which takes all three of them."""
        view = CpuRasterizer().view(self.gaussians, self.held_out[0])
        answer = next(iter(asked.answers.values()))
        if variant.query != "paper":
            splatted_relevancy(view, answer.values[:, None], PictureConfig().alpha_gate)
            return
        for level in range(len(LEVELS)):
            decoded_relevancy(
                view, asked.engine.field, level, answer.vector[None], PictureConfig().alpha_gate
            )

    def report(self) -> RoomReport:
        """Measure what the settings ask for."""
        _, held_out = self.capture.split(HOLD_OUT)
        rows = [self.measure(variant) for variant in variants(self.config, self.encoder.dim)]
        views = evaluate_views(self.gaussians, self.capture, held_out)
        return RoomReport(
            tier=self.tier,
            seed=self.seed,
            views=len(self.capture) - len(held_out),
            held_out=len(held_out),
            gaussians=len(self.gaussians),
            psnr=float(np.mean([view.psnr for view in views])),
            encoder=self.encoder.id,
            cut=self.config.cut,
            measured=tuple(rows),
            seconds=self.seconds,
        )

    def _lap(self, name: str, start: float) -> None:
        self.seconds[name] = round(self.seconds.get(name, 0.0) + time.perf_counter() - start, 1)


def labelled(progress: Progress, prefix: str) -> Progress:
    """Reports under labels that begin with `prefix`."""
    return Progress(lambda at: progress.show(replace(at, stage=prefix + at.stage)))


def median_seconds(work: Callable[[], object]) -> float:
    """Of several runs; PyTorch's first takes longer."""
    times = []
    for _ in range(FRAMES):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)
