"""What stops a program: permissions, a full disk, its user; and programs on a display of their own."""

import ctypes
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from langsplat_core.progress import Cancelled, Progress, Report

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 24, 1, 2  # linux/prctl.h, linux/capability.h


def bound_by_permissions() -> Callable[[], None] | None:
    """`preexec_fn` for `subprocess`: for the administrator, the right to pass over permissions is given up
    before the program starts; other users need nothing."""
    if os.geteuid() != 0:
        return None
    prctl = ctypes.CDLL(None, use_errno=True).prctl

    def give_up() -> None:
        for right in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            if prctl(PR_CAPBSET_DROP, right, 0, 0, 0) != 0:
                raise OSError(ctypes.get_errno(), "cannot give up a right")

    return give_up


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Any file of this process ends at `size` bytes, written by Python or by native code: the system says so
    where it would say that the disk is full, in the middle of what is written."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))  # its signal is ignored by Python
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def stop_at(stage: str, fraction: float = 0.0) -> Progress:
    """Progress that cancels the work where a stage, named by how it begins, has come so far."""

    def show(at: Report) -> None:
        if at.stage.startswith(stage) and at.fraction >= fraction:
            raise Cancelled

    return Progress(show)


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """A file system in memory of so many bytes, see `resize`; skips where one may not be mounted."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting a file system needs root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True, capture_output=True)


def resize(disk: Path, size: int) -> None:
    """Make a `small_disk` larger."""
    subprocess.run(["mount", "-o", f"remount,size={size}", str(disk)], check=True, capture_output=True)


# Programs of this tree, played on a virtual display in a process of their own.

ROOT = Path(__file__).parents[2]


def surroundings(display: str) -> dict[str, str]:
    """The environment of a program on `display`."""
    inherited = {key: value for key, value in os.environ.items() if key != "WAYLAND_DISPLAY"}
    return inherited | {"DISPLAY": display, "PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "app")))}


def play(display: str, arguments: list[str], folder: Path, timeout: float, **environment: str) -> str:
    """What Python says with `arguments`, in `folder`, for at most `timeout` seconds. It has to end well."""
    done = subprocess.run(
        [sys.executable, *arguments],
        env=surroundings(display) | environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout


class Cast:
    """A process that has imported a module that calls `serve`, and plays it in forks of itself: what takes
    seconds to import is imported once."""

    def __init__(self, module: str, display: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module],
            env=surroundings(display),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def play(self, arguments: list[str], folder: Path, timeout: int) -> str:
        """As the function of this name."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([arguments, str(folder), timeout]) + "\n")
        self._process.stdin.flush()
        code, said = json.loads(self._process.stdout.readline())
        assert code == 0, said[-4000:]
        return said

    def close(self) -> None:
        self._process.communicate()


def serve(play_one: Callable[[list[str]], None]) -> None:
    """Play what `Cast` asks for, one after another, each in a process that ends as any other does."""
    for line in sys.stdin:
        arguments, folder, timeout = json.loads(line)
        said = Path(folder) / "said.txt"
        if (child := os.fork()) == 0:
            signal.alarm(timeout)
            os.chdir(folder)
            with said.open("wb") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            return play_one(arguments)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps([code, said.read_text()]), flush=True)
        said.unlink()
