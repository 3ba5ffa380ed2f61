"""Trainings that are killed, and how far they were."""

import json
import random
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

START = "starting"  # before the first report
SCENE = ("scene.ply", "scene.langsplat.safetensors", "scene.cameras.json")
SETTINGS = (
    *("--dataset.max-side", "64", "--dataset.test-every", "4", "--radiance.steps", "30"),
    *("--radiance.sh-degree", "0", "--radiance.checkpoint-every", "5", "--masks.source", "graph"),
    *("--clip.device", "cpu", "--codec.size", "9", "--phrases", "red mug", "--progress", "lines"),
)


@dataclass(frozen=True)
class Moment:
    """When a process is killed: so many seconds after a stage began."""

    stage: str
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
        timers = [_killer(process, kill, START)]
        assert process.stderr is not None
        for line in process.stderr:
            stage = _stage(line)
            if stage is None:
                said.append(line)
            elif stage not in began:
                began[stage] = time.monotonic() - start
                timers.append(_killer(process, kill, stage))
        code = process.wait()
    for timer in timers:
        timer.cancel()
    return Ended(code, "".join(said), began, time.monotonic() - start)


def _killer(process: "subprocess.Popen[str]", kill: Moment | None, stage: str) -> threading.Timer:
    timer = threading.Timer(kill.seconds if kill else 0.0, process.send_signal, (signal.SIGKILL,))
    if kill is not None and kill.stage == stage:
        timer.start()
    return timer


def _stage(line: str) -> str | None:
    """That a line of progress reports; None for other lines."""
    try:
        label = str(json.loads(line)["label"])
    except ValueError:
        return None
    return START if label.startswith("all stages") else label.partition(":")[0].partition(" (")[0]


def moments(whole: Ended, seed: int) -> list[Moment]:
    """One in every stage of a run, in their order, anywhere within the time that it took."""
    stages = sorted(whole.began, key=whole.began.__getitem__)
    ends = [whole.began[stage] for stage in stages[1:]] + [whole.seconds]
    generator = random.Random(seed)
    return [
        Moment(stage, generator.uniform(0, end - whole.began[stage]))
        for stage, end in zip(stages, ends, strict=True)
    ]
