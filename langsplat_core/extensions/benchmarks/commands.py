"""`langsplat eval ...` and `langsplat bench ...`: the field's benchmarks, and speed against error."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from langsplat_core.cli.arguments import EncoderOption, OutFile, OutFolder
from langsplat_core.config import ClipConfig, MaskConfig, TrainConfig, TrainPreset, with_preset
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks.config import QueryBenchConfig, RasterBenchConfig
from langsplat_core.extensions.benchmarks.profiles import (
    LERF_PROFILES,
    OVS_PROFILES,
    LerfProtocol,
    OvsProtocol,
    Profile,
)
from langsplat_core.io.files import atomic_path
from langsplat_core.io.sidecar import SUFFIX
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import searchable
from langsplat_core.semantics.encoders import load_text_encoder

if TYPE_CHECKING:
    from langsplat_core.extensions.benchmarks.labels import Benchmark

SceneAndData = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="[SCENE] DATA")]


@dataclass(frozen=True)
class _Eval:
    paths: tyro.conf.Positional[SceneAndData]
    """A scene of ours, or a folder with one NAME.ply for each of the benchmark's scenes; then the folder of
    the benchmark, or one scene's folder of it. With --maps the latter alone."""
    maps: Path | None = None
    """Score these maps of another system, files named VIEW/PHRASE.npy or .png, instead of a scene."""
    only: tuple[str, ...] = ()
    """Names of the benchmark's scenes to score; all of them if empty."""
    json: OutFile | None = None
    """Also write all figures to this file."""
    encoder: EncoderOption = ""

    def scene_and_data(self) -> tuple[Path | None, Path]:
        """Return the scene, None for maps, and the benchmark's folder."""
        wanted = 1 if self.maps else 2
        if len(self.paths) != wanted:
            raise InputError(
                "give the benchmark's folder alone with --maps"
                if self.maps
                else "give a scene and the benchmark's folder, or the folder alone and --maps FOLDER"
            )
        return (None if self.maps else self.paths[0]), self.paths[-1]


@dataclass(frozen=True)
class _EvalLabels(_Eval):
    pictures: OutFolder | None = None
    """Also write one image per query into this folder."""
    paper_order: bool = False
    """Blend latents and decode every pixel, as the paper does, not the relevancies; no codebook can."""
    train: bool = False
    """Give DATA alone: every scene of it is trained from the photographs beside the labels first, with the
    settings of `langsplat train`, which no benchmark has chosen; an interrupted run continues."""
    out: OutFolder = Path("benchmark_scenes")
    """Folder for the scenes of --train; those in it are not trained again."""
    preset: TrainPreset = "full"
    """Of --train, as of `langsplat train`."""
    clip: ClipConfig = field(default_factory=ClipConfig)
    masks: MaskConfig = field(default_factory=MaskConfig)

    def scene_and_data(self) -> tuple[Path | None, Path]:
        """Return the scene, a file or folder, and the benchmark's folder; --train puts scenes into --out."""
        if not self.train:
            return super().scene_and_data()
        if self.maps or len(self.paths) != 1:
            raise InputError("--train trains the scenes itself; give the benchmark's folder alone")
        return self.out, self.paths[0]

    def evaluate(self, benchmark: "Benchmark", profile: Profile) -> None:
        """Train the scenes with --train, score them, print the tables and write the files asked for."""
        from langsplat_core.extensions.benchmarks.report import (
            Evaluated,
            beside_published,
            run_benchmark,
            save_json,
            table,
        )
        from langsplat_core.semantics.encoders import load_text_encoder

        failed = self._train(benchmark) if self.train else {}
        left = [name for name in self.only or benchmark.scenes if name not in failed]
        reasons = "; ".join(f"{name}: {reason}" for name, reason in failed.items())
        if failed and not left:
            raise InputError(reasons)
        only = tuple(left) if failed else self.only
        subject = Evaluated(self.scene_and_data()[0], self.maps, self.encoder, self.paper_order)
        with TerminalProgress() as progress:
            report = run_benchmark(
                benchmark, profile, subject, load_text_encoder, only, self.pictures, progress
            )
        print(table(report))
        published = beside_published(report)
        if published:
            print(f"\n{published}")
        if self.json is not None:
            save_json(self.json, report)
        if failed:
            raise InputError(f"not trained, and not in the table: {reasons}")

    def _train(self, benchmark: "Benchmark") -> dict[str, str]:
        """Train the scenes that --out lacks; names of those that could not be trained -> the reason."""
        from langsplat_core.pipeline.train import train_scene

        config = with_preset(TrainConfig(clip=self.clip, masks=self.masks), self.preset)
        failed = {}
        for name in self.only or benchmark.scenes:
            scene, path = benchmark.scenes.get(name), self.out / f"{name}.ply"
            if scene is None or (path.exists() and path.with_suffix(SUFFIX).exists()):
                continue  # an unknown name is complained of where all are looked up
            try:
                with TerminalProgress() as progress:
                    train_scene(scene.dataset, path, config, progress=progress)
            except InputError as error:
                failed[name] = str(error)
        return failed


