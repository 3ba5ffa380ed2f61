"""The project's own tests of the rasterizers, on the device."""

import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from gpu_sections import Missing, Plan, need_cuda

ROOT = Path(__file__).resolve().parents[3]


def measure(plan: Plan) -> Iterator[str]:
    """What pytest says at its end."""
    need_cuda()
    if find_spec("pytest") is None or find_spec("hypothesis") is None:
        raise Missing("no pytest or no hypothesis")
    yield f"# Tests: pytest {' '.join(plan.tests)}\n"
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--measured", *plan.tests]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    said = done.stdout.splitlines()
    start = next(
        (n for n, line in enumerate(said) if "measured" in line or "short test summary" in line), -10
    )
    yield "```\n" + "\n".join(said[start:]) + "\n```\n"
    if done.returncode:
        raise RuntimeError(f"pytest: {said[-1] if said else done.stderr.strip()[-300:]}")
