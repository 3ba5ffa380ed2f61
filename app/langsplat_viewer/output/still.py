"""Pictures without a window: an offscreen GL context, or none at all. Imports neither glfw nor imgui."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import moderngl

from langsplat_core.arrays import Array
from langsplat_core.config import ColourMap, Display, LevelChoice, PictureConfig
from langsplat_core.display.displays import DISPLAYS, HeatRanges, compose, latent_colours
from langsplat_core.errors import BackendError, InputError
from langsplat_core.io.files import check_output_file
from langsplat_core.io.language import SUFFIX
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult, recut
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.scene_textures import create_egl_context
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.scene.language import split_phrases
from langsplat_viewer.camera.controls import default_view, extent_of, from_camera, spanning
from langsplat_viewer.drawing import channels
from langsplat_viewer.drawing.channels import (
    UNCLIPPED,
    VISIBLE_ALPHA,
    ArrayChannels,
    Clip,
    Layers,
    Sight,
    why_nothing,
    why_undrawable,
)
from langsplat_viewer.drawing.frame import Backend, FrameRenderer, suits_opengl
from langsplat_viewer.options import check_display, chosen_camera, latent_level, say_compiling
from langsplat_viewer.output.saving import save_png
from langsplat_viewer.state import SLOTS
from langsplat_viewer.viewer import Services


@dataclass(frozen=True, eq=False)
class Subject:
    """What is drawn, from wherever it is seen."""

    scene: Scene
    picture: PictureConfig = field(default_factory=PictureConfig)
    layers: Layers = field(default_factory=Layers)
    heat_ranges: HeatRanges = ()
    clip: Clip = UNCLIPPED


@dataclass(frozen=True, eq=False)
class Drawn:
    """A picture without a window."""

    image: Array  # (H, W, 3) uint8, row 0 on top
    nothing: bool  # it shows nothing of the scene


@contextmanager
def painter(subject: Subject, backend: Backend = "auto") -> Iterator[Callable[[Camera], Drawn]]:
    """Draws one subject from camera after camera, on the thread that it was made on.

    Backends "cpu" and "cuda" touch no GL at all; "auto" takes "cpu" where GL is absent or software.
    Raises BackendError where the backend cannot work, ValueError where the layers are not the scene's.
    """
    scene, layers = subject.scene, subject.layers
    layers.check(len(scene.gaussians))
    ctx = _context_for(backend)
    if ctx is None:
        channels = ArrayChannels(load_rasterizer("cpu" if backend == "auto" else backend))

        def by_arrays(camera: Camera) -> Drawn:
            found = channels.render(Sight(scene, camera, subject.clip), layers, layers.extra(subject.picture))
            nothing = bool(found.alpha.max(initial=0) < VISIBLE_ALPHA)
            return Drawn(compose(found, subject.picture, subject.heat_ranges), nothing)

        yield by_arrays
        return
    try:
        frame = FrameRenderer(ctx, "opengl")
        frame.set_scene(scene)
        frame.set_clip(subject.clip)
        frame.set_layers(layers.latent_rgb, layers.relevancies)

        def by_gl(camera: Camera) -> Drawn:
            image = frame.read(camera, subject.picture, subject.heat_ranges)
            return Drawn(image, frame.shows_nothing())

        yield by_gl
    finally:
        ctx.release()


def render_picture(
    scene: Scene,
    camera: Camera,
    picture: PictureConfig,
    *,
    backend: Backend = "auto",
    latent_rgb: Array | None = None,
    relevancies: Array | None = None,
    heat_ranges: HeatRanges = (),
) -> Array:
    """(H, W, 3) uint8 picture of `scene`, row 0 on top, (H, W, 4) where it is transparent; layers as in
    `FrameRenderer.set_layers`.

    Raises what `painter` does, and InputError where nothing of the scene shows.
    """
    subject = Subject(scene, picture, Layers(latent_rgb, relevancies), heat_ranges)
    with painter(subject, backend) as paint:
        return draw_something(subject, camera, paint)


def draw_something(subject: Subject, camera: Camera, paint: Callable[[Camera], Drawn]) -> Array:
    """(H, W, 3) uint8 picture. InputError where it shows nothing of the scene."""
    drawn = paint(camera)
    if drawn.nothing:
        scene = subject.scene
        raise InputError(
            f"{scene.path}: {why_nothing(scene.gaussians, camera)}; try another --camera or scene"
        )
    return drawn.image


def _context_for(backend: Backend) -> moderngl.Context | None:
    """A context to draw with; None where the backend needs none."""
    if backend not in ("auto", "opengl"):
        return None
    try:
        ctx = create_egl_context()
    except BackendError:
        if backend == "auto":
            return None
        raise
    if backend == "auto" and not suits_opengl(ctx):
        ctx.release()
        return None
    return ctx


# One picture without a window: `langsplat-viewer --headless --out picture.png`.

DEFAULT_SIZE = (1280, 720)
log = logging.getLogger("langsplat")


@dataclass(frozen=True)
class StillRequest:
    """What picture is wanted."""

    path: Path  # scene
    out: Path  # *.png
    queries: tuple[str, ...] = ()
    level: LevelChoice = "auto"
    display: Display = "rgb"
    heat_opacity: float = PictureConfig.heat_opacity
    dim: float = PictureConfig.dim
    colours: tuple[int, ...] = ()  # of the queries, from 1; none: in their order
    size: tuple[int, int] | None = None  # pixels; None: the training camera's, else DEFAULT_SIZE
    camera: str = ""
    orthographic: float | None = None  # world units across the picture's shorter side; None: in perspective
    backend: Backend = "auto"
    colour_map: ColourMap = "turbo"
    transparent: bool = False
    cuts: tuple[
        float, ...
    ] = ()  # relevancies at which the answers end, 0: by itself; none: all by themselves
    canonical: str = ""  # phrases between commas; empty: the scene's own
    clip: Clip = UNCLIPPED


def check_out(out: Path | None) -> Path:
    """Where the picture goes; InputError where that cannot work, before anything slow is done."""
    if out is None:
        raise InputError("--headless needs somewhere to draw to; add --out picture.png")
    if out.suffix.lower() != ".png":
        raise InputError(f"--out {out}: only PNG is written; end the name in .png")
    check_output_file(out)
    return out


def still_camera(scene: Scene, choice: str, size: tuple[int, int] | None) -> Camera:
    """The camera of a picture: as chosen, else the first training camera, else one that frames the scene."""
    camera = chosen_camera(scene, choice) or (scene.cameras[0] if scene.cameras else None)
    if camera is None:
        return default_view(scene, extent_of(scene), size or DEFAULT_SIZE).camera(*(size or DEFAULT_SIZE))
    if size is None or size == (camera.width, camera.height):
        return camera
    return camera.with_intrinsics(camera.intrinsics.fitted(*size))


def without_perspective(scene: Scene, camera: Camera, span: float) -> Camera:
    """An orthographic camera at the same eye, `span` world units across the picture's shorter side."""
    return spanning(from_camera(camera, extent_of(scene)), span).camera(camera.width, camera.height)


