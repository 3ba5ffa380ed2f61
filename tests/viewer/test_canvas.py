"""The canvas: what is drawn when, at which level of detail, on which thread."""

import gc
import itertools
import math
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from threading import Event, Thread, current_thread, main_thread

import moderngl
import numpy as np
import pytest

from langsplat_core.display.displays import DISPLAYS
from langsplat_core.errors import BackendError
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.scene_textures import is_software
from langsplat_viewer.actions import editing, queries, selecting, settings, viewpoint
from langsplat_viewer.camera.controls import default_view, extent_of, orbit
from langsplat_viewer.canvas import FINE, MOVING_BUDGET, NOTHING_LEFT, REST_SECONDS, Canvas, Level, Pace
from langsplat_viewer.marks import unmarked
from langsplat_viewer.panels.layout import in_numbers
from langsplat_viewer.rendering import renderer as renderers
from langsplat_viewer.rendering.renderer import ArrayRenderer, GlRenderer
from langsplat_viewer.rendering.request import Clip, Splats
from langsplat_viewer.state import (
    KEPT,
    LONGEST_SIDE,
    Timing,
    ViewerState,
    compared,
    compared_size,
)
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene
from tests.support.windowless import FakeRenderer, ask, errors, recorded, rest

SIZE = (120, 90)


@pytest.fixture
def state() -> ViewerState:
    scene = blob_scene()
    extent = extent_of(scene)
    return ViewerState(
        scene=scene, extent=extent, view=default_view(scene, extent, (200, 120)), size=(200, 120)
    )


def sizes(renderer: FakeRenderer) -> list[tuple[int, int]]:
    """Sizes of what was drawn since the last call."""
    found = [(one.drawn_camera.width, one.drawn_camera.height) for one in renderer.drawn]
    renderer.drawn.clear()
    return found


# Only changes are drawn.


def test_only_changes_are_drawn_and_then_it_is_still(gl, state):
    renderer = FakeRenderer()
    canvas = Canvas(gl, renderer)
    assert not canvas.update(state, 0.0)
    assert sizes(renderer) == [(200, 120)]
    state.settings = replace(state.settings, transparent=True, fade=0.5)
    for second in range(1, 5):
        assert not canvas.update(state, float(second))
    assert (canvas.phase, sizes(renderer)) == ("still", [])
    state.picture = replace(state.picture, display="depth")
    canvas.update(state, 6.0)
    assert sizes(renderer) == [(200, 120)]
    assert np.frombuffer(canvas.textures[0].read(), np.uint8)[:4].tolist() == [255, 0, 0, 255]


def test_edits_are_drawn_once(gl, state):
    renderer = FakeRenderer()
    canvas = Canvas(gl, renderer)
    canvas.update(state, 0.0)
    marks = unmarked(360)
    for hidden, count in ((np.arange(360) < 100, 260), (np.ones(360, bool), 0), (marks.hidden, 360)):
        renderer.drawn.clear()
        state.selection = replace(state.selection, marks=replace(marks, hidden=hidden))
        for second in range(3):
            canvas.update(state, float(second))
        (request,) = renderer.drawn
        assert len(request.scene.scene.gaussians) == count
    assert request.scene.scene is state.scene  # the source itself again
    renderer.nothing = True
    state.selection = replace(state.selection, marks=replace(marks, deleted=np.ones(360, bool)))
    canvas.update(state, 9.0)
    assert state.nothing == f"{NOTHING_LEFT}: show what is hidden (U), or undo (Ctrl+Z)"


