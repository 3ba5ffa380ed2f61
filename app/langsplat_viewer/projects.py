"""Files of a user, as JSON: camera paths, projects and preferences.

What they hold are parts of a `Session`, which msgspec turns into JSON and back; what its types do not say is
checked here. Nothing in a file becomes a path, an array or a call that was not checked before.
"""

import base64
import binascii
import hashlib
import json
import math
import os
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from langsplat_core.config import check_settings
from langsplat_core.errors import FormatError, InputError, malformed, printable_line, quoted
from langsplat_core.io.files import locked, write_whole
from langsplat_core.io.hostile import read_json_file
from langsplat_core.scene import FARTHEST, Intrinsics, is_rotation
from langsplat_core.scene.transform import similarity
from langsplat_viewer.camera.flight import FOV_LIMITS, LONGEST, SAME_TIME, SPAN_LIMITS, Flight, Keyframe, Pose
from langsplat_viewer.session import (
    LONGEST_NOTE,
    MOST_RECENT,
    SLOTS,
    Bits,
    Bookmark,
    Move,
    Point,
    Preferences,
    Session,
    Things,
)

T = TypeVar("T")
SIZE_LIMIT = 64 * 1024 * 1024  # bytes of any of these files


def plain(value: object) -> Any:
    """Return a part of a session as JSON. None and infinite values are left out: they are defaults."""

    def stated(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: stated(v) for k, v in value.items() if v is not None and v != math.inf}
        return [stated(part) for part in value] if isinstance(value, list | tuple) else value

    return stated(msgspec.to_builtins(value, enc_hook=_encoded, str_keys=True))


def _encoded(value: object) -> object:
    if isinstance(value, Bits):
        return base64.b64encode(zlib.compress(value.packed)).decode()
    assert isinstance(value, np.ndarray | np.generic)
    return value.tolist()


def _converted(value: Any, kind: Any, count: int = 0) -> Any:
    """Return JSON as a `kind`, whose masks are of `count` Gaussians; ValueError where it is none."""

    def decoded(kind: Any, value: Any) -> object:
        if kind is Bits:
            return _bits(value, count)
        found = np.array(value)
        if found.dtype.kind not in "iuf" or not np.isfinite(found).all():
            raise ValueError("numbers are expected, all finite")
        return found.astype(np.float64)

    return msgspec.convert(value, kind, dec_hook=decoded, str_keys=True)


def _bits(text: Any, count: int) -> Bits:
    size = (count + 7) // 8
    try:
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(base64.b64decode(text, validate=True), size + 1)  # never more: a bomb
    except (zlib.error, binascii.Error) as error:
        raise ValueError(f"marks that cannot be read ({error})") from None
    if len(content) != size:
        raise ValueError("marks of another number of Gaussians")
    return Bits(count, content)


def _read(path: Path, what: str, decode: Callable[[Any], T]) -> T:
    """Return what `decode` makes of the JSON in a file.

    InputError and FormatError, in one line, where it is no `what`.
    """
    top = read_json_file(path, SIZE_LIMIT)
    try:
        return decode(top)
    except FormatError:
        raise
    except (InputError, ValueError) as error:
        raise malformed(path, f"no {what} ({printable_line(error, 120)})", "save it anew") from None


def _check_version(path: Path, what: str, stated: object, *known: int) -> None:
    if isinstance(stated, bool) or stated not in known:
        of_version = f"{what} of version {quoted(stated, 20)}; this program reads"
        raise malformed(path, f"{of_version} {' and '.join(map(str, known))}", "update it")


def _write(path: Path, content: object) -> None:
    write_whole(path, json.dumps(content, indent=1, ensure_ascii=False))


# Poses, in paths flat beside what else an entry has:
#
# {"position": [x, y, z],      in the world; in projects relative to their origin
#  "rotation": [[...], ...],   camera to world, three rows; OpenCV axes, as in cameras.json
#  "fov_degrees": 50.0,        across the image's shorter side
#  "span": 4.0}                world units across it; where it is, there is no perspective

