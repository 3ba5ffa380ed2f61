"""`langsplat compact`: a scene with no more Gaussians than it needs."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.table import Table

from langsplat_core.cli.checks import OutFile
from langsplat_core.cli.console import OutputConsole
from langsplat_core.config import CompactConfig
from langsplat_core.progress import TerminalProgress

if TYPE_CHECKING:
    from langsplat_core.compaction.compact import CompactReport


@dataclass(frozen=True)
class Compact:
    """Drop the Gaussians and colour harmonics that the views do not need, within an error budget. Nothing
    is retrained; the language field, the cameras and extra properties are taken along."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""
    out: OutFile | None = None
    """The scene to write (default: SCENE with .compact.ply for its ending)."""
    photos: Path | None = None
    """Dataset the scene was trained on: the loss is then measured against its photographs."""
    json: bool = False
    """Print JSON."""
    config: Annotated[CompactConfig, tyro.conf.arg(name="")] = field(default_factory=CompactConfig)

    def run(self) -> None:
        from langsplat_core.compaction.compact import compact_scene

        out = self.out or self.scene.with_name(self.scene.name.split(".")[0] + ".compact.ply")
        with TerminalProgress() as progress:
            report = compact_scene(self.scene, out, self.config, self.photos, progress)
        if self.json:
            print(json.dumps({"out": str(out), **asdict(report)}, indent=1))
            return
        console = OutputConsole()
        console.print(_table(report))
        for line in (*_notes(report), f"written: {out}"):
            console.print(line, soft_wrap=True, highlight=False, markup=False)


def _table(report: "CompactReport") -> Table:
    table = Table("", "before", "after", "after / before")
    for column in table.columns[1:]:
        column.justify = "right"
    before, after = report.before, report.after

    def row(name: str, old: float, new: float, form: str, factor: float = 1.0) -> None:
        share = f"{100 * new / old:.1f} %" if old else "-"
        table.add_row(name, format(old * factor, form), format(new * factor, form), share)

    row("Gaussians", before.gaussians, after.gaussians, ",d", 1)
    table.add_row("SH degree", str(before.sh_degree), str(after.sh_degree), "")
    row("on disk, MB", before.disk_bytes, after.disk_bytes, ".2f", 1e-6)
    row("in memory, MB", before.memory_bytes, after.memory_bytes, ".2f", 1e-6)
    row("render, ms (CPU)", before.render_ms, after.render_ms, ".1f")
    if before.psnr is not None and after.psnr is not None:
        table.add_row("PSNR, dB", f"{before.psnr:.2f}", f"{after.psnr:.2f}", "")
    return table


def _notes(report: "CompactReport") -> list[str]:
    how = (
        "measured on photographs"
        if report.assumed_psnr is None
        else f"derived from the change, if the scene has {report.assumed_psnr:g} dB"
    )
    lines = [
        f"loss: {report.loss:.3f} dB of {report.budget:g} allowed, worst view {report.worst_loss:.2f} dB; "
        f"{report.unseen_loss:.3f} dB before the measuring views had a say ({how})",
        f"pictures: PSNR {report.likeness:.1f} dB against those of the original",
        f"views: {report.ranking_views} ranked the Gaussians, {report.measuring_views} others measured; "
        f"{report.views_from}",
    ]
    if abs(report.source_bytes - report.before.disk_bytes) > 0.01 * report.before.disk_bytes:
        lines.append(
            f"as given: {report.source_bytes / 1e6:.2f} MB on disk; "
            "'before' is that scene in the new file's format"
        )
    if report.language is not None:
        lines.append(f"meaning: latents change by {report.language.latents:.1e} on average")
        for answer in report.language.answers:
            place = "no place" if answer.moved is None else f"place moved by {answer.moved:.3g}"
            verdict = "same answer" if answer.same else "ANOTHER ANSWER"
            lines.append(
                f"  {answer.phrase}: {verdict}, {place}, relevancy changes by {answer.relevancy:.1e}"
            )
    return lines
