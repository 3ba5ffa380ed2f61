"""`langsplat bench verdict`: how far "found" and "not here" can be trusted, and the calibration of both."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFile, OutFolder
from langsplat_core.lab.config import VerdictBenchConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchVerdict:
    """Things that are there and things that are not, asked for in rooms with known truth: accepted, rejected,
    the ROC curve's area, and what the probabilities are worth."""

    config: Annotated[VerdictBenchConfig, tyro.conf.arg(name="")] = field(default_factory=VerdictBenchConfig)
    work: OutFolder = Path("eval_out")
    """Folder for the rooms, as of `langsplat eval synthetic`."""
    out: OutFolder = Path("bench_out")
    """Folder for verdict.md and verdict.json."""
    fit: OutFile | None = None
    """Fit the encoder's calibration to these rooms and write it into this reading.json; measure elsewhere."""

    def run(self) -> None:
        from langsplat_core.lab.rooms.verdicts import (
            PAIRS,
            curve_table,
            figures,
            fit_calibration,
            measure_verdicts,
            verdict_table,
            write_calibration,
        )

        with TerminalProgress() as progress:
            rows = measure_verdicts(self.config, self.work, progress)
        if self.fit is not None:
            calibration = fit_calibration(rows)
            write_calibration(self.fit, calibration)
            print(f"{self.fit}: {calibration}")
        tables = "\n".join([verdict_table(rows), *(curve_table(rows, asked) for asked in PAIRS)])
        save_figures(self.out, "verdict", tables, figures(self.config, rows))
        print(tables)
