"""What the steps of a picture take, for those who want to know; nothing is measured for others."""

import json
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from time import perf_counter
from types import TracebackType

_laps: ContextVar[dict[str, float] | None] = ContextVar("laps", default=None)


@contextmanager
def watched() -> Iterator[dict[str, float]]:
    """Measure the laps inside, on this thread: name -> milliseconds, summed."""
    laps: dict[str, float] = {}
    before = _laps.set(laps)
    try:
        yield laps
    finally:
        _laps.reset(before)


@contextmanager
def lap(name: str, finish: Callable[[], object] = lambda: None) -> Iterator[None]:
    """One step. `finish` waits for what a device still has to do of it; called only where one watches."""
    laps = _laps.get()
    if laps is None:
        yield
        return
    began = perf_counter()
    yield
    finish()
    laps[name] = laps.get(name, 0.0) + 1e3 * (perf_counter() - began)


# How long work reports where it is. Core functions take a `Progress`; the command line and the window
# supply one each. A `Progress` may raise to interrupt the work (Ctrl-C, the window's cancel button).

log = logging.getLogger("langsplat")
Progress = Callable[[str, float], None]  # (what is being done, fraction done in [0, 1])


def silent(label: str, fraction: float) -> None:
    """Reports nothing."""


def is_quiet() -> bool:
    """Whether only errors are wanted."""
    return log.getEffectiveLevel() >= logging.ERROR


class Cancelled(Exception):
    """Raised by a `Progress` to stop the work; what was stored so far stays valid."""


class Terminated(KeyboardInterrupt):
    """The system asked the process to end (SIGTERM); what was stored so far stays valid."""


class LineProgress:
    """A `Progress` for other programs: a line of JSON on stderr for every report that says anything new,
    ``{"label": "matching photographs", "fraction": 0.25}``; use as a context manager."""

    def __init__(self) -> None:
        self._last: tuple[str, float] = ("", -1.0)

    def __enter__(self) -> "LineProgress":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def __call__(self, label: str, fraction: float) -> None:
        report = (label, round(min(max(fraction, 0.0), 1.0), 3))
        if report != self._last and not is_quiet():
            self._last = report
            line = json.dumps({"label": report[0], "fraction": report[1]})
            print(line, file=sys.stderr, flush=True)


class TerminalProgress:
    """A `Progress` that draws one bar per label on stderr; use as a context manager."""

    def __init__(self) -> None:
        from rich.console import Console  # a tenth of a second that nothing else needs
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as RichBar

        self._bar = RichBar(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}%"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(file=sys.stderr),
            disable=is_quiet(),
        )
        self._tasks: dict[str, int] = {}

    def __enter__(self) -> "TerminalProgress":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._tasks:  # stopping a bar that never began prints an empty line before the error's own
            self._bar.stop()

    def __call__(self, label: str, fraction: float) -> None:
        self._bar.start()
        stage = label.partition(":")[0]  # text behind a colon may change while a stage runs
        if stage not in self._tasks:
            self._tasks[stage] = self._bar.add_task(label, total=1.0)
        self._bar.update(self._tasks[stage], completed=fraction, description=label)  # type: ignore[arg-type]