POSE = ("position", "rotation", "fov_degrees", "span")


def _flat(entry: dict[str, Any]) -> dict[str, Any]:
    pose = entry.pop("pose")
    return {**entry, **pose, "rotation": np.transpose(pose["rotation"]).tolist()}


def _nested(entry: Any) -> dict[str, Any]:
    others = msgspec.convert(entry, dict[str, Any])
    pose = {name: others.pop(name) for name in POSE if name in others}
    return {**others, "pose": {**pose, "rotation": np.transpose(pose.get("rotation", ())).tolist()}}


def _check_pose(pose: Pose) -> None:
    if pose.position.shape != (3,) or np.abs(pose.position).max() > FARTHEST:
        raise ValueError(f"'position' is not 3 numbers of at most {FARTHEST:g}")
    if pose.rotation.shape != (3, 3) or not is_rotation(pose.rotation):
        raise ValueError("'rotation' is not a rotation matrix")
    for name, (low, high) in (("fov_degrees", FOV_LIMITS), ("span", SPAN_LIMITS)):
        value = getattr(pose, name)
        if value is not None and not low <= value <= high:
            raise ValueError(f"'{name}' is {value:g}; expected {low:g} to {high:g}")


# Camera paths: {"langsplat_flight": 1, "keyframes": [{"seconds": rising from 0, and a pose}]}

PATHS = ".path.json"  # that ours have
PATH_MARK, PATH_VERSION = "langsplat_flight", 1
MOST_KEYFRAMES = 10_000


def read_flight(path: Path | str) -> Flight:
    """Read the path in a file. Raises InputError and FormatError, in one line."""

    def decode(top: Any) -> Flight:
        if not isinstance(top, dict) or PATH_MARK not in top:
            raise ValueError(f'expected an object with "{PATH_MARK}": {PATH_VERSION}')
        _check_version(Path(path), "camera path", top[PATH_MARK], PATH_VERSION)
        entries = top.get("keyframes")
        if not isinstance(entries, list) or not 1 <= len(entries) <= MOST_KEYFRAMES:
            raise ValueError(f"'keyframes' is not a list of 1 to {MOST_KEYFRAMES}")
        keyframes = _converted([_nested(entry) for entry in entries], tuple[Keyframe, ...])
        _check_keyframes(keyframes)
        return Flight(keyframes)

    return _read(Path(path), "camera path", decode)


def _check_keyframes(keyframes: tuple[Keyframe, ...]) -> None:
    before = -1.0
    for index, key in enumerate(keyframes):
        _check_pose(key.pose)
        if not 0 <= key.seconds <= LONGEST:
            raise ValueError(f"keyframe {index}: 'seconds' is {key.seconds:g}; expected 0 to {LONGEST:g}")
        if key.seconds - before < SAME_TIME:
            raise ValueError(f"keyframe {index}: 'seconds' is not later than that of the keyframe before")
        before = key.seconds


def write_flight(path: Path | str, flight: Flight) -> None:
    """Write `flight`, whole or not at all."""
    keyframes = [_flat(plain(key)) for key in flight.keyframes]
    _write(Path(path), {PATH_MARK: PATH_VERSION, "keyframes": keyframes})


# Projects: a scene and its session.
#
# {"format": "langsplat-project", "version": 2,
#  "scene": "room.ply",     from the project's folder, or absolute
#  "gaussians": 81288,      that it has; of another number marks, moves and names are not taken
#  "origin": [x, y, z],     of the scene, to which all places are relative; absent: zero
#  "view": {...},           as a bookmark, and "intrinsics"
#  "panels": ["Search"],    that are open
#  "session": {...}}        the fields of `Session`. Masks are a bit for each Gaussian, zlib, base64

PROJECTS = ".langsplat"  # suffix of project files
FORMAT, VERSION = "langsplat-project", 2
NOT_COMPARED = "canonical phrases of one's own are left out: this version has none"
NO_GROUPS = "groups and locks of the outline are left out: this version has none"
Count = Annotated[int, Meta(ge=0, le=1_000_000_000)]


