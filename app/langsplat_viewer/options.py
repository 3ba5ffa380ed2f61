"""The program's arguments: options, sizes, cameras, displays. Imports no windowing library."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from langsplat_core.cli.arguments import Needs
from langsplat_core.config import ColourMap, Display, HeatOf, LevelChoice, PictureConfig, Range, Share
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.errors import InputError
from langsplat_core.io.cameras import read_cameras
from langsplat_core.io.scenes import format_of, load_scene
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import no_field
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_viewer.camera.flight import SPAN_LIMITS
from langsplat_viewer.marks import unmarked
from langsplat_viewer.projects import BUNDLED
from langsplat_viewer.rendering.renderer import Backend, renderer_for
from langsplat_viewer.rendering.request import RenderRequest, edited_scene
from langsplat_viewer.viewer import Services

DisplayChoice = Literal["auto", Display]
INDEX = re.compile(r"-?[0-9]+")
WARMING = 64  # Gaussians of the image that has the kernels compiled
MAX_SIDE = 16_384  # pixels; beyond it drivers refuse textures
Seconds = Annotated[float, Range(0.1, 36_000.0)]
PicturesPerSecond = Annotated[float, Range(0.1, 240.0)]
Span = Annotated[float, Range(*SPAN_LIMITS)]
HEADLESS = Needs("headless")  # of pictures without a window; the window has other ways to choose


@dataclass(frozen=True)
class ViewerOptions:
    """Options of `langsplat-viewer`, for the window and for images without one."""

    scene: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[SCENE]")] = None
    """Scene file, *.ply (default: the start page; with anything to show, the bundled demo)."""
    query: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TEXT")] = ()
    """Phrase to search for; repeat it for several. The last three are shown."""
    level: LevelChoice = "auto"
    """Semantic level of the search; auto takes the one that answers best."""
    display: DisplayChoice = "auto"
    """What is shown; auto is relevancy with a query, else rgb."""
    heat_scale: Annotated[tuple[Share, Share] | None, tyro.conf.arg(metavar="LOW HIGH")] = None
    """Relevancies at the ends of the heat map, the same in every image (default: each answer's own)."""
    heat: HeatOf = PictureConfig.heat
    """Relevancy in a heat map of an answer: smoothed, each Gaussian's own, its node's; or of everything."""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = ""
    """Size of the window or image in pixels."""
    camera: Annotated[str, tyro.conf.arg(metavar="FILE|INDEX")] = ""
    """First view: a camera file (JSON, as "Save view" writes it), or a training camera by number from 0."""
    orthographic: Span | None = None
    """Look without perspective: so many world units across the image's shorter side."""
    backend: Backend = "auto"
    """What draws."""
    encoder: Annotated[str, tyro.conf.arg(metavar="ID|FOLDER")] = ""
    """Text encoder in place of the one that the scene names."""
    fresh: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Neither use nor change the remembered layout, settings and recent files."""
    headless: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Draw an image or a film without a window and print the answers."""
    out: Annotated[Path | None, HEADLESS] = None
    """Where --headless writes: an image (.png); a film (.mp4) or a folder of its images."""
    path: Annotated[Path | None, tyro.conf.arg(metavar="PATH.json")] = None
    """A camera path: with --headless the film along it, else it is opened in the panel "Record"."""
    turntable: Annotated[Seconds | None, HEADLESS] = None
    """With --headless: a film of so many seconds, once around what the camera sees in its middle."""
    beside: Annotated[Path | None, tyro.conf.arg(metavar="SCENE")] = None
    """In the window: a second scene right of a line, by another encoder or method, seen and asked alike."""
    fps: Annotated[PicturesPerSecond, HEADLESS, Needs("is_film", "--path or --turntable")] = 30.0
    """Images per second of a film."""
    colour_map: Annotated[ColourMap | None, HEADLESS] = None
    """Colours of relevancy and depth in an image of --headless (default: inferno)."""
    transparent: Annotated[bool, tyro.conf.FlagCreatePairsOff, HEADLESS] = False
    """Draw the image of --headless without a background, transparent where the scene is not."""

    @property
    def wanted_size(self) -> tuple[int, int] | None:
        """Pixels; None: not said. InputError for a size that is none."""
        return parse_size(self.size)

    @property
    def shown_display(self) -> Display:
        """Relevancy when something is searched, colours otherwise, unless a display is named."""
        found: Display = "relevancy" if self.query else "rgb"
        return found if self.display == "auto" else self.display

    @property
    def picture(self) -> PictureConfig:
        """The settings of the display. InputError for a heat scale that ends before it begins."""
        scale = self.heat_scale
        if scale is not None and scale[0] >= scale[1]:
            raise InputError(f"--heat-scale {scale[0]:g} {scale[1]:g}: the second must be the larger")
        return PictureConfig(
            display=self.shown_display,
            heat=self.heat,
            heat_scale=scale,
            colour_map=self.colour_map or PictureConfig.colour_map,
            transparent=self.transparent,
        )

    @property
    def is_film(self) -> bool:
        return self.path is not None or self.turntable is not None


def parse_size(text: str) -> tuple[int, int] | None:
    """Return (1280, 720) for "1280x720", None for "". Raises InputError."""
    if not text:
        return None
    match = re.fullmatch(r"([0-9]{1,6})[xX×]([0-9]{1,6})", text.strip())
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise InputError(f"--size {text}: give width x height in pixels, 1 to {MAX_SIDE}, such as 1280x720")
    return size


def scene_path(scene: Path | None) -> Path:
    """Return the file to open; without one the bundled demo.

    InputError where it is absent or not a file.
    """
    if scene is None:
        if not BUNDLED.is_file():
            raise InputError(f"the bundled demo scene is missing ({BUNDLED}); name a scene, or reinstall")
        return BUNDLED
    try:
        if not scene.exists():
            raise InputError(f"{scene}: no such file; check the spelling and the folder")
        if scene.is_dir() and format_of(scene) is None:
            raise InputError(f"{scene}: is a folder, not a scene; name the .ply file in it")
    except OSError as error:  # a name too long, a folder that may not be looked into
        raise InputError(f"{str(scene)[:80]}: cannot be opened ({error.strerror})") from None
    return scene


def chosen_camera(choice: str, scene: Scene | None = None) -> Camera | None:
    """Return the camera that `--camera` names, of a file or by its index; None for no choice.

    Without a scene only files are read. Raises InputError.
    """
    if not choice or (scene is None and INDEX.fullmatch(choice)):
        return None
    if not INDEX.fullmatch(choice):
        cameras = read_cameras(Path(choice))
        if not cameras:
            raise InputError(f"--camera {choice}: the file holds no camera")
        return cameras[0] if scene is None else cameras[0].moved(-scene.origin)
    cameras = () if scene is None else scene.cameras
    if not cameras:
        raise InputError(f"--camera {choice}: the scene has no training cameras; name a camera file instead")
    if not 0 <= int(choice) < len(cameras):
        raise InputError(f"--camera {choice}: the scene has cameras 0 to {len(cameras) - 1}")
    return cameras[int(choice)]


def check_display(scene: Scene, display: Display, queries: tuple[str, ...]) -> None:
    """Raise InputError for a display or query that this scene cannot answer."""
    if scene.language is None and (queries or DISPLAYS[display].needs_field):
        raise InputError(f"{scene.path}: {no_field(scene)}")
    if display == "tree" and scene.language is not None and scene.language.tree is None:
        raise InputError(
            f"{scene.path}: keeps no tree, like all imported scenes and those of earlier versions; "
            "`langsplat train --gaussians` makes the field again"
        )
    if DISPLAYS[display].needs_query and not queries:
        raise InputError(f"--display {display} shows a search; add --query TEXT")


def latent_level(level: LevelChoice) -> int:
    """Index into `scene.LEVELS` of what the displays "latent" and "tree" show; auto is the whole."""
    return LEVELS.index("whole" if level == "auto" else level)


def warm_up(scene: Scene, backend: str, progress: Progress = silent) -> None:
    """Compile the CPU's kernels before the window first draws with them, and report it."""
    if backend == "cpu":
        say_compiling(progress)
        few = Scene(scene.gaussians.take(np.arange(min(len(scene.gaussians), WARMING))))
        marks, renderer = unmarked(len(few.gaussians)), renderer_for(None, "cpu")
        edited = edited_scene(few, replace(marks, selected=~marks.selected))
        for display in DISPLAYS:
            request = RenderRequest(edited, few.framing_camera((16, 16)), 16, PictureConfig(display))
            renderer.read(request)
        renderer.depth_at(request, 8, 8)


def say_compiling(progress: Progress) -> None:
    """Report that the CPU rasterizer's kernels are compiled next, unless an earlier run has done so."""
    from langsplat_core.compiled import is_compiled
    from langsplat_core.raster.cpu.rasterizer import splat_tiles

    if not is_compiled(splat_tiles):
        progress("compiling the drawing kernels, once per installation (half a minute)", 0.7)


def services(encoder_id: str) -> Services:
    """Return what the viewer needs from the layers below."""
    return Services(load_scene, load_text_encoder, encoder_id, warm_up)
