"""Opens the real window as the program does, without the test engine, and measures it.

    python -m tests.viewer.process_driver [idle|leave|type] [--scene SCENE.ply] [--count 500000]
                                          [--seconds 10] [--size 1280 800] [--slow]

By default the camera orbits. Prints JSON: pictures per second while it moves, seconds from the last move to
the full picture, the longest that a frame kept the window's thread in either, and the processor time of both,
which other work on the machine changes little. idle: prints frames and the share of a core while nothing
happens. leave: closes the window while a scene is being read for ten minutes. type: types faster than frames
are drawn. Needs a display (xvfb-run).
"""

import argparse
import json
import statistics
import threading
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from imgui_bundle import imgui, immapp
from imgui_bundle.glfw_utils import glfw_window_hello_imgui

import glfw  # isort: skip
from langsplat_core.io.scenes import load_scene
from langsplat_core.scene import Scene
from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.camera.controls import orbit
from langsplat_viewer.canvas import MOVING_BUDGET
from langsplat_viewer.options import ViewerOptions
from langsplat_viewer.viewer import Services
from langsplat_viewer.window import AWAKE_SECONDS, Window, open_window
from tests.support.fakes import FakeEncoder
from tests.support.scenes import repeated

DEMO = Path(__file__).parents[2] / "assets" / "demo" / "scene.ply"
STEP = 0.02  # radians a picture
ROUNDS = 3  # of moving and resting


@dataclass
class Orbiting:
    """Observations of a process; times in seconds."""

    gaussians: int = 0
    backend: str = ""
    pictures_per_second: list[float] = field(default_factory=list)
    cpu_per_picture: list[float] = field(default_factory=list)  # of the whole process
    picture: list[float] = field(default_factory=list)  # median of the canvas's own times
    sizes: list[tuple[int, int]] = field(default_factory=list)  # of the last picture while moving
    merged: list[bool] = field(default_factory=list)  # whether its Gaussians were
    longest_moving: list[float] = field(default_factory=list)  # that a frame kept the window's thread
    longest_resting: list[float] = field(default_factory=list)  # the same, until the full picture is there
    sharp_after: list[float] = field(default_factory=list)
    cpu_to_sharp: list[float] = field(default_factory=list)


class Rider:
    """Moves the camera once a frame and keeps time."""

    def __init__(self, window: Window, seconds: float) -> None:
        self.window, self.seconds = window, seconds
        self.seen = Orbiting()
        self._moving_since: float | None = None
        self._resting_since: float | None = None
        self._started = self._waited = 0.0
        self._pictures: list[float] = []
        self._framed = self._longest = 0.0

    def frame(self) -> None:
        viewer, now = self.window.viewer, time.monotonic()
        self._framed = now
        state = viewer.state
        if state.open is None or viewer.worker.current is not None or state.stats.width == 0:
            self._waited = now
        elif now - self._waited < self.seconds and not self._pictures:
            return  # while the scene is merged
        elif self._resting_since is not None:
            self._rest(now)
        elif self._moving_since is None:
            self._moving_since, self._started, self._pictures = now, time.process_time(), [0.0]
            self._longest, self.window.idles = 0.0, False
            self._turn()
        elif now - self._moving_since < self.seconds:
            self._pictures.append(state.stats.milliseconds / 1e3)
            self._turn()
        else:
            self._stop(now)

    def framed(self) -> None:
        """Panels and picture of a frame are drawn."""
        self._longest = max(self._longest, time.monotonic() - self._framed)

    def _turn(self) -> None:
        viewpoint.move(self.window.viewer, lambda view: orbit(view, STEP, 0.0))

    def _stop(self, now: float) -> None:
        stats, count = self.window.viewer.state.stats, len(self._pictures)
        self.seen.pictures_per_second.append(count / (now - self._moving_since))
        self.seen.cpu_per_picture.append((time.process_time() - self._started) / count)
        self.seen.picture.append(statistics.median(self._pictures))
        self.seen.sizes.append((stats.width, stats.height))
        self.seen.merged.append(stats.merged)
        self.seen.longest_moving.append(self._longest)
        self._resting_since, self._started, self._longest = now, time.process_time(), 0.0
        self.window.idles = True

    def _rest(self, now: float) -> None:
        if self.window.viewer.state.stats.scale < 1 or self.window.unfinished:
            return
        self.seen.longest_resting.append(self._longest)
        self.seen.sharp_after.append(now - self._resting_since)
        self.seen.cpu_to_sharp.append(time.process_time() - self._started)
        self._moving_since = self._resting_since = None
        if len(self.seen.sharp_after) == ROUNDS:
            glfw.set_window_should_close(glfw_window_hello_imgui(), True)


