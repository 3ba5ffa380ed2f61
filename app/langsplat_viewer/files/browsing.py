"""Query sets as files, and folders as the file browser lists them."""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from langsplat_core.config import LevelChoice
from langsplat_core.errors import InputError, printable_line
from langsplat_core.io.files import atomic_path
from langsplat_core.io.scenes import format_of
from langsplat_viewer.files import PROJECTS
from langsplat_viewer.files.flights import SUFFIX as PATHS

SUFFIX = ".queries.json"
FORMAT = "langsplat-queries"
LARGEST = 1_000_000  # bytes of a file
MOST = 200  # queries of a set
LONGEST = 1000  # characters of a phrase
LEVEL_CHOICES: tuple[LevelChoice, ...] = get_args(LevelChoice)


@dataclass(frozen=True)
class SavedQuery:
    """A query of a set."""

    phrase: str
    cut: float | None = None  # relevancy, where it was set by hand
    shown: bool = True  # in a colour


@dataclass(frozen=True)
class QuerySet:
    """The content of a query set: its queries, and how they were asked."""

    queries: tuple[SavedQuery, ...]
    level: LevelChoice = "auto"
    canonical: tuple[str, ...] = ()  # phrases that everything is compared with; none: the scene's own


def write_queries(path: Path, queries: QuerySet) -> None:
    """Write a set, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(query_entries(queries), indent=1, ensure_ascii=False), "utf-8")


def query_entries(queries: QuerySet) -> dict[str, Any]:
    """A set as JSON has it."""
    return {"format": FORMAT, "version": 1, **asdict(queries)}


def read_queries(path: Path) -> QuerySet:
    """Read a set. InputError where the file cannot be read or is none."""
    try:
        with open(path, "rb") as file:
            top = json.loads(file.read(LARGEST))
        return checked_queries(top)
    except (OSError, ValueError, RecursionError) as error:
        reason = printable_line(getattr(error, "strerror", None) or error, 100)
        raise InputError(f"{path}: no set of queries ({reason}); save one anew") from None


def checked_queries(top: Any) -> QuerySet:
    """The set that `query_entries` wrote. ValueError for what breaks a rule of the layout."""
    if not isinstance(top, dict) or top.get("format") != FORMAT or not isinstance(top.get("queries"), list):
        raise ValueError(f'"format" is not "{FORMAT}"')
    canonical, level = top.get("canonical", []), top.get("level", "auto")
    if not isinstance(canonical, list) or not all(map(_is_phrase, canonical)) or len(canonical) > MOST:
        raise ValueError('"canonical" is not a list of phrases')
    if level not in LEVEL_CHOICES:
        raise ValueError('"level" is none of ' + ", ".join(LEVEL_CHOICES))
    if len(top["queries"]) > MOST:
        raise ValueError(f"more than {MOST} queries")
    return QuerySet(tuple(map(_query, top["queries"])), level, tuple(canonical))


def _query(entry: Any) -> SavedQuery:
    if not isinstance(entry, dict) or not _is_phrase(entry.get("phrase")):
        raise ValueError("a query without a phrase")
    cut, shown = entry.get("cut"), entry.get("shown", True)
    is_cut = isinstance(cut, int | float) and not isinstance(cut, bool) and math.isfinite(cut)
    if not isinstance(shown, bool) or not (cut is None or (is_cut and 0 <= cut <= 1)):
        raise ValueError('"cut" is a number from 0 to 1, "shown" true or false')
    return SavedQuery(entry["phrase"], None if cut is None else float(cut), shown)


def _is_phrase(text: Any) -> bool:
    return isinstance(text, str) and len(text.strip()) > 0 and len(text) <= LONGEST


# Folders, files that may be scenes, query sets and camera paths.

MOST_LISTED = 2000  # entries of a folder that are listed


@dataclass(frozen=True)
class Entry:
    """A file or folder as the browser lists it."""

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
    return Listing(folder, tuple(entries[:MOST_LISTED]), max(len(entries) - MOST_LISTED, 0))


def _entry(path: Path) -> Entry | None:
    if path.name.startswith("."):
        return None
    try:
        if path.is_dir():
            return Entry(path, is_file=format_of(path) is not None)
        if format_of(path) is not None or path.name.endswith((SUFFIX, PATHS, PROJECTS)):
            return Entry(path, True, path.stat().st_size)
    except OSError:  # it may not be looked at
        pass
    return None
