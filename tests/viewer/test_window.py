"""The window itself, on a virtual display, driven like a person would; and the canvas behind it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.io.scenes import save_scene
from langsplat_core.scene import Scene
from tests.support.fakes import blob_scene
from tests.support.processes import Cast

SCENARIOS = [
    "look_and_search", "without_field", "from_the_command_line", "broken_renderer", "use_shortcuts",
    "arrange_panels", "many_queries", "select_with_the_mouse", "outline_and_rest", "name_what_is_clicked",
    "ask_before_leaving", "drag_the_gizmo", "travel_by_keys", "end_by_signals",
    "look_at_nothing", "look_from_the_broad_side", "record_and_play", "mark_and_return",
    "close_while_opening", "split_the_view", "draw_over_the_scene", "look_without_perspective",
    "name_what_is_close", "reload_what_changed", "watch_a_training", "switch_between_scenes",
    "search_a_library", "see_the_evidence", "large_letters",
    "use_the_toolbar", "drag_the_crop_box", "pin_a_note", "use_the_outline", "compare_two_scenes",
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
    save_scene(tmp_path / "wide.ply", replace(blob_scene(with_cameras=False), path=None))
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
