"""`langsplat-viewer`: arguments -> window, or a picture or film without a window."""

import math
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from langsplat_core.cli.run import main, parsed
from langsplat_core.config import ColourMap, LevelChoice, NotNegative, PictureConfig, Positive, Range, Share
from langsplat_core.display.displays import MAX_QUERIES
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_viewer.camera.flight import SPAN_LIMITS
from langsplat_viewer.drawing.channels import Clip
from langsplat_viewer.drawing.frame import Backend
from langsplat_viewer.files.preferences import preferences_folder
from langsplat_viewer.options import (
    DisplayChoice,
    camera_file,
    chosen_display,
    parse_size,
    scene_path,
    services,
)

Seconds = Annotated[float, Range(0.1, 36_000.0)]
PicturesPerSecond = Annotated[float, Range(0.1, 240.0)]
Span = Annotated[float, Range(*SPAN_LIMITS)]
Cuts = tuple[Share, ...]
Colours = tuple[Annotated[int, Range(1, MAX_QUERIES)], ...]


@dataclass(frozen=True)
class ViewerCommand:
    """Open a 3D Gaussian scene, look around in it and search it with words."""

    scene: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[SCENE]")] = None
    """Scene file, *.ply (default: the bundled demo)."""
    query: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TEXT")] = ()
    """Phrase to search for; repeat it for several. The last three are shown."""
    level: LevelChoice = "auto"
    """Semantic level of the search; auto takes the one that answers best."""
    display: DisplayChoice = "auto"
    """What is shown; auto is relevancy with a query, else rgb."""
    colour: Annotated[tyro.conf.UseAppendAction[Colours], tyro.conf.arg(metavar="N")] = ()
    """Without a window: colour of a query, 1 to 3; repeat it for each --query (default: in their order)."""
    cut: Annotated[tyro.conf.UseAppendAction[Cuts], tyro.conf.arg(metavar="RELEVANCY")] = ()
    """Without a window: relevancy from 0 to 1 at which an answer ends, 0 where it ends by itself; repeat it
    for each --query."""
    canonical: Annotated[str, tyro.conf.arg(metavar="PHRASES")] = ""
    """Without a window: what everything is compared with, phrases between commas (default: the scene's)."""
    near_cut: NotNegative = 0.0
    """Without a window: depth up to which nothing is drawn, world units."""
    far_cut: Positive | None = None
    """Without a window: depth beyond which nothing is drawn, world units (default: everything is)."""
    heat_opacity: Share = PictureConfig.heat_opacity
    """How much of the heat map covers the colours where relevancy is high."""
    dim: Share = PictureConfig.dim
    """Brightness of what a query does not find."""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = ""
    """Size of the window or picture in pixels."""
    camera: Annotated[str, tyro.conf.arg(metavar="FILE|INDEX")] = ""
    """First view: a camera file (JSON, as "Save view" writes it), or a training camera by number from 0."""
    orthographic: Span | None = None
    """Look without perspective: so many world units across the picture's shorter side."""
    backend: Backend = "auto"
    """What draws."""
    encoder: Annotated[str, tyro.conf.arg(metavar="ID|FOLDER")] = ""
    """Text encoder in place of the one that the scene names."""
    fresh: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Neither use nor change the remembered layout, settings and recent files."""
    headless: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Draw a picture or a film without a window and print the answers."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="IMAGE.png")] = None
    """Where --headless writes: a picture (.png); a film (.mp4, .webp, .gif) or a folder of its pictures."""
    path: Annotated[Path | None, tyro.conf.arg(metavar="PATH.json")] = None
    """A camera path: with --headless the film along it, else it is opened in the panel "Record"."""
    turntable: Seconds | None = None
    """With --headless: a film of so many seconds, once around what the camera sees in its middle."""
    around: Literal["view", "answer"] = "view"
    """What --turntable goes around; answer: the last query found, from near."""
    fps: PicturesPerSecond = 30.0
    """Pictures per second of a film."""
    colour_map: ColourMap | None = None
    """Colours of relevancy and depth in a picture of --headless (default: turbo)."""
    transparent: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Draw the picture of --headless without a background, transparent where the scene is not."""

    def run(self) -> None:
        size = parse_size(self.size)
        path = scene_path(self.scene)
        camera_file(self.camera)  # a file that cannot be read is said before anything slow is done
        if self.headless:
            self._without_window(path, size)
        else:
            self._window(path, size)

    def _without_window(self, path: Path, size: tuple[int, int] | None) -> None:
        from langsplat_viewer.output.film import FilmRequest, check_film, draw_film
        from langsplat_viewer.output.still import StillRequest, check_out, draw_still

        if self.path is not None and self.turntable is not None:
            raise InputError("--path and --turntable are two films; choose one")
        if self.path is not None and self.orthographic is not None:
            raise InputError("--orthographic is for one view; the keyframes of a --path say it themselves")
        is_film = self.path is not None or self.turntable is not None
        if is_film and self.transparent:
            raise InputError("--transparent is for pictures; films have a background")
        if not is_film:
            check_out(self.out)
        else:
            check_film(self.out, size)
        request = StillRequest(
            path=path,
            out=self.out or Path(),
            queries=self.query,
            level=self.level,
            display=chosen_display(self.display, self.query),
            heat_opacity=self.heat_opacity,
            dim=self.dim,
            colours=self.colour,
            size=size,
            camera=self.camera,
            orthographic=self.orthographic,
            backend=self.backend,
            colour_map=self.colour_map or "turbo",
            transparent=self.transparent,
            cuts=self.cut,
            canonical=self.canonical,
            clip=Clip(self.near_cut, math.inf if self.far_cut is None else self.far_cut),
        )
        bars: AbstractContextManager[Progress] = nullcontext(silent)
        if sys.stderr.isatty():
            bars = TerminalProgress()
        with bars as progress:
            if is_film:
                film = FilmRequest(request, self.path, self.turntable, self.around == "answer", self.fps)
                lines = draw_film(film, services(self.encoder), progress)
            else:
                lines = draw_still(request, services(self.encoder), progress)
        print("\n".join(lines))

    def _window(self, path: Path, size: tuple[int, int] | None) -> None:
        if self.out is not None:
            raise InputError("--out is for pictures without a window; add --headless")
        for option, given, panel in (
            ("--colour-map", self.colour_map, "Display"),
            ("--transparent", self.transparent, "Display"),
            ("--cut", self.cut, "Search"),
            ("--canonical", self.canonical, "Search"),
            ("--near-cut", self.near_cut, "Camera"),
            ("--far-cut", self.far_cut, "Camera"),
        ):
            if given:
                raise InputError(
                    f"{option} is for pictures without a window; choose it in the panel {panel}, "
                    "or add --headless"
                )
        if self.turntable is not None:
            raise InputError("--turntable is a film without a window; add --headless --out film.mp4")
        from langsplat_viewer.window import WindowRequest, open_window

        open_window(
            WindowRequest(
                path=path,
                queries=self.query,
                level=self.level,
                display=chosen_display(self.display, self.query),
                size=size,
                camera=self.camera,
                orthographic=self.orthographic,
                backend=self.backend,
                path_file=self.path,
                heat_opacity=self.heat_opacity,
                dim=self.dim,
                settings=None if self.fresh else preferences_folder(),
            ),
            services(self.encoder),
        )


def parse(args: Sequence[str]) -> ViewerCommand:
    """The command that the words of a command line make; SystemExit as tyro raises it."""
    found: ViewerCommand = parsed("langsplat-viewer", ViewerCommand, args)
    return found


def entry() -> None:
    """The `langsplat-viewer` console script."""
    sys.exit(main("langsplat-viewer", lambda: parse(sys.argv[1:])))


if __name__ == "__main__":
    entry()
