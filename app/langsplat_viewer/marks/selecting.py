"""Which Gaussians of the scene are selected, hidden and deleted, and the tool that selects with the mouse.

The scene itself is never changed: deleting marks, and what is marked is left out of pictures and of what is
saved. So everything can be undone, and an answer's numbers per Gaussian keep their places.
"""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.query.instances import Instance

Tool = Literal["thing", "rectangle", "lasso", "brush", "sphere", "box"]
Mode = Literal["replace", "add", "remove", "intersect"]
TOOLS: tuple[Tool, ...] = get_args(Tool)
MODES: tuple[Mode, ...] = get_args(Mode)
BRUSHES = (0.005, 0.25)  # least and largest radius of the brush, of the picture's height
REACHES = (0.001, 1.0)  # least and largest reach, scene radii


@dataclass(frozen=True, eq=False)
class Marks:
    """What is marked among a scene's N Gaussians. Nothing that is hidden or deleted is selected."""

    selected: Array  # (N,) bool
    hidden: Array  # (N,) bool: in no picture until it is shown again
    deleted: Array  # (N,) bool: in no picture, and in nothing that is saved

    @property
    def shown(self) -> Array:
        """(N,) bool: neither hidden nor deleted."""
        return ~(self.hidden | self.deleted)

    @property
    def kept(self) -> Array:
        """(N,) bool: not deleted."""
        return ~self.deleted

    def same(self, other: "Marks") -> bool:
        """Whether the same are marked in both."""
        return all(
            a is b or np.array_equal(a, b)
            for a, b in (
                (self.selected, other.selected),
                (self.hidden, other.hidden),
                (self.deleted, other.deleted),
            )
        )


def unmarked(count: int) -> Marks:
    """Of a scene that was just opened."""
    nothing = np.zeros(count, bool)
    return Marks(nothing, nothing, nothing)


def combined(marks: Marks, found: Array, mode: Mode) -> Marks:
    """Marks with the selection replaced by `found` (N,) bool, or combined with it; of what is shown."""
    match mode:
        case "add":
            selected = marks.selected | found
        case "remove":
            selected = marks.selected & ~found
        case "intersect":
            selected = marks.selected & found
        case _:
            selected = found
    return replace(marks, selected=selected & marks.shown)


def hiding(marks: Marks) -> Marks:
    """With the selection hidden, and nothing selected."""
    return Marks(np.zeros_like(marks.selected), marks.hidden | marks.selected, marks.deleted)


def isolating(marks: Marks) -> Marks:
    """With everything else hidden."""
    return replace(marks, hidden=~marks.selected & marks.kept)


def showing_all(marks: Marks) -> Marks:
    """With nothing hidden."""
    return replace(marks, hidden=np.zeros_like(marks.hidden))


def deleting(marks: Marks) -> Marks:
    """With the selection deleted, and nothing selected."""
    return Marks(np.zeros_like(marks.selected), marks.hidden, marks.deleted | marks.selected)


@dataclass(frozen=True)
class Stroke:
    """What is being drawn with the mouse. Places are fractions of the picture, (0, 0) its top left corner."""

    path: tuple[tuple[float, float], ...]  # where the mouse was, one place or more
    centre: tuple[float, float, float] | None = None  # of a sphere or box: on the surface, world units


@dataclass(frozen=True, eq=False)
class Things:
    """The instances of an answer, to be selected one by one."""

    phrase: str
    result: Any  # the `QueryResult` whose they are
    found: tuple[Instance, ...]  # best first


@dataclass(frozen=True, eq=False)
class Leaving:
    """What waits for an answer to whether deletions are to be saved."""

    then: Callable[[Any], None]  # takes the `Viewer`
    to: str  # what it does, in words: "the window closes"


@dataclass(frozen=True, eq=False)
class Selection:
    """All there is to know about selecting; replaced as a whole at every change."""

    marks: Marks = field(default_factory=lambda: unmarked(0))
    saved: Array | None = None  # (N,) what was deleted when the scene was last saved; None: not yet
    tool: Tool | None = None  # what a drag in the scene does; None: it turns the camera
    mode: Mode = "replace"
    brush: float = 0.03  # radius, of the picture's height, within BRUSHES
    reach: float = 0.05  # how far growing goes, and how large a sphere of one click is; of the scene's radius
    only_visible: bool = True  # rectangle, lasso and brush leave out what lies behind something
    stroke: Stroke | None = None
    things: Things | None = None
    leaving: Leaving | None = None
    writing: Future[Any] | None = None  # what was last written, or is being written
    may_close: bool = False  # the window closes at the next frame

    @property
    def is_unsaved(self) -> bool:
        """Whether something was deleted since the scene was opened or saved."""
        deleted = self.marks.deleted
        return bool(deleted.any()) and (self.saved is None or not np.array_equal(deleted, self.saved))


def of_scene(selection: Selection, count: int) -> Selection:
    """For another scene, of `count` Gaussians: the tool and its settings stay."""
    return replace(selection, marks=unmarked(count), saved=None, stroke=None, things=None, leaving=None)
