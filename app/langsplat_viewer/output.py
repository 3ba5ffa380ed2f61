"""Images and films as files, with a window or none: PNG; MP4 by the system's ffmpeg, animated WebP and GIF,
or a folder of images.

A file is written whole or not at all. A folder is filled image by image; where the same film was begun in
it before, the images that are there are kept.
"""

import hashlib
import json
import logging
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import count
from pathlib import Path

import moderngl
import numpy as np
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.errors import BackendError, InputError, printable_line
from langsplat_core.io.files import atomic_path, check_output_file, check_output_folder
from langsplat_core.io.sidecar import SUFFIX
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult, recut
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.scene.language import split_phrases
from langsplat_viewer.camera.controls import (
    Extent,
    default_view,
    extent_of,
    focus,
    from_camera,
    holding_distance,
    spanning,
)
from langsplat_viewer.camera.flight import Motion, camera_of, frame_times, turntable
from langsplat_viewer.files.projects import read_flight
from langsplat_viewer.options import ViewerOptions, check_display, chosen_camera, latent_level, say_compiling
from langsplat_viewer.rendering.renderer import ArrayRenderer, Backend, GlRenderer, Inputs, open_renderer
from langsplat_viewer.rendering.request import (
    RenderRequest,
    plain_request,
    why_nothing,
    why_undrawable,
)
from langsplat_viewer.session import SLOTS
from langsplat_viewer.viewer import Services


def free_name(folder: Path, stem: str, suffix: str, companions: tuple[str, ...] = ()) -> Path:
    """The first of stem-001, stem-002, ... that is free in `folder`, with all `companions` as endings."""
    for number in count(1):
        name = f"{stem}-{number:03d}"
        if not any((folder / f"{name}{ending}").exists() for ending in (suffix, *companions)):
            break
    return folder.absolute() / f"{name}{suffix}"


def save_png(path: Path, image: Array) -> None:
    """Write an (H, W, 3) or (H, W, 4) uint8 image, whole or not at all."""
    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG")


VIDEO, ANIMATIONS = ".mp4", (".webp", ".gif")
SETTINGS = "film.json"  # in a folder of images: what they are images of
FRAME = re.compile(r"frame-\d{5,}\.png")
MOST_FRAMES = 100_000
END_SECONDS = 60.0  # that ffmpeg has to finish a file

Draw = Callable[[int], Array]  # (H, W, 3) uint8 image by its number from 0


@dataclass(frozen=True)
class Film:
    """A film to be written."""

    out: Path  # .mp4, .webp or .gif; else a folder
    count: int  # images
    size: tuple[int, int]  # width and height, pixels
    fps: float
    settings: str  # the same for films of the same images


def check_film(out: Path | None, size: tuple[int, int] | None) -> Path:
    """Return where the film goes: `out`, or, for a video on a system without ffmpeg, a folder of its name.
    InputError where that cannot work, before anything slow is done."""
    if out is None:
        raise InputError("--headless needs somewhere to draw to; add --out film.mp4, or --out folder/")
    if is_folder(out):
        check_output_folder(out)
        _check_own(out)
        return out
    if out.suffix.lower() not in (VIDEO, *ANIMATIONS):
        raise InputError(f"--out {out}: a film is .mp4, .webp, .gif, or a folder of pictures")
    if out.suffix.lower() == VIDEO and find_ffmpeg() is None:
        return check_film(out.with_suffix(""), None)
    if out.suffix.lower() == VIDEO and size is not None and (size[0] % 2 or size[1] % 2):
        even = "x".join(str(max(side - side % 2, 2)) for side in size)
        raise InputError(f"--size: the sides of a video are even numbers; choose {even}")
    check_output_file(out)
    return out


def is_folder(out: Path) -> bool:
    return out.is_dir() or not out.suffix


def find_ffmpeg() -> str | None:
    return shutil.which("ffmpeg")