def ride(
    scene: Path, count: int, seconds: float, size: tuple[int, int], budget: float = MOVING_BUDGET
) -> Orbiting:
    def load(path: Path) -> Scene:
        found = load_scene(path)
        return repeated(found, count) if count else found

    options = ViewerOptions(size="{}x{}".format(*size))
    window = Window(scene, options, Services(load, lambda encoder_id: FakeEncoder()), budget=budget)
    window.idles = False
    rider = Rider(window, seconds)
    params = window.params()
    gui, picture = params.callbacks.show_gui, params.callbacks.before_imgui_render

    def ridden() -> None:
        rider.frame()
        gui()

    def pictured() -> None:
        picture()
        rider.framed()

    params.callbacks.show_gui, params.callbacks.before_imgui_render = ridden, pictured
    params.fps_idling.vsync_to_monitor = False
    immapp.run(params)
    state = window.viewer.state
    rider.seen.gaussians, rider.seen.backend = len(state.open.scene.gaussians), state.backend
    return rider.seen


SETTLE, MEASURE = 3.0, 8.0  # seconds


def slow_load(path: Path):
    time.sleep(600)
    return load_scene(path)


def close() -> None:
    """As the cross in the window's corner does; from any thread."""
    glfw.set_window_should_close(glfw_window_hello_imgui(), True)
    glfw.post_empty_event()


def close_soon() -> None:
    """However long the window takes to be there."""
    time.sleep(3)
    try:
        close()
    except RuntimeError:  # nothing runs yet
        close_soon()


def window_of(path: Path) -> Window:
    services = Services(load_scene, lambda encoder_id: FakeEncoder())
    return Window(path, ViewerOptions(size="860x620", backend="opengl"), services)


def idle(path: Path) -> None:
    window = window_of(path)
    params = window.params()
    frames, gui, is_slow = 0, params.callbacks.show_gui, False

    def counted() -> None:
        nonlocal frames
        frames += 1
        gui()
        time.sleep(1.5 * AWAKE_SECONDS * is_slow)

    def measure() -> None:
        while window.viewer.state.open is None or window.viewer.worker.current is not None:
            time.sleep(0.05)
        nonlocal is_slow
        count = -1
        while count != frames:  # something may still happen, where the cores are busy
            count = frames
            time.sleep(SETTLE)
        before = time.process_time()
        time.sleep(MEASURE)
        print(f"frames {frames - count} share {(time.process_time() - before) / MEASURE:.4f}")
        is_slow = True
        moves = partial(imgui.get_io().add_mouse_pos_event, 400, 300)
        drops, says = partial(window.drop, []), partial(window.viewer.say_error, "a line")
        for wake in (drops, says, lambda: None, moves):  # None: the toast goes
            count = frames
            wake()
            glfw.post_empty_event()
            time.sleep(MEASURE)
            print(f"awake {frames - count}", flush=True)
        close()

    params.callbacks.show_gui = counted
    threading.Thread(target=measure, daemon=True).start()
    immapp.run(params)


def leave(path: Path) -> None:
    threading.Thread(target=close_soon, daemon=True).start()
    options = ViewerOptions(size="860x620", fresh=True)
    open_window(path, options, Services(slow_load, lambda encoder_id: FakeEncoder()))


