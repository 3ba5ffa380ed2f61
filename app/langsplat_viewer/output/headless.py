"""`langsplat-viewer --headless`: an image or a film without a window. Imports neither glfw nor imgui."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.io.files import check_output_file
from langsplat_core.io.language import SUFFIX
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult, recut
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.scene.language import split_phrases
from langsplat_viewer.camera.controls import (
    default_view,
    extent_of,
    focus,
    from_camera,
    holding_distance,
    spanning,
)
from langsplat_viewer.camera.flight import Motion, turntable
from langsplat_viewer.files.projects import read_flight
from langsplat_viewer.options import ViewerOptions, check_display, chosen_camera, latent_level, say_compiling
from langsplat_viewer.output.film import VIDEO, Shot, cameras_of, check_film, in_one_line, make_film, save_png
from langsplat_viewer.rendering.renderer import ArrayRenderer, Backend, GlRenderer, open_renderer
from langsplat_viewer.rendering.request import RenderRequest, plain_request, why_nothing, why_undrawable
from langsplat_viewer.state import SLOTS
from langsplat_viewer.viewer import Services

DEFAULT_SIZE = (1280, 720)
log = logging.getLogger("langsplat")


@dataclass(frozen=True, eq=False)
class Prepared:
    """Request, answers and lines that are made once, however many images are drawn."""

    request: RenderRequest
    results: tuple[QueryResult, ...]
    lines: tuple[str, ...]  # one for each query, and what all stand on, for people and scripts


def check_options(options: ViewerOptions) -> Path:
    """Return where the image or film goes. InputError where that cannot work, before anything slow."""
    if options.path is not None and options.turntable is not None:
        raise InputError("--path and --turntable are two films; choose one")
    if options.path is not None and options.orthographic is not None:
        raise InputError("--orthographic is for one view; the keyframes of a --path say it themselves")
    if options.is_film and options.transparent:
        raise InputError("--transparent is for pictures; films have a background")
    if options.is_film:
        return check_film(options.out, options.wanted_size)
    if options.out is None:
        raise InputError("--headless needs somewhere to draw to; add --out picture.png")
    if options.out.suffix.lower() != ".png":
        raise InputError(f"--out {options.out}: only PNG is written; end the name in .png")
    check_output_file(options.out)
    return options.out


def draw_image(
    options: ViewerOptions, path: Path, services: Services, progress: Progress = silent
) -> list[str]:
    """Draw the scene of `path` and save the image; returns the lines to print: the image's, then one for each
    query."""
    out, prepared = check_options(options), prepare(options, path, services, progress)
    progress("drawing", 0.8)
    say_drawing(options.backend, progress)
    size = "{}x{}".format(*prepared.request.size)
    with in_one_line(out, size), open_renderer(options.backend) as renderer:
        save_png(out, draw_something(prepared.request, renderer))
    say_unread(prepared.request.scene.source)
    return [f"{out}: {size}, {options.shown_display}", *prepared.lines]


def draw_something(request: RenderRequest, renderer: ArrayRenderer | GlRenderer) -> Array:
    """(H, W, 3) or (H, W, 4) uint8 image. InputError where it shows nothing of the scene."""
    image = renderer.read(request)
    if renderer.shows_nothing():
        scene = request.scene.scene
        reason = why_nothing(scene.gaussians, request.camera)
        raise InputError(f"{scene.path}: {reason}; try another --camera or scene")
    return image


def draw_film(
    options: ViewerOptions, path: Path, services: Services, progress: Progress = silent
) -> list[str]:
    """Draw and write the film; returns the lines to print: the film's, then one for each query."""
    out = check_options(options)
    flight = None if options.path is None else read_flight(options.path)  # before anything slow is done
    if out != options.out:
        log.warning("this system has no ffmpeg: pictures are written into the folder %s instead", out)
    prepared = prepare(options, path, services, progress)
    request = prepared.request
    if out.suffix.lower() == VIDEO:  # of a training camera
        camera = even(request.camera)
        request = replace(request, camera=camera, width=camera.width)
    cameras = cameras_of(
        flight or turn(prepared, options), extent_of(request.scene.source), options.fps, request.size
    )
    say_drawing(options.backend, progress)
    lines = make_film(Shot(request, cameras, options.fps, options.backend), out, progress)
    say_unread(request.scene.source)
    return [*lines, *prepared.lines]


def even(camera: Camera) -> Camera:
    """The camera with sides that a video can have."""
    width, height = (max(side - side % 2, 2) for side in (camera.width, camera.height))
    return camera.with_intrinsics(camera.intrinsics.fitted(width, height))


def turn(prepared: Prepared, options: ViewerOptions) -> Motion:
    """Return the turn around what the camera sees in its middle, or around the place of the last answer, from
    where it fills half of the image. InputError where nothing was found."""
    extent = extent_of(prepared.request.scene.source)
    view = from_camera(prepared.request.camera, extent)
    if options.around == "answer":
        found = [r for r in prepared.results if r.verdict != "not here" and r.place is not None]
        if not found:
            raise InputError("--around answer: nothing was found; add --query with a thing of this scene")
        place, box = found[-1].place, found[-1].box
        assert place is not None
        if box is None:
            box = np.stack([place, place + 0.1 * extent.radius])
        nearer = min(holding_distance(view, box), float(np.linalg.norm(place - view.eye)))
        view = focus(view, place, None if view.orthographic else nearer)  # whose scale was chosen
    assert options.turntable is not None
    return turntable(view, options.turntable)


