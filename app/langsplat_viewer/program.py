"""`langsplat-viewer`: arguments -> window, or an image or film without a window."""

import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from langsplat_core.cli.run import main, parsed
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_viewer.files.projects import PROJECTS
from langsplat_viewer.options import ViewerOptions, chosen_camera, scene_path, services

WITHOUT_WINDOW = ("out", "turntable", "colour_map", "transparent", "near_cut", "far_cut")


@dataclass(frozen=True)
class ViewerCommand(ViewerOptions):
    """Open a 3D Gaussian scene, look around in it and search it with words."""

    def run(self) -> None:
        self.wanted_size, self.picture  # noqa: B018  what cannot be read is said before anything slow is done
        path = scene_path(self.scene)
        chosen_camera(self.camera)
        if self.headless and self.beside is not None:
            raise InputError("--beside is for the window; draw the two scenes one after the other")
        if self.headless and path.name.endswith(PROJECTS):
            raise InputError(
                f"{path}: a project is opened in a window; name its scene, or leave out --headless"
            )
        if self.headless:
            self._without_window(path)
        else:
            self._window(path)

    def _without_window(self, path: Path) -> None:
        from langsplat_viewer.headless import check_options, draw

        check_options(self)
        bars: AbstractContextManager[Progress] = nullcontext(silent)
        if sys.stderr.isatty():
            bars = TerminalProgress()
        with bars as progress:
            lines = draw(self, path, services(self.encoder), progress)
        print("\n".join(lines))

    def _window(self, path: Path) -> None:
        for name in WITHOUT_WINDOW:
            if getattr(self, name):
                option = f"--{name.replace('_', '-')}"
                raise InputError(
                    f"{option} is for pictures without a window; choose it there, or add --headless"
                )
        if self.beside is not None:
            scene_path(self.beside)
        from langsplat_viewer.window import open_window

        open_window(path, self, services(self.encoder))


def parse(args: Sequence[str]) -> ViewerCommand:
    """Return the command that the words of a command line make; SystemExit as tyro raises it."""
    found: ViewerCommand = parsed("langsplat-viewer", ViewerCommand, args)
    return found


def entry() -> None:
    """Run the command line."""
    sys.exit(main("langsplat-viewer", lambda: parse(sys.argv[1:])))
