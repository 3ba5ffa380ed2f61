"""`langsplat demo`: images of the bundled scene, and answers about it, without a window."""

import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from langsplat_core.cli.run import OutFolder
from langsplat_core.errors import LangSplatError

# Name of an image -> options of the viewer.
PICTURES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "colours.png": (),
        "latent_whole.png": ("--display", "latent", "--level", "whole"),
        "latent_part.png": ("--display", "latent", "--level", "part"),
        "blue_gift.png": ("--query", "blue gift"),
        "keyboard.png": ("--query", "keyboard"),
        "segmentation.png": (
            *("--query", "teddy bear", "--query", "blue gift", "--query", "burger"),
            *("--display", "segmentation"),
        ),
    }
)


@dataclass(frozen=True)
class Demo:
    """Render images of the bundled scene and answer phrases about it."""

    out: OutFolder = Path("demo_out")
    """Folder to write."""

    def run(self) -> None:
        viewer = [sys.executable, "-m", "langsplat_viewer"]
        if getattr(sys, "frozen", False):  # `make bundle`: the programs lie side by side
            viewer = [str(Path(sys.executable).with_stem("langsplat-viewer"))]
        for name, options in PICTURES.items():
            command = [*viewer, "--headless", "--size", "960x720", "--out", str(self.out / name), *options]
            if code := subprocess.run(command, check=False).returncode:
                raise LangSplatError(f"{self.out / name}: not rendered; the viewer ended with code {code}")
        print(f"The pictures are in {self.out.resolve()}")
