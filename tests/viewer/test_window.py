"""The window itself, on a virtual display, driven like a person would; and the canvas behind it."""

import gc
import time
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
import pytest

from langsplat_core.io import save_scene
from langsplat_core.scene import Scene
from langsplat_viewer.camera.controls import default_view, extent_of, orbit
from langsplat_viewer.canvas import NOTHING_LEFT, REST_SECONDS, Canvas
from langsplat_viewer.marks import unmarked
from langsplat_viewer.state import ViewerState
from tests.support.fakes import blob_scene
from tests.support.on_display import Cast
from tests.support.windowless import FakeRenderer


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
@pytest.mark.parametrize(
    "scenario",
    [
        "look_and_search",
        "without_field",
        "from_the_command_line",
        "broken_renderer",
        "use_shortcuts",
        "arrange_panels",
        "many_queries",
        "select_with_the_mouse",
        "outline_and_rest",
        "ask_before_leaving",
        "type_while_opening",
        "look_at_nothing",
        "record_and_play",
        "mark_and_return",
        "close_while_opening",
        "split_the_view",
        "draw_over_the_scene",
        "look_without_perspective",
        "name_what_is_close",
        "reload_what_changed",
        "cut_by_depth",
        "rasterize_elsewhere",
        "watch_a_training",
        "read_what_speaks_against",
        "switch_between_scenes",
        "time_and_compare",
        "fade_in_a_photograph",
        "large_letters",
    ],
)
def test_window(scenario: str, cast: Cast, folder: Path):
    drive(scenario, cast, folder)


@pytest.mark.long
def test_what_was_arranged_is_found_again(cast: Cast, folder: Path):
    drive("leave_settings", cast, folder)
    drive("find_settings", cast, folder)


def drive(scenario: str, cast: Cast, folder: Path) -> None:
    """Play one scenario of `window_driver`."""
    said = cast.play([scenario, str(folder)], folder, timeout=300)
    assert said.rstrip().endswith("PASSED"), said[-4000:]


@pytest.fixture
def state() -> ViewerState:
    scene = blob_scene()
    extent = extent_of(scene)
    return ViewerState(
        scene=scene, extent=extent, view=default_view(scene, extent, (200, 120)), size=(200, 120)
    )


def drawn(renderer: FakeRenderer) -> list[object]:
    found = [what for kind, what in renderer.calls if kind == "draw"]
    renderer.calls.clear()
    return found


def test_canvas_draws_only_changes(gl, state):
    renderer = FakeRenderer()
    canvas = Canvas(gl, renderer)
    assert not canvas.update(state, 0.0)
    assert [kind for kind, _ in renderer.calls] == ["scene", "clip", "layers", "draw"]
    renderer.calls.clear()
    for second in range(1, 5):
        canvas.update(state, float(second))
    assert renderer.calls == []
    state.picture = replace(state.picture, display="depth")
    canvas.update(state, 6.0)
    assert renderer.calls == [("draw", (200, 120))]
    renderer.calls.clear()
    state.latent, state.picture = np.zeros((3, 360, 3), np.float32), replace(state.picture, display="latent")
    canvas.update(state, 7.0)
    assert renderer.calls == [("layers", True), ("draw", (200, 120))]
    assert np.frombuffer(canvas.textures[0].read(), np.uint8)[:4].tolist() == [255, 0, 0, 255]


def test_canvas_draws_what_is_marked_once(gl, state):
    renderer = FakeRenderer()
    canvas = Canvas(gl, renderer)
    canvas.update(state, 0.0)
    renderer.calls.clear()
    marks = unmarked(360)
    for hidden, count in ((np.arange(360) < 100, 260), (np.ones(360, bool), 0), (marks.hidden, 360)):
        state.selection = replace(state.selection, marks=replace(marks, hidden=hidden))
        for second in range(3):
            canvas.update(state, float(second))
        (kind, scene), *others = renderer.calls
        assert (kind, [name for name, _ in others]) == ("scene", ["layers", "draw"])
        assert len(scene.gaussians) == count
        renderer.calls.clear()
    assert scene is state.scene  # the source itself again
    renderer.shows_nothing = lambda: True
    state.selection = replace(state.selection, marks=replace(marks, deleted=np.ones(360, bool)))
    canvas.update(state, 9.0)
    assert state.nothing == f"{NOTHING_LEFT}: show what is hidden (U), or undo (Ctrl+Z)"


@pytest.mark.parametrize(("fine_ms", "coarse"), [(10, (200, 120)), (150, (100, 60)), (5000, (50, 30))])
def test_canvas_is_coarse_only_while_a_slow_camera_moves(gl, state, fine_ms, coarse):
    renderer = FakeRenderer(seconds=fine_ms / 1000)
    canvas = Canvas(gl, renderer, renderer.clock)
    canvas.update(state, 0.0)
    assert state.stats.milliseconds == pytest.approx(fine_ms)
    drawn(renderer)
    state.view = orbit(state.view, 0.1, 0)
    assert canvas.update(state, 10.0)  # a finer picture is due
    assert drawn(renderer) == [coarse]
    canvas.update(state, 10.0 + 0.5 * REST_SECONDS)
    assert drawn(renderer) == []
    assert not canvas.update(state, 10.0 + 2 * REST_SECONDS)
    assert drawn(renderer) == ([] if coarse == (200, 120) else [(200, 120)])


