"""`langsplat bench`: speed against error."""

from dataclasses import dataclass
from pathlib import Path

from langsplat_core.errors import InputError
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchRaster:
    """Time, error and memory of every rasterizer that loads here, in one run; takes some minutes."""

    quick: bool = False
    """Fewer and smaller scenes, in about a minute; --counts and --sizes are then not read."""
    counts: tuple[int, ...] = (10_000, 31_000, 100_000, 200_000, 1_000_000)
    """Sizes of the random scenes, drawn at the middle one of --sizes."""
    sizes: tuple[tuple[int, int], ...] = ((320, 240), (640, 480), (960, 720))
    """Widths and heights of the picture, pixels; all are drawn with --pivot Gaussians."""
    pivot: int = 200_000
    """Gaussians of the random scene that is drawn at every size."""
    channels: tuple[int, ...] = (3, 12)
    """Values per Gaussian."""
    scenes: tuple[Path, ...] = ()
    """Real scenes to measure beside the random ones, from their first camera, else one that frames them."""
    limit: float = 60.0
    """Seconds that a single call may be expected to take; what would take longer is named and left out."""
    cold: bool = False
    """Also measure the first call in fresh processes, without and with compiled kernels."""
    out: Path = Path("bench_out")
    """Folder for raster.md, raster.json and raster.png."""

    def run(self) -> None:
        if not self.channels or min(self.channels) < 1:
            raise InputError("--channels must be one or more numbers of at least 1")
        if not self.sizes:
            raise InputError("--sizes must be one or more pairs of a width and a height")
        if min((*self.counts, self.pivot, *(side for size in self.sizes for side in size))) < 1:
            raise InputError("--counts, --sizes and --pivot must be 1 or more")
        from langsplat_core.lab.speed.raster import Plan, quick_plan, run_plan

        plan = Plan(self.counts, self.sizes, self.pivot, self.channels, self.scenes, self.limit, self.cold)
        if self.quick:
            plan = quick_plan(plan)
        with TerminalProgress() as progress:
            report = run_plan(plan, progress)
        report.save(self.out)
        print(report.text)
