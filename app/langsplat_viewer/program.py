"""`langsplat-viewer`: arguments -> window, or an image or film without a window.

Without one neither glfw nor imgui is imported.
"""

import logging
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from langsplat_core.arrays import Array, length_text
from langsplat_core.cli.run import main, parsed
from langsplat_core.display.displays import MAX_QUERIES
from langsplat_core.errors import InputError
from langsplat_core.io.files import check_output_file
from langsplat_core.io.sidecar import SUFFIX
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import LEVELS, NO_ORIGIN, Camera, Scene
from langsplat_core.scene.language import split_phrases
from langsplat_viewer import output
from langsplat_viewer.camera.controls import default_view, extent_of, from_camera, spanning
from langsplat_viewer.camera.flight import turntable
from langsplat_viewer.camera.overlays import measured
from langsplat_viewer.options import (
    ViewerOptions,
    check_display,
    chosen_camera,
    latent_level,
    say_compiling,
    scene_path,
    services,
)
from langsplat_viewer.projects import PROJECTS, read_flight
from langsplat_viewer.rendering.renderer import open_renderer
from langsplat_viewer.rendering.request import plain_request, why_undrawable
from langsplat_viewer.viewer import Services

DEFAULT_SIZE = (1280, 720)
log = logging.getLogger("langsplat")


@dataclass(frozen=True)
class ViewerCommand(ViewerOptions):
    """Open a 3D Gaussian scene, look around in it and search it with words."""

    def run(self) -> None:
        self.wanted_size, self.picture  # noqa: B018  what cannot be read is said before anything slow is done
        path = scene_path(self.scene)
        chosen_camera(self.camera)
        if self.headless:
            with TerminalProgress() if sys.stderr.isatty() else nullcontext(silent) as progress:
                lines = draw(self, path, services(self.encoder), progress)
            print("\n".join(lines))
            return
        if self.beside is not None:
            scene_path(self.beside)
        from langsplat_viewer.window import open_window

        starts = self.scene is None and not (self.query or self.camera or self.path or self.beside)
        open_window(None if starts else path, self, services(self.encoder))


# Images and films without a window.


def check_options(options: ViewerOptions, path: Path) -> Path:
    """Return where the image or film of the scene `path` goes.

    InputError where that cannot work, before anything slow.
    """
    if options.beside is not None:
        raise InputError("--beside is for the window; draw the two scenes one after the other")
    if path.name.endswith(PROJECTS):
        raise InputError(f"{path}: a project is opened in a window; name its scene, or leave out --headless")
    if options.path is not None and options.turntable is not None:
        raise InputError("--path and --turntable are two films; choose one")
    if options.path is not None and options.orthographic is not None:
        raise InputError("--orthographic is for one view; the keyframes of a --path say it themselves")
    if options.is_film and options.transparent:
        raise InputError("--transparent is for pictures; films have a background")
    if options.is_film:
        return output.check_film(options.out, options.wanted_size)
    if options.out is None:
        raise InputError("--headless needs somewhere to draw to; add --out picture.png")
    if options.out.suffix.lower() != ".png":
        raise InputError(f"--out {options.out}: only PNG is written; end the name in .png")
    check_output_file(options.out)
    return options.out


def draw(options: ViewerOptions, path: Path, services: Services, progress: Progress = silent) -> list[str]:
    """Draw the image or film that is asked for; return lines for people and scripts.

    The first is of the file, then follow one of each query, and what the answers stand on. Raises InputError
    and what the services do.
    """
    out = check_options(options, path)
    flight = None if options.path is None else read_flight(options.path)  # before anything slow is done
    if out != options.out:
        log.warning("PyAV is not installed: pictures are written into the folder %s instead", out)
    progress("opening the scene", 0.1)
    scene = services.load_scene(path)
    reason = why_undrawable(scene.gaussians)
    if reason:  # before a text encoder is loaded for nothing
        raise InputError(f"{path}: {reason}; export it again, or open another scene")
    check_display(scene, options.shown_display, options.query)
    camera, engine = _first_camera(scene, options), services.engine(scene)
    results = _answers(engine, options, camera, progress)
    if out.suffix.lower() == output.VIDEO:  # whose sides are even, those of a training camera need not be
        width, height = (max(side - side % 2, 2) for side in (camera.width, camera.height))
        camera = camera.fitted(width, height)
    request = plain_request(
        scene,
        camera,
        options.picture,
        level=latent_level(options.level),
        answers=results[-MAX_QUERIES:],  # as in the window, where a fourth takes the oldest one's colour
    )
    if options.backend in ("auto", "cpu"):
        say_compiling(progress)
    if options.is_film:
        extent = extent_of(scene)
        if flight is None:
            assert options.turntable is not None
            flight = turntable(from_camera(camera, extent), options.turntable)
        else:
            flight = flight.moved(-scene.origin)
        cameras = output.cameras_of(flight, extent, options.fps, request.size)
        lines = output.make_film(request, cameras, options.fps, out, options.backend, progress)
    else:
        progress("drawing", 0.8)
        size = f"{camera.width}x{camera.height}"
        with output.in_one_line(out, size), open_renderer(options.backend) as renderer:
            output.save_png(out, output.draw_something(request, renderer))
        ends = " to ".join(measured(end, scene.metres_per_unit) for end in request.depths or ())
        lines = [f"{out}: {size}, {options.shown_display} {ends}".rstrip()]
    for reason in scene.unread:
        if SUFFIX in reason:  # of the cameras it was said when they were read
            log.warning("opened without its language field: %s", reason)
    basis = [f"answers: {engine.basis.long}"] if results else []
    return [*lines, *(answer_line(result, scene.origin) for result in results), *basis]


def _first_camera(scene: Scene, options: ViewerOptions) -> Camera:
    """Return the camera that is chosen, else the first training camera, else one that frames the scene."""
    size = options.wanted_size
    camera = chosen_camera(options.camera, scene) or (scene.cameras[0] if scene.cameras else None)
    if camera is None:
        camera = default_view(scene, extent_of(scene), size or DEFAULT_SIZE).camera(*(size or DEFAULT_SIZE))
    elif size is not None and size != (camera.width, camera.height):
        camera = camera.fitted(*size)
    if options.orthographic is not None:  # at the same eye
        view = spanning(from_camera(camera, extent_of(scene)), options.orthographic)
        camera = view.camera(camera.width, camera.height)
    return camera


def _answers(
    engine: QueryEngine, options: ViewerOptions, camera: Camera, progress: Progress
) -> tuple[QueryResult, ...]:
    phrases = [phrase for text in options.query for phrase in split_phrases(text) or [text]]
    for phrase in phrases:  # before anything slow is done
        check_phrase(engine, phrase, camera, progress)
    return tuple(run_phrase(engine, phrase, options.level, camera, progress).answer for phrase in phrases)


def answer_line(result: QueryResult, origin: Array = NO_ORIGIN) -> str:
    """Return the answer as a line for people and for scripts, its place in the world."""
    shown = None if result.verdict == "not here" else result.place
    place = "none" if shown is None else f"({length_text(shown, ', ', origin=origin)})"
    level = LEVELS[result.level]
    return f"'{result.phrase}': {result.said}, score {result.peak:.3f}, level {level}, place {place}"


# The command line.


def parse(args: Sequence[str]) -> ViewerCommand:
    """Return the command that the words of a command line make; SystemExit as tyro raises it."""
    found: ViewerCommand = parsed("langsplat-viewer", ViewerCommand, args)
    return found


def entry() -> None:
    """Run the command line."""
    sys.exit(main("langsplat-viewer", lambda: parse(sys.argv[1:])))
