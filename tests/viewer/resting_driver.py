"""Opens the real window as the program does, without the test engine, and lets it be; run by test_resting.py.

    python -m tests.viewer.resting_driver rest|leave SCENE.ply

rest: prints frames per second and the share of a core while nothing happens. leave: closes the window while
a scene is being read for a minute.
"""

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil
from imgui_bundle import immapp
from imgui_bundle.glfw_utils import glfw_window_hello_imgui

import glfw  # isort: skip
from langsplat_core.io import load_scene
from langsplat_viewer.rendering.renderer import GlRenderer
from langsplat_viewer.viewer import Services
from langsplat_viewer.window import Window, WindowRequest, open_window
from tests.support.fakes import FakeEncoder

SETTLE, MEASURE = 3.0, 8.0  # seconds


def slow_load(path: Path):
    time.sleep(60)
    return load_scene(path)


def close() -> None:
    """As the cross in the window's corner does; from any thread."""
    glfw.set_window_should_close(glfw_window_hello_imgui(), True)
    glfw.post_empty_event()


def close_after(seconds: float, ready: Callable[[], bool]) -> None:
    """On a thread: leave the window `seconds` after `ready`."""

    def wait() -> None:
        while not ready():
            time.sleep(0.05)
        time.sleep(seconds)
        close()

    threading.Thread(target=wait, daemon=True).start()


def rest(path: Path) -> None:
    services = Services(load_scene, lambda encoder_id: FakeEncoder())
    window = Window(WindowRequest(path, size=(860, 620)), services, lambda ctx: GlRenderer(ctx, "opengl"))
    params = window.params()
    frames, gui = [], params.callbacks.show_gui

    def counted() -> None:
        frames.append(time.monotonic())
        gui()

    def measure() -> None:
        while window.viewer.state.scene is None or window.viewer.worker.current is not None:
            time.sleep(0.05)
        time.sleep(SETTLE)
        process = psutil.Process()
        before, count = process.cpu_times(), len(frames)
        time.sleep(MEASURE)
        after = process.cpu_times()
        used = after.user + after.system - before.user - before.system
        print(f"frames {len(frames) - count} share {used / MEASURE:.4f}", flush=True)
        close()

    params.callbacks.show_gui = counted
    threading.Thread(target=measure, daemon=True).start()
    immapp.run(params)


def leave(path: Path) -> None:
    began = time.monotonic()
    close_after(2.0, lambda: time.monotonic() - began > 1)
    open_window(WindowRequest(path, size=(860, 620)), Services(slow_load, lambda encoder_id: FakeEncoder()))


if __name__ == "__main__":
    {"rest": rest, "leave": leave}[sys.argv[1]](Path(sys.argv[2]))
