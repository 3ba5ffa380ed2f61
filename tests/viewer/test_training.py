"""Training from the window, with a process that only says it trains."""

import json
import signal
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from langsplat_core.cli.app import parse
from langsplat_core.io.scenes import load_scene
from langsplat_core.pipeline.report import PREVIEW, REPORT
from langsplat_core.scene import Scene
from langsplat_viewer import viewer as training_process
from langsplat_viewer.actions import opening, settings, viewpoint
from langsplat_viewer.disk import IN_TRAINING, write_preview
from langsplat_viewer.panels.menus import figures
from langsplat_viewer.panels.scene import waits_for
from langsplat_viewer.state import TrainingForm
from langsplat_viewer.viewer import PREVIEW_EVERY, ProcessProgress, training_words
from tests.support.fakes import blob_scene
from tests.support.scenes import random_gaussians
from tests.support.windowless import SCENES, act, errors, open_scene, repeat, settle

SAYS = """
import json, sys
report = {"stage": "reading photographs", "fraction": 1.0}
print(json.dumps(report), file=sys.stderr, flush=True)
"""
GOOD = SAYS + "print('done: 3 Gaussians')"
BAD = SAYS + "print('langsplat: photos: none can be located', file=sys.stderr); sys.exit(2)"
SLOW = SAYS + "import time; time.sleep(60)"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Photographs."""
    made = tmp_path / "photos"
    made.mkdir()
    for number in range(4):
        (made / f"{number}.jpg").write_bytes(b"")
    return made


@pytest.fixture
def begin(viewer, folder, monkeypatch) -> Callable[..., None]:
    """Begins a training that does what a script says, for a file beside the photographs."""

    def start(script: str, out: str = "photos.ply") -> None:
        monkeypatch.setattr(
            training_process, "training_words", lambda request: [sys.executable, "-c", script]
        )
        opening.choose_photographs(viewer, folder)
        viewer.state.training_form = replace(viewer.state.training_form, out=str(folder.with_name(out)))
        opening.start_training(viewer)

    return start


def finish(viewer) -> None:
    repeat(lambda: opening.watch_training(viewer), lambda: viewer.training is not None)
    settle(viewer)


def test_training_opens_its_scene(viewer, folder, begin):
    opening.open_dropped(viewer, [folder])
    form = viewer.state.training_form
    assert (form.dataset, form.out) == (str(folder), str(folder.with_suffix(".ply")))
    assert settings.take(viewer.state, "wanted_panel") == "Train"
    begin(GOOD + "; print('a'); print('b'); print('c')", "blobs.ply")
    progress = viewer.training.progress
    finish(viewer)
    assert progress.stages == {"reading photographs": 1.0}
    assert any(message.text == "done: 3 Gaussians" for message in viewer.state.messages)
    assert viewer.state.open.scene is SCENES["blobs.ply"]


def test_quality_warnings_are_said(viewer, folder, begin):
    warnings = [
        "held-out photographs are reproduced at 9.1 dB, below 16: take more",
        "two groups",
        "few pixels",
    ]
    report = folder.with_name("blobs.work") / REPORT
    report.parent.mkdir()
    report.write_text(json.dumps({"gaussians": 360, "warnings": warnings}))
    begin(GOOD + "".join(f"; print('warning: {warning}')" for warning in warnings), "blobs.ply")
    finish(viewer)
    assert viewer.state.open.warnings == tuple(warnings)
    assert errors(viewer) == warnings
    said = [message.text for message in viewer.state.messages]
    assert "done: 3 Gaussians" in said  # not pushed out by the warnings, which are not said twice
    assert not any(text.startswith("warning") for text in said)
    open_scene(viewer, folder.with_name("plain.ply"))
    assert viewer.state.open.warnings == ()


def test_failed_training_says_why(viewer, begin):
    begin(BAD)
    finish(viewer)
    assert errors(viewer) == ["photos: none can be located"]
    assert viewer.state.open is None


def test_training_is_stopped_and_runs_once(viewer, begin):
    begin(SLOW)
    opening.start_training(viewer)
    assert "under way" in errors(viewer)[-1]
    opening.look_at_training(viewer)
    assert "no Gaussians to look at yet" in viewer.state.messages[-1].text
    (said, _), *_ = figures(viewer)  # whatever panel is open
    assert said.startswith("training photos.ply: ")
    process = viewer.training.process
    viewer.training.interrupt()
    assert "kernels" in waits_for(viewer.training)
    finish(viewer)
    assert process.returncode == -signal.SIGTERM
    assert "goes on" in viewer.state.messages[-1].text


def test_gaussians_are_shown_before_the_end(viewer, folder, begin, monkeypatch):
    begin(SLOW)
    work = folder.with_name("photos.work")
    work.mkdir()
    (work / "radiance-0.ply").write_bytes(b"")
    monkeypatch.setitem(SCENES, PREVIEW, SCENES["plain.ply"])
    act(opening.watch_training, viewer)  # nothing else is open
    viewer.training.end()
    assert viewer.state.open.scene is SCENES["plain.ply"]


@pytest.mark.parametrize("dataset", ["", "  ", "gone", "."])
def test_folder_without_photographs_is_refused(viewer, tmp_path, monkeypatch, dataset):
    monkeypatch.chdir(tmp_path)
    viewer.state.training_form = replace(viewer.state.training_form, dataset=dataset)
    opening.start_training(viewer)
    assert "no photographs" in errors(viewer)[-1]
    assert viewer.training is None


def test_training_command_is_parsed_and_what_it_says_is_heard():
    words = training_words(TrainingForm("photos", "trained.ply", "s.ply", "demo", "quick"))
    assert words[1:3] == ["-m", "langsplat_core"]
    parsed = parse(words[3:])
    assert (parsed.dataset, parsed.out) == ((Path("photos"),), Path("s.ply"))
    assert (parsed.config.radiance.steps, parsed.config.clip.model) == (500, "demo")
    assert parsed.config.radiance.checkpoint_every == PREVIEW_EVERY
    assert parsed.gaussians == Path("trained.ply")
    progress = ProcessProgress()
    for line in ("plain words\n", '{"stage": 3}', '"text"', "", "[1]", '{"stage": "a", "fraction": 0.5}'):
        progress.hear(line)
    assert progress.said == ["plain words", '{"stage": 3}', '"text"', "[1]"]
    assert progress.stages == {"a": 0.5}
    for number in range(100):
        progress.hear(f"line {number}")
    assert len(progress.said) < 30
    progress, both = ProcessProgress(), {"loss": 0.125, "psnr": 21.5}
    for fraction, metrics in ((0.0, {}), (0.1, {"loss": 0.25}), (0.11, {"loss": 0.25}), (0.2, both)):
        progress.hear(json.dumps({"stage": "training Gaussians", "fraction": fraction, "metrics": metrics}))
    assert progress.curves == {"loss": [0.25, 0.125], "psnr": [21.5]}
    assert progress.stages == {"training Gaussians": 0.2}


def checkpoint(folder: Path, scene: Scene) -> Path:
    """As training writes it, with what the window does not read."""
    values = {field.name: getattr(scene.gaussians, field.name) for field in fields(scene.gaussians)}
    rest = np.zeros((len(scene.gaussians), 3, 3), np.float32)
    values |= {"sh_dc": values.pop("sh")[:, :1], "sh_rest": rest}
    tensors = {f"values.{name}": np.ascontiguousarray(array) for name, array in values.items()}
    path = folder / "photos.work" / "radiance-1.checkpoint.safetensors"
    path.parent.mkdir(exist_ok=True)
    save_file(tensors | {"seen": rest}, path)
    return path


def test_checkpoints_are_shown_and_followed(viewer, folder, begin):
    viewer.services = replace(viewer.services, load_scene=load_scene)
    begin(SLOW)
    whole = blob_scene()
    path = checkpoint(folder.parent, whole)
    path.write_bytes(path.read_bytes()[:100])  # damaged
    act(opening.look_at_training, viewer)
    assert "no Gaussians in training" in errors(viewer)[-1]
    assert viewer.state.open is None
    viewer.state.messages.clear()

    checkpoint(folder.parent, whole.take(np.arange(0, 360, 2)))
    act(opening.look_at_training, viewer)
    assert viewer.state.path == folder.parent / "photos.work" / PREVIEW
    seen = viewer.state.open.scene.gaussians
    assert (len(seen), seen.sh_degree) == (180, 1)
    np.testing.assert_array_equal(seen.means, whole.gaussians.means[::2])
    viewpoint.zoom_by(viewer, 1.5)
    view = viewer.state.open.view
    opening.watch_training(viewer)
    assert viewer.worker.current is None  # nothing new

    checkpoint(folder.parent, whole)
    act(opening.watch_training, viewer)
    assert len(viewer.state.open.scene.gaussians) == 360
    assert viewer.state.open.view is view
    assert errors(viewer) == []
    assert viewer.state.scenes == ()  # what is on its way is not kept in the list
    write_preview(checkpoint(folder.parent, whole.take(np.arange(9))))
    viewer.watch.look()
    viewer.watch.look()
    assert not viewer.watch.changed  # it is followed, not asked about
    viewer.training.end()


@pytest.mark.long
def test_checkpoint_of_the_trainer_is_read(tmp_path):
    import torch

    from langsplat_core.training.radiance.state import save_checkpoint, start

    gaussians = random_gaussians(40, sh_degree=2)
    path = tmp_path / f"radiance-0{IN_TRAINING}"
    save_checkpoint(path, start(gaussians, 0, torch.device("cpu")), "a run")
    seen = load_scene(write_preview(path)).gaussians
    for field in fields(gaussians):
        np.testing.assert_array_equal(getattr(seen, field.name), getattr(gaussians, field.name))
