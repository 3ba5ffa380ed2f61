"""The window at rest costs nothing, and leaves when it is told to."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from langsplat_core.io.scenes import save_scene
from tests.support.fakes import blob_scene
from tests.support.on_display import play

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.long


def run(scenario: str, display: str, folder: Path, **environment: str) -> str:
    """The output of one scenario of `resting_driver`."""
    save_scene(folder / "blobs.ply", blob_scene())
    arguments = ["-m", "tests.viewer.resting_driver", scenario, str(folder / "blobs.ply")]
    return play(display, arguments, folder, 120, **environment)


def test_at_rest_no_frame_is_drawn_and_no_time_is_used(display, tmp_path):
    words = run("rest", display, tmp_path).split()
    assert int(words[1]) <= 2  # one in a hundred seconds, and a late one
    assert float(words[3]) < 0.01


def test_closing_does_not_wait_for_what_is_being_read(display, tmp_path):
    began = time.monotonic()
    run("leave", display, tmp_path)
    assert time.monotonic() - began < 45  # the reading takes 60


def test_the_window_is_not_heavier_than_it_has_to_be():
    heavy = ("torch", "transformers", "pycolmap", "open3d", "skimage", "matplotlib")
    script = (
        f"import sys, langsplat_viewer.window\nprint([name for name in {heavy!r} if name in sys.modules])"
    )
    paths = os.pathsep.join((str(ROOT), str(ROOT / "app")))
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout.strip() == "[]", done.stderr
