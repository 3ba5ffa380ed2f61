"""`langsplat train` as a process of its own: started, listened to, interrupted."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from langsplat_core.config import TrainPreset
from langsplat_core.errors import printable_line
from langsplat_viewer.files.watching import Stamps

ALL = "all stages"  # the label under which the whole is reported
LOSS = re.compile(r"\bloss (\d+\.\d+)")  # behind a stage's colon
PREVIEW_EVERY = 100  # steps between the checkpoints that can be looked at
KEPT = 20  # lines of what it says that are kept


@dataclass(frozen=True)
class TrainingRequest:
    """What to train."""

    dataset: Path
    out: Path  # *.ply
    preset: TrainPreset = "good"
    encoder: str = "demo"


@dataclass(eq=False)
class TrainingProgress:
    """Where it is. Written by the listening thread, read by the window's."""

    stages: dict[str, float] = field(default_factory=dict)  # label -> fraction in [0, 1], in their order
    overall: float = 0.0
    left: str = ""  # "about 3 min left"
    losses: list[float] = field(default_factory=list)  # of the Gaussians, as far as they are trained
    said: list[str] = field(default_factory=list)  # lines that are no progress, the latest last

    _heard: str = ""  # the last one, as it was said

    def hear(self, line: str) -> None:
        """Take one line of what the process writes."""
        try:
            report = json.loads(line)
            label, fraction = str(report["label"]), float(report["fraction"])
        except (ValueError, TypeError, KeyError):
            text = printable_line(line, 300)
            if text:
                self.said = [*self.said[1 - KEPT :], text]
            return
        stage, _, detail = label.partition(":")
        if stage == ALL:
            self.overall, self.left = fraction, detail.strip()
        else:
            self.stages[stage] = fraction
            loss = LOSS.search(detail)
            if loss is not None and loss[0] != self._heard:
                self._heard = loss[0]
                self.losses = [*self.losses, float(loss[1])]


def command(request: TrainingRequest) -> list[str]:
    """The command line of a request, for the interpreter that runs this, or the program beside it that a
    one-folder build has."""
    program = [sys.executable, "-m", "langsplat_core"]
    if getattr(sys, "frozen", False):
        program = [str(Path(sys.executable).with_stem("langsplat"))]
    return [
        *(*program, "train", str(request.dataset), "--out", str(request.out)),
        *("--preset", request.preset, "--clip.model", request.encoder, "--progress", "lines"),
        *("--radiance.checkpoint-every", str(PREVIEW_EVERY)),
    ]


class Training:
    """One running process."""

    def __init__(self, request: TrainingRequest, wake: Callable[[], None]) -> None:
        """`wake` is called from another thread when there is news. OSError where it cannot be started."""
        self.request = request
        self.progress = TrainingProgress()
        self.interrupted = False
        self.previewed: Stamps = ()  # the checkpoint that is looked at
        self._wake = wake
        # Ctrl-C in the terminal is the window's; the process gets its own signal from `interrupt`.
        self.process = subprocess.Popen(
            command(request),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="backslashreplace",
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
            start_new_session=True,
        )
        assert self.process.stdout is not None
        self._listener = threading.Thread(target=self._listen, args=(self.process.stdout,), daemon=True)
        self._listener.start()

    def _listen(self, lines: IO[str]) -> None:
        for line in lines:
            self.progress.hear(line)
            self._wake()
        self.process.wait()
        self._wake()

    @property
    def exit_code(self) -> int | None:
        """None while it runs, or while what it wrote is still being read."""
        return None if self._listener.is_alive() else self.process.poll()

    def interrupt(self) -> None:
        """Have it stop soon; what is finished is kept."""
        self.interrupted = True
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)

    def end(self, patience: float = 5.0) -> None:
        """Stop it for good: the window closes."""
        self.interrupt()
        try:
            self.process.wait(patience)
        except subprocess.TimeoutExpired:
            self.process.kill()
