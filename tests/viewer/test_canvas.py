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
from langsplat_viewer.actions import editing, settings, viewpoint
from langsplat_viewer.camera.controls import orbit
from langsplat_viewer.canvas import (
    FULL,
    MOVING_BUDGET,
    PLAIN,
    REST_SECONDS,
    WITH_MERGED,
    AdaptiveResolution,
    Canvas,
    Detail,
)
from langsplat_viewer.rendering.renderer import ArrayRenderer, renderer_for
from langsplat_viewer.rendering.request import Clip, Splats
from langsplat_viewer.viewer import Viewer
from tests.support.windowless import CHANGES, FakeRenderer, go, on_screen, put_marks, put_scene, repeat, rest


@pytest.fixture
def shown(opened: Viewer) -> Viewer:
    """Shows the scene of three blobs in 200 x 120 pixels."""
    settings.resize(opened, 200, 120)
    return opened


def turn(viewer: Viewer) -> None:
    """Move the camera."""
    viewpoint.move(viewer, lambda view: orbit(view, 0.1, 0))


def sizes(renderer: FakeRenderer) -> list[tuple[int, int]]:
    """Sizes of what was drawn since the last call."""
    found = [(one.camera.width, one.camera.height) for one in renderer.drawn]
    renderer.drawn.clear()
    return found


# Only changes are drawn.


def test_canvas_draws_only_changes_and_is_then_still(gl, shown):
    renderer = FakeRenderer()
    canvas = Canvas(gl, renderer)
    assert not canvas.update(shown.state, 0.0)
    assert sizes(renderer) == [(200, 120)]
    settings.set_picture(shown, replace(shown.state.session.picture, transparent=True))
    for second in range(1, 5):
        assert not canvas.update(shown.state, float(second))
    assert (canvas.phase, sizes(renderer)) == ("still", [])
    settings.set_display(shown, "depth")
    canvas.update(shown.state, 6.0)
    assert sizes(renderer) == [(200, 120)]
    assert (on_screen(canvas)[0] == (255, 0, 0)).all()


def test_canvas_draws_each_edit_once_and_keeps_few_textures(gl, shown):
    renderer = FakeRenderer()
    canvas, everything = Canvas(gl, renderer), np.ones(360, bool)
    for hidden, count in ((np.arange(360) < 100, 260), (everything, 0), (~everything, 360)):
        put_marks(shown, hidden=hidden)
        renderer.drawn.clear()
        for second in range(3):
            canvas.update(shown.state, float(second))
        (request,) = renderer.drawn
        assert len(request.gaussians) == count
    assert request.gaussians is shown.state.open.scene.gaussians  # the source itself again
    renderer.nothing = True
    put_marks(shown, deleted=everything)
    canvas.update(shown.state, 9.0)
    assert "hidden or deleted: show what is hidden (U), or undo (Ctrl+Z)" in shown.state.nothing
    canvas, seen = Canvas(gl, FakeRenderer()), []
    for width in range(20, 40):
        settings.resize(shown, width, 20)
        canvas.update(shown.state, 0.0)
        assert canvas.textures[0].size == (width, 20)
        seen.append(canvas.textures[0])
    assert sum(not isinstance(texture.mglo, moderngl.InvalidObject) for texture in seen) <= 3


def test_point_at_is_the_surface_in_the_last_image(gl, shown):
    canvas = Canvas(gl, FakeRenderer())
    assert canvas.point_at(0.8, 0.5) is None  # nothing was drawn yet
    canvas.update(shown.state, 0.0)
    pixels, depth = shown.state.open.view.camera(200, 120).project(canvas.point_at(0.8, 0.25)[None])
    np.testing.assert_allclose(pixels[0], (160, 30))
    np.testing.assert_allclose(depth, 2.0)
    assert canvas.point_at(0.2, 0.25) is None