def describe(result: QueryResult) -> str:
    """One line for people and for scripts."""
    shown = None if result.verdict == "not here" else result.place
    place = "none" if shown is None else "({})".format(", ".join(f"{v:.3f}" for v in shown))
    verdict: str = result.verdict
    if result.probability is not None:
        verdict += f" ({100 * result.probability:.0f} %)"
    level = LEVELS[result.level]
    return f"'{result.phrase}': {verdict}, score {result.peak:.3f}, level {level}, place {place}"


@dataclass(frozen=True, eq=False)
class Prepared:
    """All that is done once, however many pictures are drawn."""

    subject: Subject
    camera: Camera
    results: tuple[QueryResult, ...]
    lines: tuple[str, ...]  # one for each query, and what all stand on, for people and scripts


def prepare(request: StillRequest, services: Services, progress: Progress = silent) -> Prepared:
    """Open the scene, choose the camera, answer the queries. Raises InputError and what the services do."""
    progress("opening the scene", 0.1)
    scene = services.load_scene(request.path)
    reason = why_undrawable(scene.gaussians)
    if reason:  # before a text encoder is loaded for nothing
        raise InputError(f"{request.path}: {reason}; export it again, or open another scene")
    check_display(scene, request.display, request.queries)
    camera = still_camera(scene, request.camera, request.size)
    if request.orthographic is not None:
        camera = without_perspective(scene, camera, request.orthographic)
    engine = services.engine(scene)
    phrases = [phrase for text in request.queries for phrase in split_phrases(text) or [text]]
    check_colours(request.colours, len(phrases))
    if request.cuts and len(request.cuts) != len(phrases):
        raise InputError(f"--cut {request.cuts[0]:g}: give each --query a cut, 0 for its own, or none any")
    if request.canonical:
        _compare_with(engine, request.canonical, progress)
    for phrase in phrases:  # before anything slow is done
        check_phrase(engine, phrase, camera, progress)
    results = tuple(run_phrase(engine, phrase, request.level, camera, progress).answer for phrase in phrases)
    if request.cuts:
        pairs = zip(results, request.cuts, strict=True)
        results = tuple(recut(result, cut) if cut > 0 else result for result, cut in pairs)
    subject = _subject(scene, request, slots(results, request.colours))
    basis = (f"answers: {engine.basis.long}",) if results else ()
    return Prepared(subject, camera, results, (*map(describe, results), *basis))


