"""The program `langsplat` in this process, and in children of one process.

python -m tests.support.commands FOLDER    runs `langsplat convert` for every FOLDER/NAME.pth
"""

import gc
import json
import os
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

import langsplat_core.extensions.checkpoints.importing  # noqa: F401  which imports torch
from langsplat_core.cli.app import parse
from langsplat_core.cli.export import Convert
from langsplat_core.cli.run import main


def run(*words: object) -> int:
    """The exit code of `langsplat` with these words."""
    return main("langsplat", lambda: parse([str(word) for word in words]))


def refusal(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line with which `langsplat` refuses these words; nothing is printed beside it."""
    capsys.readouterr()
    assert run(*words) == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = (line for line in said.err.splitlines() if line.startswith("langsplat"))
    return line


# A command once for each of many files, each in a child of one process that has all imports behind it: what
# crashes is told from what refuses, and starting torch is paid for once.

ROOM, SECONDS = 3 << 30, 20  # bytes of address space beyond the parent's, seconds of the processor


@dataclass(frozen=True)
class Ended:
    """How a child ended."""

    code: int  # negative: the number of the signal that killed it
    said: str  # on the standard error
    wrote: bool  # anything beside its log


def convert_each(folder: Path) -> dict[str, Ended]:
    """`langsplat convert` of every checkpoint in `folder`, by name."""
    command = [sys.executable, "-m", __name__, str(folder)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return {name: Ended(*how) for name, how in json.loads(done.stdout).items()}


def _child(path: Path) -> tuple[int, str, bool]:
    folder = path.with_suffix("")
    folder.mkdir()
    log = path.with_suffix(".log")
    process = os.fork()
    if process == 0:
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(os.open(log, os.O_CREAT | os.O_WRONLY), 2)
            held = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            resource.setrlimit(resource.RLIMIT_AS, (held + ROOM,) * 2)
            resource.setrlimit(resource.RLIMIT_CPU, (SECONDS,) * 2)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            code = main("langsplat", lambda: Convert(path, (folder / "out.ply",)))
        except BaseException:  # noqa: BLE001  as at the end of any program
            sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
            code = 1
        sys.stderr.flush()
        os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    return code, log.read_text(), any(folder.iterdir())


def _all(folder: Path) -> None:
    gc.freeze()  # or every child copies what its first collection touches
    print(json.dumps({path.stem: _child(path) for path in sorted(folder.glob("*.pth"))}))


if __name__ == "__main__":
    _all(Path(sys.argv[1]))
