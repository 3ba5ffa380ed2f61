"""What a user waits for at the first picture: imports, and compiling or loading the CPU backend's kernels."""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass

from langsplat_core.errors import BackendError

_STEPS = ("import langsplat_core", "import the CPU backend", "view", "splat", "gather", "backward")
_SCRIPT = """
import json, time
start, seconds = time.perf_counter(), []
def done():
    global start
    seconds.append(time.perf_counter() - start)
    start = time.perf_counter()
import langsplat_core; done()
from langsplat_core.raster import load_rasterizer
cpu = load_rasterizer("cpu"); done()
import numpy as np
from langsplat_core.lab.speed.cases import default_camera, random_scene
scene, camera = random_scene(100), default_camera(48, 32)
values, image = np.ones((100, 3), np.float32), np.ones((32, 48, 3), np.float32)
start = time.perf_counter()
view = cpu.view(scene, camera); done()
view.splat(values); done()
view.gather(image); done()
view.backward(values, image); done()
print(json.dumps(seconds))
"""


@dataclass(frozen=True)
class Start:
    """Seconds from a fresh process to the end of each first call."""

    cache: str  # "cold": nothing compiled yet; "warm": compiled by an earlier process
    seconds: dict[str, float]  # by step, each without those before it


def measure_starts() -> list[Start]:
    """Two fresh interpreters, one after the other, on a kernel cache that is empty at first."""
    with tempfile.TemporaryDirectory() as cache:
        return [Start(kind, _fresh_process(cache)) for kind in ("cold", "warm")]


def _fresh_process(cache: str) -> dict[str, float]:
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    run = subprocess.run(
        [sys.executable, "-c", _SCRIPT], env=environment, capture_output=True, text=True, check=False
    )
    if run.returncode != 0:
        raise BackendError(f"a fresh interpreter could not draw: {run.stderr.strip().splitlines()[-1:]}")
    return dict(zip(_STEPS, json.loads(run.stdout), strict=True))


def starts_table(starts: list[Start]) -> str:
    """A Markdown table."""
    lines = ["| kernel cache | " + " | ".join(_STEPS) + " | in all |", "|---" * (len(_STEPS) + 2) + "|"]
    for start in starts:
        cells = [f"{start.seconds[step]:.2f}" for step in _STEPS]
        lines.append(f"| {start.cache} | " + " | ".join(cells) + f" | {sum(start.seconds.values()):.2f} |")
    return "\n".join(lines) + "\n"
