"""Programs of this tree, played on a virtual display in a process of their own."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def play(display: str, arguments: list[str], folder: Path, timeout: float, **environment: str) -> str:
    """What Python says with `arguments`, in `folder`, for at most `timeout` seconds. It has to end well."""
    inherited = {key: value for key, value in os.environ.items() if key != "WAYLAND_DISPLAY"}
    paths = os.pathsep.join((str(ROOT), str(ROOT / "app")))
    done = subprocess.run(
        [sys.executable, *arguments],
        env=inherited | {"DISPLAY": display, "PYTHONPATH": paths} | environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout
