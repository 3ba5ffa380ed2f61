"""`langsplat bench memory`: what the way from masks to codes takes, and how it grows."""

from dataclasses import asdict, dataclass
from pathlib import Path

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.errors import InputError
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchMemory:
    """Lift random masks onto random Gaussians at several sizes, each in a fresh interpreter."""

    sizes: tuple[tuple[int, int], ...] = ((100_000, 15), (100_000, 30), (200_000, 30), (400_000, 30))
    """Numbers of Gaussians and of views."""
    picture: tuple[int, int] = (720, 540)
    """Width and height, pixels."""
    out: Path = Path("bench_out")
    """Folder for memory.md and memory.json."""

    def run(self) -> None:
        if not self.sizes or min(min(size) for size in (*self.sizes, self.picture)) < 1:
            raise InputError("--sizes and --picture must be pairs of numbers of at least 1")
        from langsplat_core.lab.speed.lift_memory import cost_table, measure_lift_memory

        with TerminalProgress() as progress:
            costs = measure_lift_memory(self.sizes, self.picture, progress)
        table = cost_table(costs)
        save_figures(self.out, "memory", table, [asdict(cost) for cost in costs])
        print(table)
