"""What a reader may do with a damaged file: load it, or refuse it in one short printable line. Everything
else is a fault, and so are memory, time, Python warnings, and lines on the standard error that nobody
wrote."""

import logging
import os
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from langsplat_core.errors import InputError, printable_line

MEMORY_FACTOR, MEMORY_SLACK = 4, 300_000_000  # bytes: beyond the file's size times the factor
LINE = 300  # characters of a message, with the short path of a test
SECONDS = 20.0  # of the processor: what the worst mutants need is hundredths


@dataclass
class Outcome:
    """What became of many mutants of one kind."""

    tried: int = 0
    loaded: int = 0
    warned: int = 0  # of those, with a warning of ours
    faults: Counter[str] = field(default_factory=Counter)  # description -> mutants
    examples: dict[str, bytes] = field(default_factory=dict)  # the first mutant of each fault
    peak: int = 0  # most bytes that one mutant took
    slowest: float = 0.0  # most seconds of the processor

    def fault(self, what: str, content: bytes) -> None:
        self.faults[what] += 1
        self.examples.setdefault(what, content)

    @property
    def refused(self) -> int:
        return self.tried - self.loaded - self.faults.total()

    def summary(self) -> str:
        lines = [
            f"{self.tried} tried, {self.loaded} loaded ({self.warned} with a warning), "
            f"{self.refused} refused, {self.faults.total()} faults; "
            f"most memory {self.peak / 1e6:.0f} MB, longest {self.slowest:.2f} s"
        ]
        return "\n".join([*lines, *(f"  {count} x {what}" for what, count in self.faults.most_common())])


class Ordeal:
    """`read(path)` returns the share of sound content, in [0, 1]; below a half a warning is due."""

    def __init__(self, path: Path, read: Callable[[Path], float]) -> None:
        self.path, self._read = path, read
        self.outcome = Outcome()

    def run(self, mutants: Iterator[bytes]) -> Outcome:
        """Try all of them."""
        with _listening() as said, _standard_error() as stray:
            for content in mutants:
                said.clear()
                self._try(content, said, stray)
        return self.outcome

    def _try(self, content: bytes, said: list[str], stray: Callable[[], str]) -> None:
        outcome = self.outcome
        outcome.tried += 1
        self.path.write_bytes(content)
        before, began = _resident(), time.process_time()
        what = self._verdict(said)
        took, seconds = _peak() - before, time.process_time() - began
        outcome.peak, outcome.slowest = max(outcome.peak, took), max(outcome.slowest, seconds)
        if what is None and took > MEMORY_FACTOR * len(content) + MEMORY_SLACK:
            what = f"memory: {took / 1e6:.0f} MB for {len(content)} bytes"
        if what is None and seconds > SECONDS:
            what = f"time: {seconds:.0f} s for {len(content)} bytes"
        if text := stray():
            what = what or f"on the standard error: {text[:100]!r}"
        if what is not None:
            outcome.fault(what, content)

    def _verdict(self, said: list[str]) -> str | None:
        """The fault, if any; counts what loaded."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                sound = self._read(self.path)
        except InputError as error:
            return _bad_line(str(error))
        except Exception as error:  # noqa: BLE001  which is what is looked for
            last = traceback.extract_tb(error.__traceback__)[-1]
            return f"{type(error).__name__} ({str(error)[:80]}) at {Path(last.filename).name}:{last.lineno}"
        bad = next((line for line in map(_bad_line, said) if line), None)
        if bad is None and sound < 0.5 and not said:
            bad = "mostly unsound, unsaid"
        self.outcome.loaded += bad is None
        self.outcome.warned += bad is None and bool(said)
        return bad


def _bad_line(text: str) -> str | None:
    if not text or len(text) >= LINE or not text.isprintable():
        return f"message: {len(text)} characters, {text[:60]!r} ... {text[-60:]!r}"
    return None


@contextmanager
def _listening() -> Iterator[list[str]]:
    """What the logger "langsplat" says, as the command line shows it."""
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(printable_line(record.getMessage()))  # type: ignore[method-assign]
    logger = logging.getLogger("langsplat")
    logger.addHandler(handler)
    try:
        yield said
    finally:
        logger.removeHandler(handler)


@contextmanager
def _standard_error() -> Iterator[Callable[[], str]]:
    """A function that returns what was written to the standard error, by native code too, since its last
    call."""
    kept, propagate = os.dup(2), logging.getLogger("langsplat").propagate
    logging.getLogger("langsplat").propagate = False
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)

        def since() -> str:
            text = os.pread(file.fileno(), 10_000, 0)
            if text:
                file.truncate(0)
                os.lseek(2, 0, os.SEEK_SET)
            return text.decode("utf-8", "replace")

        try:
            yield since
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            logging.getLogger("langsplat").propagate = propagate


def _resident() -> int:
    """Bytes of memory in use, after the peak was made to begin here; 0 where the system does not tell."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return 0
    return _status("VmRSS")


def _peak() -> int:
    return _status("VmHWM")


def _status(key: str) -> int:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(key + ":")), 0)
