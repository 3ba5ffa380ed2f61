"""`langsplat bench`: speed against error on this machine and of one's own scene."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from langsplat_core.bench import QueryBenchConfig, RasterBenchConfig
from langsplat_core.cli.run import OutFolder
from langsplat_core.cli.teach import searchable
from langsplat_core.io.files import atomic_path
from langsplat_core.progress import TerminalProgress
from langsplat_core.semantics.encoders import load_text_encoder


@dataclass(frozen=True)
class BenchRaster:
    """Time, error and memory of every rasterizer that loads here, in one run; takes some minutes."""

    quick: bool = False
    """Fewer and smaller scenes, in about a minute; --counts and --sizes are then not read."""
    config: Annotated[RasterBenchConfig, tyro.conf.arg(name="")] = field(default_factory=RasterBenchConfig)
    out: OutFolder = Path("bench_out")
    """Folder for raster.md, raster.json and raster.png."""

    def run(self) -> None:
        from langsplat_core.bench.raster import Report, plot, quick_plan, run_plan

        def keep(report: Report) -> None:
            draw = partial(plot, report.rows)
            write_report(self.out, "raster", report.text, report.figures, draw)

        with TerminalProgress() as progress:
            report = run_plan(quick_plan(self.config) if self.quick else self.config, progress, keep)
        keep(report)
        print(report.text)


@dataclass(frozen=True)
class BenchQuery:
    """The paper's order, a table over the sphere and a codebook on one scene: time of a new phrase, a new
    camera and a frame, beside the error of relevancy. Some minutes, nearly all of them the paper's order."""

    scene: tyro.conf.Positional[Path]
    """A scene with a codebook, and its cameras beside it."""
    config: Annotated[QueryBenchConfig, tyro.conf.arg(name="")] = field(default_factory=QueryBenchConfig)
    out: OutFolder = Path("bench_out")
    """Folder for query.md and query.json."""

    def run(self) -> None:
        scene = searchable(self.scene)
        assert scene.language is not None
        from langsplat_core.bench.query import measure_queries, query_table

        encoder = load_text_encoder(scene.language.encoder_id)
        with TerminalProgress() as progress:
            report = measure_queries(scene, encoder, self.config, progress)
        table = query_table(report)
        write_report(self.out, "query", table, {"config": asdict(self.config), "report": asdict(report)})
        print(table)


def write_report(
    out: Path, name: str, text: str, figures: Any, plot: Callable[[Path], None] | None = None
) -> None:
    """Write `name`.md, .json and, with `plot`, .png into the folder `out`, each whole or not at all."""
    with atomic_path(out / f"{name}.md") as path:
        path.write_text(text, encoding="utf-8")
    with atomic_path(out / f"{name}.json") as path:
        path.write_text(json.dumps(figures, indent=1, default=str), encoding="utf-8")
    if plot is not None:
        with atomic_path(out / f"{name}.png") as path:
            plot(path)
