"""Files that a user saves, as JSON: camera paths, bookmarks, query sets and projects."""

import base64
import binascii
import json
import math
import os
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice, PictureConfig, check_settings
from langsplat_core.display.displays import COLOUR_MAPS, DISPLAYS
from langsplat_core.errors import FormatError, InputError, printable_line, quoted
from langsplat_core.io.cameras import is_rotation, numbers
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import read_json_file
from langsplat_core.scene import FARTHEST, LEVELS
from langsplat_core.scene.transform import similarity
from langsplat_viewer.camera.flight import FOV_LIMITS, LONGEST, SAME_TIME, SPAN_LIMITS, Flight, Keyframe, Pose
from langsplat_viewer.marks import Move, PackedMarks
from langsplat_viewer.rendering.request import Clip

# Camera paths.
#
# {"langsplat_flight": 1,
#  "keyframes": [{"seconds": 0.0,             rising, 0 to 36000
#                 "position": [x, y, z],      world units
#                 "rotation": [[...], ...],   camera to world, three rows; OpenCV axes, as in cameras.json
#                 "fov_degrees": 50.0,        across the image's shorter side
#                 "span": 4.0}]}              world units across it; where it is, there is no perspective

PATHS = ".path.json"  # that ours have
PATH_MARK, PATH_VERSION = "langsplat_flight", 1
PATH_SIZE_LIMIT = 16 * 1024 * 1024  # bytes
MOST_KEYFRAMES = 10_000


def read_flight(path: Path | str) -> Flight:
    """Read the path in a file. Raises InputError and FormatError, in one line."""
    path = Path(path)
    top = read_json_file(path, PATH_SIZE_LIMIT)
    if not isinstance(top, dict) or PATH_MARK not in top:
        raise FormatError(f'{path}: no camera path; expected an object with "{PATH_MARK}": {PATH_VERSION}')
    if top[PATH_MARK] != PATH_VERSION or isinstance(top[PATH_MARK], bool):
        raise FormatError(
            f"{path}: a camera path of version {quoted(top[PATH_MARK], 20)}; this program reads 1"
        )
    return Flight(keyframes_from(top.get("keyframes"), str(path)))