def test_canvas_draws_merged_gaussians_while_a_large_scene_moves(gl, state):
    """As soon as they are there; at rest all of them again. Under the cursor is what was drawn last."""
    renderer, quick = FakeRenderer(seconds=0.6), FakeRenderer(seconds=0.05)
    quick.depth_at = lambda *_: 3.0
    canvas = Canvas(gl, renderer, lambda: renderer.now + quick.now, quick)
    canvas.update(state, 0.0)
    assert quick.calls == []
    drawn(renderer)
    for step in range(1, 2000):  # the thread that merges them may take a while
        state.view = orbit(state.view, 0.1, 0)
        assert canvas.update(state, float(step))
        if quick.calls:
            break
        assert drawn(renderer) == [(50, 30)]
        time.sleep(0.01)
    (kind, scene), _, (layers, _), draw = quick.calls
    assert (kind, layers, draw) == ("scene", "layers", ("draw", (100, 60)))
    assert len(scene.gaussians) < len(state.scene.gaussians) == 360
    away = np.linalg.norm(canvas.point_at(0.5, 0.5) - state.view.camera(200, 120).position)
    assert away == pytest.approx(3, rel=1e-3)
    quick.calls.clear()
    assert not canvas.update(state, step + 1.0)
    assert (drawn(renderer), quick.calls) == ([(200, 120)], [])
    assert canvas.point_at(0.2, 0.25) is None  # the fine renderer's answer
    state.view = orbit(state.view, 0.1, 0)
    canvas.update(state, step + 2.0)
    assert quick.calls == [("draw", (100, 60))]
    canvas.close()


def test_canvas_merges_what_is_shown(gl, state):
    """Layers too; after a change of what is hidden the merged scene is made anew."""
    renderer, quick = FakeRenderer(seconds=0.6), FakeRenderer()
    given: list[np.ndarray] = []
    quick.set_layers = lambda latent, _: given.append(latent)
    canvas = Canvas(gl, renderer, renderer.clock, quick)
    state.latent, state.picture = np.ones((3, 360, 3), np.float32), replace(state.picture, display="latent")
    hidden = np.arange(360) < 120
    counts, now = [], 0.0
    for marks in (unmarked(360), replace(unmarked(360), hidden=hidden)):
        state.selection = replace(state.selection, marks=marks)
        canvas.update(state, now := now + 1.0)
        quick.calls.clear()
        while not quick.calls:
            assert now < 3000
            time.sleep(0.01)
            state.view = orbit(state.view, 0.1, 0)
            canvas.update(state, now := now + 1.0)
        counts.append(len(dict(quick.calls)["scene"].gaussians))
        assert given[-1].shape == (counts[-1], 3)
        np.testing.assert_allclose(given[-1], 1, rtol=1e-6)
    assert 0 < counts[1] < counts[0] < 360
    canvas.close()


def test_the_quick_renderer_s_stage_lets_go_of_a_scene_that_was_left(gl, state):
    left = weakref.ref(state.scene)
    renderer, quick = FakeRenderer(seconds=0.6), FakeRenderer(seconds=0.05)
    canvas = Canvas(gl, renderer, lambda: renderer.now + quick.now, quick)
    now = 0.0
    while not quick.calls:
        assert now < 3000
        time.sleep(0.01)
        state.view = orbit(state.view, 0.1, 0)
        canvas.update(state, now := now + 1.0)
    state.scene = blob_scene()
    canvas.update(state, now + 1.0)
    canvas.update(state, now + 2.0)
    renderer.calls.clear()  # which note the scenes
    quick.calls.clear()
    gc.collect()
    assert left() is None
    canvas.close()


def test_canvas_stays_fine_if_told_so(gl, state):
    renderer = FakeRenderer(seconds=5.0)
    canvas = Canvas(gl, renderer, renderer.clock)
    state.coarse_while_moving = False
    canvas.update(state, 0.0)
    state.view = orbit(state.view, 0.1, 0)
    canvas.update(state, 10.0)
    assert drawn(renderer) == [(200, 120), (200, 120)]


def test_canvas_keeps_few_textures(gl, state):
    canvas, seen = Canvas(gl, FakeRenderer()), []
    for width in range(20, 40):
        state.size = (width, 20)
        canvas.update(state, 0.0)
        assert canvas.textures[0].size == (width, 20)
        seen.append(canvas.textures[0])
    kept = [texture for texture in seen if not isinstance(texture.mglo, moderngl.InvalidObject)]
    assert len(kept) <= 3


def test_canvas_finds_the_point_under_the_cursor(gl, state):
    canvas = Canvas(gl, FakeRenderer())
    assert canvas.point_at(0.8, 0.5) is None  # nothing was drawn yet
    canvas.update(state, 0.0)
    camera = state.view.camera(200, 120)
    pixels, depth = camera.project(canvas.point_at(0.8, 0.25)[None])
    np.testing.assert_allclose(pixels[0], (160, 30))
    np.testing.assert_allclose(depth, 2.0)
    assert canvas.point_at(0.2, 0.25) is None
