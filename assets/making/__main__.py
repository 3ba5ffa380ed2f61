"""`python -m assets.making dataset|encoder|build`: make photographs, the demo encoder, the demo scene.

It runs from a checkout; no part of it is installed. The work is imported when it is done: torch and open3d
take seconds that --help need not pay.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from assets.making.crops import EncoderConfig
from assets.making.dataset import LabelLayout, Size
from assets.making.world import Tier
from langsplat_core.cli.arguments import OutFile, OutFolder, Runnable
from langsplat_core.cli.run import main, parsed
from langsplat_core.config import Count, Seed
from langsplat_core.progress import TerminalProgress

PROGRAM = "python -m assets.making"


@dataclass(frozen=True)
class Dataset:
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
        """Write the room's photographs, with their ground truth, into `out`."""
        from assets.making.dataset import write_labelled

        with TerminalProgress() as progress:
            folder = write_labelled(
                self.out, self.layout, self.seed, self.views, self.size, progress, self.tier
            )
        print(f"{folder}: {self.views} photographs with ground truth")


@dataclass(frozen=True)
class Encoder:
    """Train the demo encoder on procedural crops, and measure it in new rooms. Resumes when interrupted."""

    out: OutFolder
    """Folder to write: model, tokenizer, vocabulary."""
    config: Annotated[EncoderConfig, tyro.conf.arg(name="")] = field(default_factory=EncoderConfig)

    def run(self) -> None:
        """Train the encoder and print its figures."""
        from assets.making.encoder import report_table, train_encoder

        with TerminalProgress() as progress:
            rows = train_encoder(self.out, self.config, progress)
        print(report_table(rows))


@dataclass(frozen=True)
class Build:
    """Make the demo scene: render its photographs, train it with the ordinary pipeline, compact it."""

    out: OutFile
    """The scene to write, *.ply."""
    gaussians: Path | None = None
    """Keep the Gaussians of this scene of the same room, and make only their language field again."""

    def run(self) -> None:
        """Render, train and compact the demo scene, and write it to `out`."""
        from assets.making.dataset import build_scene

        with TerminalProgress() as progress:
            made = build_scene(self.out, self.gaussians, progress)
        print(f"{self.out}: {made}")


def parse(args: list[str]) -> Runnable:
    """Return the command that the words of a command line name; SystemExit as tyro raises it."""
    command: Runnable = parsed(PROGRAM, Dataset | Encoder | Build, args, "Make the bundled files again.")
    return command


if __name__ == "__main__":
    sys.exit(main(PROGRAM, lambda: parse(sys.argv[1:] or ["--help"])))