def test_canvas_draws_several_panes_and_no_line(gl, opened):
    renderer = renderer_for(gl, "cpu")
    canvas, state = Canvas(gl, renderer), opened.state
    settings.resize(opened, 60, 40)
    drawn, original = [], renderer.draw
    renderer.draw = lambda request, targets: (drawn.append(request), original(request, targets))
    for display in DISPLAYS:
        settings.compare(opened, "wipe", display)
        rest(canvas, state, 1.0)
        assert [texture.size for texture in canvas.textures] == [(60, 40)] * 2
    drawn.clear()
    settings.move_line(opened, 0.2)  # the window draws the line
    rest(canvas, state, 2.0)
    assert drawn == []
    both = canvas.capture(state.request())
    settings.compare(opened, "off")
    np.testing.assert_array_equal(canvas.capture(state.request())[:, :12], both[:, :12])
    settings.toggle_levels(opened)
    rest(canvas, state, 3.0)
    assert [texture.size for texture in canvas.textures] == [(20, 40)] * 3
    assert canvas.capture(state.request()).shape == (40, 60, 3)
    assert renderer.ahead(state.request()) is None  # the layers on screen are kept
    assert canvas.capture(state.request((90, 60))).shape == (60, 90, 3)
    assert renderer.ahead(state.request((90, 60))) is not None  # those of another size are not
    renderer.release()


def test_point_at_finds_the_surface_in_every_column(gl, opened):
    canvas = Canvas(gl, renderer_for(gl, "cpu"))
    settings.resize(opened, 240, 120)
    settings.toggle_levels(opened)
    rest(canvas, opened.state, 1.0)
    places = [canvas.point_at((column + 0.5) / 3, 0.5) for column in range(3)]
    assert all(place is not None for place in places)
    np.testing.assert_allclose(places[1:], [places[0]] * 2)
    settings.compare(opened, "off")
    rest(canvas, opened.state, 2.0)
    np.testing.assert_allclose(canvas.point_at(0.5, 0.5), places[0], atol=0.1)


# While the camera moves.


@pytest.mark.parametrize(("full_ms", "coarse"), [(10, (200, 120)), (75, (100, 60)), (5000, (50, 30))])
def test_image_is_coarse_only_while_a_slow_camera_moves(gl, shown, full_ms, coarse):
    renderer = FakeRenderer(seconds=full_ms / 1000)
    canvas = Canvas(gl, renderer, renderer.clock)
    canvas.update(shown.state, 0.0)
    assert shown.state.stats.milliseconds == pytest.approx(full_ms)
    sizes(renderer)
    turn(shown)
    assert canvas.update(shown.state, 10.0)  # a finer image is due
    assert sizes(renderer) == [coarse]
    canvas.update(shown.state, 10.0 + 0.5 * REST_SECONDS)
    assert sizes(renderer) == []
    assert not canvas.update(shown.state, 10.0 + 2 * REST_SECONDS)
    assert sizes(renderer) == ([] if coarse == (200, 120) else [(200, 120)])


@pytest.fixture
def merging(gl) -> Iterator[tuple[Canvas, FakeRenderer]]:
    """A canvas whose full images take 0.3 s, those of merged Gaussians 0.025."""
    renderer = FakeRenderer(0.3, 0.025, "cpu")
    made = Canvas(gl, renderer, renderer.clock)
    yield made, renderer
    made.close()


def moved_until_merged(canvas: Canvas, renderer: FakeRenderer, viewer: Viewer, now: float = 0.0) -> float:
    """Move the camera until merged Gaussians are drawn: the thread that merges may take a while."""
    renderer.drawn.clear()
    while not renderer.drawn or renderer.drawn[-1].merged is None:
        assert now < 3000
        time.sleep(0.01)
        turn(viewer)
        now += 1.0
        canvas.update(viewer.state, now)
    return now