def keyframes_from(entries: Any, path: str) -> tuple[Keyframe, ...]:
    """The keyframes that `keyframe_entries` wrote; FormatError, that begins with `path`, for none."""
    if not isinstance(entries, list) or not 1 <= len(entries) <= MOST_KEYFRAMES:
        raise FormatError(
            f"{path}: 'keyframes' is not a list of 1 to {MOST_KEYFRAMES} keyframes; record the path again"
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
        text = f'{{"{PATH_MARK}": {PATH_VERSION}, "keyframes": [\n{lines}\n]}}\n'
        temporary.write_text(text, encoding="utf-8")


def keyframe_entries(keyframes: Sequence[Keyframe]) -> list[dict[str, Any]]:
    return [{"seconds": key.seconds, **pose_entry(key.pose)} for key in keyframes]


def pose_entry(pose: Pose) -> dict[str, Any]:
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

BOOKMARKS = "bookmarks.json"
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
        return (self.folder or Path()) / BOOKMARKS

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
    return {"name": bookmark.name, **pose_entry(bookmark.pose), "distance": float(bookmark.distance)}


def bookmark_from(entry: Any, what: str) -> Bookmark:
    """The view that `bookmark_entry` wrote; FormatError, beginning with `what`, where there is none."""
    pose = pose_from(entry, what)
    name, distance = entry.get("name"), float(numbers(entry, "distance", (), what))
    if not isinstance(name, str) or not (distance > 0 and math.isfinite(distance)):
        raise FormatError(f"{what}: without a name, or a distance above 0; mend or delete the file")
    return Bookmark(named(name), pose, distance)


# Query sets.

QUERIES = ".queries.json"
QUERY_FORMAT = "langsplat-queries"
QUERY_SIZE_LIMIT = 1_000_000  # bytes of a file
MOST_QUERIES = 200  # queries of a set
LONGEST_PHRASE = 1000  # characters of a phrase
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
    return {"format": QUERY_FORMAT, "version": 1, **asdict(queries)}


def read_queries(path: Path) -> QuerySet:
    """Read a set. InputError where the file cannot be read or is none."""
    try:
        with open(path, "rb") as file:
            top = json.loads(file.read(QUERY_SIZE_LIMIT))
        return checked_queries(top)
    except (OSError, ValueError, RecursionError) as error:
        reason = printable_line(getattr(error, "strerror", None) or error, 100)
        raise InputError(f"{path}: no set of queries ({reason}); save one anew") from None


def checked_queries(top: Any) -> QuerySet:
    """The set that `query_entries` wrote. ValueError for what breaks a rule of the layout."""
    if (
        not isinstance(top, dict)
        or top.get("format") != QUERY_FORMAT
        or not isinstance(top.get("queries"), list)
    ):
        raise ValueError(f'"format" is not "{QUERY_FORMAT}"')
    canonical, level = top.get("canonical", []), top.get("level", "auto")
    if (
        not isinstance(canonical, list)
        or not all(map(_is_phrase, canonical))
        or len(canonical) > MOST_QUERIES
    ):
        raise ValueError('"canonical" is not a list of phrases')
    if level not in LEVEL_CHOICES:
        raise ValueError('"level" is none of ' + ", ".join(LEVEL_CHOICES))
    if len(top["queries"]) > MOST_QUERIES:
        raise ValueError(f"more than {MOST_QUERIES} queries")
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
    return isinstance(text, str) and len(text.strip()) > 0 and len(text) <= LONGEST_PHRASE


# Projects: a scene with what was asked, seen, noted and selected in it.
#
# {"format": "langsplat-project", "version": 1,
#  "scene": "room.ply",            from the project's folder, or absolute
#  "gaussians": 81288,             that it has; of another number marks and moves are not taken
#  "view": {...}, "bookmarks": [{"name", "distance", and what a pose of a camera path has}],
#  "keyframes": [...],             as in a camera path
#  "look": {...}, "level": 2,      fields of `config.PictureConfig`; level whose latents are shown
#  "cuts": {"near", "far"},        depths; far null: none is too far
#  "queries": {...},               as in a query set
#  "notes": [{"text", "at": [x, y, z]}], "ruler": [[x, y, z], ...],
#  "marks": {"selected", "hidden", "deleted"},   a bit for each Gaussian, zlib, base64; null: none
#  "moves": [{"matrix", "of"}],    4 x 4, in this order; of: as in marks, null: everything with the cameras
#  "panels": ["Search", ...],      that are open
#  "things": {"names": [[node, name]], "groups": [{"name", "nodes"}], "locked": [nodes]}, of the scene's tree
#  "answers": [...]}               of the queries, for other programs; it is not read

PROJECTS = ".langsplat"  # suffix of project files
FORMAT, VERSION = "langsplat-project", 1
SIZE_LIMIT = 64 * 1024 * 1024  # bytes
MOST_NOTES, LONGEST_NOTE, MOST_MOVES, MOST_PANELS = 1000, 500, 100, 100
MOST_THINGS = 100_000
MARKS = ("selected", "hidden", "deleted")
LOOKS = ("display", "heat_opacity", "colour_map", "dim", "background", "heat_scale")
Place = tuple[float, float, float]  # world units


@dataclass(frozen=True)
class Note:
    """A text pinned to a place of the scene."""

    text: str
    at: Place


@dataclass(frozen=True)
class Group:
    """Things that belong together."""

    name: str
    nodes: tuple[int, ...]  # of the scene's tree


@dataclass(frozen=True)
class Things:
    """Names, groups and locks that a user gave to nodes of the scene's tree."""

    names: Mapping[int, str] = field(default_factory=dict)
    groups: tuple[Group, ...] = ()
    locked: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class Project:
    """The content of a project file."""

    scene: Path  # absolute
    count: int  # Gaussians
    view: Bookmark
    picture: PictureConfig
    latent_level: int  # index into scene.LEVELS
    clip: Clip
    queries: QuerySet
    keyframes: tuple[Keyframe, ...]
    bookmarks: tuple[Bookmark, ...]
    notes: tuple[Note, ...]
    ruler: tuple[Place, ...]  # at most two
    marks: PackedMarks
    moves: tuple[Move, ...]
    panels: tuple[str, ...]
    things: Things


def write_project(path: Path, project: Project, answers: list[dict[str, Any]]) -> None:
    """Write a project, whole or not at all."""
    folder, look = path.absolute().parent, asdict(project.picture)
    beside = project.scene.is_relative_to(folder)
    far = None if math.isinf(project.clip.far) else project.clip.far
    content = {
        "format": FORMAT,
        "version": VERSION,
        "scene": project.scene.relative_to(folder).as_posix() if beside else str(project.scene),
        "gaussians": project.count,
        "view": bookmark_entry(project.view),
        "look": {name: look[name] for name in LOOKS},
        "level": project.latent_level,
        "cuts": {"near": project.clip.near, "far": far},
        "queries": query_entries(project.queries),
        "keyframes": keyframe_entries(project.keyframes),
        "bookmarks": [bookmark_entry(bookmark) for bookmark in project.bookmarks],
        "notes": [asdict(note) for note in project.notes],
        "ruler": project.ruler,
        "marks": dict(zip(MARKS, map(_text, project.marks.masks), strict=True)),
        "moves": [{"matrix": m.to.matrix.tolist(), "of": _text(m.packed)} for m in project.moves],
        "panels": project.panels,
        "things": {
            "names": [[node, name] for node, name in project.things.names.items()],
            "groups": [asdict(group) for group in project.things.groups],
            "locked": sorted(project.things.locked),
        },
        "answers": answers,
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, ensure_ascii=False), encoding="utf-8")


