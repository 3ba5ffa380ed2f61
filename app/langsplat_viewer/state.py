"""The viewer's state: plain data that actions change, and that panels and the canvas read."""

import math
import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from statistics import median
from typing import Any, Literal, get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice, PictureConfig, TrainPreset
from langsplat_core.display.displays import MAX_QUERIES
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.describe import Outline, Pointed, Suggestions
from langsplat_core.query.instances import Instance
from langsplat_core.scene import Camera, Scene
from langsplat_core.scene.tree import Tree
from langsplat_viewer.camera.controls import Extent, OrbitCamera
from langsplat_viewer.camera.flight import Flight, Keyframe
from langsplat_viewer.files.disk import Listing, Photograph
from langsplat_viewer.files.preferences import Preferences
from langsplat_viewer.files.projects import Bookmark, Note, Things
from langsplat_viewer.marks import Move, Selection
from langsplat_viewer.rendering.request import (
    UNCLIPPED,
    Clip,
    EditedScene,
    Pane,
    RenderRequest,
    Splats,
    Split,
    edited_scene,
    panes,
)

# View settings and the ruler.


@dataclass(frozen=True)
class ViewSettings:
    """View settings of the scene, apart from display and camera; undone together."""

    split: Split = field(default_factory=Split)
    splats: Splats = field(default_factory=Splats)
    clip: Clip = UNCLIPPED
    transparent: bool = False  # images are saved without a background
    fade: float = 0.0  # how much of the photograph of a training camera lies over the image, 0 to 1


Overlay = Literal["things", "cameras", "cube", "grid"]
OVERLAYS: tuple[Overlay, ...] = get_args(Overlay)
Point = tuple[float, float, float]  # world units


@dataclass(frozen=True)
class Ruler:
    """A distance between two points on the surface."""

    measures: bool = False  # a click on the scene sets a point
    points: tuple[Point, ...] = ()  # at most two

    @property
    def length(self) -> float | None:
        """World units; None before there are two points."""
        return math.dist(*self.points) if len(self.points) > 1 else None

    def with_point(self, point: Point) -> "Ruler":
        """Set the second point, or the first of a new measurement."""
        return replace(self, points=(*self.points, point) if len(self.points) == 1 else (point,))


# Times of the steps of drawing: the panel "Timing".

KEPT = 31  # measurements of which the median is told
STEPS = {  # names of laps, and what they are called; in the order of the panel
    "projection": "Projection",
    "sort": "Sort",
    "tiles": "Tiles",
    "colours": "Colours",
    "blend": "Blend",
    "upload": "Upload",
    "compose": "Compose",
    "picture": "Picture, all of it",
    "panels": "Panels",
    "search": "Search",
}


@dataclass(eq=False)
class Timing:
    """A part of the viewer's state."""

    wanted: bool = False  # this frame is measured: the panel is seen
    laps: dict[str, deque[float]] = field(default_factory=dict)  # milliseconds by the names of STEPS

    def add(self, name: str, milliseconds: float) -> None:
        self.laps.setdefault(name, deque(maxlen=KEPT)).append(milliseconds)

    def medians(self) -> list[tuple[str, float]]:
        """Return the steps measured, in words, and the median of its last measurements in milliseconds."""
        return [(title, median(self.laps[name])) for name, title in STEPS.items() if self.laps.get(name)]


def memory_bytes() -> int | None:
    """Bytes that this process holds in memory; None where the system does not tell."""
    try:
        resident = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return None
    return int(resident) * os.sysconf("SC_PAGE_SIZE")


# Camera path and film: the panel "Record".

SPACING = 2.0  # seconds from the last keyframe to one that is added
TURN_SECONDS = 8.0
FPS_CHOICES = (10.0, 24.0, 25.0, 30.0, 60.0)


