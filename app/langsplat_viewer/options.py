"""The program's arguments, and what they mean: sizes, cameras, displays. Imports no windowing library."""

import re
from importlib.resources import files
from pathlib import Path
from typing import Literal

from langsplat_core.config import Display, LevelChoice
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.errors import InputError
from langsplat_core.io.cameras import read_cameras
from langsplat_core.io.scenes import format_of, load_scene
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import no_field
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_viewer.viewer import Services

DisplayChoice = Literal["auto", Display]
MAX_SIDE = 16_384  # pixels; beyond it drivers refuse textures


def parse_size(text: str) -> tuple[int, int] | None:
    """ "1280x720" -> (1280, 720); "" -> None. Raises InputError."""
    if not text:
        return None
    match = re.fullmatch(r"(\d{1,6})[xX×](\d{1,6})", text.strip())
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise InputError(f"--size {text}: give width x height in pixels, 1 to {MAX_SIDE}, such as 1280x720")
    return size


def scene_path(scene: Path | None) -> Path:
    """The file to open; without one the bundled demo. InputError where it is absent or not a file."""
    if scene is None:
        demo = Path(str(files("langsplat_assets") / "demo" / "scene.ply"))
        if not demo.is_file():
            raise InputError(f"the bundled demo scene is missing ({demo}); name a scene, or reinstall")
        return demo
    try:
        if not scene.exists():
            raise InputError(f"{scene}: no such file; check the spelling and the folder")
        if scene.is_dir() and format_of(scene) is None:
            raise InputError(f"{scene}: is a folder, not a scene; name the .ply file in it")
    except OSError as error:  # a name too long, a folder that may not be looked into
        raise InputError(f"{str(scene)[:80]}: cannot be opened ({error.strerror})") from None
    return scene


def camera_file(choice: str) -> Camera | None:
    """The camera of a `--camera FILE`; None where `choice` is empty or an index. Raises InputError."""
    if not choice or re.fullmatch(r"-?\d+", choice):
        return None
    cameras = read_cameras(Path(choice))
    if not cameras:
        raise InputError(f"--camera {choice}: the file holds no camera")
    return cameras[0]


def chosen_camera(scene: Scene, choice: str) -> Camera | None:
    """The camera that `--camera` names: of a file, or a training camera by index from 0; None without a
    choice. Raises InputError."""
    if not choice:
        return None
    of_file = camera_file(choice)
    if of_file is not None:
        return of_file
    if not scene.cameras:
        raise InputError(f"--camera {choice}: the scene has no training cameras; name a camera file instead")
    if not 0 <= int(choice) < len(scene.cameras):
        raise InputError(f"--camera {choice}: the scene has cameras 0 to {len(scene.cameras) - 1}")
    return scene.cameras[int(choice)]


def chosen_display(choice: DisplayChoice, queries: tuple[str, ...]) -> Display:
    """Relevancy when something is searched, colours otherwise, unless a display is named."""
    if choice == "auto":
        return "relevancy" if queries else "rgb"
    return choice


def check_display(scene: Scene, display: Display, queries: tuple[str, ...]) -> None:
    """InputError for a display or query that this scene cannot answer."""
    if scene.language is None and (queries or DISPLAYS[display].needs_field):
        raise InputError(f"{scene.path}: {no_field(scene)}")
    if DISPLAYS[display].needs_query and not queries:
        raise InputError(f"--display {display} shows a search; add --query TEXT")


def latent_level(level: LevelChoice) -> int:
    """Index into `scene.LEVELS` of the latents that the display "latent" shows; auto is the whole."""
    return LEVELS.index("whole" if level == "auto" else level)


def warm_up(scene: Scene, backend: str, progress: Progress = silent) -> None:
    """Have the CPU rasterizer compiled before the window first draws with it, and say so."""
    if backend == "cpu":
        say_compiling(progress)
        from langsplat_core.raster import load_rasterizer
        from langsplat_viewer.drawing.channels import ArrayChannels, Layers, Sight

        channels, sight = ArrayChannels(load_rasterizer("cpu")), Sight(scene, scene.framing_camera((16, 16)))
        channels.render(sight, Layers(), "none")
        channels.depth_at(sight, 8, 8)


def say_compiling(progress: Progress) -> None:
    """Report that the CPU rasterizer's kernels are compiled next, unless an earlier run has done so."""
    from langsplat_core.compiled import is_compiled
    from langsplat_core.raster.cpu import blend

    if not is_compiled(Path(blend.__file__)):
        progress("compiling the drawing kernels, once per installation (half a minute)", 0.7)


def services(encoder_id: str) -> Services:
    """The real layers below."""
    return Services(load_scene, load_text_encoder, encoder_id, warm_up)