def press(window: Window, *keys: str) -> Iterator[None]:
    """Have keys arrive between two frames: "Ctrl+F" or "h"; goes on once all have had their effect."""
    io = imgui.get_io()
    for text in keys:
        name, ctrl = text.removeprefix("Ctrl+").lower(), text.startswith("Ctrl+")
        key = imgui.Key[f"_{name}" if name.isdigit() else name]
        io.add_key_event(imgui.Key.mod_ctrl, ctrl)
        io.add_key_event(key, True)
        if len(name) == 1 and not ctrl:
            io.add_input_character(ord(name))
        io.add_key_event(imgui.Key.mod_ctrl, False)  # people let go of it before the key as often as after it
        io.add_key_event(key, False)
    yield
    while window.keyboard.is_waiting:
        yield
    for _ in range(8):
        yield


def typing(window: Window) -> Iterator[None]:
    """However slow the frames, each key does what it did in its own moment."""
    state = window.viewer.state
    while state.open is None or window.viewer.worker.current is not None:
        yield
    while not state.suggestions.phrases:
        yield
    before = state.open.view
    yield from press(window, "Ctrl+F", *"hamburger")
    assert (state.drafts["##phrase"], state.open.view is before) == ("hamburger", True)
    yield from press(window, "escape", "Ctrl+A", "h")  # keys of the scene again
    assert state.marks.hidden.all()
    held = (imgui.Key.u, "u"), (imgui.Key.slash, "/"), (imgui.Key.h, "h")  # all at once
    for key, letter in held:
        imgui.get_io().add_key_event(key, True)
        imgui.get_io().add_input_character(ord(letter))
    for _ in range(3):
        yield
    for key, _ in held:
        imgui.get_io().add_key_event(key, False)
    yield from press(window)
    assert (state.drafts["##phrase"], state.marks.hidden.any()) == ("h", False)
    assert not any(imgui.is_key_down(key) for key, _ in held)
    yield from press(window, "escape", *"231")
    assert not state.marks.hidden.any()
    assert state.session.picture.display == "rgb"
    state.drafts["##phrase"] = "mug"
    yield from press(window, "Ctrl+F", "enter", *"plant", "enter", *"bo")
    asked = [query.phrase for query in state.session.queries]
    assert (asked, state.drafts["##phrase"]) == (["mug", "plant"], "bo")
    yield from press(window, "tab")
    assert (state.drafts["##phrase"], state.show_panel) == ("book", True)
    yield from press(window, "up_arrow")
    assert state.drafts["##phrase"] == "plant"
    yield from press(window, "escape")
    settings.turn_panel(window.viewer, "Transform", is_open=True)
    settings.open_panel(window.viewer, "Transform")
    for _ in range(8):
        yield
    yield from press(window, *["tab"] * 7, "2", "tab", "1", "tab", "escape")
    assert (state.edit_form.move, state.session.picture.display) == ((2.0, 1.0, 0.0), "relevancy")
    print("PASSED", flush=True)
    close()


def drive(path: Path) -> None:
    window = window_of(path)
    params = window.params()
    gui, steps = params.callbacks.show_gui, typing(window)
    window.idles = False

    def stepped() -> None:
        gui()
        try:
            next(steps, None)
        except AssertionError:
            traceback.print_exc()
            close()

    params.callbacks.show_gui = stepped
    immapp.run(params)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    deeds = {"idle": idle, "leave": leave, "type": drive}
    parser.add_argument("what", nargs="?", choices=deeds, help="in place of orbiting")
    parser.add_argument("--scene", type=Path, default=DEMO)
    parser.add_argument("--count", type=int, default=500_000, help="Gaussians; 0: as the file has")
    parser.add_argument("--seconds", type=float, default=10.0, help="of moving, three times")
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 800))
    parser.add_argument("--slow", action="store_true", help="as if the machine were slow")
    asked = parser.parse_args()
    if asked.what:
        deeds[asked.what](asked.scene)
    else:
        budget = 0.0 if asked.slow else MOVING_BUDGET
        seen = ride(asked.scene, asked.count, asked.seconds, tuple(asked.size), budget)
        print(json.dumps(asdict(seen)))
