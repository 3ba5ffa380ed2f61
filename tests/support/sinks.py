"""Programs whose output is taken by nobody, each in a fork of one process that has imported everything."""

import gc
import json
import logging
import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

SINKS = ("file", "closed pipe", "full device", "closed")


@dataclass(frozen=True)
class Case:
    """A command line, and what its output and its errors lead to."""

    words: tuple[str, ...]  # program first; "reports" is `Reports`
    out: str = "file"
    err: str = "file"


@dataclass(frozen=True)
class Ended:
    """Its exit code, and what reached the files."""

    code: int
    out: str
    err: str


@dataclass(frozen=True)
class Reports:
    """A command that shows progress both ways, warns, and answers."""

    def run(self) -> None:
        """Do so."""
        from langsplat_core.progress import LineProgress, TerminalProgress

        for progress in (LineProgress(), TerminalProgress()):
            with progress as report:
                report("working", 0.5)
        log = logging.getLogger("langsplat")
        log.warning("a warning")
        log.debug("a detail")
        print("the answer")


def run_all(cases: Sequence[Case]) -> dict[Case, Ended]:
    """How every case ends."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.support.sinks"],
        input=json.dumps([astuple(case) for case in cases]),
        cwd=Path(__file__).parents[2],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return {case: Ended(*ended) for case, ended in zip(cases, json.loads(done.stdout), strict=True)}


def lead(descriptor: int, sink: str, file: Path) -> None:
    """Lead a standard stream to a sink, as a shell does before a program starts."""
    if sink == "closed":
        os.close(descriptor)
        name = {1: "stdout", 2: "stderr"}[descriptor]
        setattr(sys, name, None)
        setattr(sys, f"__{name}__", None)
        return
    if sink == "closed pipe":
        reading, opened = os.pipe()
        os.close(reading)
    else:
        path = "/dev/full" if sink == "full device" else file
        opened = os.open(path, os.O_WRONLY | os.O_CREAT)
    os.dup2(opened, descriptor)
    os.close(opened)


def programs() -> dict[str, Callable[[], None]]:
    """The entries of all programs, with what they import."""
    from langsplat_core.cli.app import COMMANDS, GROUPS, entry, load_command
    from langsplat_core.cli.run import main, parsed
    from langsplat_viewer.__main__ import entry as viewer_entry

    for commands in (COMMANDS, *(members for _, members in GROUPS.values())):
        for where in commands.values():
            load_command(where)
    return {
        "langsplat": entry,
        "langsplat-viewer": viewer_entry,
        "reports": lambda: sys.exit(main("reports", lambda: parsed("reports", Reports, sys.argv[1:]))),
    }


def end(entry: Callable[[], None]) -> int:
    """The exit code of a program, with what an interpreter does to its standard streams at last: in full it
    would take a quarter of a second."""
    try:
        entry()
    except SystemExit as stop:
        code = int(stop.code or 0)
    except BaseException:  # noqa: BLE001  as an interpreter does
        traceback.print_exc()
        code = 1
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            code = 120
    return code


def fork_all() -> None:
    """Read cases from standard input, and print how they end."""
    entries, results = programs(), []
    gc.freeze()
    for words, out, err in json.load(sys.stdin):
        with tempfile.TemporaryDirectory() as folder:
            files = [Path(folder, name) for name in ("out", "err")]
            pid = os.fork()
            if pid == 0:
                sys.argv = words
                lead(1, out, files[0])
                lead(2, err, files[1])
                os._exit(end(entries[words[0]]))
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            results.append((code, *(file.read_text() if file.exists() else "" for file in files)))
    print(json.dumps(results))


if __name__ == "__main__":
    fork_all()