@dataclass(eq=False)
class Recording:
    """A part of the viewer's state."""

    keyframes: tuple[Keyframe, ...] = ()  # in the order of time
    chosen: Keyframe | None = None  # in the list
    at: float = 0.0  # seconds: where on the path the view is
    began: float | None = None  # when `at` was 0, seconds on the window's clock; None while nothing is played
    loops: bool = False
    turns: bool = False  # once around in place of the keyframes
    turn_seconds: float = TURN_SECONDS
    turn_from: OrbitCamera | None = None  # where the turn that is played began
    size: tuple[int, int] = (1280, 720)  # of films, and of images that are no screenshots, pixels
    fps: float = 30.0
    film_typed: str = ""  # where the film goes; empty: a new name
    path_typed: str = ""  # a file with a path
    clipboard: str = ""  # put there at the next frame


@lru_cache(maxsize=2)
def flight_of(keyframes: tuple[Keyframe, ...]) -> Flight:
    """The path through them; its curve is computed once for many frames of a window."""
    return Flight(keyframes)


# The state as one dataclass.

SLOTS = MAX_QUERIES  # queries shown at a time: one colour each
MAX_MESSAGES = 50
GLIDE_SECONDS = 0.35


@dataclass(eq=False)
class Query:
    """One line of the query list."""

    phrase: str
    slot: int | None = None  # index of its colour while shown, None while hidden
    shown_since: int = 0  # larger for a query shown later
    result: QueryResult | None = None  # as it is shown
    automatic: QueryResult | None = None  # the same where it ends by itself
    things: tuple[Instance, ...] = ()  # what it found, one by one, where it ends by itself
    cut: float | None = None  # relevancy at which it ends instead
    reading: str = ""  # how the phrase was understood, where it has structure
    asked_for: tuple[str, ...] = ()  # its words without what that is related to, see `grammar.heads`
    problem: str = ""  # why it has no result, one line
    meant: str = ""  # the phrase with its unknown words replaced by known ones, where there are such
    pending: bool = True


@dataclass(frozen=True, eq=False)
class EvidenceSheet:
    """The photographs and masks that an answer stands on."""

    phrase: str
    image: Array  # (H, W, 3) uint8, row 0 on top


@dataclass(frozen=True)
class FolderChoice:
    """A folder that the file browser asks for."""

    title: str  # of the browser
    then: Callable[[Any, Path], None]  # is given the Viewer and the folder that was taken


@dataclass(frozen=True, eq=False)
class OutlineView:
    """The scene's tree in words, as the panel "Outline" lists it."""

    roots: tuple[Outline, ...] = ()
    tree: Tree | None = None
    sizes: Array = field(default_factory=lambda: np.zeros(0, np.int64))  # (K,) Gaussians of every node
    problem: str = ""  # why there is none, or none yet
    colours: dict[tuple[str, int, int], Point] = field(default_factory=dict)  # by display, level and node

    @cached_property
    def _rows(self) -> dict[int, Outline]:
        found, waiting = {}, list(self.roots)
        while waiting:
            row = waiting.pop()
            found[row.node] = row
            waiting += row.parts
        return found

    def row(self, node: int) -> Outline | None:
        return self._rows.get(node)


@dataclass(frozen=True)
class Message:
    """One line of the messages area."""

    text: str
    is_error: bool = False


@dataclass(frozen=True, eq=False)
class Glide:
    """A camera move under way."""

    start: OrbitCamera
    end: OrbitCamera
    began: float  # seconds, on the window's clock


@dataclass(frozen=True)
class FrameStats:
    """Size and time of the image on screen."""

    milliseconds: float = 0.0
    width: int = 0  # pixels
    height: int = 0
    scale: float = 1.0  # of the window's resolution, below 1 while the camera moves on a slow machine
    merged: bool = False  # drawn from fewer, merged Gaussians, then, too


