"""Project files, `*.langsplat`: a scene with what was asked, seen, noted and selected in it, as JSON.

{"format": "langsplat-project", "version": 1,
 "scene": "room.ply",            from the project's folder, or absolute
 "gaussians": 81288,             that it has; of another number marks and moves are not taken
 "view": {...}, "bookmarks": [{"name", "distance", and what a pose of a camera path has}],
 "keyframes": [...],             as in a camera path
 "look": {...}, "level": 2,      fields of `config.PictureConfig`; index of the level whose latents are shown
 "cuts": {"near", "far"},        depths; far null: none is too far
 "queries": {...},               as in a query set
 "notes": [{"text", "at": [x, y, z]}], "ruler": [[x, y, z], ...],
 "marks": {"selected", "hidden", "deleted"},   a bit for each Gaussian, zlib, base64; null: none
 "moves": [{"matrix", "of"}],    4 x 4, in this order; of: as in marks, null: everything with the cameras
 "panels": ["Search", ...],      that are open
 "things": {"names": [[node, name]], "groups": [{"name", "nodes"}], "locked": [nodes]},   of the scene's tree
 "answers": [...]}               of the queries, for other programs; it is not read
"""

import base64
import binascii
import json
import math
import os
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig, check_settings
from langsplat_core.display.displays import COLOUR_MAPS, DISPLAYS
from langsplat_core.errors import FormatError, InputError, printable_line
from langsplat_core.io.cameras import numbers
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import read_json_file
from langsplat_core.scene import FARTHEST, LEVELS
from langsplat_core.scene.transform import similarity
from langsplat_viewer.camera.flight import Keyframe
from langsplat_viewer.files.browsing import QuerySet, checked_queries, query_entries
from langsplat_viewer.files.flights import (
    MOST_VIEWS,
    Bookmark,
    bookmark_entry,
    bookmark_from,
    keyframe_entries,
    keyframes_from,
)
from langsplat_viewer.marks import Move, PackedMarks
from langsplat_viewer.rendering.depth import Clip

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
    """Packed bits as text."""
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
