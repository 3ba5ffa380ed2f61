"""The session: what is shown, asked, selected, edited, named and bookmarked in a scene; and the preferences.

Undo goes back to earlier sessions, a scene that was left is found again by its session, and project files
hold one. So a field that is added to `Session` is undone and saved, and one of `Preferences` outlives the
window. The bounds beside the types hold for files and widgets; what has a title gets its widget in the panel
that is named with it.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from msgspec import Meta

from langsplat_core.arrays import Array
from langsplat_core.config import ColourMap, LevelChoice, PictureConfig
from langsplat_core.display.displays import DISPLAYS, MAX_QUERIES
from langsplat_core.scene import FARTHEST, LEVELS, Scene
from langsplat_core.scene.language import phrase_key
from langsplat_core.scene.transform import Similarity, between_worlds, transform_scene
from langsplat_viewer.camera.flight import Keyframe, Pose
from langsplat_viewer.marks import Marks
from langsplat_viewer.rendering.request import Clip, Splats, Split, widget

SLOTS = MAX_QUERIES  # queries shown at a time: one colour each
LONGEST_NAME, LONGEST_NOTE = 80, 500  # characters
MOST_BOOKMARKS, MOST_NOTES = 50, 1000

Coordinate = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]  # world units
Point = tuple[Coordinate, Coordinate, Coordinate]


def point_of(position: Array) -> Point:
    """Return a (3,) position as plain numbers."""
    x, y, z = position.tolist()
    return x, y, z


Phrase = Annotated[str, Meta(pattern=r"\S", max_length=1000)]
Name = Annotated[str, Meta(pattern=r"\S", max_length=LONGEST_NOTE)]
Node = Annotated[int, Meta(ge=0, lt=2**31)]  # of the scene's tree
Level = Annotated[int, Meta(ge=0, lt=len(LEVELS))]  # index into LEVELS
Overlay = Literal["things", "cameras", "cube", "grid"]
OVERLAYS: tuple[Overlay, ...] = get_args(Overlay)


# Marks and transforms. Of masks a session keeps bits, an eighth of their size: histories hold a hundred.


class Bits:
    """Booleans, one for each of `count` Gaussians, packed into bytes."""

    def __init__(self, count: int, packed: bytes) -> None:
        self.count, self.packed = count, packed

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Bits) and (self.count, self.packed) == (other.count, other.packed)

    def __hash__(self) -> int:
        return hash((self.count, self.packed))

    @property
    def mask(self) -> Array:
        """The Booleans unpacked: (count,) bool."""
        return np.unpackbits(np.frombuffer(self.packed, np.uint8), count=self.count).astype(bool)


def pack(mask: Array) -> Bits | None:
    """Return the bits of an (N,) mask; None where nothing is set."""
    return Bits(len(mask), np.packbits(mask).tobytes()) if mask.any() else None


@dataclass(frozen=True)
class MarkBits:
    """The masks of `Marks` as a session keeps them; None: nothing is marked."""

    selected: Bits | None = None
    hidden: Bits | None = None
    deleted: Bits | None = None

    def of(self, marks: Marks) -> "MarkBits":
        """Return the bits of `marks`; those of this object where they are the same: histories share them."""
        pairs = ((getattr(self, name), pack(getattr(marks, name))) for name in MASKS)
        return MarkBits(*(old if old == new else new for old, new in pairs))

    def masks(self, count: int) -> Marks:
        """Unpack these bits into masks, (count,) bool each."""
        return Marks(*(unpacked(getattr(self, name), count) for name in MASKS))


MASKS = ("selected", "hidden", "deleted")


@lru_cache(len(MASKS))  # the same mask for the same bits: nothing is drawn anew for it
def unpacked(bits: Bits | None, count: int) -> Array:
    """Return (count,) bool, of which none is set for None."""
    return np.zeros(count, bool) if bits is None else bits.mask


@dataclass(frozen=True, eq=False)
class Move:
    """A transform of the whole scene with its cameras (`of` is None), or of some of its Gaussians."""

    to: Similarity
    of: Bits | None = None

    def applied(self, scene: Scene) -> Scene:
        """Return the scene with it. Raises InputError where it leads too far."""
        return transform_scene(scene, self.to, None if self.of is None else self.of.mask)

    def then(self, other: "Move") -> "Move":
        """Return both as one, where they are of the same Gaussians."""
        return replace(self, to=self.to.then(other.to))


# Queries, names, notes and views.


@dataclass(frozen=True)
class Query:
    """One line of the query list."""

    phrase: Phrase
    cut: Annotated[float, Meta(ge=0, le=1)] | None = None  # relevancy from which on it answers, by hand
    slot: Annotated[int, Meta(ge=0, lt=SLOTS)] | None = None  # index of its colour while shown, None: hidden
    shown_since: int = 0  # larger for a query shown later


@dataclass(frozen=True)
class Note:
    """A text pinned to a place of the scene."""

    text: Annotated[str, Meta(max_length=LONGEST_NOTE)]
    at: Point


@dataclass(frozen=True)
class Things:
    """Names that a user gave to nodes of the scene's tree, and to Gaussians."""

    names: Mapping[Node, Name] = field(default_factory=dict)
    given: Mapping[Name, Bits] = field(default_factory=dict)  # what a taught name was given to

    def known(self, count: int) -> "Things":
        """Return those of the first `count` nodes, and of Gaussians."""
        return replace(self, names={node: name for node, name in self.names.items() if node < count})

    def named(self, phrase: str) -> Array | None:
        """Return (N,) bool of what was given a name; None where the phrase is none."""
        key = phrase_key(phrase)
        return next((bits.mask for name, bits in self.given.items() if phrase_key(name) == key), None)


