"""`langsplat bench memory`: what the way from masks to codes takes, and how it grows."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.config import Count, Range
from langsplat_core.lab.config import Size
from langsplat_core.progress import TerminalProgress

Sizes = Annotated[tuple[tuple[Count, Count], ...], Range(1, 1_000_000_000, some=True)]


@dataclass(frozen=True)
class BenchMemory:
    """Lift random masks onto random Gaussians at several sizes, each in a fresh interpreter."""

    sizes: Sizes = (
        (100_000, 15),
        (100_000, 30),
        (200_000, 30),
        (400_000, 30),
    )
    """Numbers of Gaussians and of views."""
    picture: Size = (720, 540)
    """Width and height, pixels."""
    out: OutFolder = Path("bench_out")
    """Folder for memory.md and memory.json."""

    def run(self) -> None:
        from langsplat_core.lab.speed.lift_memory import cost_table, measure_lift_memory

        with TerminalProgress() as progress:
            costs = measure_lift_memory(self.sizes, self.picture, progress)
        table = cost_table(costs)
        save_figures(self.out, "memory", table, [asdict(cost) for cost in costs])
        print(table)
