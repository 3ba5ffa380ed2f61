"""The window on a virtual display: scenarios, idling, closing, orbiting, memory, a long day of 100 scenes."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.io.scenes import save_scene
from langsplat_core.scene import Scene
from tests.support.fakes import blob_scene
from tests.support.processes import Cast, play, surroundings

SCENARIOS = [
    "look_and_search", "without_field", "from_the_command_line", "broken_renderer", "use_shortcuts",
    "arrange_panels", "many_queries", "select_with_the_mouse", "outline_and_rest", "ask_before_leaving",
    "drag_the_gizmo", "travel_by_keys", "end_by_signals", "look_at_nothing", "record_and_play",
    "close_while_opening", "split_the_view", "draw_over_the_scene", "look_without_perspective",
    "reload_what_changed", "search_a_library", "see_the_evidence", "large_letters", "use_the_toolbar",
    "drag_the_crop_box", "pin_a_note", "open_many_scenes", "use_the_outline", "compare_two_scenes",
]  # fmt: skip


@pytest.fixture(scope="module")
def cast(display: str) -> Iterator[Cast]:
    """Plays scenarios of `window_driver`."""
    made = Cast("tests.viewer.window_driver", display)
    yield made
    made.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Scenes with and without a language field, one cut short, and one of which nothing can be drawn."""
    for name, field in (("blobs", True), ("plain", False)):
        save_scene(tmp_path / f"{name}.ply", replace(blob_scene(field=field), path=None))
    gaussians = replace(blob_scene().gaussians, opacity_logits=np.full(360, np.nan))
    save_scene(tmp_path / "nothing.ply", Scene(gaussians))
    whole = (tmp_path / "plain.ply").read_bytes()
    (tmp_path / "truncated.ply").write_bytes(whole[: len(whole) // 2])
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_window(scenario: str, cast: Cast, folder: Path):
    drive(scenario, cast, folder)


@pytest.mark.long
def test_layout_is_remembered(cast: Cast, folder: Path):
    drive("leave_settings", cast, folder)
    drive("find_settings", cast, folder)


def drive(scenario: str, cast: Cast, folder: Path) -> None:
    """Play one scenario of `window_driver`."""
    said = cast.play([scenario, str(folder)], folder, timeout=300)
    assert said.rstrip().endswith("PASSED"), said[-4000:]


ROOT = Path(__file__).parents[2]
DEMO = ROOT / "assets" / "demo" / "scene.ply"


def run(display: str, folder: Path, *arguments: str) -> str:
    """Return what `process_driver` prints."""
    return play(display, ["-m", "tests.viewer.process_driver", *arguments], folder, 200)


@pytest.fixture
def blobs(tmp_path: Path) -> str:
    save_scene(tmp_path / "blobs.ply", blob_scene())
    return str(tmp_path / "blobs.ply")


@pytest.mark.long
def test_idle_window_draws_nothing(display, tmp_path, blobs):
    words = run(display, tmp_path, "--idle", blobs).split()
    assert int(words[1]) <= 2  # one in a hundred seconds, and a late one
    assert float(words[3]) < 0.01


@pytest.mark.long
def test_closing_does_not_wait_for_reading(display, tmp_path, blobs):
    began = time.monotonic()
    run(display, tmp_path, "--leave", blobs)
    assert time.monotonic() - began < 45  # the reading takes 60


@pytest.mark.long
def test_fast_keys_keep_their_order(display, tmp_path):
    save_scene(tmp_path / "many.ply", blob_scene(phrasebook=True))
    assert "PASSED" in run(display, tmp_path, "--type", str(tmp_path / "many.ply"))


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="says where settings are")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_an_idle_window(display, tmp_path, blobs, number):
    process = subprocess.Popen(
        [sys.executable, "-m", "langsplat_viewer", blobs],
        env=surroundings(display) | {"XDG_CONFIG_HOME": str(tmp_path)},
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (tmp_path / "langsplat-viewer" / "preferences.json").exists():  # the scene is a recent one
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.2)
    time.sleep(2)  # and it rests
    process.send_signal(number)
    assert process.wait(100) == 0, process.communicate()[1]


@pytest.mark.long
@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="needs a machine without CUDA")
def test_absent_backend_is_refused_before_a_window(display, tmp_path, blobs):
    done = subprocess.run(
        [sys.executable, "-m", "langsplat_viewer", blobs, "--fresh", "--backend", "cuda"],
        env=surroundings(display),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "cuda" in done.stderr.lower()


@pytest.mark.long
def test_images_are_coarse_while_moving_only(display, tmp_path):
    options = ["--scene", str(DEMO), "--count", "0", "--seconds", "2", "--size", "860", "620", "--slow"]
    seen = json.loads(run(display, tmp_path, *options))
    assert len(seen["sharp_after"]) == 3
    assert all(rate > 0 for rate in seen["pictures_per_second"])
    if seen["backend"] == "cpu":
        assert all(width < 250 for width, _ in seen["sizes"])  # a quarter of what the panels leave
        assert seen["merged"] == [True] * 3


@pytest.mark.long
def test_window_memory_stays_small():
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
