"""`langsplat bench paper`: the paper's comparisons and ablations, on known truth."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.io.files import atomic_path
from langsplat_core.lab.config import PaperBenchConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchPaper:
    """LERF's way, the paper's with and without its autoencoder, and ours, in rooms with known truth: accuracy
    in pictures and among Gaussians, and time from a phrase to a picture. An hour and more."""

    config: Annotated[PaperBenchConfig, tyro.conf.arg(name="")] = field(default_factory=PaperBenchConfig)
    work: OutFolder = Path("eval_out")
    """Folder for the rooms, as of `langsplat eval synthetic`."""
    out: OutFolder = Path("bench_out")
    """Folder for paper.md, .json and .png, and for rows as they are made: the same command goes on."""

    def run(self) -> None:
        from langsplat_core.lab.rooms.paper_tables import figures, measure_paper, paper_table, plot

        with TerminalProgress() as progress:
            rows = measure_paper(self.config, self.work, progress, kept=self.out / "paper.rows.jsonl")
        save_figures(self.out, "paper", paper_table(rows), figures(self.config, rows))
        with atomic_path(self.out / "paper.png") as path:
            plot(rows, path)
        print(paper_table(rows))
