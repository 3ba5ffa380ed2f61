"""The canvas: what is drawn when, at which level of detail, on which thread."""

import gc
import itertools
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
from langsplat_viewer.actions import editing, selecting, settings, viewpoint
from langsplat_viewer.camera.controls import default_view, extent_of, orbit
from langsplat_viewer.canvas import FINE, MOVING_BUDGET, NOTHING_LEFT, REST_SECONDS, Canvas, Level, Pace
from langsplat_viewer.marks import unmarked
from langsplat_viewer.rendering import renderer as renderers
from langsplat_viewer.rendering.renderer import GlRenderer
from langsplat_viewer.rendering.request import Clip, Splats
from langsplat_viewer.state import ViewerState
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene
from tests.support.windowless import CHANGES, FakeRenderer, go, on_screen, rest


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
    assert (on_screen(canvas)[0] == (255, 0, 0)).all()


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


@pytest.fixture
def merging(gl) -> Iterator[tuple[Canvas, FakeRenderer, FakeRenderer]]:
    """A canvas, its renderer of whole pictures, which takes 0.3 s, and that of merged Gaussians."""
    renderer, quick = FakeRenderer(seconds=0.3), FakeRenderer(seconds=0.025)
    quick.depth = 3.0
    made = Canvas(gl, renderer, lambda: renderer.now + quick.now, quick)
    yield made, renderer, quick
    made.close()


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


def test_merged_gaussians_are_drawn_while_a_large_scene_moves(merging, state):
    """As soon as they are there; at rest all of them again. Under the cursor is what was drawn last."""
    canvas, renderer, quick = merging
    canvas.update(state, 0.0)
    now = moved_until_merged(canvas, state, quick)
    assert set(sizes(renderer)) <= {(200, 120), (50, 30)}
    (request,) = quick.drawn
    assert len(request.detail.merged.gaussians) < len(state.scene.gaussians) == 360
    assert sizes(quick) == [(100, 60)]
    away = np.linalg.norm(canvas.point_at(0.5, 0.5) - state.view.camera(200, 120).position)
    assert away == pytest.approx(3, rel=1e-3)
    assert not canvas.update(state, now + 1.0)
    assert (sizes(renderer), quick.drawn) == ([(200, 120)], [])
    assert canvas.point_at(0.2, 0.25) is None  # the fine renderer's answer
    state.view = orbit(state.view, 0.1, 0)
    canvas.update(state, now + 2.0)
    assert sizes(quick) == [(100, 60)]


def test_the_edited_scene_is_merged_and_anew_after_an_edit(merging, state):
    canvas, _, quick = merging
    counts, now = [], 0.0
    for marks in (unmarked(360), replace(unmarked(360), hidden=np.arange(360) < 120)):
        state.selection = replace(state.selection, marks=marks)
        canvas.update(state, now := now + 1.0)
        now = moved_until_merged(canvas, state, quick, now)
        counts.append(len(quick.drawn[0].detail.merged.gaussians))
    assert 0 < counts[1] < counts[0] < 360


def test_a_scene_that_was_left_is_let_go_by_both_renderers(merging, state):
    canvas, *renderers = merging
    left = weakref.ref(state.scene)
    now = moved_until_merged(canvas, state, renderers[1])
    state.scene = blob_scene()
    for _ in range(2):
        canvas.update(state, now := now + 1.0)
    for renderer in renderers:
        renderer.drawn.clear()
    gc.collect()
    assert left() is None


def test_it_keeps_few_textures(gl, state):
    canvas, seen = Canvas(gl, FakeRenderer()), []
    for width in range(20, 40):
        state.size = (width, 20)
        canvas.update(state, 0.0)
        assert canvas.textures[0].size == (width, 20)
        seen.append(canvas.textures[0])
    assert sum(not isinstance(texture.mglo, moderngl.InvalidObject) for texture in seen) <= 3


def test_it_finds_the_point_under_the_cursor(gl, state):
    canvas = Canvas(gl, FakeRenderer())
    assert canvas.point_at(0.8, 0.5) is None  # nothing was drawn yet
    canvas.update(state, 0.0)
    pixels, depth = state.view.camera(200, 120).project(canvas.point_at(0.8, 0.25)[None])
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


def slow_clock() -> Callable[[], float]:
    """By which everything takes a tenth of a second at least."""
    seconds = itertools.count()
    return lambda: 0.1 * next(seconds)


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


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


@pytest.fixture
def begun(canvas: Canvas, asked: Viewer, gated: Gated) -> Canvas:
    """The canvas, a thread of which waits before it projects."""
    assert canvas.update(asked.state, 0.0)
    until(lambda: len(gated.threads) == 1)
    return canvas


