"""What stops a program: permissions, a full disk, its user."""

import ctypes
import os
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from langsplat_core.io import apart
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


def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """What runs in a process of its own runs in this one, where what is patched is so for it too."""
    monkeypatch.setattr(apart, "run", lambda function, *given, progress: function(*given, progress))


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
