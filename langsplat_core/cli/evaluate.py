"""`langsplat eval`: queries against ground truth."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.checks import OutFile, OutFolder
from langsplat_core.errors import InputError
from langsplat_core.io.files import check_output_folder
from langsplat_core.lab.config import BenchmarkConfig
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class EvalSynthetic:
    """Localisation, segmentation and rejection in procedural rooms, in views that training did not see.

    Without --scene, fresh rooms are rendered and trained first, some minutes each; an interrupted run
    continues where it stopped."""

    config: Annotated[BenchmarkConfig, tyro.conf.arg(name="")] = field(default_factory=BenchmarkConfig)
    work: OutFolder = Path("eval_out")
    """Folder for the rooms and all intermediate results."""
    json: OutFile | None = None
    """Also write all figures to this file."""
    scene: Path | None = None
    """Measure this scene, trained on --dataset, instead of fresh rooms; of the settings, --cut applies."""
    dataset: Path | None = None
    """The room that --scene shows, as written by `python -m assets.making dataset`."""
    paper_order: bool = False
    """With --scene: blend latents and decode every pixel, as the paper does, not the relevancies."""

    def run(self) -> None:
        if (self.scene is None) != (self.dataset is None):
            raise InputError("--scene and --dataset belong together: a scene, and the room it was trained on")
        if self.scene is not None and self.dataset is not None:
            if self.json is not None:
                raise InputError("--json holds the figures of fresh rooms; leave it out with --scene")
            self._run_scene(self.scene, self.dataset)
            return
        if self.paper_order:
            raise InputError("--paper-order needs --scene; for fresh rooms, --budget measures it beside ours")
        self._run_rooms()

    def _run_rooms(self) -> None:
        check_output_folder(self.work)
        from langsplat_core.lab.rooms.benchmark import run_benchmark
        from langsplat_core.lab.rooms.report import (
            budget_table,
            room_table,
            save_json,
            score_table,
        )

        with TerminalProgress() as progress:
            reports = run_benchmark(self.config, self.work, progress)
        tables = [score_table(reports), room_table(reports)]
        if self.config.budget or self.config.ceiling:
            tables.append(budget_table(reports))
        print("\n\n".join(tables))
        unknown = sum(len(report.measured[0].unknown) for report in reports)
        if unknown:
            print(f"\nleft out: {unknown} phrases with words that the encoder was never taught")
        if self.json is not None:
            save_json(self.json, asdict(self.config), reports)

    def _run_scene(self, path: Path, dataset: Path) -> None:
        from langsplat_core.lab.rooms.of_scene import measure_scene
        from langsplat_core.lab.rooms.scoring import Reading

        reading = Reading(self.paper_order, self.config.cut)
        with TerminalProgress() as progress:
            report = measure_scene(path, dataset, reading, progress)
        print(report)
