"""Trainings that are killed in every stage end as if nothing had been."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.progress import ALL_STAGES, Report
from tests.support.photographs import colmap_reconstruction, poses, write_photos
from tests.support.tiny_clip import tiny_clip

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="no signal 9")]
LENS = PhotoIntrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)
VIEWS = 6
START = "starting"  # before the first report
SCENE = ("scene.ply", "scene.langsplat.safetensors", "scene.cameras.json")
SETTINGS = (
    *("--dataset.max-side", "64", "--dataset.test-every", "4", "--radiance.steps", "30"),
    *("--radiance.sh-degree", "0", "--radiance.checkpoint-every", "5", "--masks.source", "graph"),
    *("--clip.device", "cpu", "--codec.size", "9", "--phrases", "red mug", "--progress", "lines"),
)


@dataclass(frozen=True)
class Moment:
    """When a process is killed: some seconds after a stage has come so far, or is over."""

    stage: str
    fraction: float
    seconds: float


@dataclass(frozen=True)
class Ended:
    """A process: its code, what it said besides its progress, and when its stages began."""

    code: int
    said: str
    began: dict[str, float]  # seconds since the process did
    seconds: float


def train(data: Path, encoder: Path, folder: Path, kill: Moment | None = None) -> Ended:
    """Train ``folder/scene.ply``, and kill it with signal 9 at a moment."""
    words = ["train", str(data), "--out", str(folder / SCENE[0]), "--clip.model", str(encoder), *SETTINGS]
    start = time.monotonic()
    began, said = {START: 0.0}, []
    with subprocess.Popen(
        [sys.executable, "-m", "langsplat_core", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        killer = threading.Timer(kill.seconds if kill else 0, process.send_signal, (signal.SIGKILL,))
        if kill is not None and kill.stage == START:
            killer.start()
        assert process.stderr is not None
        for line in process.stderr:
            report = _report(line)
            if report is None:
                said.append(line)
                continue
            stage, fraction = report
            began.setdefault(stage, time.monotonic() - start)
            passed = kill is not None and kill.stage in began
            passed = passed and (stage != kill.stage or fraction >= kill.fraction)
            if passed and not killer.is_alive() and not killer.finished.is_set():
                killer.start()
        code = process.wait()
    killer.cancel()
    return Ended(code, "".join(said), began, time.monotonic() - start)


def _report(line: str) -> tuple[str, float] | None:
    """Stage and fraction of a line of progress; None for other lines and for the progress of the whole."""
    try:
        report = Report.from_json(line)
    except ValueError:
        return None
    return None if report.stage == ALL_STAGES else (report.stage, report.fraction)


def moments(whole: Ended, seed: int) -> list[Moment]:
    """One in every stage of a run, in their order: anywhere in its progress, and where there is none to see,
    before the first report and after the last, anywhere in its time."""
    first, *stages, last = sorted(whole.began, key=whole.began.__getitem__)
    generator = random.Random(seed)
    before, after = whole.began[stages[0]], whole.seconds - whole.began[last]
    return [
        Moment(first, 0, generator.uniform(0, before)),
        *(Moment(stage, generator.random(), 0) for stage in stages),
        Moment(last, 0, generator.uniform(0, after)),
    ]


def photographs(folder: Path, kind: str) -> Path:
    """Of the room, plain or with the cameras of a COLMAP model without points."""
    names = write_photos(folder / "images", LENS, poses(VIEWS))
    if kind == "COLMAP":
        (folder / "sparse" / "0").mkdir(parents=True)
        params = [LENS.fx, LENS.fy, LENS.cx, LENS.cy]
        size = (LENS.width, LENS.height)
        model = colmap_reconstruction("PINHOLE", size, params, names, poses(VIEWS))
        model.write_binary(folder / "sparse" / "0")
    return folder


@pytest.mark.parametrize("kind", ["photographs", "COLMAP"])
def test_killed_in_every_stage_it_ends_with_the_same_bytes(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """One run, killed once in each stage at a random moment and begun again, against one that was not."""
    data, encoder = photographs(tmp_path / "data", kind), tmp_path / "encoder"
    tiny_clip(encoder)
    whole = train(data, encoder, tmp_path / "whole")
    assert whole.code == 0, whole.said
    seed = request.config.getoption("--seed") or 0
    killed = []
    for moment in moments(whole, seed):
        ended = train(data, encoder, tmp_path / "killed", moment)
        assert ended.code in (0, -signal.SIGKILL), ended.said  # 0: it was faster than before
        killed.append(ended.code != 0)
    assert sum(killed) > len(killed) / 2
    last = train(data, encoder, tmp_path / "killed")
    assert last.code == 0, last.said
    for name in SCENE:
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