@dataclass(frozen=True)
class Ruler:
    """A distance between two points on the surface."""

    measures: bool = False  # a click on the scene sets a point
    points: Annotated[tuple[Point, ...], Meta(max_length=2)] = ()

    @property
    def length(self) -> float | None:
        """World units; None before there are two points."""
        return math.dist(*self.points) if len(self.points) > 1 else None


@dataclass(frozen=True, eq=False)
class Bookmark:
    """A view to return to."""

    name: Annotated[str, Meta(pattern=r"\S", max_length=LONGEST_NAME)]
    pose: Pose
    distance: Annotated[float, Meta(gt=0, le=FARTHEST)]  # to what it turns around, world units

    def moved(self, offset: Array) -> "Bookmark":
        return replace(self, pose=self.pose.moved(offset))


@dataclass(frozen=True)
class Session:
    """State of a scene that the user set: it is undone, kept with the scene and saved in projects."""

    # how it is shown
    picture: PictureConfig = field(default_factory=PictureConfig)
    latent_level: Level = 2  # whose latents and nodes are shown
    split: Split = field(default_factory=Split)
    splats: Splats = field(default_factory=Splats)
    clip: Clip = field(default_factory=Clip)
    overlays: tuple[Overlay, ...] = ()  # what lies over the scene

    # what was asked
    queries: Annotated[tuple[Query, ...], Meta(max_length=200)] = ()  # in the order of asking
    chosen: str = ""  # the phrase whose details are shown
    level: LevelChoice = "auto"
    adds: bool = False  # a new answer is shown beside those that are, not in their place

    # what was selected, edited, named and noted
    marks: MarkBits = field(default_factory=MarkBits)
    moves: Annotated[tuple[Move, ...], Meta(max_length=100)] = ()  # transforms since the scene was opened
    things: Things = field(default_factory=Things)
    notes: Annotated[tuple[Note, ...], Meta(max_length=MOST_NOTES)] = ()

    # views
    keyframes: Annotated[tuple[Keyframe, ...], Meta(max_length=10_000)] = ()  # of the camera path, by time
    bookmarks: Annotated[tuple[Bookmark, ...], Meta(max_length=MOST_BOOKMARKS)] = ()
    ruler: Ruler = field(default_factory=Ruler)

    def moved(self, offset: Array) -> "Session":
        """Return the session of the same scene about an origin that lies `offset` (3,) lower."""
        if not offset.any():
            return self
        return replace(
            self,
            moves=tuple(replace(move, to=between_worlds(move.to, offset, offset)) for move in self.moves),
            notes=tuple(replace(note, at=point_of(np.add(note.at, offset))) for note in self.notes),
            keyframes=tuple(key.moved(offset) for key in self.keyframes),
            bookmarks=tuple(bookmark.moved(offset) for bookmark in self.bookmarks),
            ruler=replace(self.ruler, points=tuple(point_of(np.add(at, offset)) for at in self.ruler.points)),
        )

    def query(self, phrase: str) -> Query | None:
        """Return the query of a phrase, None where it is not listed."""
        return next((query for query in self.queries if query.phrase == phrase), None)

    def in_order_of_showing(self) -> list[Query]:
        """Return the queries that have a colour, the one shown longest first."""
        return sorted((q for q in self.queries if q.slot is not None), key=lambda query: query.shown_since)

    def with_query(self, phrase: str, **values: object) -> "Session":
        """Return the session with other values of the query of a phrase."""
        changed = (replace(q, **values) if q.phrase == phrase else q for q in self.queries)  # type: ignore[arg-type]
        return replace(self, queries=tuple(changed))

    def showing(self, phrase: str) -> "Session":
        """Return the session with a query shown, in the first free colour, else that of the longest shown."""
        shown = self.in_order_of_showing()
        if any(query.phrase == phrase for query in shown):
            return self
        free = [slot for slot in range(SLOTS) if slot not in {query.slot for query in shown}]
        slot = free[0] if free else shown[0].slot
        session = self if free else self.with_query(shown[0].phrase, slot=None)
        return session.with_query(
            phrase, slot=slot, shown_since=1 + max((q.shown_since for q in shown), default=0)
        )

    def without(self, phrases: Collection[str]) -> "Session":
        """Return the session without some queries; for the chosen one the latest is chosen, and shown."""
        left = tuple(query for query in self.queries if query.phrase not in phrases)
        if self.chosen not in phrases:
            return replace(self, queries=left)
        session = replace(self, queries=left, chosen=left[-1].phrase if left else "")
        return session if session.in_order_of_showing() else session.showing(session.chosen)

    def answering(self, phrase: str, painted: bool, beside: Collection[str]) -> "Session":
        """Return the session with a display of answers, and a query shown where something is painted.

        What was shown before goes, unless it `adds`; `beside`: the phrases that were asked together.
        """
        kept = (q if self.adds or q.phrase in beside else replace(q, slot=None) for q in self.queries)
        session = replace(self, queries=tuple(kept))
        session = session.showing(phrase) if painted else session
        if DISPLAYS[self.picture.display].needs_query:
            return session
        return replace(session, picture=replace(self.picture, display="relevancy"))

    def undone(self, now: "Session") -> "Session":
        """Return this earlier session with what is never undone as it is `now`."""
        return replace(self, ruler=now.ruler if now.moves == self.moves else replace(now.ruler, points=()))

    def of_next_scene(self) -> "Session":
        """Return the session that another scene begins with: settings of the window stay."""
        return Session(**{name: getattr(self, name) for name in OF_WINDOW})

    def found_again(self, now: "Session") -> "Session":
        """Return the session of a scene that is shown again.

        Settings of the window are as `now`; what was selected, hidden, deleted and moved was saved or
        discarded when it was left.
        """
        kept: dict[str, Any] = {name: getattr(now, name) for name in OF_WINDOW}
        kept |= {"picture": replace(now.picture, display=self.picture.display)}
        return replace(self, **kept | {"latent_level": self.latent_level}, marks=MarkBits(), moves=())


