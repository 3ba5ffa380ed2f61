"""`langsplat bench words`: how well `langsplat describe` names what is in fresh rooms."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.lab.config import WordBenchConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class BenchWords:
    """Words for every region of rooms whose truth is known, and their inventories: seconds a room."""

    config: Annotated[WordBenchConfig, tyro.conf.arg(name="")] = field(default_factory=WordBenchConfig)
    work: OutFolder = Path("eval_out")
    """Folder for the rooms, as of `langsplat eval synthetic`."""
    out: OutFolder = Path("bench_out")
    """Folder for words.md and words.json."""

    def run(self) -> None:
        from langsplat_core.lab.rooms.word_bench import figures, measure_words, word_table

        with TerminalProgress() as progress:
            rooms = measure_words(self.config, self.work, progress)
        table = word_table(rooms)
        save_figures(self.out, "words", table, figures(self.config, rooms))
        print(table)
