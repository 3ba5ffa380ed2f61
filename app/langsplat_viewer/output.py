"""Images and films as files: PNG; MP4 by PyAV, or a folder of images.

A file is written whole or not at all. A folder is filled image by image.
"""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

import moderngl
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.errors import BackendError, InputError, printable_line
from langsplat_core.io.files import atomic_path, check_output_file, check_output_folder
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import Camera
from langsplat_viewer.camera.controls import Extent
from langsplat_viewer.camera.flight import Flight, camera_of, frame_times
from langsplat_viewer.rendering.renderer import Backend, Renderer, open_renderer
from langsplat_viewer.rendering.request import RenderRequest, why_nothing

VIDEO = ".mp4"
SETTINGS = "film.json"  # in a folder of images: how many, and how fast
FRAME = re.compile(r"frame-\d{5,}\.png")
MOST_FRAMES = 100_000


def free_name(folder: Path, stem: str, suffix: str, companions: tuple[str, ...] = ()) -> Path:
    """Return the first of stem-001, stem-002, ... that is free in `folder`, with each of `companions`."""
    names, ends = (f"{stem}-{number:03d}" for number in count(1)), (suffix, *companions)
    free = next(name for name in names if not any((folder / f"{name}{end}").exists() for end in ends))
    return folder.absolute() / f"{free}{suffix}"


def save_png(path: Path, image: Array) -> None:
    """Write an (H, W, 3) or (H, W, 4) uint8 image, whole or not at all."""
    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG", compress_level=4)  # 6: 2.5 times as long


def draw_something(request: RenderRequest, renderer: Renderer[Any]) -> Array:
    """Return the (H, W, 3) or (H, W, 4) uint8 image. InputError where it shows nothing of the scene."""
    image = renderer.read(request)
    if renderer.shows_nothing():
        scene = request.scene.scene
        reason = why_nothing(scene.gaussians, request.camera)
        raise InputError(f"{scene.path}: {reason}; try another camera or scene")
    return image


@contextmanager
def in_one_line(out: Path, size: str) -> Iterator[None]:
    """Say what goes wrong while images are drawn and written as a line for the user."""
    try:
        yield
    except MemoryError:
        raise InputError(f"not enough memory for a picture of {size}; choose a smaller size") from None
    except moderngl.Error as error:
        raise BackendError(f"OpenGL cannot draw {size} here ({error}); start with --backend cpu") from None
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror or error})") from None


# Writing films.

Draw = Callable[[int], Array]  # (H, W, 3) uint8 image by its number from 0


def has_video() -> bool:
    """Return whether videos can be written: PyAV is installed."""
    return find_spec("av") is not None


def is_folder(out: Path) -> bool:
    """Return whether a film of this name is a folder of images."""
    return out.is_dir() or not out.suffix


def check_film(out: Path | None, size: tuple[int, int] | None) -> Path:
    """Return where the film goes: `out`, or a folder of its name for a video that cannot be written here.

    InputError where that cannot work, before anything slow is done.
    """
    if out is None:
        raise InputError("--headless needs somewhere to draw to; add --out film.mp4, or --out folder/")
    if is_folder(out):
        check_output_folder(out)
        _check_own(out)
        return out
    if out.suffix.lower() != VIDEO:
        raise InputError(f"{out}: a film is .mp4, or a folder of pictures")
    if not has_video():
        return check_film(out.with_suffix(""), None)
    if size is not None and (size[0] % 2 or size[1] % 2):
        even = "x".join(str(max(side - side % 2, 2)) for side in size)
        raise InputError(f"{out}: the sides of a video are even numbers; choose {even}")
    check_output_file(out)
    return out


def _check_own(folder: Path) -> None:
    """Raise InputError where images in `folder` were not written by us: they would be overwritten."""
    if folder.is_dir() and not (folder / SETTINGS).exists():
        stranger = next((path.name for path in folder.iterdir() if FRAME.fullmatch(path.name)), None)
        if stranger is not None:
            raise InputError(f"{folder}: holds {stranger} of another program; choose another folder")


