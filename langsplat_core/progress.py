"""Progress of long work.

Core functions take a `Progress`; the command line and the window supply one each.
"""

import json
import logging
import os
import sys
import time
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import msgspec

log = logging.getLogger("langsplat")


@dataclass(frozen=True)
class Report:
    """The state of a piece of work."""

    stage: str  # constant while it runs
    fraction: float  # done, in [0, 1]
    note: str = ""  # the item under way
    metrics: Mapping[str, float] = field(default_factory=dict)  # such as loss, psnr (dB)

    @classmethod
    def from_json(cls, line: str) -> "Report":
        """Return the report in a line of `line_progress`; ValueError for any other line."""
        return msgspec.convert(json.loads(line), cls)

    @property
    def text(self) -> str:
        """Stage, note and metrics in words: "training: 9 Gaussians, loss 0.0312"."""
        words = {"psnr": "held-out PSNR {:.1f} dB"}
        metrics = (words.get(name, name + " {:.4f}").format(value) for name, value in self.metrics.items())
        return ": ".join(filter(None, [self.stage, ", ".join(filter(None, [self.note, *metrics]))]))


@dataclass(frozen=True)
class Progress:
    """The callable that work reports to: ``progress("training", 0.5, "room 3", loss=0.01)``."""

    show: Callable[[Report], None]
    """It may raise to interrupt the work (Ctrl-C, the window's cancel button)."""

    def __call__(self, stage: str, fraction: float, note: str = "", **metrics: float) -> None:
        """Report that `fraction` of a stage, in [0, 1], is done."""
        self.show(Report(stage, fraction, note, metrics))

    def part(self, index: int, count: int, stage: str = "", note: str = "") -> "Progress":
        """Return the progress of item `index` of `count`; `stage` and `note` replace the item's own."""

        def show(report: Report) -> None:
            fraction = (index + report.fraction) / count
            self.show(Report(stage or report.stage, fraction, note or report.note, report.metrics))

        return Progress(show)


silent = Progress(lambda report: None)


@dataclass
class TimeLeft:
    """The time until a stage ends, by the work that it was seen to do; its text counts down.

    The rate is that of the later half of the time: stages slow down, and pass at once what was done before.
    """

    clock: Callable[[], float] = time.monotonic
    _reports: list[tuple[float, float]] = field(default_factory=list)  # seconds, fraction; both ascending

    def hear(self, fraction: float) -> None:
        """Take the fraction of the stage that is done now; one smaller than before begins it again."""
        if self._reports and fraction < self._reports[-1][1]:
            self._reports = []
        if not self._reports or fraction > self._reports[-1][1]:
            self._reports.append((self.clock(), fraction))

    def seconds(self) -> float | None:
        """Return the seconds left; None while too little was seen, and where the stage is done."""
        reports = self._reports  # another thread shows what one hears
        if len(reports) < 2 or reports[-1][1] >= 1:
            return None
        (begun, _), (_, before), (now, done) = reports[0], *reports[-2:]
        middle = bisect_left(reports, ((begun + now) / 2, 0.0))
        first, at_first = reports[min(middle, len(reports) - 2)]
        waited = self.clock() - now
        if now - first < max(2.0, waited):  # nor is anything known of work that takes longer than all before
            return None
        each = (now - first) / (done - at_first)
        under_way = min(done - before, 1 - done)
        # What is overdue takes as long again as it is late.
        return each * (1 - done - under_way) + abs(each * under_way - waited)

    def __str__(self) -> str:
        if (seconds := self.seconds()) is None:
            return ""
        minutes = seconds / 60
        if minutes < 2:
            return f"{max(round(seconds), 1)} s left"
        return f"{minutes:.0f} min left" if minutes < 120 else f"{minutes / 60:.1f} h left"


class WorkCancelledError(Exception):
    """Raised by a `Progress` to stop the work; what was stored so far stays valid."""


def line_progress() -> Progress:
    """Return progress for other programs: a line of JSON on stderr for every new report.

    ``{"stage": "training", "fraction": 0.2, "note": "step 9", "metrics": {"loss": 0.03}}``
    """
    last = ""

    def show(report: Report) -> None:
        nonlocal last
        metrics = {name: float(f"{value:.4g}") for name, value in report.metrics.items()}
        fraction = round(min(max(report.fraction, 0.0), 1.0), 3)
        stated = {"stage": report.stage, "fraction": fraction, "note": report.note, "metrics": metrics}
        line = json.dumps(stated)
        if line != last and log.isEnabledFor(logging.WARNING):
            last = line
            print(line, file=sys.stderr, flush=True)

    return Progress(show)


AS_LINES = "LANGSPLAT_PROGRESS"  # environment: "lines", as the window asks of the commands that it runs


class TerminalProgress:
    """Progress on stderr, a context manager: one bar per stage, or lines for other programs."""

    def __init__(self, lines: bool = False) -> None:
        from rich.console import Console  # a tenth of a second that nothing else needs
        from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as RichBar

        self._bar = RichBar(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}%"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=Console(file=sys.stderr),
            disable=not log.isEnabledFor(logging.WARNING),
        )
        self._tasks: dict[str, tuple[TaskID, TimeLeft]] = {}
        self._stage = ""  # the last one
        self._lines = lines or os.environ.get(AS_LINES) == "lines"

    def __enter__(self) -> Progress:
        return line_progress() if self._lines else Progress(self._show)

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is None:
            self._complete()
        if self._tasks:  # stopping a bar that never began prints an empty line before the error's own
            self._bar.stop()

    def _complete(self) -> None:
        if self._stage in self._tasks:
            task, left = self._tasks[self._stage]
            left.hear(1.0)
            self._bar.update(task, completed=1.0)

    def _show(self, report: Report) -> None:
        self._bar.start()
        if report.stage != self._stage:
            self._complete()
            self._stage = report.stage
        if report.stage not in self._tasks:
            left = TimeLeft()
            self._tasks[report.stage] = self._bar.add_task(report.stage, total=1.0, left=left), left
        task, left = self._tasks[report.stage]
        left.hear(report.fraction)
        self._bar.update(task, completed=report.fraction, description=report.text)
