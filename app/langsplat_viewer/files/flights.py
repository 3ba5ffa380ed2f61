"""Camera paths and bookmarks as files: small JSON, with a version.

{"langsplat_flight": 1,
 "keyframes": [{"seconds": 0.0,             rising, 0 to 36000
                "position": [x, y, z],      world units
                "rotation": [[...], ...],   camera to world, three rows; OpenCV axes, as in cameras.json
                "fov_degrees": 50.0,        across the image's shorter side
                "span": 4.0}]}              world units across it; where it is, there is no perspective
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.errors import FormatError, InputError, printable_line, quoted
from langsplat_core.io.cameras import is_rotation, numbers
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import read_json_file
from langsplat_core.scene import FARTHEST
from langsplat_viewer.camera.flight import (
    FOV_LIMITS,
    LONGEST,
    SAME_TIME,
    SPAN_LIMITS,
    Flight,
    Keyframe,
    Pose,
)

SUFFIX = ".path.json"  # that ours have
MARK, VERSION = "langsplat_flight", 1
SIZE_LIMIT = 16 * 1024 * 1024  # bytes
MOST = 10_000  # keyframes


def read_flight(path: Path | str) -> Flight:
    """Read the path in a file. Raises InputError and FormatError, in one line."""
    path = Path(path)
    top = read_json_file(path, SIZE_LIMIT)
    if not isinstance(top, dict) or MARK not in top:
        raise FormatError(f'{path}: no camera path; expected an object with "{MARK}": {VERSION}')
    if top[MARK] != VERSION or isinstance(top[MARK], bool):
        raise FormatError(f"{path}: a camera path of version {quoted(top[MARK], 20)}; this program reads 1")
    return Flight(keyframes_from(top.get("keyframes"), str(path)))


def keyframes_from(entries: Any, path: str) -> tuple[Keyframe, ...]:
    """The keyframes that `keyframe_entries` wrote; FormatError, that begins with `path`, for none."""
    if not isinstance(entries, list) or not 1 <= len(entries) <= MOST:
        raise FormatError(
            f"{path}: 'keyframes' is not a list of 1 to {MOST} keyframes; record the path again"
        )
    keyframes: list[Keyframe] = []
    for index, entry in enumerate(entries):
        what = f"{path}: keyframe {index}"
        pose = pose_from(entry, what)
        seconds = float(numbers(entry, "seconds", (), what))
        if not 0 <= seconds <= LONGEST:
            raise FormatError(f"{what}: 'seconds' is {seconds:g}; expected 0 to {LONGEST:g}")
        if keyframes and seconds - keyframes[-1].seconds < SAME_TIME:
            raise FormatError(f"{what}: 'seconds' is not later than that of the keyframe before; sort them")
        keyframes.append(Keyframe(seconds, pose))
    return tuple(keyframes)


def write_flight(path: Path | str, flight: Flight) -> None:
    """Write `flight`, whole or not at all."""
    lines = ",\n".join(json.dumps(entry) for entry in keyframe_entries(flight.keyframes))
    with atomic_path(path) as temporary:
        text = f'{{"{MARK}": {VERSION}, "keyframes": [\n{lines}\n]}}\n'
        temporary.write_text(text, encoding="utf-8")


def keyframe_entries(keyframes: Sequence[Keyframe]) -> list[dict[str, Any]]:
    """Keyframes as JSON has them."""
    return [{"seconds": key.seconds, **pose_entry(key.pose)} for key in keyframes]


def pose_entry(pose: Pose) -> dict[str, Any]:
    """A pose as JSON has it."""
    entry = {
        "position": np.asarray(pose.position, float).tolist(),
        "rotation": np.asarray(pose.rotation, float).T.tolist(),
        "fov_degrees": float(pose.fov_degrees),
    }
    return entry if pose.span is None else {**entry, "span": float(pose.span)}


def pose_from(entry: Any, what: str) -> Pose:
    """The pose that `pose_entry` wrote; FormatError, beginning with `what`, where there is none."""
    if not isinstance(entry, dict):
        raise FormatError(f"{what}: expected an object with position, rotation, fov_degrees")
    position = numbers(entry, "position", (3,), what)
    if np.abs(position).max() > FARTHEST:
        raise FormatError(f"{what}: 'position' is more than {FARTHEST:g} units from the origin")
    rotation = numbers(entry, "rotation", (3, 3), what)
    if not is_rotation(rotation):
        raise FormatError(f"{what}: 'rotation' is not a rotation matrix")
    fov = float(numbers(entry, "fov_degrees", (), what))
    if not FOV_LIMITS[0] <= fov <= FOV_LIMITS[1]:
        low, high = FOV_LIMITS
        raise FormatError(f"{what}: 'fov_degrees' is {fov:g}; expected {low:g} to {high:g}")
    span = float(numbers(entry, "span", (), what)) if "span" in entry else None
    if span is not None and not SPAN_LIMITS[0] <= span <= SPAN_LIMITS[1]:
        low, high = SPAN_LIMITS
        raise FormatError(f"{what}: 'span' is {span:g}; expected {low:g} to {high:g}")
    return Pose(position, rotation.T, fov, span)


# Bookmarks, kept per scene in the folder of the preferences.

FILE_NAME = "bookmarks.json"
MOST_VIEWS, MOST_SCENES = 50, 200  # of a scene; scenes, those that were marked last
LONGEST_NAME = 80  # characters of a name
VIEWS_SIZE_LIMIT = 16_000_000  # bytes


@dataclass(frozen=True, eq=False)
class Bookmark:
    """Named view of a flight."""

    name: str
    pose: Pose
    distance: float  # to what it turns around, world units, > 0


@dataclass(frozen=True)
class Shelf:
    """All bookmarks of a user."""

    folder: Path | None = None  # of the preferences; None: nothing is read and nothing is written

    def read(self, scene: Path) -> tuple[Bookmark, ...]:
        """Read the bookmarks of a scene. InputError where the file makes no sense."""
        entries = self._all().get(str(scene.absolute()), [])
        what = f"{self._path}: bookmark"
        if not isinstance(entries, list):
            raise FormatError(f"{what}s of {scene}: no list; mend or delete the file")
        return tuple(bookmark_from(entry, what) for entry in entries[:MOST_VIEWS])

    def write(self, scene: Path, bookmarks: tuple[Bookmark, ...]) -> None:
        """Keep the bookmarks of a scene beside those of others. InputError where the file that is there
        makes no sense: it stays as it is. OSError where it cannot be written."""
        if self.folder is None:
            return
        scenes = self._all()
        scenes.pop(str(scene.absolute()), None)
        if bookmarks:
            scenes[str(scene.absolute())] = [bookmark_entry(bookmark) for bookmark in bookmarks]
        kept = dict(list(scenes.items())[-MOST_SCENES:])
        with atomic_path(self._path) as temporary:
            text = json.dumps({"version": 1, "scenes": kept}, indent=1, ensure_ascii=False)
            temporary.write_text(text, encoding="utf-8")

    @property
    def _path(self) -> Path:
        return (self.folder or Path()) / FILE_NAME

    def _all(self) -> dict[str, Any]:
        if self.folder is None or not self._path.exists():
            return {}
        top = read_json_file(self._path, VIEWS_SIZE_LIMIT)
        if not isinstance(top, dict) or not isinstance(top.get("scenes"), dict) or top.get("version") != 1:
            raise FormatError(f"{self._path}: no bookmarks of this version; mend or delete it")
        return dict(top["scenes"])


def named(name: str) -> str:
    """A name as it is kept. InputError for none."""
    name = printable_line(name, LONGEST_NAME)
    if not name:
        raise InputError("a bookmark needs a name")
    return name


def bookmark_entry(bookmark: Bookmark) -> dict[str, Any]:
    """A named view as JSON has it."""
    return {"name": bookmark.name, **pose_entry(bookmark.pose), "distance": float(bookmark.distance)}


def bookmark_from(entry: Any, what: str) -> Bookmark:
    """The view that `bookmark_entry` wrote; FormatError, beginning with `what`, where there is none."""
    pose = pose_from(entry, what)
    name, distance = entry.get("name"), float(numbers(entry, "distance", (), what))
    if not isinstance(name, str) or not (distance > 0 and math.isfinite(distance)):
        raise FormatError(f"{what}: without a name, or a distance above 0; mend or delete the file")
    return Bookmark(named(name), pose, distance)
