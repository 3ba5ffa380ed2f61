"""`langsplat demo`: make the bundled scene, its photographs and its encoder again.

The work is imported when it is done: torch and open3d take seconds that --help need not pay.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.config import DemoEncoderConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class DemoDataset:
    """Render a procedural room: photographs, cameras, points, and the truth at three levels."""

    out: Path
    """Folder to write."""
    seed: int = 0
    """Another seed is another room."""
    views: int = 72
    """Number of photographs."""
    size: tuple[int, int] = (640, 480)
    """Width and height, pixels."""

    def run(self) -> None:
        from langsplat_core.datasets.synthetic.dataset import write_dataset

        with TerminalProgress() as progress:
            write_dataset(self.out, self.seed, self.views, self.size, progress)
        print(f"{self.out}: {self.views} photographs with ground truth")


@dataclass(frozen=True)
class DemoEncoder:
    """Train the small demo CLIP from scratch on procedural crops. Resumes when interrupted."""

    out: Path
    """Folder to write: model, tokenizer, vocabulary."""
    config: Annotated[DemoEncoderConfig, tyro.conf.arg(name="")] = field(default_factory=DemoEncoderConfig)

    def run(self) -> None:
        from langsplat_core.training.demo_encoder import train_demo_encoder

        with TerminalProgress() as progress:
            train_demo_encoder(self.out, self.config, progress)
        print(f"{self.out}: demo encoder")


@dataclass(frozen=True)
class DemoBuild:
    """Make the demo scene: render its photographs, then train it with the ordinary pipeline."""

    out: Path
    """The scene to write, *.ply."""
    seed: int = 7
    """Another seed is another room."""
    steps: int = 5_000
    """Steps of radiance training."""

    def run(self) -> None:
        from langsplat_core.pipeline.demo import build_demo

        with TerminalProgress() as progress:
            report = build_demo(self.out, self.seed, self.steps, progress)
        print(f"{self.out}: {report.gaussians} Gaussians, held-out PSNR {report.psnr:.2f} dB")
