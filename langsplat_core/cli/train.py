"""`langsplat train`: photographs -> scene.ply with a language field."""

from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.config import TrainConfig
from langsplat_core.progress import TerminalProgress, silent


@dataclass(frozen=True)
class Train:
    """Train a searchable scene from photographs: a COLMAP folder, a nerfstudio transforms.json, or a
    plain folder of photographs. An interrupted run continues where it stopped."""

    dataset: tyro.conf.Positional[Path]
    """Folder of photographs, COLMAP project folder, or transforms.json."""
    out: Path
    """The scene to write, *.ply; its language field and cameras are written beside it."""
    work: Path | None = None
    """Folder for intermediate results (default: <out>.work)."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def run(self) -> None:
        # They import torch: seconds that --help need not pay.
        from langsplat_core.pipeline.crew import join_crew
        from langsplat_core.pipeline.train import train_scene

        crew = join_crew()
        with TerminalProgress() if crew.leads else nullcontext(silent) as progress:
            report = train_scene(self.dataset, self.out, self.config, self.work, progress, crew=crew)
        if not crew.leads:
            return
        psnr = "no held-out views" if report.psnr is None else f"held-out PSNR {report.psnr:.2f} dB"
        print(
            f"{self.out}: {report.gaussians} Gaussians from {report.views} photographs, {psnr}; "
            f"{report.mask_count} masks by {report.masks}, encoder {report.encoder}; "
            f"{report.codec} of {report.codec_size}, relevancy error {report.relevancy_error:.4f} "
            f"(99 % below {report.relevancy_error_p99:.3f}); "
            f"{sum(report.seconds.values()):.0f} s"
        )