def write_film(film: Film, draw: Draw) -> int:
    """Draw and write all images; returns how many were drawn, for others were there already. Raises
    InputError where ffmpeg or the image library fail, OSError where nothing can be written, and what
    `draw` does; a file is then as it was before."""
    if is_folder(film.out):
        return _write_pictures(film, draw)
    if film.out.suffix.lower() == VIDEO:
        _write_video(film, draw)
    else:
        _write_animation(film, draw)
    return film.count


def frame_name(number: int) -> str:
    return f"frame-{number:05d}.png"


def _check_own(folder: Path) -> None:
    """InputError where images in `folder` were not written by us: they would be overwritten."""
    if folder.is_dir() and not (folder / SETTINGS).exists():
        stranger = next((path.name for path in folder.iterdir() if FRAME.fullmatch(path.name)), None)
        if stranger is not None:
            raise InputError(f"--out {folder}: holds {stranger} of another program; choose another folder")


def _write_pictures(film: Film, draw: Draw) -> int:
    folder = film.out
    folder.mkdir(parents=True, exist_ok=True)
    _check_own(folder)
    text = json.dumps({"film": film.settings, "pictures": film.count, "fps": film.fps}) + "\n"
    if _text(folder / SETTINGS) != text:
        for path in folder.iterdir():  # of another film, or of this one in other settings
            if FRAME.fullmatch(path.name):
                path.unlink()
        with atomic_path(folder / SETTINGS) as temporary:
            temporary.write_text(text, encoding="utf-8")
    missing = [number for number in range(film.count) if not (folder / frame_name(number)).exists()]
    for number in missing:
        save_png(folder / frame_name(number), draw(number))
    return len(missing)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""


def _write_animation(film: Film, draw: Draw) -> None:
    def rest() -> Iterator[Image.Image]:
        for number in range(1, film.count):
            yield Image.fromarray(draw(number))

    kind = film.out.suffix[1:].upper()
    options = {"save_all": True, "append_images": rest(), "duration": 1000 / film.fps, "loop": 0}
    if kind == "WEBP":
        options |= {"quality": 85, "duration": max(round(1000 / film.fps), 1)}
    with atomic_path(film.out) as temporary:
        try:
            Image.fromarray(draw(0)).save(temporary, format=kind, **options)
        except (ValueError, KeyError, SystemError) as error:
            reason = printable_line(error, 120)
            raise InputError(f"{film.out}: {kind} cannot hold this film ({reason}); use .mp4") from None


def _write_video(film: Film, draw: Draw) -> None:
    """Raw images through a pipe. ffmpeg runs in a session of its own, so that Ctrl-C is ours to handle."""
    with atomic_path(film.out) as temporary, tempfile.TemporaryFile() as complaints:
        command = _ffmpeg(film, temporary)
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=complaints,
            start_new_session=True,
        )
        assert process.stdin is not None
        try:
            for number in range(film.count):
                process.stdin.write(draw(number).tobytes())
            process.stdin.close()
            failed = process.wait(END_SECONDS) != 0
        except BrokenPipeError:
            failed = True
        except subprocess.TimeoutExpired:
            raise InputError(f"{film.out}: ffmpeg does not end; use a folder of pictures") from None
        finally:
            _end(process)
        if failed or temporary.stat().st_size == 0:
            complaints.seek(0)
            said = complaints.read()[-4000:].decode("utf-8", "replace").split("\n")
            reason = next((line for line in reversed(said) if line.strip()), "it wrote nothing")
            reason = printable_line(reason, 160)
            raise InputError(f"{film.out}: ffmpeg failed ({reason}); use a folder of pictures, --out folder/")