def test_merged_gaussians_are_drawn_while_a_large_scene_moves(merging, shown):
    canvas, renderer = merging
    canvas.update(shown.state, 0.0)
    now = moved_until_merged(canvas, renderer, shown)
    *others, request = renderer.drawn
    assert all(one.merged is None for one in others)
    assert len(request.gaussians) < len(shown.state.open.scene.gaussians) == 360
    assert sizes(renderer)[-1] == (100, 60)
    away = np.linalg.norm(canvas.point_at(0.8, 0.5) - shown.state.open.view.camera(200, 120).position)
    assert away > 2.9  # of the merged ones: they were drawn last
    assert not canvas.update(shown.state, now + 1.0)
    assert sizes(renderer) == [(200, 120)]  # at rest all of them again
    turn(shown)
    canvas.update(shown.state, now + 2.0)
    assert sizes(renderer) == [(100, 60)]


# Another thread rasterizes the full image of a slow scene.


class Gated:
    """The CPU's rasterizer, whose other threads wait at a closed gate, and fail where they are told to."""

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
def gated() -> Gated:
    return Gated()


def slow_clock() -> Callable[[], float]:
    """By which everything takes a tenth of a second at least."""
    seconds = itertools.count()
    return lambda: 0.1 * next(seconds)


def until(condition: Callable[[], bool]) -> None:
    repeat(lambda: None, lambda: not condition())


@pytest.fixture
def canvas(gl: moderngl.Context, gated: Gated, asked: Viewer) -> Iterator[Canvas]:
    """Nothing is drawn yet; every image is held to be slow."""
    renderer = ArrayRenderer(gated)
    asked.surface = made = Canvas(gl, renderer, slow_clock(), budget=0.0)
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
    """The full image comes, and is that of another renderer."""
    rest(canvas, viewer.state, now)
    renderer, (shown,) = renderer_for(gl, "cpu"), on_screen(canvas)
    np.testing.assert_array_equal(shown, renderer.read(viewer.state.request()))
    renderer.release()


def test_another_thread_projects_the_full_image(gl, asked, begun, gated):
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
    "deleted": lambda v: (editing.select_all(v), editing.delete_selected(v)),
    "undone": lambda v: (editing.select_all(v), editing.delete_selected(v), editing.undo(v)),
    "scene": lambda v: put_scene(v, replace(v.state.open.scene)),
}


@pytest.mark.parametrize("name", STALE)
def test_stale_layers_are_never_shown(gl, asked, begun, gated, name):
    go(STALE[name], asked)
    for now in (20.0, 21.0):
        begun.update(asked.state, now)
    gated.gate.set()
    assert_rests_as_drawn_anew(gl, begun, asked, 22.0)
    assert begun.textures[0].size == asked.state.size


def test_a_slider_does_not_begin_the_projection_anew(gl, asked, begun, gated):
    settings.set_picture(asked, replace(asked.state.request().picture, dim=0.1))
    begun.update(asked.state, 1.0)
    gated.gate.set()
    rest(begun, asked.state, 2.0)
    assert len(gated.threads) == 1
    assert_rests_as_drawn_anew(gl, begun, asked, 2.0)


@pytest.mark.parametrize("coarse", [True, False])
def test_the_window_s_thread_follows_a_moving_camera(asked, begun, gated, coarse):
    settings.prefer(asked, coarse_while_moving=coarse)
    go(viewpoint.look_from, asked, "left")
    begun.update(asked.state, 10.0)
    assert gated.threads[1:] == [main_thread()]
    assert not begun.waits
    assert (asked.state.stats.scale < 1) == coarse
    gated.gate.set()
    until(lambda: not begun.is_running)
    begun.update(asked.state, 10.01)
    assert (asked.state.stats.scale < 1) == coarse  # of the old view nothing is shown


def test_an_error_is_raised_once_and_the_next_request_drawn(gl, asked, canvas, gated):
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


