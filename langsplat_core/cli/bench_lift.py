"""`langsplat bench lift`: ways from masks to meanings, error and accuracy against time."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.io.files import atomic_path
from langsplat_core.lab.config import LiftBenchConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchLift:
    """The paper's training, one-pass latents, and lifted CLIP vectors behind every codec, in one room with
    known truth: relevancy error, accuracy, seconds and bytes. Half an hour and more."""

    config: Annotated[LiftBenchConfig, tyro.conf.arg(name="")] = field(default_factory=LiftBenchConfig)
    work: OutFolder = Path("eval_out")
    """Folder for the room, as of `langsplat eval synthetic`."""
    out: OutFolder = Path("bench_out")
    """Folder for lift.md, lift.json and lift.png, and for rows as they are made: the same command goes on."""

    def run(self) -> None:
        from langsplat_core.lab.rooms.lifting import measure_liftings, plot

        with TerminalProgress() as progress:
            report = measure_liftings(self.config, self.work, progress, kept=self.out / "lift.rows.jsonl")
        save_figures(self.out, "lift", report.text, report.figures)
        with atomic_path(self.out / "lift.png") as path:
            plot(report.rows, path)
        print(report.text)