# What led from a session to the next, for undo to name it.

CHANGES = {  # fields of a session -> words
    "moves": "transform", "things": "name", "notes": "note", "bookmarks": "bookmark", "keyframes": "keyframe",
    "picture": "display", "latent_level": "display", "split": "comparison", "splats": "splats",
    "clip": "near and far cut", "overlays": "overlay", "level": "level of the search", "adds": "new answers",
    "queries": "answers shown",
}  # fmt: skip
MARKINGS = {"deleted": ("delete", "restore"), "hidden": ("hide", "show"), "selected": ("select", "deselect")}


def change_between(before: Session, after: Session) -> str:
    """Return the change from one session to the next, in words."""
    for name, verbs in MARKINGS.items():
        old, new = (getattr(session.marks, name) for session in (before, after))
        if old != new:
            more = sum(sign * int(bits.mask.sum()) for sign, bits in ((-1, old), (1, new)) if bits)
            return f"{verbs[more < 0]} {abs(more):,} Gaussians" if more else f"{verbs[0]} others"
    asked, listed = ([query.phrase for query in session.queries] for session in (before, after))
    for verb, phrases in (
        ("search", [phrase for phrase in listed if phrase not in asked]),
        ("remove", [phrase for phrase in asked if phrase not in listed]),
    ):
        if phrases:
            return f"{verb} '{phrases[0]}'" + f" and {len(phrases) - 1} more" * (len(phrases) > 1)
    changed = (words for name, words in CHANGES.items() if getattr(before, name) != getattr(after, name))
    return next(changed, "change")


OF_PROJECT = ("things", "notes", "bookmarks", "keyframes")  # fields that are lost unless a project holds them
OF_WINDOW = ("picture", "latent_level", "split", "splats", "overlays", "level", "adds")  # not of a scene


# Preferences, kept in the platform's folder for settings.

SCALES = (0.75, 3.0)  # least and largest size of letters and widgets
MOST_RECENT = 12


@dataclass(frozen=True)
class Preferences:
    """The settings that outlive a window."""

    theme: Literal["dark", "light"] = "dark"
    ui_scale: Annotated[float, Meta(ge=SCALES[0], le=SCALES[1])] = 1.0  # of letters and widgets
    recent: tuple[str, ...] = ()  # scenes that were opened, the latest first
    panels: tuple[str, ...] | None = None  # titles of those that are open; None: those that are at first
    colour_map: ColourMap = PictureConfig.colour_map  # that a session begins with
    overlays: tuple[str, ...] = ()  # that a session begins with
    fly_speed: Annotated[float, widget("Camera", "Fly speed", "Scene radii per second", 0.05, 4)] = 0.5
    coarse_while_moving: Annotated[
        bool, widget("Camera", "Coarse while moving", "Where drawing is slow: fewer pixels, merged Gaussians")
    ] = True
    undocked: tuple[str, ...] = ()  # titles of sections of the inspector that are windows of their own

    def with_recent(self, path: Path) -> "Preferences":
        """Return the preferences with `path` as what was opened last."""
        others = (other for other in self.recent if other != str(path))
        return replace(self, recent=(str(path), *others)[:MOST_RECENT])
