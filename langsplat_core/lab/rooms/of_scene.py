"""One given scene measured against the truth of the room that it shows."""

from pathlib import Path

from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.lab.rooms.scoring import Reading, ask, evaluate, found_rate
from langsplat_core.lab.rooms.truth import read_truth
from langsplat_core.lab.world.objects.catalogue import EVERYTHING
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import QueryEngine, no_field
from langsplat_core.raster import load_rasterizer
from langsplat_core.semantics.encoders import load_text_encoder

WHOLE = DatasetConfig(max_side=65_536)  # photographs are not shrunk


def measure_scene(scene_path: Path, dataset: Path, reading: Reading, progress: Progress = silent) -> str:
    """Every phrase of the room in the views that the scene was not trained on; a report for people.

    dataset: the room, as `langsplat demo dataset` wrote it. Raises InputError for a scene without a language
    field or without held-out views, and for a dataset without truth.
    """
    scene = load_scene(scene_path)
    if scene.language is None:
        raise InputError(f"{scene_path}: {no_field(scene)}")
    truth = read_truth(dataset)
    trained = {camera.name for camera in scene.cameras}
    capture = load_capture(dataset, WHOLE, dataset, progress)
    held_out = [camera for camera in capture.cameras if camera.name not in trained]
    if not held_out:
        raise InputError(f"{scene_path}: no view was held out from training")
    engine = QueryEngine(scene, load_text_encoder)
    absent = truth.absent(EVERYTHING)
    asked = ask(engine, [*(phrase.text for phrase in truth.phrases), *absent])
    scores = evaluate(asked, load_rasterizer("cpu"), held_out, truth, reading, progress)
    lines = ["| phrases | queries | mIoU % | localisation % |", "|---|---|---|---|"]
    for score in scores:
        shares = f"{100 * score.mean_iou:.1f} | {100 * score.localisation:.1f}"
        lines.append(f"| {score.kind} | {score.queries} | {shares} |")
    found, count = found_rate(asked, absent)
    lines += ["", f"absent objects rejected: {100 * (1 - found):.0f} % of {count}"]
    if asked.unknown:
        lines.append(f"left out: {len(asked.unknown)} phrases with words that the encoder was never taught")
    return "\n".join(lines)
