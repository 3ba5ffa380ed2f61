"""Make the README's pictures again: `make pictures`. Needs a display (or Xvfb) for the window."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from imgui_bundle import hello_imgui, imgui  # isort: skip  (before glfw)
from imgui_bundle.immapp import testing  # isort: skip

from langsplat_core.parsing.pictures import opened
from langsplat_viewer import actions
from langsplat_viewer.drawing.frame import FrameRenderer
from langsplat_viewer.options import scene_path, services
from langsplat_viewer.window import Window, WindowRequest

OUT = Path(__file__).parent.parent / "docs" / "pictures"
CAMERA = "3"
FRAMES = 20_000  # that something is waited for
PATIENCE = 600.0  # seconds that a picture may take
Act = Callable[[Any, Window], None]
STILLS = {
    "colours.png": [],
    "latent_whole.png": ["--display", "latent", "--level", "whole"],
    "latent_part.png": ["--display", "latent", "--level", "part"],
    "segmentation.png": [
        *("--query", "teddy bear", "--query", "blue gift", "--query", "burger"),
        *("--display", "segmentation"),
    ],
}


QUERIES = ("teddy bear", "blue gift", "hamburger")


def _found(ctx: Any, window: Window) -> None:
    actions.toggle_overlay(window.viewer, "things")


def _under_the_cursor(ctx: Any, window: Window) -> None:
    actions.toggle_pointing(window.viewer)
    ctx.mouse_teleport_to_pos((480, 430))
    for _ in range(FRAMES):
        ctx.yield_()
        hover = window.viewer.state.hover
        if hover is not None and hover.found is not None:
            return


def _selected(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    actions.open_panel(viewer, "Select")
    actions.select_query(viewer)
    actions.set_display(viewer, "rgb")


def _side_by_side(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    actions.open_panel(viewer, "Record")
    actions.compare_with(viewer, "latent", 2)
    actions.toggle_overlay(viewer, "cube")
    actions.toggle_overlay(viewer, "grid")


# File -> what is searched, and what is done in the window before its picture is taken.
WINDOWS: dict[str, tuple[tuple[str, ...], Act]] = {
    "window.png": (QUERIES, _found),
    "cursor.jpg": (("teddy bear",), _under_the_cursor),
    "select.jpg": (("teddy bear",), _selected),
    "side_by_side.jpg": (("teddy bear",), _side_by_side),
}


def window_picture(path: Path, queries: tuple[str, ...], act: Act) -> None:
    """A screenshot of the window with the demo scene and answered queries."""
    request = WindowRequest(
        scene_path(None), queries=queries, display="relevancy", size=(1280, 800), camera=CAMERA
    )
    window = Window(request, services(""), FrameRenderer)
    window.idles = False
    whole = path.with_suffix(".whole.png")

    def wait_and_capture(ctx: Any) -> None:  # imgui's test context has no public type
        engine = imgui.test_engine.get_io(hello_imgui.get_imgui_test_engine())
        engine.config_watchdog_warning = engine.config_watchdog_kill_test = PATIENCE
        state = window.viewer.state
        for _ in range(FRAMES):
            ctx.yield_()
            answered = state.queries and all(query.result is not None for query in state.queries)
            if answered and window.viewer.worker.current is None:
                break
        act(ctx, window)
        ctx.yield_(30)
        testing.capture(ctx, str(whole))

    testing.run(test_function=wait_and_capture, runner_params=window.params())
    with opened(whole) as picture:
        rgb = picture.convert("RGB")
    rgb.save(path, optimize=True, quality=88)
    whole.unlink()


def main() -> None:
    """Write every picture into `docs/pictures`."""
    OUT.mkdir(exist_ok=True)
    for name, options in STILLS.items() if not sys.argv[1:] else ():
        command = [sys.executable, "-m", "langsplat_viewer", "--headless", "--camera", CAMERA]
        subprocess.run([*command, "--out", str(OUT / name), *options], check=True)
    wanted = sys.argv[1:] or list(WINDOWS)  # one window a process: imgui's test engine runs once
    if len(wanted) > 1:
        for name in wanted:
            subprocess.run([sys.executable, __file__, name], check=True)
    else:
        window_picture(OUT / wanted[0], *WINDOWS[wanted[0]])


if __name__ == "__main__":
    main()
