"""`langsplat bench load`: reading a large scene, in time and memory."""

from dataclasses import asdict, dataclass
from pathlib import Path

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.config import Count
from langsplat_core.lab.speed.load import as_table, measure_loading
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchLoad:
    """Read a large PLY with this program and with plyfile, each in a fresh interpreter."""

    count: Count = 2_500_000
    """Gaussians in the file, which takes 248 bytes each in the temporary folder while it runs."""
    repeats: Count = 3
    """Readings with each; the fastest counts."""
    out: OutFolder = Path("bench_out")
    """Folder for load.md and load.json."""

    def run(self) -> None:
        with TerminalProgress() as progress:
            loadings = measure_loading(self.count, self.repeats, progress)
        table = as_table(loadings)
        save_figures(self.out, "load", table, [asdict(loading) for loading in loadings])
        print(table)