@pytest.mark.parametrize(("fine_ms", "coarse"), [(10, (200, 120)), (75, (100, 60)), (5000, (50, 30))])
def test_it_is_coarse_only_while_a_slow_camera_moves(gl, state, fine_ms, coarse):
    renderer = FakeRenderer(seconds=fine_ms / 1000)
    canvas = Canvas(gl, renderer, renderer.clock)
    canvas.update(state, 0.0)
    assert state.stats.milliseconds == pytest.approx(fine_ms)
    sizes(renderer)
    state.view = orbit(state.view, 0.1, 0)
    assert canvas.update(state, 10.0)  # a finer picture is due
    assert sizes(renderer) == [coarse]
    canvas.update(state, 10.0 + 0.5 * REST_SECONDS)
    assert sizes(renderer) == []
    assert not canvas.update(state, 10.0 + 2 * REST_SECONDS)
    assert sizes(renderer) == ([] if coarse == (200, 120) else [(200, 120)])


def moved_until_merged(canvas: Canvas, state: ViewerState, quick: FakeRenderer, now: float = 0.0) -> float:
    """Move the camera until the quick renderer draws: the thread that merges may take a while."""
    quick.drawn.clear()
    while not quick.drawn:
        assert now < 3000
        time.sleep(0.01)
        state.view = orbit(state.view, 0.1, 0)
        now += 1.0
        canvas.update(state, now)
    return now


def test_merged_gaussians_are_drawn_while_a_large_scene_moves(gl, state):
    """As soon as they are there; at rest all of them again. Under the cursor is what was drawn last."""
    renderer, quick = FakeRenderer(seconds=0.3), FakeRenderer(seconds=0.025)
    quick.depth = 3.0
    canvas = Canvas(gl, renderer, lambda: renderer.now + quick.now, quick)
    canvas.update(state, 0.0)
    now = moved_until_merged(canvas, state, quick)
    assert set(sizes(renderer)) <= {(200, 120), (50, 30)}
    (request,) = quick.drawn
    assert len(request.detail.merged.gaussians) < len(state.scene.gaussians) == 360
    assert sizes(quick) == [(100, 60)]
    away = np.linalg.norm(canvas.point_at(0.5, 0.5) - state.view.camera(200, 120).position)
    assert away == pytest.approx(3, rel=1e-3)
    renderer.drawn.clear()
    assert not canvas.update(state, now + 1.0)
    assert (sizes(renderer), quick.drawn) == ([(200, 120)], [])
    assert canvas.point_at(0.2, 0.25) is None  # the fine renderer's answer
    state.view = orbit(state.view, 0.1, 0)
    canvas.update(state, now + 2.0)
    assert sizes(quick) == [(100, 60)]
    canvas.close()


def test_the_edited_scene_is_merged_and_anew_after_an_edit(gl, state):
    renderer, quick = FakeRenderer(seconds=0.6), FakeRenderer()
    canvas = Canvas(gl, renderer, renderer.clock, quick)
    counts, now = [], 0.0
    for marks in (unmarked(360), replace(unmarked(360), hidden=np.arange(360) < 120)):
        state.selection = replace(state.selection, marks=marks)
        canvas.update(state, now := now + 1.0)
        now = moved_until_merged(canvas, state, quick, now)
        counts.append(len(quick.drawn[0].detail.merged.gaussians))
    assert 0 < counts[1] < counts[0] < 360
    canvas.close()


def test_a_scene_that_was_left_is_let_go_by_both_renderers(gl, state):
    left = weakref.ref(state.scene)
    renderer, quick = FakeRenderer(seconds=0.3), FakeRenderer(seconds=0.025)
    canvas = Canvas(gl, renderer, lambda: renderer.now + quick.now, quick)
    now = moved_until_merged(canvas, state, quick)
    state.scene = blob_scene()
    canvas.update(state, now + 1.0)
    canvas.update(state, now + 2.0)
    renderer.drawn.clear()
    quick.drawn.clear()
    gc.collect()
    assert left() is None
    canvas.close()


