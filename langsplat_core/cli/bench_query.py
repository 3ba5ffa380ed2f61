"""`langsplat bench query`: what a phrase costs in every order, beside its error."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.lab.config import QueryBenchConfig
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import no_field
from langsplat_core.semantics.encoders import load_text_encoder


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
        c = self.config
        scene = load_scene(self.scene)
        if scene.language is None:
            raise InputError(f"{self.scene}: {no_field(scene)}")
        from langsplat_core.lab.speed.queries import figures, measure_queries, query_table

        encoder = load_text_encoder(scene.language.encoder_id)
        with TerminalProgress() as progress:
            report = measure_queries(scene, encoder, c, progress)
        table = query_table(report)
        save_figures(self.out, "query", table, figures(c, report))
        print(table)
