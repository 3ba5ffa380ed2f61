"""A film without a window: `langsplat-viewer --headless --path path.json --out film.mp4`."""

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import Camera
from langsplat_viewer.camera.controls import Extent, extent_of, focus, from_camera, holding_distance
from langsplat_viewer.camera.flight import Motion, camera_of, frame_times, turntable
from langsplat_viewer.drawing.frame import Backend
from langsplat_viewer.drawing.looking import why_nothing
from langsplat_viewer.files.flight_files import read_flight
from langsplat_viewer.output.film_files import MOST_FRAMES, VIDEO, Film, check_film, is_folder, write_film
from langsplat_viewer.output.headless import Drawn, Subject, painter
from langsplat_viewer.output.still import (
    Prepared,
    StillRequest,
    in_one_line,
    prepare,
    say_drawing,
    say_unread,
)
from langsplat_viewer.viewer import Services

log = logging.getLogger("langsplat")


@dataclass(frozen=True)
class FilmRequest:
    """What film is wanted: a path, or a turn of some seconds around what the camera sees, or around the last
    query that is found."""

    still: StillRequest  # scene, queries, size, where it goes; its camera begins a turntable
    path: Path | None = None  # a camera path
    turntable: float | None = None  # seconds
    around_answer: bool = False
    fps: float = 30.0


@dataclass(frozen=True, eq=False)
class Shot:
    """A subject seen by a camera that moves."""

    subject: Subject
    cameras: tuple[Camera, ...]  # one for each picture, all of one size
    fps: float
    backend: Backend = "auto"

    @property
    def size(self) -> tuple[int, int]:
        """Of a picture, pixels."""
        return self.cameras[0].width, self.cameras[0].height


def draw_film(request: FilmRequest, services: Services, progress: Progress = silent) -> list[str]:
    """Draw and write the film; returns the lines to print: the film's, then one for each query."""
    still = request.still
    out = check_film(still.out, still.size)
    flight = None if request.path is None else read_flight(request.path)  # before anything slow is done
    if out != still.out:
        log.warning("this system has no ffmpeg: pictures are written into the folder %s instead", out)
    prepared = prepare(still, services, progress)
    size = (prepared.camera.width, prepared.camera.height)
    if out.suffix.lower() == VIDEO:  # of a training camera
        size = (max(size[0] - size[0] % 2, 2), max(size[1] - size[1] % 2, 2))
    shot = Shot(
        prepared.subject,
        cameras_of(flight or turn(prepared, request), extent_of(prepared.subject.scene), request.fps, size),
        request.fps,
        still.backend,
    )
    say_drawing(still.backend, progress)
    lines = make_film(shot, out, progress)
    say_unread(prepared.subject.scene)
    return [*lines, *prepared.lines]


def turn(prepared: Prepared, request: FilmRequest) -> Motion:
    """Once around what the camera sees in its middle, or around the place of the last answer, from as far
    as it fills half of the picture. InputError where nothing was found."""
    extent = extent_of(prepared.subject.scene)
    view = from_camera(prepared.camera, extent)
    if request.around_answer:
        found = [r for r in prepared.results if r.verdict != "not here" and r.place is not None]
        if not found:
            raise InputError("--around answer: nothing was found; add --query with a thing of this scene")
        place, box = found[-1].place, found[-1].box
        assert place is not None
        if box is None:
            box = np.stack([place, place + 0.1 * extent.radius])
        nearer = min(holding_distance(view, box), float(np.linalg.norm(place - view.eye)))
        view = focus(view, place, None if view.back else nearer)  # the scale of a parallel one was chosen
    assert request.turntable is not None
    return turntable(view, request.turntable)


def cameras_of(motion: Motion, extent: Extent, fps: float, size: tuple[int, int]) -> tuple[Camera, ...]:
    """One for each picture of a film. InputError for more than `MOST_FRAMES`."""
    if motion.seconds * fps > MOST_FRAMES:
        raise InputError(f"a film of {motion.seconds * fps:.0f} pictures; at most {MOST_FRAMES}, lower --fps")
    return tuple(camera_of(pose, extent, size) for pose in motion.poses(frame_times(motion, fps)))


def make_film(shot: Shot, out: Path, progress: Progress = silent) -> list[str]:
    """Draw and write a film; returns the lines to print. Raises InputError, among others where no picture
    shows anything of the scene, and BackendError; `progress` may raise to stop it."""
    width, height = shot.size
    film = Film(out, len(shot.cameras), shot.size, shot.fps, fingerprint(shot))
    with in_one_line(out, f"{width}x{height}"), painter(shot.subject, shot.backend) as paint:
        roll = _Roll(shot, paint, progress)
        drawn = write_film(film, roll.draw)
    kept = f", {film.count - drawn} of them kept" if drawn < film.count else ""
    name = f"{out}/" if is_folder(out) else str(out)
    pictures = "picture" if film.count == 1 else "pictures"
    empty = [f"{roll.empty} of {film.count} pictures show nothing of the scene"] if roll.empty else []
    return [f"{name}: {width}x{height}, {film.count} {pictures}{kept}, {film.fps:g} a second", *empty]


class _Roll:
    """Draws picture after picture and says how far it is."""

    def __init__(self, shot: Shot, paint: Callable[[Camera], Drawn], progress: Progress) -> None:
        self._shot, self._paint, self._progress = shot, paint, progress
        self._drawn = 0
        self.empty = 0  # pictures that show nothing of the scene

    def draw(self, number: int) -> Array:
        """(H, W, 3) uint8. InputError at the last picture where none showed anything."""
        cameras = self._shot.cameras
        self._progress(f"drawing: {number + 1} of {len(cameras)} pictures", number / len(cameras))
        drawn = self._paint(cameras[number])
        self._drawn += 1
        self.empty += drawn.nothing
        if self.empty == len(cameras):
            scene = self._shot.subject.scene
            raise InputError(
                f"{scene.path}: no picture of the film shows anything of the scene: "
                f"{why_nothing(scene.gaussians, cameras[number])}; mend the path"
            )
        return drawn.image


def fingerprint(shot: Shot) -> str:
    """The same for shots that give the same pictures, whoever asks for them."""
    digest = hashlib.sha256()
    _add(digest.update, shot.subject.scene.gaussians)
    _add(digest.update, shot.subject.scene.raster_settings())
    subject = shot.subject
    _add(
        digest.update,
        (subject.picture, subject.layers, subject.heat_ranges, subject.clip, shot.backend, shot.cameras),
    )
    return digest.hexdigest()


def _add(update: Callable[[bytes], object], value: object) -> None:
    """A dataclass, array, list or plain value."""
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
