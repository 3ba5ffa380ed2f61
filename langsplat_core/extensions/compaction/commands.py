"""`langsplat clean` and `compact`."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from langsplat_core.cli.arguments import AnyScene, JsonOption, OutFile, WrittenScene
from langsplat_core.cli.run import OutputConsole, print_json
from langsplat_core.extensions.compaction.clean import CleanConfig, CleanReport, clean_scene
from langsplat_core.extensions.compaction.compact import BudgetConfig, CompactReport, compact_scene
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class Clean:
    """Remove floaters: small regions that touch nothing and veils in free space, the least visible first.

    As many go as the allowed loss of PSNR lets go. It is measured on photographs that the scene was not
    trained on where --photos has some, else derived from how far the scene's images change.
    """

    scene: AnyScene
    out: WrittenScene
    photos: Path | None = None
    """Dataset the scene was trained on: true floaters then cost nothing, and more of them go."""
    json: JsonOption = False
    config: Annotated[CleanConfig, tyro.conf.arg(name="")] = field(default_factory=CleanConfig)

    def run(self) -> None:
        with TerminalProgress() as progress:
            report = clean_scene(self.scene, self.out, self.config, self.photos, progress)
        if self.json:
            print_json({"out": str(self.out), "removed": report.removed, **asdict(report)})
            return
        print(*_clean_lines(report), f"written: {self.out}", sep="\n")


def _clean_lines(report: CleanReport) -> list[str]:
    lines = [
        f"removed: {report.removed} of {report.gaussians} Gaussians: {report.regions} in small regions, "
        f"{report.free_space} in free space, {report.invalid} that cannot be drawn",
        *report.lines,
    ]
    if report.psnr_before is not None and report.psnr_after is not None:
        lines.append(f"PSNR: {report.psnr_before:.2f} dB before, {report.psnr_after:.2f} after")
    if report.kept:
        lines.append(f"kept: {report.kept} more are suspected; --max-psnr-loss allows more")
    return lines


@dataclass(frozen=True)
class Compact:
    """Drop the Gaussians and colour harmonics that the views do not need, within an error budget.

    Nothing is retrained; the language field, the cameras and extra properties are taken along.
    """

    scene: AnyScene
    out: OutFile | None = None
    """The scene to write (default: SCENE with .compact.ply for its ending)."""
    photos: Path | None = None
    """Dataset the scene was trained on: the loss is then measured against its photographs."""
    json: JsonOption = False
    config: Annotated[BudgetConfig, tyro.conf.arg(name="")] = field(default_factory=BudgetConfig)

    def run(self) -> None:
        out = self.out or self.scene.with_name(self.scene.name.split(".")[0] + ".compact.ply")
        with TerminalProgress() as progress:
            report = compact_scene(self.scene, out, self.config, self.photos, progress)
        if self.json:
            print_json({"out": str(out), **asdict(report)})
            return
        OutputConsole().print(_table(report))
        print(*report.lines, f"written: {out}", sep="\n")


def _table(report: CompactReport) -> Table:
    table = Table("", "before", "after", "after / before")
    before, after = report.before, report.after
    rows: list[tuple[str, float, float, str]] = [
        ("Gaussians", before.gaussians, after.gaussians, ",d"),
        ("SH degree", before.sh_degree, after.sh_degree, "d"),
        ("on disk, MB", before.disk_bytes / 1e6, after.disk_bytes / 1e6, ".2f"),
        ("in memory, MB", before.memory_bytes / 1e6, after.memory_bytes / 1e6, ".2f"),
    ]
    if before.psnr is not None and after.psnr is not None:
        rows.append(("PSNR, dB", before.psnr, after.psnr, ".2f"))
    for name, old, new, form in rows:
        table.add_row(name, format(old, form), format(new, form), f"{100 * new / old:.1f} %" if old else "-")
    return table
