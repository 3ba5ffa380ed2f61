"""`langsplat bench steps`: what each step of the CPU kernels gains."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.checks import OutFolder
from langsplat_core.io.files import atomic_path
from langsplat_core.lab.config import KernelStepsConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchSteps:
    """Time the CPU kernels whole and with one step taken out at a time; takes some minutes."""

    config: Annotated[KernelStepsConfig, tyro.conf.arg(name="")] = field(default_factory=KernelStepsConfig)
    out: OutFolder = Path("bench_out")
    """Folder for steps.md."""

    def run(self) -> None:
        from langsplat_core.lab.speed.kernel_steps import measure_steps, steps_table

        with TerminalProgress() as progress:
            table = steps_table(measure_steps(self.config, progress))
        with atomic_path(self.out / "steps.md") as path:
            path.write_text(table)
        print(table)
