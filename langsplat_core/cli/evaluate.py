"""`langsplat eval`: a scene against ground truth."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from langsplat_core.config import DatasetConfig
from langsplat_core.errors import InputError
from langsplat_core.evaluation.synthetic import evaluate, read_truth, rejection_rate
from langsplat_core.formats import load_scene
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import NO_FIELD, QueryEngine
from langsplat_core.raster import load_rasterizer


@dataclass(frozen=True)
class EvalSynthetic:
    """Localisation and segmentation in the views of a procedural room that training did not see."""

    scene: tyro.conf.Positional[Path]
    """The scene trained on the room's photographs."""
    dataset: tyro.conf.Positional[Path]
    """The room, as written by `langsplat demo dataset`."""
    paper_order: bool = False
    """Blend latents and decode every pixel, as the paper does, instead of blending relevancies."""

    def run(self) -> None:
        from langsplat_core.datasets import load_capture
        from langsplat_core.datasets.synthetic.world import SMALL
        from langsplat_core.semantics.clip import load_text_encoder

        scene = load_scene(self.scene)
        if scene.language is None:
            raise InputError(f"{self.scene}: {NO_FIELD}")
        truth = read_truth(self.dataset)
        engine = QueryEngine(scene, load_text_encoder(scene.language.encoder_id))
        config = DatasetConfig(max_side=100_000)
        trained = {camera.name for camera in scene.cameras}
        with TerminalProgress() as progress:
            capture = load_capture(self.dataset, config, self.dataset, progress)
            held_out = [camera for camera in capture.cameras if camera.name not in trained]
            if not held_out:
                raise InputError(f"{self.scene}: no view was held out from training")
            scores = evaluate(engine, load_rasterizer("cpu"), held_out, truth, self.paper_order, progress)
        print("| phrases | queries | mIoU % | localisation % |\n|---|---|---|---|")
        for score in scores:
            print(
                f"| {score.kind} | {score.queries} | {100 * score.mean_iou:.1f} | "
                f"{100 * score.localisation:.1f} |"
            )
        absent = sorted(set(SMALL) - truth.things)
        print(f"\nabsent objects rejected: {100 * rejection_rate(engine, absent):.0f} % of {len(absent)}")
