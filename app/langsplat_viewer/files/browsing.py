"""What the file browser lists: folders, files that may be scenes, sets of queries and camera paths."""

from dataclasses import dataclass
from pathlib import Path

from langsplat_core.formats.sog import META_NAME
from langsplat_viewer.files.flight_files import SUFFIX as PATHS
from langsplat_viewer.files.querysets import SUFFIX as QUERIES

SCENE_SUFFIXES = (".ply", ".spz", ".splat", ".ksplat", ".sog")
MOST = 2000  # entries of a folder that are listed


@dataclass(frozen=True)
class Entry:
    """One line of the list."""

    path: Path
    is_file: bool  # to be opened; else a folder to go into
    size: int = 0  # bytes, of a file


@dataclass(frozen=True)
class Listing:
    """A folder as the browser shows it."""

    folder: Path
    entries: tuple[Entry, ...] = ()  # folders first, each kind by name
    left_out: int = 0  # more than `MOST`
    problem: str = ""  # why there are none, one line


def list_folder(folder: Path) -> Listing:
    """Folders and scenes in `folder`; hidden ones are left out. Does not raise."""
    try:
        paths = sorted(folder.iterdir(), key=lambda path: path.name.lower())
        entries = [entry for path in paths if (entry := _entry(path)) is not None]
    except OSError as error:
        return Listing(folder, problem=f"cannot be listed ({error.strerror or error})")
    entries.sort(key=lambda entry: entry.is_file)
    return Listing(folder, tuple(entries[:MOST]), max(len(entries) - MOST, 0))


def is_scene(path: Path) -> bool:
    """Whether a file or folder is named as scenes are."""
    return path.suffix.lower() in SCENE_SUFFIXES or path.name == META_NAME or (path / META_NAME).is_file()


def _entry(path: Path) -> Entry | None:
    if path.name.startswith("."):
        return None
    try:
        if path.is_dir():
            return Entry(path, is_file=(path / META_NAME).is_file())
        if path.suffix.lower() in SCENE_SUFFIXES or path.name.endswith((QUERIES, PATHS)):
            return Entry(path, True, path.stat().st_size)
    except OSError:  # it may not be looked at
        pass
    return None
