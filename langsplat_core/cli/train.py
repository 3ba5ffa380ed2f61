"""`langsplat train`: photographs -> scene.ply with a language field."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.config import TrainConfig
from langsplat_core.progress import TerminalProgress


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
        from langsplat_core.pipeline.train import (
            train_scene,  # imports torch: seconds that --help need not pay
        )

        with TerminalProgress() as progress:
            report = train_scene(self.dataset, self.out, self.config, self.work, progress)
        psnr = "no held-out views" if report.psnr is None else f"held-out PSNR {report.psnr:.2f} dB"
        print(
            f"{self.out}: {report.gaussians} Gaussians from {report.views} photographs, {psnr}; "
            f"{report.mask_count} masks by {report.masks}, encoder {report.encoder}; "
            f"{sum(report.seconds.values()):.0f} s"
        )