def write_film(out: Path, count: int, fps: float, draw: Draw) -> None:
    """Draw `count` images and write them as a video, or into a folder.

    Raises InputError where PyAV fails, OSError where nothing can be written, and what
    `draw` does; a file is then as it was before.
    """
    write = _write_folder if is_folder(out) else _write_video
    write(out, count, fps, draw)


def _write_folder(out: Path, count: int, fps: float, draw: Draw) -> None:
    out.mkdir(parents=True, exist_ok=True)
    _check_own(out)
    with atomic_path(out / SETTINGS) as temporary:
        temporary.write_text(json.dumps({"pictures": count, "fps": fps}), encoding="utf-8")
    for number in range(count):
        image = draw(number)
        if number == 0:  # only now there is something in the place of an earlier film
            for path in filter(lambda path: FRAME.fullmatch(path.name), list(out.iterdir())):
                path.unlink()
        save_png(out / f"frame-{number:05d}.png", image)


def _write_video(out: Path, count: int, fps: float, draw: Draw) -> None:
    """Write H.264 that every player plays."""
    import av

    options = {"movflags": "faststart"}
    try:
        with atomic_path(out) as temporary, av.open(str(temporary), "w", "mp4", options) as container:
            rate = Fraction(fps).limit_denominator(1001)
            stream = container.add_stream("libx264", rate=rate, options={"crf": "18"})
            stream.pix_fmt = "yuv420p"
            for number in range(count):
                image = draw(number)
                if number == 0:
                    stream.height, stream.width = image.shape[:2]
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode())
    except av.error.FFmpegError as error:
        if isinstance(error, OSError):
            raise
        reason = printable_line(error, 160)
        raise InputError(f"{out}: no video can be written ({reason}); name a folder instead") from None


# A film of the scene.


def cameras_of(flight: Flight, extent: Extent, fps: float, size: tuple[int, int]) -> tuple[Camera, ...]:
    """Return one camera of `size` pixels for each image of a film. InputError for more than `MOST_FRAMES`."""
    if flight.seconds * fps > MOST_FRAMES:
        raise InputError(f"{flight.seconds * fps:.0f} pictures; at most {MOST_FRAMES}, choose fewer a second")
    return tuple(camera_of(pose, extent, size) for pose in flight.poses(frame_times(flight, fps)))


def make_film(
    request: RenderRequest,
    cameras: Sequence[Camera],
    fps: float,
    out: Path,
    backend: Backend = "auto",
    progress: Progress = silent,
) -> list[str]:
    """Draw and write a film of what `cameras` see, one for each image; return the lines to print.

    Raises InputError, among others where no image shows anything of the scene, and BackendError; `progress`
    may raise to stop it.
    """
    (width, height), empty = request.size, 0
    with in_one_line(out, f"{width}x{height}"), open_renderer(backend) as renderer:

        def draw(number: int) -> Array:
            nonlocal empty
            progress("drawing", number / len(cameras), f"{number + 1} of {len(cameras)} pictures")
            image = renderer.read(request.seen_by(cameras[number]))
            empty += renderer.shows_nothing()
            if empty == len(cameras):
                scene = request.scene.scene
                raise InputError(
                    f"{scene.path}: no picture of the film shows anything of the scene: "
                    f"{why_nothing(scene.gaussians, cameras[number])}; mend the path"
                )
            return image

        write_film(out, len(cameras), fps, draw)
    name, count = f"{out}/" if is_folder(out) else str(out), len(cameras)
    pictures = "picture" if count == 1 else "pictures"
    nothing = [f"{empty} of {count} pictures show nothing of the scene"] if empty else []
    return [f"{name}: {width}x{height}, {count} {pictures}, {fps:g} a second", *nothing]
