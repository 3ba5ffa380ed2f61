"""`langsplat eval`: queries against ground truth."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.config import BenchmarkConfig, DatasetConfig
from langsplat_core.errors import InputError
from langsplat_core.formats import load_scene
from langsplat_core.progress import TerminalProgress


@dataclass(frozen=True)
class EvalSynthetic:
    """Localisation, segmentation and rejection in procedural rooms, in views that training did not see.

    Without --scene, fresh rooms are rendered and trained first, some minutes each; an interrupted run
    continues where it stopped."""

    config: Annotated[BenchmarkConfig, tyro.conf.arg(name="")] = field(default_factory=BenchmarkConfig)
    work: Path = Path("eval_out")
    """Folder for the rooms and all intermediate results."""
    json: Path | None = None
    """Also write all figures to this file."""
    scene: Path | None = None
    """Measure this scene, trained on --dataset, instead of fresh rooms; of the settings, --cut applies."""
    dataset: Path | None = None
    """The room that --scene shows, as written by `langsplat demo dataset`."""
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
        if self.config.budget:
            tables.append(budget_table(reports))
        print("\n\n".join(tables))
        unknown = sum(len(report.measured[0].unknown) for report in reports)
        if unknown:
            print(f"\nleft out: {unknown} phrases with words that the encoder was never taught")
        if self.json is not None:
            save_json(self.json, asdict(self.config), reports)

    def _run_scene(self, path: Path, dataset: Path) -> None:
        from langsplat_core.datasets import load_capture
        from langsplat_core.lab.rooms.scoring import Reading, ask, evaluate, found_rate, read_truth
        from langsplat_core.lab.world.objects.catalogue import EVERYTHING
        from langsplat_core.query.engine import NO_FIELD, QueryEngine
        from langsplat_core.raster import load_rasterizer
        from langsplat_core.semantics.clip import load_text_encoder

        scene = load_scene(path)
        if scene.language is None:
            raise InputError(f"{path}: {NO_FIELD}")
        truth = read_truth(dataset)
        trained = {camera.name for camera in scene.cameras}
        with TerminalProgress() as progress:
            capture = load_capture(dataset, DatasetConfig(max_side=100_000), dataset, progress)
            held_out = [camera for camera in capture.cameras if camera.name not in trained]
            if not held_out:
                raise InputError(f"{path}: no view was held out from training")
            engine = QueryEngine(scene, load_text_encoder(scene.language.encoder_id))
            absent = truth.absent(EVERYTHING)
            asked = ask(engine, [*(phrase.text for phrase in truth.phrases), *absent])
            reading = Reading(self.paper_order, self.config.cut)
            scores = evaluate(asked, load_rasterizer("cpu"), held_out, truth, reading, progress)
        print("| phrases | queries | mIoU % | localisation % |\n|---|---|---|---|")
        for score in scores:
            shares = f"{100 * score.mean_iou:.1f} | {100 * score.localisation:.1f}"
            print(f"| {score.kind} | {score.queries} | {shares} |")
        found, count = found_rate(asked, absent)
        print(f"\nabsent objects rejected: {100 * (1 - found):.0f} % of {count}")
        if asked.unknown:
            print(f"left out: {len(asked.unknown)} phrases with words that the encoder was never taught")
