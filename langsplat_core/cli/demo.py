"""`langsplat demo`: make the bundled scene, its photographs and its encoder again.

The work is imported when it is done: torch and open3d take seconds that --help need not pay.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.checks import OutFile, OutFolder
from langsplat_core.config import Count, Seed
from langsplat_core.io.files import atomic_path
from langsplat_core.lab.config import DemoEncoderConfig, LabelLayout, MaskOrigin, Pixels, Size, Tier
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class DemoDataset:
    """Render a procedural room: photographs, cameras, points, and the truth at three levels."""

    out: OutFolder
    """Folder to write."""
    seed: Seed = 0
    """Another seed is another room."""
    views: Count = 72
    """Number of photographs."""
    size: Size = (640, 480)
    """Width and height, pixels."""
    tier: Tier = "clutter"
    """How hard the room is: objects apart, cluttered, or packed with look-alikes."""
    layout: LabelLayout = "plain"
    """lerf-ovs, 3d-ovs: the photographs in OUT/room, and every eighth labelled as in that benchmark."""

    def run(self) -> None:
        from langsplat_core.lab.rooms.label_layouts import write_labelled

        with TerminalProgress() as progress:
            folder = write_labelled(
                self.out, self.layout, self.seed, self.views, self.size, progress, self.tier
            )
        print(f"{folder}: {self.views} photographs with ground truth")


@dataclass(frozen=True)
class DemoEncoder:
    """Train the small demo CLIP on procedural crops. Resumes when interrupted."""

    out: OutFolder
    """Folder to write: model, tokenizer, vocabulary."""
    config: Annotated[DemoEncoderConfig, tyro.conf.arg(name="")] = field(default_factory=DemoEncoderConfig)

    def run(self) -> None:
        from langsplat_core.lab.encoder.train import train_demo_encoder

        with TerminalProgress() as progress:
            train_demo_encoder(self.out, self.config, progress)
        print(f"{self.out}: demo encoder")


@dataclass(frozen=True)
class DemoBuild:
    """Make the demo scene: render its photographs, train it with the ordinary pipeline, compact it."""

    out: OutFile
    """The scene to write, *.ply."""
    seed: Seed = 2
    """Another seed is another room."""
    tier: Tier = "clutter"
    """How hard the room is: objects apart, cluttered, or packed with look-alikes."""
    masks: MaskOrigin = "truth"
    """Outlines as a perfect segmenter would find them, or those of the weight-free segmenter."""
    steps: Count = 6_000
    """Steps of radiance training."""
    gaussians: Path | None = None
    """Keep the Gaussians of this scene of the same room, and make only their language field again."""

    def run(self) -> None:
        from langsplat_core.lab.demo import build_demo

        with TerminalProgress() as progress:
            made = build_demo(
                self.out, self.seed, self.tier, self.masks, self.steps, self.gaussians, progress
            )
        print(f"{self.out}: {made}")


@dataclass(frozen=True)
class DemoSheet:
    """Draw every class of object that the generator knows, so that one sees what its words mean."""

    out: OutFile
    """The picture to write, *.png."""
    seed: Seed = 0
    """Another seed draws other examples."""
    side: Pixels = 128
    """Pixels per example."""
    instances: Count = 3
    """Examples of every class."""

    def run(self) -> None:
        from PIL import Image

        from langsplat_core.lab.world.sheet import contact_sheet

        with TerminalProgress() as progress:
            picture = contact_sheet(self.instances, self.side, self.seed, progress)
        with atomic_path(self.out) as path:
            Image.fromarray(picture).save(path, "PNG")
        print(f"{self.out}: {picture.shape[1]}x{picture.shape[0]} pixels")
