"""`langsplat eval ...`: scores of a scene, or of another system's maps, on published benchmarks."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.arguments import EncoderOption, Needs, OutFile
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks import profiles
from langsplat_core.extensions.benchmarks.labels import Benchmark, read_3d_ovs, read_gr_lerf, read_lerf_ovs
from langsplat_core.extensions.benchmarks.report import Evaluated, run_benchmark, save_json, table
from langsplat_core.progress import TerminalProgress
from langsplat_core.semantics.encoders import load_text_encoder


@dataclass(frozen=True)
class _Eval:
    paths: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="[SCENE] DATA")]]
    """A scene, or a folder with NAME.ply for each of the benchmark's scenes; then the folder of the
    benchmark, or of one of its scenes. With --maps only the latter."""
    maps: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Score these maps of another system, files named VIEW/PHRASE.npy or .png, instead of a scene."""
    json: OutFile | None = None
    """Also write all figures to this file."""
    encoder: Annotated[EncoderOption, Needs("is_ours", "a scene in place of --maps")] = ""

    @property
    def is_ours(self) -> bool:
        """True if a scene is scored, False for maps of another system."""
        return self.maps is None

    def evaluate(self, read: Callable[[Path], Benchmark], profile: profiles.Profile) -> None:
        """Score the scene or maps, print the tables and write the JSON file."""
        if self.maps is not None and len(self.paths) != 1:
            raise InputError("give the benchmark's folder alone with --maps")
        if self.maps is None and len(self.paths) != 2:
            raise InputError("give a scene and the benchmark's folder, or the folder alone and --maps FOLDER")
        subject = Evaluated(self.paths[0] if self.is_ours else None, self.maps, self.encoder)
        benchmark = read(self.paths[-1])
        with TerminalProgress() as progress:
            report = run_benchmark(benchmark, profile, subject, load_text_encoder, progress)
        print(table(report))
        if self.json is not None:
            save_json(self.json, report)


@dataclass(frozen=True)
class EvalLerfOvs(_Eval):
    """LERF-OVS: mIoU and localisation in labelled frames, by a named protocol.

    DATA is the folder with label/SCENE/FRAME.json. Frames are matched to views by name; cameras of frames
    that the scene was not trained on are read from the dataset beside the labels.
    """

    protocol: profiles.LerfProtocol = "langsplat-code"
    """Constants of the evaluation: filters, cut and choice of level; docs/evaluating.md lists them."""

    def run(self) -> None:
        self.evaluate(read_lerf_ovs, profiles.LERF_PROFILES[self.protocol])


@dataclass(frozen=True)
class EvalGrLerf(_Eval):
    """GR-LERF: phrases for none, one or several things; gIoU, and accuracy for phrases that name nothing.

    DATA is a folder with SCENE/json/test_json/FRAME.json, or one SCENE; docs/evaluating.md has the layout.
    """

    protocol: profiles.LerfProtocol = "ours"
    """Constants of the evaluation, as for lerf-ovs; those of LangSplat never give an empty answer."""

    def run(self) -> None:
        self.evaluate(read_gr_lerf, profiles.GR_PROFILES[self.protocol])


@dataclass(frozen=True)
class EvalOvs3d(_Eval):
    """3D-OVS: mIoU of every class in every labelled view, by a named protocol.

    DATA is a folder with segmentations/classes.txt and segmentations/VIEW/CLASS.png, or one of several.
    """

    protocol: profiles.OvsProtocol = "langsplat-paper"
    """Constants of the evaluation: cut and choice of level; docs/evaluating.md lists them."""

    def run(self) -> None:
        self.evaluate(read_3d_ovs, profiles.OVS_PROFILES[self.protocol])
