"""`langsplat bench gains`: small changes of the lifting, tried in fresh rooms."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.lab.config import GainBenchConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchGains:
    """What each change that others report gains from gives here: a few minutes per room and origin of the
    masks."""

    config: Annotated[GainBenchConfig, tyro.conf.arg(name="")] = field(default_factory=GainBenchConfig)
    work: OutFolder = Path("eval_out")
    """Folder for the rooms, as of `langsplat eval synthetic`."""
    out: OutFolder = Path("bench_out")
    """Folder for gains.md and gains.json, and for rows as they are made: the same command goes on."""

    def run(self) -> None:
        from langsplat_core.lab.rooms.gain_bench import figures, gain_table, measure_gains

        with TerminalProgress() as progress:
            rows = measure_gains(self.config, self.work, progress, kept=self.out / "gains.rows.jsonl")
        table = gain_table(rows)
        save_figures(self.out, "gains", table, figures(self.config, rows))
        print(table)