def first_camera(scene: Scene, choice: str, size: tuple[int, int] | None) -> Camera:
    """Camera of an image: as chosen, else the first training camera, else one that frames the scene."""
    camera = chosen_camera(scene, choice) or (scene.cameras[0] if scene.cameras else None)
    if camera is None:
        return default_view(scene, extent_of(scene), size or DEFAULT_SIZE).camera(*(size or DEFAULT_SIZE))
    if size is None or size == (camera.width, camera.height):
        return camera
    return camera.with_intrinsics(camera.intrinsics.fitted(*size))


def without_perspective(scene: Scene, camera: Camera, span: float) -> Camera:
    """Return an orthographic camera at the same eye, `span` world units across the image's shorter side."""
    return spanning(from_camera(camera, extent_of(scene)), span).camera(camera.width, camera.height)


def describe(result: QueryResult) -> str:
    """Return the answer as a line for people and for scripts."""
    shown = None if result.verdict == "not here" else result.place
    place = "none" if shown is None else "({})".format(", ".join(f"{v:.3f}" for v in shown))
    verdict: str = result.verdict
    if result.probability is not None:
        verdict += f" ({100 * result.probability:.0f} %)"
    level = LEVELS[result.level]
    return f"'{result.phrase}': {verdict}, score {result.peak:.3f}, level {level}, place {place}"


def prepare(options: ViewerOptions, path: Path, services: Services, progress: Progress = silent) -> Prepared:
    """Open the scene, choose the camera, answer the queries. Raises InputError and what the services do."""
    progress("opening the scene", 0.1)
    scene = services.load_scene(path)
    reason = why_undrawable(scene.gaussians)
    if reason:  # before a text encoder is loaded for nothing
        raise InputError(f"{path}: {reason}; export it again, or open another scene")
    check_display(scene, options.shown_display, options.query)
    camera = first_camera(scene, options.camera, options.wanted_size)
    if options.orthographic is not None:
        camera = without_perspective(scene, camera, options.orthographic)
    engine = services.engine(scene)
    results = answers(engine, options, camera, progress)
    request = plain_request(
        scene,
        camera,
        options.picture,
        level=latent_level(options.level),
        answers=by_colour(results, options.colour),
        clip=options.clip,
    )
    basis = (f"answers: {engine.basis.long}",) if results else ()
    return Prepared(request, results, (*map(describe, results), *basis))


def answers(
    engine: QueryEngine, options: ViewerOptions, camera: Camera, progress: Progress
) -> tuple[QueryResult, ...]:
    """Answers to the queries, in their order, cut where the options say so."""
    phrases = [phrase for text in options.query for phrase in split_phrases(text) or [text]]
    check_colours(options.colour, len(phrases))
    if options.cut and len(options.cut) != len(phrases):
        raise InputError(f"--cut {options.cut[0]:g}: give each --query a cut, 0 for its own, or none any")
    if options.canonical:
        canonical = split_phrases(options.canonical)
        if engine.scene.language is None or not canonical:
            needed = "needs a phrase, and a scene with a language field"
            raise InputError(f"--canonical {options.canonical}: {needed}")
        engine.compare_with(canonical, progress)
    for phrase in phrases:  # before anything slow is done
        check_phrase(engine, phrase, camera, progress)
    results = tuple(run_phrase(engine, phrase, options.level, camera, progress).answer for phrase in phrases)
    if not options.cut:
        return results
    pairs = zip(results, options.cut, strict=True)
    return tuple(recut(result, cut) if cut > 0 else result for result, cut in pairs)


def check_colours(colours: tuple[int, ...], count: int) -> None:
    """InputError unless there are none, or a different one for each of `count` queries."""
    if colours and (len(colours) != count or len(set(colours)) != count):
        raise InputError(f"--colour {colours[0]}: give each --query a colour of its own, or none any")


def by_colour(results: Sequence[QueryResult], colours: tuple[int, ...]) -> tuple[QueryResult | None, ...]:
    """The answers by colour. Without `colours` in their order and the last ones only, as in the window, where
    a fourth query takes the oldest one's colour."""
    if not colours:
        return tuple(results[-SLOTS:])
    by_colour = dict(zip(colours, results, strict=True))
    return tuple(by_colour.get(number) for number in range(1, max(colours) + 1))


def say_drawing(backend: Backend, progress: Progress) -> None:
    """Say, before the first image, where the CPU's kernels will be compiled."""
    if backend in ("auto", "cpu"):
        say_compiling(progress)


def say_unread(scene: Scene) -> None:
    """Say, after the last image, what lay beside the scene and could not be read."""
    for reason in scene.unread:
        if SUFFIX in reason:  # of the cameras it was said when they were read
            log.warning("opened without its language field: %s", reason)