@dataclass(eq=False)
class Hover:
    """The mouse over the scene, while it and the camera rest."""

    pixel: tuple[int, int]  # column and row in the scene's area
    view: OrbitCamera
    since: float  # seconds, on the window's clock
    asked: bool = False
    found: Pointed | None = None
    phrases: tuple[str, ...] = ()  # whose relevancies it has


@dataclass(frozen=True)
class TrainingForm:
    """Fields of the panel that trains scenes."""

    dataset: str = ""
    out: str = ""
    preset: TrainPreset = "good"
    encoder: str = "demo"


Gizmo = Literal["off", "move", "rotate", "scale", "box"]


@dataclass(frozen=True)
class EditForm:
    """Fields of the panel that transforms and crops."""

    gizmo: Gizmo = "off"
    move: Point = (0.0, 0.0, 0.0)
    rotate: Point = (0.0, 0.0, 0.0)  # degrees about x, then y, then z
    scale: float = 1.0
    low: Point = (-1.0, -1.0, -1.0)  # two opposite corners of the box that is cropped to
    high: Point = (1.0, 1.0, 1.0)
    clips: bool = False  # what lies outside it is hidden
    clipped: tuple[Point, Point] | None = None  # the box that it was last done for


@dataclass(eq=False)
class SceneState:
    """The part of the state that begins anew with every scene."""

    scene: Scene | None = None
    opened: Scene | None = None  # as its file has it, once something was transformed
    moving: tuple[Move, Scene] | None = None  # what a gizmo that is held does, and what is seen of it
    path: Path | None = None
    extent: Extent | None = None  # there whenever a scene is
    doubts: tuple[str, ...] = ()  # quality warnings of its training, with the remedies
    nothing: str = ""  # why the image shows nothing of the scene, where it does not

    view: OrbitCamera | None = None
    glide: Glide | None = None
    opening_camera: Camera | None = None  # what R returns to, where that is not the scene's own choice
    camera_index: int | None = None  # training camera last jumped to
    photograph: Photograph | None = None  # that was looked for last
    bookmarks: tuple[Bookmark, ...] = ()
    bookmark_typed: str = ""
    record: Recording = field(default_factory=Recording)
    hover: Hover | None = None
    ruler: Ruler = field(default_factory=Ruler)
    notes: tuple[Note, ...] = ()
    fresh_note: Note | None = None  # just pinned, to be written now
    kept: tuple[Things, tuple[Note, ...]] = Things(), ()  # things and notes as a project has them
    project: Path | None = None  # the file that all this is saved to again
    selection: Selection = field(default_factory=Selection)

    outline: OutlineView | None = None  # once it was wanted
    things: Things = field(default_factory=Things)
    queries: list[Query] = field(default_factory=list)
    selected: Query | None = None  # whose details are shown
    evidence: EvidenceSheet | None = None  # in a window of its own, while that is open
    canonical: tuple[str, ...] = ()  # phrases that everything is compared with; none: the scene's own
    canonical_typed: str = ""
    suggestions: Suggestions = field(default_factory=Suggestions)
    suggestions_of: Scene | None = None  # the scene for which they were looked for
    _edited: EditedScene | None = None  # of the last request

    @property
    def has_field(self) -> bool:
        """True where a scene with a language field is open."""
        return self.scene is not None and self.scene.language is not None

    @property
    def lacks_field(self) -> bool:
        """True where a scene without one is open."""
        return self.scene is not None and self.scene.language is None


