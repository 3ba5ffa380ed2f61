"""`langsplat bench`: speed against error."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.checks import OutFolder
from langsplat_core.lab.config import RasterBenchConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchRaster:
    """Time, error and memory of every rasterizer that loads here, in one run; takes some minutes."""

    quick: bool = False
    """Fewer and smaller scenes, in about a minute; --counts and --sizes are then not read."""
    config: Annotated[RasterBenchConfig, tyro.conf.arg(name="")] = field(default_factory=RasterBenchConfig)
    out: OutFolder = Path("bench_out")
    """Folder for raster.md, raster.json and raster.png."""

    def run(self) -> None:
        from langsplat_core.lab.speed.raster import quick_plan, run_plan

        with TerminalProgress() as progress:
            plan = quick_plan(self.config) if self.quick else self.config
            report = run_plan(plan, progress, keep=lambda unfinished: unfinished.save(self.out))
        report.save(self.out)
        print(report.text)