def test_merged_gaussians_stand_in_for_the_full_image(gl, asked, gated):
    renderer = ArrayRenderer(gated)
    canvas = Canvas(gl, renderer, slow_clock(), budget=50.0)
    gated.gate.set()
    rest(canvas, asked.state, 0.0)
    until(lambda: not canvas.is_running)
    gated.gate.clear()
    asked.change(splats=Splats(0.5))
    for now in (1.0, 2.0, 3.0):
        assert canvas.update(asked.state, now)
    assert asked.state.stats.merged
    assert canvas.textures[0].size == (60, 45)
    gated.gate.set()
    assert_rests_as_drawn_anew(gl, canvas, asked, 4.0)
    assert not asked.state.stats.merged
    canvas.close()
    renderer.release()


def test_the_other_thread_wakes_the_window(asked, begun, gated):
    woken = Event()
    begun.wake_with(woken.set)
    assert not woken.is_set()
    gated.gate.set()
    while begun.update(asked.state, 1.0):  # as often as it is woken, and no oftener
        assert woken.wait(60)
        woken.clear()
    assert asked.state.stats.scale == 1


def test_the_other_thread_lets_go_of_a_scene_that_was_left(asked, canvas, gated):
    put_scene(asked, replace(asked.state.open.scene))
    left = weakref.ref(asked.state.open.scene)
    canvas.update(asked.state, 0.0)
    until(lambda: len(gated.threads) == 1)
    put_scene(asked, replace(asked.state.open.scene))
    gated.gate.set()
    rest(canvas, asked.state, 1.0)
    gc.collect()
    assert left() is None


# Adaptive resolution.

HALF, QUARTER = Detail(0.5), Detail(0.25)
MERGED, COARSEST = Detail(0.5, merged=True), Detail(0.25, merged=True)


def after(*images: tuple[Detail, float]) -> AdaptiveResolution:
    resolution = AdaptiveResolution()
    for detail, milliseconds in images:
        resolution.drew(detail, milliseconds)
    return resolution


@pytest.mark.parametrize(
    ("full_ms", "plain", "with_merged"),
    [
        (0, FULL, FULL),
        (MOVING_BUDGET, FULL, FULL),
        (3 * MOVING_BUDGET, HALF, HALF),
        (12 * MOVING_BUDGET, QUARTER, MERGED),
        (1000, QUARTER, COARSEST),
    ],
)
def test_the_first_level_of_detail_is_guessed(full_ms, plain, with_merged):
    resolution = after((FULL, full_ms))
    assert (resolution.finest(PLAIN), resolution.finest(WITH_MERGED)) == (plain, with_merged)
    assert resolution.is_slow == (full_ms > MOVING_BUDGET)


@pytest.mark.parametrize(
    ("images", "detail"),
    [
        ([(FULL, 75)], HALF),
        ([(FULL, 75), (HALF, 60)], MERGED),  # hardly faster: projecting takes as long for few pixels
        ([(FULL, 75), (HALF, 10), (HALF, 10), (HALF, 30)], HALF),  # one slow image is forgiven
        ([(FULL, 75), (HALF, 60), (FULL, 19)], FULL),  # on a machine that became free
        ([(FULL, 75), (HALF, 35)], MERGED),
        ([(FULL, 75), (HALF, 35), *3 * [(FULL, 75)]], HALF),  # better is tried again after some rests
    ],
)
def test_measured_times_choose_the_level_of_detail(images, detail):
    assert after(*images).finest(WITH_MERGED) == detail


def test_times_of_other_scenes_follow_from_their_size():
    resolution = AdaptiveResolution()
    resolution.count = 1000
    assert not resolution.is_slow
    resolution.count = 1_000_000  # guessed
    assert resolution.is_slow
    resolution.drew(FULL, 500)
    resolution.count = 100_000
    assert resolution.finest(PLAIN) == HALF
    resolution.count = 50_000
    assert resolution.finest(PLAIN) == FULL
