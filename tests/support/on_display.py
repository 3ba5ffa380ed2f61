"""Programs of this tree, played on a virtual display in a process of their own."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

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