@dataclass(frozen=True)
class EvalLerfOvs(_EvalLabels):
    """LERF-OVS: mIoU and localisation in labelled frames, by a named protocol.

    DATA is the folder with label/SCENE/FRAME.json. Frames are matched to views by name; the cameras of those
    that the scene was not trained on are taken from the dataset beside the labels.
    """

    protocol: LerfProtocol = "langsplat-code"
    """Whose constants: filters, cut and choice of level; docs/evaluating.md lists them."""

    def run(self) -> None:
        from langsplat_core.extensions.benchmarks.labels import read_lerf_ovs

        self.evaluate(read_lerf_ovs(self.scene_and_data()[1]), LERF_PROFILES[self.protocol])


@dataclass(frozen=True)
class EvalOvs3d(_EvalLabels):
    """3D-OVS: mIoU of every class in every labelled view, by a named protocol.

    DATA is a folder with segmentations/classes.txt and segmentations/VIEW/CLASS.png, or one of several.
    """

    protocol: OvsProtocol = "langsplat-paper"
    """Whose constants: cut and choice of level; docs/evaluating.md lists them."""

    def run(self) -> None:
        from langsplat_core.extensions.benchmarks.labels import read_3d_ovs

        self.evaluate(read_3d_ovs(self.scene_and_data()[1]), OVS_PROFILES[self.protocol])


@dataclass(frozen=True)
class EvalScanNet(_Eval):
    """ScanNet, direct in 3D: mIoU and mAcc of 19, 15 and 10 classes among the labelled vertices.

    DATA is a folder of NAME/NAME_vh_clean_2.labels.ply; maps are NAME.npy, one class id per vertex.
    """

    def run(self) -> None:
        from langsplat_core.extensions.benchmarks.report import Evaluated
        from langsplat_core.extensions.benchmarks.scannet import (
            point_table,
            read_scannet,
            run_scannet,
            save_point_json,
        )
        from langsplat_core.semantics.encoders import load_text_encoder

        scene, data = self.scene_and_data()
        with TerminalProgress() as progress:
            subject = Evaluated(scene, self.maps, self.encoder)
            report = run_scannet(read_scannet(data), subject, load_text_encoder, self.only, progress)
        print(point_table(report))
        if self.json is not None:
            save_point_json(self.json, report)


# `langsplat bench`.


@dataclass(frozen=True)
class BenchRaster:
    """Time, error and memory of every rasterizer that loads here, in one run; takes some minutes."""

    quick: bool = False
    """Fewer and smaller scenes, in about a minute; --counts and --sizes are then not read."""
    config: Annotated[RasterBenchConfig, tyro.conf.arg(name="")] = field(default_factory=RasterBenchConfig)
    out: OutFolder = Path("bench_out")
    """Folder for raster.md, raster.json and raster.png."""

    def run(self) -> None:
        from langsplat_core.extensions.benchmarks.raster_speed import RasterReport, plot, quick_plan, run_plan

        def keep(report: RasterReport) -> None:
            draw = partial(plot, report.rows)
            write_report(self.out, "raster", report.text, report.figures, draw)

        with TerminalProgress() as progress:
            report = run_plan(quick_plan(self.config) if self.quick else self.config, progress, keep)
        keep(report)
        print(report.text)


@dataclass(frozen=True)
class BenchQuery:
    """Time phrases, cameras and frames on one scene in the paper's order and in ours, beside the error.

    The paper's order, a table and a codebook are compared by the error of relevancy. Some minutes, nearly all
    of them the paper's order.
    """

    scene: tyro.conf.Positional[Path]
    """A scene with a codebook, and its cameras beside it."""
    config: Annotated[QueryBenchConfig, tyro.conf.arg(name="")] = field(default_factory=QueryBenchConfig)
    out: OutFolder = Path("bench_out")
    """Folder for query.md and query.json."""

    def run(self) -> None:
        scene = searchable(self.scene)
        assert scene.language is not None
        from langsplat_core.extensions.benchmarks.query_speed import measure_queries, query_table

        encoder = load_text_encoder(scene.language.encoder_id)
        with TerminalProgress() as progress:
            report = measure_queries(scene, encoder, self.config, progress)
        table = query_table(report)
        write_report(self.out, "query", table, {"config": asdict(self.config), "report": asdict(report)})
        print(table)


def write_report(
    out: Path, name: str, text: str, figures: Any, plot: Callable[[Path], None] | None = None
) -> None:
    """Write `name`.md, .json and, with `plot`, .png into the folder `out`, each whole or not at all."""
    with atomic_path(out / f"{name}.md") as path:
        path.write_text(text, encoding="utf-8")
    with atomic_path(out / f"{name}.json") as path:
        path.write_text(json.dumps(figures, indent=1, default=str), encoding="utf-8")
    if plot is not None:
        with atomic_path(out / f"{name}.png") as path:
            plot(path)
