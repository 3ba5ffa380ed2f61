"""`langsplat train`: photographs -> scene.ply with a language field."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from langsplat_core.cli.arguments import OutFile, OutFolder, codec_settings, named
from langsplat_core.config import (
    PAPER,
    TrainConfig,
    TrainPreset,
    TrainProfile,
    with_preset,
)
from langsplat_core.progress import LineProgress, TerminalProgress, silent


@dataclass(frozen=True)
class Train:
    """Train a searchable scene from photographs.

    DATASET is a COLMAP folder, a nerfstudio transforms.json, a video or a plain folder of photographs. An
    interrupted run continues where it stopped.
    """

    dataset: tyro.conf.Positional[Path]
    """Folder of photographs, video, COLMAP project folder, or transforms.json."""
    out: OutFile
    """The scene to write, *.ply; its language field and cameras are written beside it."""
    work: OutFolder | None = None
    """Folder for intermediate results (default: <out>.work)."""
    profile: TrainProfile = "default"
    """"paper" starts from the published method's settings; options beside it still count."""
    preset: TrainPreset = "full"
    """How much is spent: quick takes minutes on a CPU, good perhaps half an hour, full is as published and
    for a GPU; options beside it still count."""
    progress: Literal["bars", "lines"] = "bars"
    """How progress is shown: as bars, or for other programs as lines of JSON (stage, fraction, note,
    metrics), both on standard error."""
    gaussians: Path | None = None
    """Take the Gaussians of this scene, trained elsewhere from the same cameras, and describe them."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def run(self) -> None:
        """Train, and print the figures of the scene."""
        # They import torch: seconds that --help need not pay.
        from langsplat_core.errors import shortened
        from langsplat_core.pipeline.report import PAGE, work_folder
        from langsplat_core.pipeline.stages import join_processes
        from langsplat_core.pipeline.train import train_scene

        processes = join_processes()
        shown = LineProgress() if self.progress == "lines" else TerminalProgress()
        with shown if processes.is_main else nullcontext(silent) as progress:
            report = train_scene(
                self.dataset,
                self.out,
                self.config,
                self.work,
                progress,
                processes=processes,
                gaussians_from=self.gaussians,
            )
        if not processes.is_main:
            return
        names = shortened(view.name for view in report.held_out_views)
        small = "" if report.psnr_small is None else f", {report.psnr_small:.2f} dB at 320 px"
        psnr = (
            "none held out, so that nothing was measured"
            if report.psnr is None
            else f"held-out PSNR {report.psnr:.2f} dB{small} ({names})"
        )
        print(
            f"{self.out}: {report.gaussians} Gaussians from {report.views} photographs, {psnr}; "
            f"{report.mask_count} masks by {report.masks}, encoder {report.encoder}; "
            f"{report.codec} of {report.codec_size}, relevancy error {report.relevancy_error:.4f} "
            f"(99 % below {report.relevancy_error_p99:.3f}); "
            f"{sum(report.seconds.values()):.0f} s"
        )
        for warning in report.warnings:
            print(f"warning: {warning}")
        page = (self.work or work_folder(self.out)) / PAGE
        print(f"photographs beside what the scene shows: {page}")


def train_command(args: Sequence[str]) -> type[Train]:
    """Return `Train` with the settings of the profile and preset that `args` name as defaults."""
    profile, preset = named(args, "--profile"), named(args, "--preset")
    config = PAPER if profile == "paper" else TrainConfig()
    config = replace(config, codec=codec_settings(args, config.codec))
    for known in get_args(TrainPreset):
        if known == preset:
            config = with_preset(config, known)

    @dataclass(frozen=True)
    class ProfiledTrain(Train):
        config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=lambda: config)

    ProfiledTrain.__doc__ = Train.__doc__
    return ProfiledTrain