def _compare_with(engine: QueryEngine, text: str, progress: Progress) -> None:
    """Take other canonical phrases."""
    phrases = split_phrases(text)
    if engine.scene.language is None or not phrases:
        raise InputError(f"--canonical {text}: needs a phrase, and a scene with a language field")
    engine.compare_with(phrases, progress)


def check_colours(colours: tuple[int, ...], count: int) -> None:
    """InputError unless there are none, or a different one for each of `count` queries."""
    if colours and (len(colours) != count or len(set(colours)) != count):
        raise InputError(f"--colour {colours[0]}: give each --query a colour of its own, or none any")


def slots(results: Sequence[QueryResult], colours: tuple[int, ...]) -> tuple[QueryResult | None, ...]:
    """The answers by colour. Without `colours` in their order and the last ones only, as in the window, where
    a fourth query takes the oldest one's colour."""
    if not colours:
        return tuple(results[-SLOTS:])
    by_colour = dict(zip(colours, results, strict=True))
    return tuple(by_colour.get(number) for number in range(1, max(colours) + 1))


def _subject(scene: Scene, request: StillRequest, shown: channels.Shown) -> Subject:
    picture = PictureConfig(
        display=request.display,
        heat_opacity=request.heat_opacity,
        dim=request.dim,
        colour_map=request.colour_map,
        transparent=request.transparent,
    )
    relevancies = channels.columns(shown, request.display, len(scene.gaussians))
    return Subject(
        scene,
        channels.fitted(picture, shown),
        Layers(_latent(scene, request), relevancies),
        channels.heat_ranges(shown, request.display),
        request.clip,
    )


def draw_still(request: StillRequest, services: Services, progress: Progress = silent) -> list[str]:
    """Draw and save the picture; returns the lines to print: the picture's, then one for each query."""
    prepared = prepare(request, services, progress)
    progress("drawing", 0.8)
    say_drawing(request.backend, progress)
    size = f"{prepared.camera.width}x{prepared.camera.height}"
    with in_one_line(request.out, size), painter(prepared.subject, request.backend) as paint:
        save_png(request.out, draw_something(prepared.subject, prepared.camera, paint))
    say_unread(prepared.subject.scene)
    return [f"{request.out}: {size}, {request.display}", *prepared.lines]


def say_drawing(backend: Backend, progress: Progress) -> None:
    """Before the first picture: say where the CPU's kernels will be compiled."""
    if backend in ("auto", "cpu"):
        say_compiling(progress)


def say_unread(scene: Scene) -> None:
    """After the last picture: say what lay beside the scene and could not be read."""
    for reason in scene.unread:
        if SUFFIX in reason:  # of the cameras it was said when they were read
            log.warning("opened without its language field: %s", reason)


@contextmanager
def in_one_line(out: Path, size: str) -> Iterator[None]:
    """What may go wrong while pictures are drawn and written, as a line for the user."""
    try:
        yield
    except MemoryError:
        raise InputError(f"not enough memory for a picture of {size}; choose a smaller --size") from None
    except moderngl.Error as error:
        raise BackendError(f"OpenGL cannot draw {size} here ({error}); try --backend cpu") from None
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror or error})") from None


def _latent(scene: Scene, request: StillRequest) -> Array | None:
    if DISPLAYS[request.display].extra != "latent" or scene.language is None:
        return None
    colours: Array = latent_colours(scene.language)[latent_level(request.level)]
    return colours