def _ffmpeg(film: Film, target: Path) -> list[str]:
    """H.264 that every player plays; nothing is asked on the terminal."""
    width, height = film.size
    return [
        *(find_ffmpeg() or "ffmpeg", "-nostdin", "-hide_banner", "-loglevel", "error", "-y"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{film.fps:g}"),
        *("-i", "pipe:0", "-an", "-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p"),
        *("-movflags", "+faststart", "-f", "mp4", str(target)),
    ]


def _end(process: "subprocess.Popen[bytes]") -> None:
    if process.poll() is None:
        process.kill()
    process.wait()
    if process.stdin is not None and not process.stdin.closed:
        with suppress(OSError):  # what was buffered finds nobody to read it
            process.stdin.close()


# A film of the scene.


@dataclass(frozen=True, eq=False)
class Shot:
    """A request seen by a camera that moves."""

    request: RenderRequest
    cameras: tuple[Camera, ...]  # one for each image, of its size
    fps: float
    backend: Backend = "auto"


def cameras_of(motion: Motion, extent: Extent, fps: float, size: tuple[int, int]) -> tuple[Camera, ...]:
    """One camera of `size` pixels for each image of a film. InputError for more than `MOST_FRAMES`."""
    if motion.seconds * fps > MOST_FRAMES:
        raise InputError(f"a film of {motion.seconds * fps:.0f} pictures; at most {MOST_FRAMES}, lower --fps")
    return tuple(camera_of(pose, extent, size) for pose in motion.poses(frame_times(motion, fps)))


def make_film(shot: Shot, out: Path, progress: Progress = silent) -> list[str]:
    """Draw and write a film; returns the lines to print. Raises InputError, among others where no image
    shows anything of the scene, and BackendError; `progress` may raise to stop it."""
    (width, height), cameras, empty = shot.request.size, shot.cameras, 0
    film = Film(out, len(cameras), (width, height), shot.fps, fingerprint(shot))
    with in_one_line(out, f"{width}x{height}"), open_renderer(shot.backend) as renderer:

        def draw(number: int) -> Array:
            nonlocal empty
            progress("drawing", number / len(cameras), f"{number + 1} of {len(cameras)} pictures")
            image = renderer.read(shot.request.seen_by(cameras[number]))
            empty += renderer.shows_nothing()
            if empty == len(cameras):
                scene = shot.request.scene.scene
                raise InputError(
                    f"{scene.path}: no picture of the film shows anything of the scene: "
                    f"{why_nothing(scene.gaussians, cameras[number])}; mend the path"
                )
            return image

        drawn = write_film(film, draw)
    kept = f", {film.count - drawn} of them kept" if drawn < film.count else ""
    name = f"{out}/" if is_folder(out) else str(out)
    pictures = "picture" if film.count == 1 else "pictures"
    nothing = [f"{empty} of {film.count} pictures show nothing of the scene"] if empty else []
    return [f"{name}: {width}x{height}, {film.count} {pictures}{kept}, {film.fps:g} a second", *nothing]


@contextmanager
def in_one_line(out: Path, size: str) -> Iterator[None]:
    """Say what goes wrong while images are drawn and written as a line for the user."""
    try:
        yield
    except MemoryError:
        raise InputError(f"not enough memory for a picture of {size}; choose a smaller --size") from None
    except moderngl.Error as error:
        raise BackendError(f"OpenGL cannot draw {size} here ({error}); try --backend cpu") from None
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror or error})") from None


def fingerprint(shot: Shot) -> str:
    """Return a digest that is the same for shots that give the same images, whoever asks for them."""
    digest, inputs = hashlib.sha256(), Inputs()
    request = shot.request
    scene = inputs.scene(request)
    _add(digest.update, (scene.gaussians, scene.raster_settings(), request.clip, request.split, request.size))
    _add(digest.update, [(pane.picture, pane.ranges) for pane in request.panes])
    _add(digest.update, [c if isinstance(c, np.ndarray) else None for c in inputs.channels(request)])
    _add(digest.update, (shot.backend, shot.fps, shot.cameras))
    return digest.hexdigest()


def _add(update: Callable[[bytes], object], value: object) -> None:
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            _add(update, getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        update(repr((value.dtype, value.shape)).encode())
        update(np.ascontiguousarray(value).data)  # type: ignore[arg-type]  # a buffer
    elif isinstance(value, Sequence) and not isinstance(value, str):
        update(f"[{len(value)}".encode())
        for item in value:
            _add(update, item)
    else:
        update(f"{value!r};".encode())


# `--headless`: an image or a film without a window. Imports neither glfw nor imgui.

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
    """Draw the scene and save the image; returns the lines to print: the image's, then each query's."""
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