def test_it_keeps_few_textures(gl, state):
    canvas, seen = Canvas(gl, FakeRenderer()), []
    for width in range(20, 40):
        state.size = (width, 20)
        canvas.update(state, 0.0)
        assert canvas.textures[0].size == (width, 20)
        seen.append(canvas.textures[0])
    kept = [texture for texture in seen if not isinstance(texture.mglo, moderngl.InvalidObject)]
    assert len(kept) <= 3


def test_it_finds_the_point_under_the_cursor(gl, state):
    canvas = Canvas(gl, FakeRenderer())
    assert canvas.point_at(0.8, 0.5) is None  # nothing was drawn yet
    canvas.update(state, 0.0)
    camera = state.view.camera(200, 120)
    pixels, depth = camera.project(canvas.point_at(0.8, 0.25)[None])
    np.testing.assert_allclose(pixels[0], (160, 30))
    np.testing.assert_allclose(depth, 2.0)
    assert canvas.point_at(0.2, 0.25) is None


def test_several_panes_are_drawn_and_then_it_rests(gl, opened):
    renderer = GlRenderer(gl, "cpu")
    canvas, state = Canvas(gl, renderer), opened.state
    state.size = (60, 40)
    drawn, original = [], renderer.draw
    renderer.draw = lambda request, targets: (drawn.append(request), original(request, targets))
    for display in DISPLAYS:
        settings.compare_with(opened, display)
        rest(canvas, state, 1.0)
        assert [texture.size for texture in canvas.textures] == [(60, 40)] * 2
    drawn.clear()
    settings.move_line(opened, 0.2)  # the window draws the line
    rest(canvas, state, 2.0)
    assert drawn == []
    both = canvas.capture(state.request())
    settings.show_one(opened)
    np.testing.assert_array_equal(canvas.capture(state.request())[:, :12], both[:, :12])
    settings.toggle_levels(opened)
    rest(canvas, state, 3.0)
    assert [texture.size for texture in canvas.textures] == [(20, 40)] * 3
    assert canvas.capture(state.request()).shape == (40, 60, 3)
    renderer.release()


def test_the_surface_is_found_in_every_column(gl, opened):
    canvas, state = Canvas(gl, GlRenderer(gl, "cpu")), opened.state
    state.size = (240, 120)
    settings.toggle_levels(opened)
    rest(canvas, state, 1.0)
    places = [canvas.point_at((column + 0.5) / 3, 0.5) for column in range(3)]
    assert all(place is not None for place in places)
    np.testing.assert_allclose(places[1:], [places[0]] * 2)
    settings.show_one(opened)
    rest(canvas, state, 2.0)
    np.testing.assert_allclose(canvas.point_at(0.5, 0.5), places[0], atol=0.1)


# Another thread rasterizes the full image of a slow scene.


class Gated:
    """The CPU's rasterizer. Other threads than the window's wait before they project, as long as the gate is
    closed, and fail where they are told to."""

    name = "cpu"

    def __init__(self) -> None:
        self.threads: list[Thread] = []  # that projected, in turn
        self.gate = Event()
        self.error: Exception | None = None

    def view(self, *arguments):
        self.threads.append(current_thread())
        if current_thread() is not main_thread():
            assert self.gate.wait(60)
            if self.error is not None:
                raise self.error
        return load_rasterizer("cpu").view(*arguments)


@pytest.fixture
def gated(monkeypatch: pytest.MonkeyPatch) -> Gated:
    """What "cpu" is; every picture is held to be slow before it was drawn, and found so."""
    made = Gated()
    monkeypatch.setattr(renderers, "load_rasterizer", lambda name: made)
    monkeypatch.setattr("langsplat_viewer.canvas.GUESS", 1.0)
    return made


@pytest.fixture
def asked(opened: Viewer) -> Viewer:
    ask(opened, "mug")
    settings.resize(opened, *SIZE)
    return opened