def read_project(path: Path) -> Project:
    """Read a project. Raises InputError and FormatError, in one line."""
    top = read_json_file(path, SIZE_LIMIT)
    if not isinstance(top, dict) or top.get("format") != FORMAT:
        raise FormatError(f'{path}: no project; "format" is not "{FORMAT}"')
    if top.get("version") != VERSION or isinstance(top.get("version"), bool):
        raise FormatError(f"{path}: a project of another version; this program reads {VERSION}")
    try:
        return _project(top, path)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        what = printable_line(f"{type(error).__name__} {error}", 80)
        raise FormatError(f"{path}: not laid out as a project ({what}); save it anew") from None


def _project(top: dict[str, Any], path: Path) -> Project:
    scene, count = top["scene"], top["gaussians"]
    if not isinstance(scene, str) or not scene or "\0" in scene:
        raise ValueError('"scene" is no path')
    if not isinstance(count, int) or isinstance(count, bool) or not 0 <= count <= 1_000_000_000:
        raise ValueError('"gaussians" is no number of them')
    if top["level"] not in range(len(LEVELS)):
        raise ValueError('"level" is no index of a level')
    panels = _list(top["panels"], MOST_PANELS)
    if not all(isinstance(title, str) for title in panels):
        raise ValueError('"panels" are no titles')
    moves = _list(top["moves"], MOST_MOVES)
    return Project(
        scene=Path(os.path.abspath(path.parent / scene)),
        count=count,
        view=bookmark_from(top["view"], f"{path}: view"),
        picture=_look(top["look"]),
        latent_level=int(top["level"]),
        clip=_clip(top["cuts"], f"{path}: cuts"),
        queries=checked_queries(top["queries"]),
        keyframes=keyframes_from(top["keyframes"], str(path)) if top["keyframes"] else (),
        bookmarks=tuple(
            bookmark_from(entry, f"{path}: bookmark") for entry in _list(top["bookmarks"], MOST_VIEWS)
        ),
        notes=tuple(_note(entry, f"{path}: note") for entry in _list(top["notes"], MOST_NOTES)),
        ruler=tuple(_place({"at": point}, f"{path}: ruler") for point in _list(top["ruler"], 2)),
        marks=PackedMarks(count, tuple(_bits(top["marks"][name], count) for name in MARKS)),
        moves=tuple(
            Move(
                similarity(numbers(move, "matrix", (4, 4), f"{path}: move")), _bits(move["of"], count), count
            )
            for move in moves
        ),
        panels=tuple(panels),
        things=_things(top["things"]),
    )


