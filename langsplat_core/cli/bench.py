"""`langsplat bench`: speed against error."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.errors import InputError
from langsplat_core.lab.config import RasterBenchConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchRaster:
    """Time, error and memory of every rasterizer that loads here, in one run; takes some minutes."""

    quick: bool = False
    """Fewer and smaller scenes, in about a minute; --counts and --sizes are then not read."""
    config: Annotated[RasterBenchConfig, tyro.conf.arg(name="")] = field(default_factory=RasterBenchConfig)
    out: Path = Path("bench_out")
    """Folder for raster.md, raster.json and raster.png."""

    def run(self) -> None:
        c = self.config
        if not c.channels or min(c.channels) < 1:
            raise InputError("--channels must be one or more numbers of at least 1")
        if not c.sizes:
            raise InputError("--sizes must be one or more pairs of a width and a height")
        if min((*c.counts, c.pivot, *(side for size in c.sizes for side in size))) < 1:
            raise InputError("--counts, --sizes and --pivot must be 1 or more")
        from langsplat_core.lab.speed.raster import quick_plan, run_plan

        with TerminalProgress() as progress:
            report = run_plan(quick_plan(c) if self.quick else c, progress)
        report.save(self.out)
        print(report.text)