@pytest.fixture
def canvas(gl: moderngl.Context, gated: Gated, asked: Viewer) -> Iterator[Canvas]:
    """Nothing is drawn yet."""
    renderer = GlRenderer(gl, "cpu")
    asked.surface = made = Canvas(gl, renderer, slow_clock())
    yield made
    gated.gate.set()
    made.close()
    until(lambda: not made.is_running)
    renderer.release()


def slow_clock() -> Callable[[], float]:
    """By which everything takes a tenth of a second at least."""
    seconds = itertools.count()
    return lambda: 0.1 * next(seconds)


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def on_screen(canvas: Canvas) -> np.ndarray:
    """(H, W, 3)"""
    (texture,) = canvas.textures
    return np.frombuffer(texture.read(), np.uint8).reshape(*texture.size[::-1], 4)[::-1, :, :3]


def expected(gl: moderngl.Context, viewer: Viewer) -> np.ndarray:
    renderer = GlRenderer(gl, "cpu")
    picture = Canvas(gl, renderer).capture(viewer.state.request())
    renderer.release()
    return picture


def test_the_window_s_thread_projects_no_fine_picture(gl, asked, canvas, gated):
    assert canvas.update(asked.state, 0.0)  # though nobody can project yet
    assert canvas.waits
    assert canvas.textures == ()
    until(lambda: len(gated.threads) == 1)
    gated.gate.set()
    rest(canvas, asked.state, 1.0)
    assert gated.threads[0] is not main_thread()
    assert len(gated.threads) == 1
    assert not canvas.update(asked.state, 2.0)
    np.testing.assert_array_equal(on_screen(canvas), expected(gl, asked))
    gated.threads.clear()
    assert canvas.point_at(0.5, 0.5) is not None  # with the projection that was made elsewhere
    assert gated.threads == []


