"""The fine picture of a slow scene is rasterized beside the window's thread; what nobody wants any more is
dropped."""

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

from langsplat_core.errors import BackendError
from langsplat_core.raster import load_rasterizer
from langsplat_viewer.actions import queries, selecting, settings, undoing, viewpoint
from langsplat_viewer.canvas import Canvas
from langsplat_viewer.drawing import frame, renderer
from langsplat_viewer.drawing.channels import Clip, Splats
from langsplat_viewer.drawing.frame import FrameRenderer
from langsplat_viewer.viewer import Viewer
from tests.support.windowless import FakeRenderer, rest, settle

SIZE = (120, 90)


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
    monkeypatch.setattr(frame, "load_rasterizer", lambda name: made)
    monkeypatch.setattr(renderer, "GUESS", 1.0)
    return made


@pytest.fixture
def asked(opened: Viewer) -> Viewer:
    queries.ask(opened, "mug")
    settle(opened)
    settings.resize(opened, *SIZE)
    return opened


@pytest.fixture
def canvas(gl: moderngl.Context, gated: Gated, asked: Viewer) -> Iterator[Canvas]:
    """Nothing is drawn yet."""
    renderer = FrameRenderer(gl, "cpu")
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
    renderer = FrameRenderer(gl, "cpu")
    picture = Canvas(gl, renderer).capture(viewer.state)
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
    "undone": lambda v: (selecting.select_all(v), selecting.delete_selected(v), undoing.undo(v)),
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
    take = FrameRenderer.take
    monkeypatch.setattr(FrameRenderer, "take", lambda self, made: (taken.append(made.of), take(self, made)))
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
    assert taken[0].sight.camera.width == asked.state.size[0]
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
    renderer, quick = FrameRenderer(gl, "cpu"), FakeRenderer()
    canvas = Canvas(gl, renderer, slow_clock(), quick)
    gated.gate.set()
    rest(canvas, asked.state, 0.0)
    until(lambda: not canvas.is_running)
    gated.gate.clear()
    monkeypatch.setattr("langsplat_viewer.drawing.renderer.MERGED_SHARE", 1e-3)
    settings.set_splats(asked, Splats(0.5))
    for now in (1.0, 2.0, 3.0):
        assert canvas.update(asked.state, now)
    assert [what for kind, what in quick.calls if kind == "draw"] == [(60, 45)]
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


def test_a_scene_that_was_left_is_let_go(asked, canvas, gated):
    asked.state.scene = replace(asked.state.scene)
    left = weakref.ref(asked.state.scene)
    canvas.update(asked.state, 0.0)
    until(lambda: len(gated.threads) == 1)
    asked.state.scene = replace(asked.state.scene)
    gated.gate.set()
    rest(canvas, asked.state, 1.0)
    gc.collect()
    assert left() is None