class Project(msgspec.Struct, omit_defaults=True):
    """The content of a project file."""

    scene: Annotated[str, Meta(pattern=r"\A[^\0]+\Z", max_length=4096)]
    gaussians: Count
    view: Bookmark
    session: Session
    intrinsics: Intrinsics | None = None  # of the view, where the field of view does not say all
    panels: Annotated[tuple[str, ...], Meta(max_length=100)] = ()
    origin: Point = (0.0, 0.0, 0.0)
    version: int = VERSION
    left_out: tuple[str, ...] = ()  # of a project of an earlier version, a line each


def _folder_of(path: Path) -> Path:  # of a symbolic link its target's, which may also be opened itself
    return Path(os.path.realpath(path) if os.path.islink(path) else os.path.abspath(path)).parent


def digest_of(path: Path) -> str:
    """Return a digest of a file's content; "" where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""


def write_project(
    path: Path, project: Project, apart: Callable[[], Path], known: str = ""
) -> tuple[str, Path | None]:
    """Write a project, whole or not at all; return its `digest_of`, and where what was there is kept.

    known: the digest as it was last read or written here. What another window has written since then is kept
    under the name that `apart` gives, asked while no other window writes; else nothing is kept, None.
    """
    own = {"version": VERSION, "left_out": ()}
    project = msgspec.structs.replace(project, session=checked(project.session), **own)
    folder, scene = _folder_of(path), Path(project.scene)
    named = scene.relative_to(folder).as_posix() if scene.is_relative_to(folder) else str(scene)
    kept = None
    with locked(folder):
        if digest_of(path) not in ("", known):
            kept = apart()
            write_whole(kept, path.read_bytes())
        _write(path, {"format": FORMAT, "version": VERSION, **plain(project), "scene": named})
        return digest_of(path), kept


def read_project(path: Path) -> Project:
    """Read a project. Raises InputError and FormatError, in one line."""

    def decode(top: Any) -> Project:
        if not isinstance(top, dict) or top.get("format") != FORMAT:
            raise ValueError(f'"format" is not "{FORMAT}"')
        _check_version(path, "project", top.get("version"), 1, VERSION)
        if top["version"] == 1:
            try:
                top = _from_version_1(top)
            except (AttributeError, LookupError, TypeError) as error:  # it checks nothing
                raise ValueError(repr(error)) from None
        count = _converted(top.get("gaussians"), Count)
        project: Project = _converted(top, Project, count)
        _check_pose(project.view.pose)
        if project.intrinsics is not None:
            _check_pose(replace(project.view.pose, fov_degrees=project.intrinsics.fov_degrees))
        project.session = checked(project.session)
        things = top["session"].get("things", {})
        groups = things.get("groups") or things.get("locked")
        found = {NO_GROUPS: groups, NOT_COMPARED: top["session"].get("canonical")}
        project.left_out = tuple(reason for reason, there in found.items() if there)
        project.scene = os.path.abspath(_folder_of(path) / project.scene)
        return project

    return _read(path, "project", decode)


def checked(session: Session) -> Session:
    """Return a session as a file has it, names and notes on one line.

    ValueError, or InputError, where something is wrong in it that its types do not say.
    """
    check_settings(session.picture)
    scale = session.picture.heat_scale
    if scale is not None and scale[0] >= scale[1]:
        raise ValueError("a heat scale that ends before it begins")
    if session.clip.near > session.clip.far:
        raise ValueError("a near cut beyond the far one")
    _check_keyframes(session.keyframes)
    for bookmark in session.bookmarks:
        _check_pose(bookmark.pose)
    things = session.things
    return replace(
        session,
        moves=tuple(map(_rigid, session.moves)),
        things=Things(
            {node: _line(name) for node, name in things.names.items()},
            {_line(name): bits for name, bits in things.given.items()},
        ),
        notes=tuple(replace(note, text=_line(note.text)) for note in session.notes),
        bookmarks=tuple(replace(mark, name=_line(mark.name)) for mark in session.bookmarks),
    )


def _line(text: str) -> str:
    return printable_line(text, LONGEST_NOTE)


def _rigid(move: Move) -> Move:
    """Return a move whose matrix is a similarity; itself where it is one, as it was written."""
    matrix = move.to.matrix
    exact = similarity(matrix)
    alike = np.allclose(exact.matrix, matrix, 1e-12, 1e-12 * move.to.scale)
    return move if alike else replace(move, to=exact)


def _from_version_1(top: dict[str, Any]) -> dict[str, Any]:
    asked = top["queries"]["queries"]
    free = iter([*range(SLOTS), *[None] * len(asked)])
    queries = [
        {
            "phrase": query["phrase"],
            "cut": query.get("cut"),
            "slot": next(free) if query.get("shown", True) else None,
            "shown_since": number,
        }
        for number, query in enumerate(asked)
    ]
    session = {
        "picture": top["look"],
        "latent_level": top["level"],
        "clip": {name: depth for name, depth in top["cuts"].items() if depth is not None},
        "queries": queries,
        "level": top["queries"].get("level", "auto"),
        "canonical": top["queries"].get("canonical"),
        "chosen": asked[-1]["phrase"] if asked else "",
        "keyframes": [_nested(key) for key in top["keyframes"]],
        "bookmarks": [_nested(bookmark) for bookmark in top["bookmarks"]],
        "notes": top["notes"],
        "ruler": {"points": top["ruler"]},
        "marks": top["marks"],
        "moves": [{"to": plain(similarity(move["matrix"])), "of": move["of"]} for move in top["moves"]],
        "things": {**top["things"], "names": dict(top["things"]["names"])},
    }
    return {**top, "view": _nested(top["view"]), "session": session}


# Preferences, and where they are kept.

BUNDLED = Path(str(files("langsplat_assets") / "demo" / "scene.ply"))
FILE_NAME, LAYOUT_NAME = "preferences.json", "layout.ini"


def thumbnail_of(folder: Path | None, path: Path) -> Path | None:
    """Return the file with the thumbnail of a scene or project; None where nothing is kept."""
    if path == BUNDLED:
        return path.with_suffix(".jpg")
    name = hashlib.sha256(os.fsencode(path.absolute())).hexdigest()[:24]
    return None if folder is None else folder / "thumbnails" / f"{name}.jpg"


def load_preferences(folder: Path, at_first: Preferences | None = None) -> Preferences:
    """Read the preferences in `folder`, `at_first` or the defaults where there are none.

    InputError where the file makes no sense.
    """
    path = folder / FILE_NAME
    try:
        return msgspec.json.decode(path.read_bytes()[:1_000_000], type=Preferences)
    except FileNotFoundError:
        return at_first or Preferences()
    except (OSError, ValueError, RecursionError) as error:
        reason = printable_line(getattr(error, "strerror", None) or error, 120)
        raise InputError(f"{path}: {reason}; the defaults are used; mend or delete it") from None


def save_preferences(folder: Path, preferences: Preferences, before: Preferences | None = None) -> None:
    """Write the preferences, whole or not at all. OSError where the folder cannot be written.

    before: as they were read; what is the same since then stays as another window has written it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        if before is not None:
            pairs = ((entry.name, getattr(preferences, entry.name)) for entry in fields(preferences))
            changed = {name: value for name, value in pairs if value != getattr(before, name)}
            with suppress(InputError):  # a file that makes no sense is written anew
                there = load_preferences(folder, preferences)
                if "recent" in changed:
                    new = [path for path in preferences.recent if path not in before.recent]
                    latest = new or preferences.recent[:1]
                    recent = dict.fromkeys((*latest, *there.recent, *preferences.recent))
                    changed["recent"] = tuple(recent)[:MOST_RECENT]
                preferences = replace(there, **changed)
        write_whole(folder / FILE_NAME, msgspec.json.format(msgspec.json.encode(preferences), indent=1))