CHANGES = {
    "camera": lambda v: viewpoint.look_from(v, "left"),
    "undone camera": lambda v: (viewpoint.look_from(v, "left"), viewpoint.reset_view(v)),
    "marks": selecting.select_all,
    "deleted": lambda v: (selecting.select_all(v), selecting.delete_selected(v)),
    "undone": lambda v: (selecting.select_all(v), selecting.delete_selected(v), editing.undo(v)),
    "splats": lambda v: settings.set_splats(v, Splats(0.5)),
    "cut": lambda v: settings.set_clip(v, Clip(1.0)),
    "display": lambda v: settings.set_display(v, "depth"),
    "query": lambda v: queries.hide(v, v.state.queries[0]),
    "size": lambda v: settings.resize(v, 100, 80),
    "scene": lambda v: setattr(v.state, "scene", replace(v.state.scene)),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_became_stale_is_dropped(gl, asked, canvas, gated, monkeypatch, name):
    taken = []
    take = GlRenderer.take
    monkeypatch.setattr(GlRenderer, "take", lambda self, made: (taken.append(made.of), take(self, made)))
    canvas.update(asked.state, 0.0)
    until(lambda: len(gated.threads) == 1)  # it is under way
    CHANGES[name](asked)
    viewpoint.tick(asked, 10.0)
    viewpoint.tick(asked, 20.0)
    canvas.update(asked.state, 20.0)
    canvas.update(asked.state, 21.0)
    gated.gate.set()
    rest(canvas, asked.state, 22.0)
    assert len(taken) == 1
    assert taken[0].key.camera.width == asked.state.size[0]
    np.testing.assert_array_equal(on_screen(canvas), expected(gl, asked))


def test_what_changes_no_projection_does_not_begin_anew(gl, asked, canvas, gated):
    canvas.update(asked.state, 0.0)
    until(lambda: len(gated.threads) == 1)
    settings.set_picture(asked, replace(asked.state.picture, dim=0.1))
    canvas.update(asked.state, 1.0)
    gated.gate.set()
    rest(canvas, asked.state, 2.0)
    assert len(gated.threads) == 1
    np.testing.assert_array_equal(on_screen(canvas), expected(gl, asked))


def test_a_camera_that_moves_on_is_followed_coarsely(asked, canvas, gated):
    canvas.update(asked.state, 0.0)
    until(lambda: len(gated.threads) == 1)
    viewpoint.look_from(asked, "left")
    viewpoint.tick(asked, 10.0)
    canvas.update(asked.state, 10.0)
    assert gated.threads[1:] == [main_thread()]
    assert not canvas.waits
    assert asked.state.stats.scale < 1
    gated.gate.set()
    until(lambda: not canvas.is_running)
    canvas.update(asked.state, 10.01)
    assert asked.state.stats.scale < 1  # of the old view nothing is shown


def test_told_to_stay_fine_it_draws_while_the_camera_moves(asked, canvas, gated):
    asked.state.coarse_while_moving = False
    gated.gate.set()
    rest(canvas, asked.state, 0.0)
    viewpoint.look_from(asked, "left")
    viewpoint.tick(asked, 10.0)
    canvas.update(asked.state, 10.0)
    assert gated.threads[1:] == [main_thread()]
    assert asked.state.stats.scale == 1


def test_an_error_is_said_once_and_another_picture_is_tried(gl, asked, canvas, gated):
    gated.error = FloatingPointError("out of range")
    gated.gate.set()
    canvas.update(asked.state, 0.0)
    until(lambda: not canvas.is_running)
    with pytest.raises(BackendError, match=r"^internal error: FloatingPointError: out of range$"):
        canvas.update(asked.state, 1.0)
    assert not canvas.update(asked.state, 2.0)
    assert len(gated.threads) == 1
    gated.error = None
    settings.set_clip(asked, Clip(1.0))
    rest(canvas, asked.state, 3.0)
    np.testing.assert_array_equal(on_screen(canvas), expected(gl, asked))


def test_until_it_is_there_merged_gaussians_show_what_was_changed(gl, asked, gated, monkeypatch):
    renderer, quick = GlRenderer(gl, "cpu"), FakeRenderer()
    canvas = Canvas(gl, renderer, slow_clock(), quick)
    gated.gate.set()
    rest(canvas, asked.state, 0.0)
    until(lambda: not canvas.is_running)
    gated.gate.clear()
    monkeypatch.setattr("langsplat_viewer.canvas.MERGED_SHARE", 1e-3)
    settings.set_splats(asked, Splats(0.5))
    for now in (1.0, 2.0, 3.0):
        assert canvas.update(asked.state, now)
    assert sizes(quick) == [(60, 45)]
    assert asked.state.stats.merged
    gated.gate.set()
    rest(canvas, asked.state, 4.0)
    assert asked.state.stats.scale == 1
    np.testing.assert_array_equal(on_screen(canvas), expected(gl, asked))
    canvas.close()
    renderer.release()


def test_closing_does_not_wait_for_it(asked, canvas, gated):
    canvas.update(asked.state, 0.0)
    until(lambda: len(gated.threads) == 1)
    canvas.close()
    assert canvas.is_running
    gated.gate.set()
    until(lambda: not canvas.is_running)
    until(lambda: not gated.threads[0].is_alive())


def test_it_wakes_the_window(asked, canvas, gated):
    woken = Event()
    canvas.wake_with(woken.set)
    canvas.update(asked.state, 0.0)
    until(lambda: len(gated.threads) == 1)
    assert not woken.is_set()
    gated.gate.set()
    while canvas.update(asked.state, 1.0):  # as often as it is woken, and no oftener
        assert woken.wait(60)
        woken.clear()
    assert asked.state.stats.scale == 1


def test_a_scene_that_was_left_is_let_go_by_the_thread(asked, canvas, gated):
    asked.state.scene = replace(asked.state.scene)
    left = weakref.ref(asked.state.scene)
    canvas.update(asked.state, 0.0)
    until(lambda: len(gated.threads) == 1)
    asked.state.scene = replace(asked.state.scene)
    gated.gate.set()
    rest(canvas, asked.state, 1.0)
    gc.collect()
    assert left() is None


# Level of detail.


HALF, QUARTER = Level(0.5), Level(0.25)
MERGED, COARSEST = Level(0.5, merged=True), Level(0.25, merged=True)


def after(*pictures: tuple[Level, float]) -> Pace:
    pace = Pace()
    for level, milliseconds in pictures:
        pace.drew(level, milliseconds)
    return pace


@pytest.mark.parametrize(
    ("fine_ms", "plain", "with_merged"),
    [
        (0, FINE, FINE),
        (MOVING_BUDGET, FINE, FINE),
        (3 * MOVING_BUDGET, HALF, HALF),
        (12 * MOVING_BUDGET, QUARTER, MERGED),
        (1e5, QUARTER, COARSEST),
    ],
)
def test_first_guess(fine_ms, plain, with_merged):
    pace = after((FINE, fine_ms))
    assert (pace.level(False), pace.level(True)) == (plain, with_merged)
    assert pace.is_slow == (fine_ms > MOVING_BUDGET)


@pytest.mark.parametrize(
    ("pictures", "level"),
    [
        ([(FINE, 75)], HALF),
        ([(FINE, 75), (HALF, 60)], MERGED),  # hardly faster: projecting takes as long for few pixels
        ([(FINE, 75), (HALF, 10), (HALF, 10), (HALF, 30)], HALF),  # one slow picture is forgiven
        ([(FINE, 75), (HALF, 60), (FINE, 19)], FINE),  # on a machine that became free
        ([(FINE, 75), (HALF, 35)], MERGED),
        ([(FINE, 75), (HALF, 35), *3 * [(FINE, 75)]], HALF),  # better is tried again after some rests
    ],
)
def test_what_was_measured_chooses_the_level(pictures, level):
    assert after(*pictures).level(True) == level


def test_other_scenes_take_as_long_as_they_are_large():
    pace = Pace()
    pace.expect(1000)
    assert not pace.is_slow
    pace.expect(1_000_000)  # guessed
    assert pace.is_slow
    pace.drew(FINE, 500)
    pace.expect(100_000)
    assert pace.level(False) == HALF
    pace.expect(50_000)
    assert pace.level(False) == FINE


def test_only_merged_gaussians_stand_in():
    assert after((FINE, 150)).stand_in() == MERGED
    assert after((FINE, 1000)).stand_in() == COARSEST
    assert after((FINE, 1e5)).stand_in() is None


# Times of the steps, and the comparison with the reference.


def test_the_median_of_the_last_measurements_is_told():
    timing = Timing()
    for value in (1000.0, *range(KEPT)):
        timing.add("sort", value)
    timing.add("blend", 2.0)
    assert timing.medians() == [("Sort", (KEPT - 1) / 2), ("Blend", 2.0)]


def test_errors_are_those_of_the_pictures():
    shown = np.zeros((2, 5, 3), np.uint8)
    reference = shown.copy()
    assert compared(shown, reference, "cpu").psnr == math.inf
    assert "every pixel is the same" in in_numbers(compared(shown, reference, "cpu"))
    reference[0, 0] = (255, 0, 0)
    found = compared(shown, reference, "cpu")
    assert (found.size, found.largest, found.mean) == ((5, 2), 255, 255 / 30)
    assert found.psnr == pytest.approx(10 * math.log10(30))
    assert "5 x 2: error at most 255 of 255, mean 8.5, PSNR 14.8 dB" in in_numbers(found)


@pytest.fixture(params=["cpu", "opengl"])
def drawn(gl, opened, request):
    """A viewer with a real picture."""
    renderer = GlRenderer(gl, request.param, "single")
    opened.surface = canvas = Canvas(gl, renderer)
    opened.state.backend = renderer.backend
    settings.resize(opened, 400, 300)
    rest(canvas, opened.state, 0.0)
    yield opened
    renderer.release()


def test_the_steps_of_a_picture_are_measured_while_the_panel_is_seen(gl, drawn):
    assert drawn.state.timing.medians() == []
    drawn.state.timing.wanted = True
    drawn.state.coarse_while_moving = False
    viewpoint.look_from(drawn, "left")
    viewpoint.tick(drawn, 10.0)
    rest(drawn.surface, drawn.state, 10.0)
    laps, steps = drawn.state.timing.laps, {"projection", "sort", "blend", "compose"}
    if drawn.state.backend == "cpu":
        steps |= {"tiles", "colours"} if is_software(gl) else {"tiles", "colours", "upload"}
    assert laps.keys() == steps | {"picture"}
    assert sum(laps[name][0] for name in steps) <= laps["picture"][0]


def test_the_panel_has_a_picture_measured_when_it_opens(drawn):
    """All of its steps, though nothing has changed; once."""
    for now in (10.0, 11.0):
        drawn.state.timing.wanted = True
        rest(drawn.surface, drawn.state, now)
        counts = {name: len(measured) for name, measured in drawn.state.timing.laps.items()}
        assert counts.keys() >= {"projection", "sort", "blend", "compose", "picture"}
        assert set(counts.values()) == {1}
    drawn.state.timing.wanted = False  # closed, and opened again
    rest(drawn.surface, drawn.state, 12.0)
    drawn.state.timing.wanted = True
    rest(drawn.surface, drawn.state, 13.0)
    assert {len(measured) for measured in drawn.state.timing.laps.values()} == {2}


@pytest.mark.parametrize("look", ["plain", "heat", "wipe", "levels", "changed"])
def test_what_is_shown_is_that_of_the_reference(drawn, look):
    """Whatever is chosen in the window: queries, split, marks, cuts, splats."""
    if look != "plain":
        ask(drawn, "mug")
    if look == "wipe":
        settings.toggle_wipe(drawn)
    if look == "levels":
        settings.toggle_levels(drawn)
    if look == "changed":
        selecting.select_all(drawn)
        settings.set_splats(drawn, Splats(0.5, 0))
        settings.set_clip(drawn, Clip(1.0, 5.2))
        settings.set_colour_map(drawn, "viridis")
    viewpoint.compare_with_reference(drawn)
    recorded(drawn)
    found = drawn.state.timing.comparison
    assert errors(drawn) == []
    assert LONGEST_SIDE - 3 < max(found.size) <= LONGEST_SIDE
    assert found.backend == drawn.state.backend
    assert found.mean < 0.05
    assert found.psnr > 45


def test_what_is_wrong_is_told(drawn, monkeypatch):
    right = (
        ArrayRenderer(load_rasterizer("reference"))
        .read(drawn.state.request(compared_size(drawn.state.size)))
        .astype(int)
    )
    capture = drawn.surface.capture
    monkeypatch.setattr(drawn.surface, "capture", lambda state: 255 - capture(state))
    viewpoint.compare_with_reference(drawn)
    recorded(drawn)
    found = drawn.state.timing.comparison
    assert found.largest == 255
    assert found.mean == pytest.approx(np.abs(255 - 2 * right).mean(), abs=1)


def test_the_picture_on_screen_is_drawn_again_after_it(drawn):
    viewpoint.compare_with_reference(drawn)
    recorded(drawn)
    rest(drawn.surface, drawn.state, 2.0)
    assert drawn.surface.textures[0].size == (400, 300)
    depths = drawn.surface.depths()
    assert depths.shape == (300, 400)


def test_a_comparison_is_one_at_a_time_and_can_be_left(drawn):
    viewpoint.compare_with_reference(drawn)
    viewpoint.compare_with_reference(drawn)
    assert "wait for it or cancel it" in errors(drawn)[-1]
    drawn.recorder.cancel()
    recorded(drawn)
    assert drawn.state.timing.comparison is None
