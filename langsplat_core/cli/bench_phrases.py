"""`langsplat bench phrases`: phrases with structure, composed and asked whole, against the truth."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.lab.config import PhraseBenchConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchPhrases:
    """Every construction of the grammar in fresh rooms: composed in 3D beside asked whole; some minutes per
    room."""

    config: Annotated[PhraseBenchConfig, tyro.conf.arg(name="")] = field(default_factory=PhraseBenchConfig)
    work: OutFolder = Path("eval_out")
    """Folder for the rooms, as of `langsplat eval synthetic`."""
    out: OutFolder = Path("bench_out")
    """Folder for phrases.md and phrases.json."""

    def run(self) -> None:
        from langsplat_core.lab.rooms.phrases import figures, measure_phrases, phrase_table

        with TerminalProgress() as progress:
            rows = measure_phrases(self.config, self.work, progress)
        table = phrase_table(rows)
        save_figures(self.out, "phrases", table, figures(self.config, rows))
        print(table)
