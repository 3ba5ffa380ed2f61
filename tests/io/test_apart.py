"""Functions in a process of their own: what comes back of them, and that they never outlive who asked."""

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from langsplat_core.errors import STRICTNESS, FormatError, InputError, report_loss
from langsplat_core.io import apart
from langsplat_core.io.hostile import PictureError
from langsplat_core.progress import Progress, Report, WorkCancelledError, silent
from tests.support.processes import stop_at

log = logging.getLogger("langsplat")


def halve(number: float, progress: Progress) -> tuple[float, int]:
    progress("halving", 0.5, "a number", loss=0.25)
    log.warning("%g is halved", number)
    print("what a library prints is no message")
    return number / 2, os.getpid()


def lose(_: Progress) -> None:
    report_loss("%s is left out", "a.jpg")


def fail(error: Exception, _: Progress) -> None:
    raise error


def abort(number: int, _: Progress) -> None:
    os.write(2, b"Check failed: no room\n\n")
    os.kill(os.getpid(), number)


def wait(pid: Path, progress: Progress) -> None:
    pid.write_text(str(os.getpid()))
    progress("waiting", 0.0)
    time.sleep(600)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


def test_results_progress_and_messages_come_back(caplog: pytest.LogCaptureFixture) -> None:
    reports: list[Report] = []
    half, pid = apart.run(halve, 3.0, progress=Progress(reports.append))
    assert half == 1.5
    assert pid != os.getpid()
    assert reports == [Report("halving", 0.5, "a number", {"loss": 0.25})]
    assert caplog.messages == ["3 is halved"]


def test_a_loss_in_the_process_is_said_or_with_strict_an_error(caplog, monkeypatch):
    apart.run(lose, progress=silent)
    assert caplog.messages == [STRICTNESS.said[-1]] == ["a.jpg is left out"]
    monkeypatch.setattr(STRICTNESS, "on", True)
    with pytest.raises(InputError, match="--strict"):
        apart.run(lose, progress=silent)


@pytest.mark.parametrize("error", [FormatError("no model"), OSError(28, "full", "/a"), WorkCancelledError()])
def test_errors_of_the_process_are_raised(error: Exception) -> None:
    with pytest.raises(type(error)) as caught:
        apart.run(fail, error, progress=silent)
    assert caught.value.args == error.args
    assert str(caught.value) == str(error)


def test_unpicklable_errors_keep_their_message() -> None:
    with pytest.raises(RuntimeError, match=r"PictureError: a\.png: not a readable picture \(cut off\)"):
        apart.run(fail, _UnpackedError(), progress=silent)


class _UnpackedError(Exception):
    """Becomes, where it is raised, an error that cannot be unpickled."""

    def __reduce__(self) -> tuple[type, tuple[str, str]]:
        return PictureError, ("a.png", "cut off")


@pytest.mark.skipif(os.name == "nt", reason="no such signals")
@pytest.mark.parametrize(
    ("number", "said"),
    [(signal.SIGABRT, "SIGABRT: Check failed: no room"), (signal.SIGKILL, "SIGKILL, as where memory runs")],
)
def test_a_process_that_ends_early_is_an_error(number: int, said: str) -> None:
    with pytest.raises(apart.AbortedError, match=f"ended with {said}"):
        apart.run(abort, number, progress=silent)


def test_cancelled_work_ends_at_once(tmp_path: Path) -> None:
    with pytest.raises(WorkCancelledError):
        apart.run(wait, tmp_path / "pid", progress=stop_at())
    assert not is_alive(int((tmp_path / "pid").read_text()))


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_process_ends_with_its_caller(tmp_path: Path) -> None:
    """Killed without a chance to tell."""
    code = (
        "import sys, pathlib; from tests.io.test_apart import apart, silent, wait;"
        "apart.run(wait, pathlib.Path(sys.argv[1]), progress=silent)"
    )
    pid = tmp_path / "pid"
    with subprocess.Popen([sys.executable, "-c", code, str(pid)]) as process:
        until = time.monotonic() + 60
        while not (pid.exists() and pid.read_text()) and time.monotonic() < until:
            time.sleep(0.05)
        process.kill()
    number = int(pid.read_text())
    while is_alive(number) and time.monotonic() < until:
        time.sleep(0.05)
    assert not is_alive(number)