def _things(entry: Any) -> Things:
    names = [(_node(node), _name(name)) for node, name in _list(entry["names"], MOST_THINGS)]
    groups = [
        Group(_name(group["name"]), tuple(map(_node, _list(group["nodes"], MOST_THINGS))))
        for group in _list(entry["groups"], MOST_THINGS)
    ]
    if not all(group.nodes for group in groups) or len({group.name for group in groups}) < len(groups):
        raise ValueError("groups without things, or of one name")
    return Things(dict(names), tuple(groups), frozenset(map(_node, _list(entry["locked"], MOST_THINGS))))


def known_things(things: Things, count: int) -> Things:
    """Return things without what speaks of other nodes than the first `count`."""
    groups = (replace(g, nodes=tuple(n for n in dict.fromkeys(g.nodes) if n < count)) for g in things.groups)
    return Things(
        {node: name for node, name in things.names.items() if node < count},
        tuple(group for group in groups if group.nodes),
        frozenset(node for node in things.locked if node < count),
    )


def _node(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**31:
        raise ValueError("no node of a tree")
    return value


def _name(value: Any) -> str:
    if not isinstance(value, str) or not printable_line(value, LONGEST_NOTE):
        raise ValueError("no name")
    return printable_line(value, LONGEST_NOTE)


def _list(value: Any, most: int) -> list[Any]:
    if not isinstance(value, list) or len(value) > most:
        raise ValueError(f"no list of at most {most}")
    return value


def _look(entry: Any) -> PictureConfig:
    look = {name: entry[name] for name in LOOKS}
    look["background"] = tuple(_list(look["background"], 3))
    scale = look["heat_scale"]
    look["heat_scale"] = None if scale is None else tuple(_list(scale, 2))
    picture = PictureConfig(**look)
    check_settings(picture)
    known = picture.display in DISPLAYS and picture.colour_map in COLOUR_MAPS
    scale = picture.heat_scale
    if not known or len(picture.background) != 3 or (scale and not (len(scale) == 2 and scale[0] < scale[1])):
        raise ValueError('"look" is not a way to look at a scene')
    return replace(picture, own_colours=False)


def _clip(entry: Any, what: str) -> Clip:
    near = float(numbers(entry, "near", (), what))
    far = math.inf if entry["far"] is None else float(numbers(entry, "far", (), what))
    if not 0 <= near <= far:
        raise FormatError(f"{what}: expected 0 <= near <= far")
    return Clip(near, far)


def _note(entry: Any, what: str) -> Note:
    text = printable_line(entry["text"], LONGEST_NOTE) if isinstance(entry["text"], str) else ""
    return Note(text, _place(entry, what))


def _place(entry: Any, what: str) -> Place:
    point = numbers(entry, "at", (3,), what)
    if np.abs(point).max() > FARTHEST:
        raise FormatError(f"{what}: farther than {FARTHEST:g} units from the origin")
    return float(point[0]), float(point[1]), float(point[2])


def _text(bits: Array | None) -> str | None:
    return None if bits is None else base64.b64encode(zlib.compress(bits.tobytes())).decode()


def _bits(text: Any, count: int) -> Array | None:
    """The bits of `count` Gaussians that `_text` wrote. ValueError for others."""
    if text is None:
        return None
    size = (count + 7) // 8
    try:
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(base64.b64decode(text, validate=True), size + 1)  # never more: a bomb
    except (zlib.error, binascii.Error) as error:
        raise ValueError(f"marks that cannot be read ({error})") from None
    if len(content) != size:
        raise ValueError("marks of another number of Gaussians")
    return np.frombuffer(content, np.uint8)


def scene_of(project: Project) -> Path:
    """Return the path of a project's scene. InputError where no file is there any more."""
    if not project.scene.exists():
        raise InputError(f"{project.scene}: the project's scene is not there; move it back, or mend its path")
    return project.scene
