"""`langsplat bench moving`: pictures while the camera moves, in time and error."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.io.scenes import load_scene
from langsplat_core.lab.config import MovingBenchConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchMoving:
    """The coarse pictures that the viewer draws while the camera moves, on the CPU rasterizer: their time
    beside their distance from the full picture."""

    scene: tyro.conf.Positional[Path]
    """A scene with its cameras beside it."""
    config: Annotated[MovingBenchConfig, tyro.conf.arg(name="")] = field(default_factory=MovingBenchConfig)
    out: OutFolder = Path("bench_out")
    """Folder for moving.md and moving.json."""

    def run(self) -> None:
        from langsplat_core.lab.speed.moving import figures, measure_moving, moving_table

        scene = load_scene(self.scene)
        with TerminalProgress() as progress:
            report = measure_moving(scene, self.config, progress)
        table = moving_table(report)
        save_figures(self.out, "moving", table, figures(self.config, report))
        print(table)