@dataclass(eq=False)
class ViewerState(SceneState):
    """The viewer without its window."""

    scenes: tuple[Path, ...] = ()  # to switch between, absolute
    opening: Path | None = None  # the file being read, until it is open or has failed

    picture: PictureConfig = field(default_factory=PictureConfig)
    latent_level: int = 2  # index into scene.LEVELS
    settings: ViewSettings = field(default_factory=ViewSettings)
    level: LevelChoice = "auto"
    pins_notes: bool = False  # a click on the scene pins one
    pointing: bool = False  # it is said what lies under the cursor
    fly_speed: float = 0.5  # scene radii per second
    walks: bool = False  # the keys fly level, as one walks
    coarse_while_moving: bool = True

    typed: str = ""
    asked: list[str] = field(default_factory=list)  # what was searched for, the oldest first
    recalled: int = 0  # index into `asked` of the phrase last recalled; its length: none
    focus_input: bool = False  # the query box takes the keyboard at the next frame
    awaits_keyboard: bool = False  # keys wait until a box has it

    training_form: TrainingForm = field(default_factory=TrainingForm)
    edit_form: EditForm = field(default_factory=EditForm)
    path_typed: str = ""
    outline_typed: str = ""  # what its rows are filtered by
    messages: list[Message] = field(default_factory=list)
    timing: Timing = field(default_factory=Timing)
    stats: FrameStats = field(default_factory=FrameStats)
    backend: str = ""
    size: tuple[int, int] = (1, 1)  # pixels of the scene's area
    wanted_panel: str = ""  # the title of one that is opened and brought to the front at the next frame
    show_panel: bool = True  # the panels, as many as are open
    show_help: bool = False
    show_palette: bool = False
    resets_panels: bool = False  # at the next frame
    shows_panels: tuple[str, ...] = ()  # titles of those that alone are open from now on; (): as they are
    palette_typed: str = ""
    browser: Listing | None = None  # the folder that the file browser shows, while it is open
    picks_folder: FolderChoice | None = None  # that it is open for; None: a scene
    picks_beside: bool = False  # it chooses a scene to be shown beside this one
    extension_panels: dict[str, Any] = field(default_factory=dict)  # title -> what an extension's panel keeps
    preferences: Preferences = field(default_factory=Preferences)
    letters_muted: bool = False  # letters are no keys: they were meant for a box that cannot be typed in

    def begin(self, fresh: SceneState) -> None:
        """Show another scene: all that belongs to the one before is gone."""
        for part in fields(SceneState):
            setattr(self, part.name, getattr(fresh, part.name))

    @property
    def has_unsaved_notes(self) -> bool:
        """True where no project has the notes, names, groups and locks that there are."""
        return (self.things, self.notes) != self.kept

    def say(self, text: str, is_error: bool = False) -> None:
        """Add one line to the messages area."""
        message = Message(" ".join(text.split()), is_error)
        if not self.messages or self.messages[-1] != message:
            self.messages = [*self.messages[1 - MAX_MESSAGES :], message]

    def in_order_of_showing(self) -> list[Query]:
        """Queries that have a colour, the one shown longest first."""
        return sorted((q for q in self.queries if q.slot is not None), key=lambda q: q.shown_since)

    def shown(self) -> list[Query | None]:
        """Answered queries by slot, as many as the highest slot in use."""
        by_slot = {q.slot: q for q in self.queries if q.slot is not None and q.result is not None}
        return [by_slot.get(slot) for slot in range(max(by_slot, default=-1) + 1)]

    def shown_results(self) -> tuple[QueryResult | None, ...]:
        return tuple(None if query is None else query.result for query in self.shown())

    def panes(self) -> tuple[Pane, ...]:
        """Displays in the scene's area, from left to right."""
        return panes(self.picture, self.latent_level, self.shown_results(), self.settings.split)

    def request(self, size: tuple[int, int] | None = None, transparent: bool = False) -> RenderRequest:
        """The image that the scene's area shows, or the same of another size (width, height) in pixels."""
        assert self.scene is not None
        assert self.view is not None
        settings = self.settings
        size = size or self.size
        seen = self.scene if self.moving is None else self.moving[1]
        self._edited = edited_scene(seen, self.selection.marks, self._edited)
        return RenderRequest(
            self._edited,
            self.view.camera(*settings.split.pane_size(size)),
            size[0],
            replace(self.picture, transparent=transparent),
            self.latent_level,
            self.shown_results(),
            settings.split,
            settings.splats,
            settings.clip,
        )
