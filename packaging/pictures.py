"""Make the README's pictures again: `make pictures`. Needs a display (or Xvfb) for the window."""

import subprocess
import sys
from pathlib import Path
from typing import Any

from imgui_bundle.immapp import testing  # isort: skip  (before glfw)

from langsplat_core.parsing.pictures import opened
from langsplat_viewer.frame import FrameRenderer
from langsplat_viewer.options import scene_path, services
from langsplat_viewer.window import Window, WindowRequest

OUT = Path(__file__).parent.parent / "docs" / "pictures"
CAMERA = "3"
STILLS = {
    "colours.png": [],
    "latent_whole.png": ["--display", "latent", "--level", "whole"],
    "latent_part.png": ["--display", "latent", "--level", "part"],
    "segmentation.png": [
        *("--query", "teddy bear", "--query", "blue gift", "--query", "burger"),
        *("--display", "segmentation"),
    ],
}


def window_picture(path: Path, queries: tuple[str, ...]) -> None:
    """A screenshot of the window with the demo scene and answered queries."""
    request = WindowRequest(
        scene_path(None), queries=queries, display="relevancy", size=(1280, 800), camera=CAMERA
    )
    window = Window(request, services(""), FrameRenderer)
    window.idles = False

    def wait_and_capture(ctx: Any) -> None:  # imgui's test context has no public type
        state = window.viewer.state
        for _ in range(20_000):
            ctx.yield_()
            answered = state.queries and all(query.result is not None for query in state.queries)
            if answered and window.viewer.worker.current is None:
                break
        ctx.yield_(30)
        testing.capture(ctx, str(path))

    testing.run(test_function=wait_and_capture, runner_params=window.params())
    with opened(path) as picture:
        rgb = picture.convert("RGB")
    rgb.save(path, optimize=True)


def main() -> None:
    """Write every picture into `docs/pictures`."""
    OUT.mkdir(exist_ok=True)
    for name, options in STILLS.items():
        command = [sys.executable, "-m", "langsplat_viewer", "--headless", "--camera", CAMERA]
        subprocess.run([*command, "--out", str(OUT / name), *options], check=True)
    window_picture(OUT / "window.png", ("blue gift",))


if __name__ == "__main__":
    main()
