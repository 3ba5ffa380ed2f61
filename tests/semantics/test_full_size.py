"""Encoders and segmenters in their real sizes, with random weights in the layout of the hub: names, shapes,
seconds and memory are those of the real thing. Gigabytes are written and read: the slow tier."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.full_size import MODELS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent.parent
PICKLED_TOO = ("clip", "sam2.1-hiera-tiny")


def run(task: str, name: str, folder: Path) -> str:
    """One task of `tests.support.full_size` in a process of its own, on all cores."""
    environment = os.environ | {"OMP_NUM_THREADS": str(os.cpu_count())}
    command = [sys.executable, "-m", "tests.support.full_size", task, name, str(folder)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.parametrize("name", MODELS)
def test_a_model_of_real_size(name: str, tmp_path: Path, measured: Callable[[str, str, float], None]) -> None:
    run("make", name, tmp_path)
    figures = json.loads(run("measure", name, tmp_path))
    for quantity, value in figures.items():
        measured(name, quantity, value)
    assert figures["peak MB"] < 16_000
    if name in PICKLED_TOO:
        run("pickle", name, tmp_path)
        assert not list(tmp_path.glob("*.safetensors"))
        run("measure", name, tmp_path)
