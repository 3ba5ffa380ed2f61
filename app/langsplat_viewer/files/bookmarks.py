"""Views that have a name, kept per scene in the folder of the preferences."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from langsplat_core.errors import FormatError, InputError, printable_line
from langsplat_core.files import atomic_path
from langsplat_core.formats.cameras_json import numbers
from langsplat_core.parsing.opening import read_json_file
from langsplat_viewer.camera.flight import Pose
from langsplat_viewer.files.flight_files import pose_entry, pose_from

FILE_NAME = "bookmarks.json"
MOST, MOST_SCENES = 50, 200  # of a scene; scenes, those that were marked last
LONGEST = 80  # characters of a name
SIZE_LIMIT = 16_000_000  # bytes


@dataclass(frozen=True, eq=False)
class Bookmark:
    """A view."""

    name: str
    pose: Pose
    distance: float  # to what it turns around, world units, > 0


@dataclass(frozen=True)
class Shelf:
    """All bookmarks of a user."""

    folder: Path | None = None  # of the preferences; None: nothing is read and nothing is written

    def read(self, scene: Path) -> tuple[Bookmark, ...]:
        """Those of a scene. InputError where the file makes no sense."""
        entries = self._all().get(str(scene.absolute()), [])
        what = f"{self._path}: bookmark"
        if not isinstance(entries, list):
            raise FormatError(f"{what}s of {scene}: no list; mend or delete the file")
        return tuple(_bookmark(entry, what) for entry in entries[:MOST])

    def write(self, scene: Path, bookmarks: tuple[Bookmark, ...]) -> None:
        """Keep those of a scene beside those of others. InputError where the file that is there makes no
        sense: it stays as it is. OSError where it cannot be written."""
        if self.folder is None:
            return
        scenes = self._all()
        scenes.pop(str(scene.absolute()), None)
        if bookmarks:
            scenes[str(scene.absolute())] = [_entry(bookmark) for bookmark in bookmarks]
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
        top = read_json_file(self._path, SIZE_LIMIT)
        if not isinstance(top, dict) or not isinstance(top.get("scenes"), dict) or top.get("version") != 1:
            raise FormatError(f"{self._path}: no bookmarks of this version; mend or delete it")
        return dict(top["scenes"])


def named(name: str) -> str:
    """A name as it is kept. InputError for none."""
    name = printable_line(name, LONGEST)
    if not name:
        raise InputError("a bookmark needs a name")
    return name


def _entry(bookmark: Bookmark) -> dict[str, Any]:
    return {"name": bookmark.name, **pose_entry(bookmark.pose), "distance": float(bookmark.distance)}


def _bookmark(entry: Any, what: str) -> Bookmark:
    pose = pose_from(entry, what)
    name, distance = entry.get("name"), float(numbers(entry, "distance", (), what))
    if not isinstance(name, str) or not (distance > 0 and math.isfinite(distance)):
        raise FormatError(f"{what}: without a name, or a distance above 0; mend or delete the file")
    return Bookmark(named(name), pose, distance)
