"""What `make demo` runs: the viewer on the bundled scene, or pictures of it where there is no display."""

import os
import subprocess
import sys
from pathlib import Path

OUT = Path("demo_out")
VIEWER = [sys.executable, "-m", "langsplat_viewer"]
PICTURES = {
    "colours.png": [],
    "latent_whole.png": ["--display", "latent", "--level", "whole"],
    "latent_part.png": ["--display", "latent", "--level", "part"],
    "blue_gift.png": ["--query", "blue gift"],
    "keyboard.png": ["--query", "keyboard"],
    "segmentation.png": [
        *("--query", "teddy bear", "--query", "blue gift", "--query", "burger"),
        *("--display", "segmentation"),
    ],
}


def has_display() -> bool:
    """True where a window can open."""
    return not sys.platform.startswith("linux") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def main() -> int:
    """Exit code of the viewer, or of the first picture that failed."""
    if has_display():
        return subprocess.run(VIEWER, check=False).returncode
    print("No display: rendering the bundled scene to pictures instead of opening a window.")
    for name, options in PICTURES.items():
        command = [*VIEWER, "--headless", "--size", "960x720", "--out", str(OUT / name), *options]
        code = subprocess.run(command, check=False).returncode
        if code:
            return code
    print(f"The pictures are in {OUT.resolve()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