def assert_rests_as_drawn_anew(gl: moderngl.Context, canvas: Canvas, viewer: Viewer, now: float) -> None:
    """The fine picture comes, and is that of another renderer."""
    rest(canvas, viewer.state, now)
    renderer, (shown,) = GlRenderer(gl, "cpu"), on_screen(canvas)
    np.testing.assert_array_equal(shown, Canvas(gl, renderer).capture(viewer.state.request()))
    renderer.release()


def test_the_window_s_thread_projects_no_fine_picture(gl, asked, begun, gated):
    assert begun.waits
    assert begun.textures == ()
    gated.gate.set()
    rest(begun, asked.state, 1.0)
    (thread,) = gated.threads
    assert thread is not main_thread()
    assert not begun.update(asked.state, 2.0)
    assert_rests_as_drawn_anew(gl, begun, asked, 2.0)
    gated.threads.clear()
    assert begun.point_at(0.5, 0.5) is not None  # with the projection that was made elsewhere
    assert gated.threads == []


STALE = {
    **CHANGES,
    "undone camera": lambda v: (viewpoint.look_from(v, "left"), viewpoint.reset_view(v)),
    "deleted": lambda v: (selecting.select_all(v), selecting.delete_selected(v)),
    "undone": lambda v: (selecting.select_all(v), selecting.delete_selected(v), editing.undo(v)),
    "scene": lambda v: setattr(v.state, "scene", replace(v.state.scene)),
}


@pytest.mark.parametrize("name", STALE)
def test_what_became_stale_is_dropped(gl, asked, begun, gated, monkeypatch, name):
    taken, take = [], GlRenderer.take
    monkeypatch.setattr(GlRenderer, "take", lambda self, made: (taken.append(made.of), take(self, made)))
    go(STALE[name], asked)
    for now in (20.0, 21.0):
        begun.update(asked.state, now)
    gated.gate.set()
    assert_rests_as_drawn_anew(gl, begun, asked, 22.0)
    (of,) = taken
    assert of.key.camera.width == asked.state.size[0]


def test_what_changes_no_projection_does_not_begin_anew(gl, asked, begun, gated):
    settings.set_picture(asked, replace(asked.state.picture, dim=0.1))
    begun.update(asked.state, 1.0)
    gated.gate.set()
    rest(begun, asked.state, 2.0)
    assert len(gated.threads) == 1
    assert_rests_as_drawn_anew(gl, begun, asked, 2.0)


@pytest.mark.parametrize("coarse", [True, False])
def test_a_camera_that_moves_on_is_followed_in_the_windows_thread(asked, begun, gated, coarse):
    asked.state.coarse_while_moving = coarse
    go(viewpoint.look_from, asked, "left")
    begun.update(asked.state, 10.0)
    assert gated.threads[1:] == [main_thread()]
    assert not begun.waits
    assert (asked.state.stats.scale < 1) == coarse
    gated.gate.set()
    until(lambda: not begun.is_running)
    begun.update(asked.state, 10.01)
    assert (asked.state.stats.scale < 1) == coarse  # of the old view nothing is shown


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
    assert_rests_as_drawn_anew(gl, canvas, asked, 3.0)


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
    assert_rests_as_drawn_anew(gl, canvas, asked, 4.0)
    assert asked.state.stats.scale == 1
    canvas.close()
    renderer.release()


def test_closing_does_not_wait_for_it(begun, gated):
    begun.close()
    assert begun.is_running
    gated.gate.set()
    until(lambda: not begun.is_running and not gated.threads[0].is_alive())


def test_it_wakes_the_window(asked, begun, gated):
    woken = Event()
    begun.wake_with(woken.set)
    assert not woken.is_set()
    gated.gate.set()
    while begun.update(asked.state, 1.0):  # as often as it is woken, and no oftener
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
    ("fine_ms", "plain", "with_merged", "stand_in"),
    [
        (0, FINE, FINE, MERGED),
        (MOVING_BUDGET, FINE, FINE, MERGED),
        (3 * MOVING_BUDGET, HALF, HALF, MERGED),
        (12 * MOVING_BUDGET, QUARTER, MERGED, MERGED),
        (1000, QUARTER, COARSEST, COARSEST),
        (1e5, QUARTER, COARSEST, None),
    ],
)
def test_first_guess(fine_ms, plain, with_merged, stand_in):
    pace = after((FINE, fine_ms))
    assert (pace.level(False), pace.level(True), pace.stand_in()) == (plain, with_merged, stand_in)
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
