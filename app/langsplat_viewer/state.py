"""The viewer's state: the session, what follows from it, and what the window shows beside the scene."""

import sys
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

from langsplat_core.arrays import Array
from langsplat_core.config import TrainPreset
from langsplat_core.query.answers import QueryResult, recut
from langsplat_core.query.describe import Pointed
from langsplat_core.query.engine import QueryEngine, no_field
from langsplat_core.query.instances import Instance
from langsplat_core.query.inventory import Outline, Suggestions
from langsplat_core.scene import NO_ORIGIN, Camera, Scene
from langsplat_core.scene.language import Tree
from langsplat_viewer.camera.controls import Extent, OrbitCamera
from langsplat_viewer.camera.flight import Flight, Keyframe
from langsplat_viewer.marks import Marks, Mode, Stroke, Tool, hidden_nodes, middle_of
from langsplat_viewer.rendering.request import EditedScene, Pane, RenderRequest, edited_scene, panes, widget
from langsplat_viewer.session import OF_PROJECT, MarkBits, Move, Note, Point, Preferences, Query, Session

# Camera path and film: the panel "Record".

SPACING = 2.0  # seconds from the last keyframe to one that is added


@dataclass(eq=False)
class Recording:
    """Settings with which the camera path is played and filmed."""

    chosen: Keyframe | None = None  # in the list
    at: float = 0.0  # seconds: where on the path the view is
    began: float | None = None  # when `at` was 0, seconds on the window's clock; None while nothing is played
    loops: bool = False
    size: tuple[int, int] = (1280, 720)  # of films, and of images that are no screenshots, pixels
    fps: float = 30.0
    film_file: str = ""  # where the film goes; empty: a new name
    thumbnails: dict[Keyframe, Array] = field(default_factory=dict)  # (H, W, 3) uint8, see viewpoint


@lru_cache(maxsize=2)
def flight_of(keyframes: tuple[Keyframe, ...]) -> Flight:
    """Return the path through them; its curve is computed once for many frames of a window."""
    return Flight(keyframes)


# Parts of the state.

MAX_MESSAGES = 50
GLIDE_SECONDS = 0.35


@dataclass(frozen=True, eq=False)
class QueryAnswer:
    """The answer to a query, or the reason why there is none; neither while it is pending."""

    result: QueryResult | None = None  # with the threshold of its own
    things: tuple[Instance, ...] = ()  # the instances found, with that threshold
    reading: str = ""  # how the phrase was understood, where it has structure
    asked_for: tuple[str, ...] = ()  # its words without what that is related to, see `grammar.heads`
    problem: str = ""  # why it has no result, one line
    meant: str = ""  # the phrase with its unknown words replaced by known ones, where there are such
    pending: bool = False
    has_evidence: bool = False  # training kept its evidence
    like: QueryResult | None = None  # of a name that finds what was given it: all that is like that
    with_cut: Callable[[QueryResult, float], QueryResult] = field(default_factory=lambda: lru_cache(1)(recut))

    def at(self, cut: float | None) -> QueryResult | None:
        """Return the result with another threshold; with its own one for None."""
        return self.result if cut is None or self.result is None else self.with_cut(self.result, cut)


@dataclass(frozen=True)
class Tools:
    """Settings of selecting with the mouse."""

    tool: Tool | None = None  # what a drag in the scene does; None: it turns the camera
    mode: Mode = "replace"
    brush: float = 0.03  # radius, of the image's height, within BRUSHES
    reach: float = 0.05  # how far growing goes, and how large a sphere of one click is; of the scene's radius
    only_visible: bool = True  # rectangle, lasso and brush leave out what lies behind something
    stroke: Stroke | None = None


@dataclass(frozen=True, eq=False)
class Leaving:
    """An action that waits for the answer whether edits are to be saved, or for a film."""

    then: Callable[[Any], None]  # takes the `Viewer`
    to: str  # what it does, in words: "the window closes"
    film: bool = False  # it is done as soon as the recorder is


@dataclass(frozen=True, eq=False)
class FileChoice:
    """A file or folder that a dialog asks for."""

    title: str
    then: Callable[[Any, Path], object]  # what is done with it in a `Viewer`
    kind: Literal["open", "save", "folder"] = "open"
    suffixes: tuple[str, ...] = ()  # of files to save; those to open may be all that can be
    start: Path = Path()  # the folder that is shown first, and in it the name of a file to save


@dataclass(frozen=True, eq=False)
class OutlineView:
    """The scene's tree in words, as the panel "Outline" lists it."""

    roots: tuple[Outline, ...] = ()
    tree: Tree | None = None
    problem: str = ""  # why there is none, or none yet
    colours: dict[tuple[str, int, int], Point] = field(default_factory=dict)  # by display, level and node
    hidden: Callable[[Tree, Marks], Array] = field(default_factory=lambda: lru_cache(1)(hidden_nodes))


@dataclass(frozen=True)
class Message:
    """One line of the messages area, said over the scene first."""

    text: str
    is_error: bool = False
    file: Path | None = None  # that was written
    undoes: Session | None = field(default=None, compare=False)  # that an undo right now returns to


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
    depths: tuple[float, float] | None = None  # camera z drawn as near and as far, where depth is shown


@dataclass(eq=False)
class Hover:
    """The mouse over the scene, while it and the camera rest."""

    pixel: tuple[int, int]  # column and row in the scene's area
    view: OrbitCamera
    since: float  # seconds, on the window's clock
    asked: bool = False
    found: Pointed | None = None
    phrases: tuple[str, ...] = ()  # whose relevancies it has


in_train = partial(widget, "Train")


@dataclass(frozen=True)
class TrainingForm:
    """Fields of the panel that trains scenes."""

    dataset: Annotated[str, in_train("Photographs", "a folder, a COLMAP project, transforms.json")] = ""
    # of the scene that gets a language field
    gaussians: Annotated[str, in_train("Gaussians", "a trained scene; empty: they are trained, too")] = ""
    out: Annotated[str, in_train("Scene", "scene.ply")] = ""
    encoder: Annotated[str, in_train("Encoder", '"demo", or a folder or hub id of CLIP')] = "demo"
    preset: TrainPreset = "good"


@dataclass(frozen=True)
class ExportForm:
    """Fields of the dialog that exports."""

    title: str  # of what is written, see `actions.saving.EXPORTS`
    suffix: str  # of the file, "" for a folder
    values: Mapping[str, float] = field(default_factory=dict)  # of options of the command line, True where on
    only_selected: bool = False


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


# The state as one dataclass.


@dataclass(frozen=True, eq=False)
class OpenScene:
    """The scene that is shown, and the view of it."""

    path: Path
    scene: Scene  # transformed as the session says
    in_file: Scene  # as its file has it
    extent: Extent  # of `scene`
    view: OrbitCamera
    opening_camera: Camera | None = None  # what R returns to, where that is not the scene's own choice
    warnings: tuple[str, ...] = ()  # quality warnings of its training, with the remedies


@dataclass(frozen=True, eq=False)
class Saved:
    """The session as its files hold it."""

    session: Session = field(default_factory=Session)  # as a project or an exported scene last had it
    project: Path | None = None  # the file that it is saved to again
    digest: str = ""  # of what that held when it was last read or written here

    def lacks_notes(self, session: Session) -> bool:
        """Return whether no project has the names, notes, bookmarks and keyframes of `session`."""
        held = (self.session,) if self.project else (self.session, Session())  # nothing needs no project
        return any(all(getattr(session, n) != getattr(one, n) for one in held) for n in OF_PROJECT)


@dataclass(eq=False)
class Visit:
    """A scene that was left, without large arrays."""

    path: Path
    view: OrbitCamera
    opening_camera: Camera | None
    camera_index: int | None
    count: int  # Gaussians
    origin: Array  # (3,) of the scene
    session: Session
    saved: Saved


@dataclass(eq=False)
class SceneState:
    """The part of the state that begins anew with every scene."""

    session: Session = field(default_factory=Session)
    saved: Saved = field(default_factory=Saved)
    open: OpenScene | None = None
    nothing: str = ""  # why the image shows nothing of the scene, where it does not
    answers: dict[str, QueryAnswer] = field(default_factory=dict)  # by phrase

    glide: Glide | None = None
    camera_index: int | None = None  # training camera last jumped to
    moving: tuple[Move, Scene] | None = None  # what a gizmo that is held does, and what is seen of it
    record: Recording = field(default_factory=Recording)
    hover: Hover | None = None
    fresh_note: Note | None = None  # just pinned, to be written now
    outline: OutlineView | None = None  # once it was wanted
    uncovered: tuple[Instance, ...] = ()  # found last, and the view has moved aside for them or need not
    evidence: tuple[str, Array] | None = None  # a phrase, and what its answer stands on: (H, W, 3) uint8
    suggestions: Suggestions = field(default_factory=Suggestions)
    offered: tuple[str, tuple[str, tuple[str, ...]]] = ("", ("", ()))  # what was typed, and its offers
    suggestions_of: QueryEngine | None = None  # of the scene that they were looked for in
    # Functions that keep their last result, as long as the scene is open.
    middle: Callable[[Scene, Marks], Array | None] = field(default_factory=lambda: lru_cache(1)(middle_of))
    masks_of: Callable[[MarkBits, int], Marks] = field(default_factory=lambda: lru_cache(1)(MarkBits.masks))
    _edited: EditedScene | None = None  # of the last request

    def visit(self, seen: OpenScene) -> Visit:
        """Return what is kept of the open scene."""
        stand = seen.path, seen.view, seen.opening_camera, self.camera_index
        return Visit(*stand, self.count, self.origin, self.session, self.saved)

    def look(self, view: OrbitCamera) -> None:
        """Set the view of the open scene."""
        if self.open is not None:
            self.open = replace(self.open, view=view)

    @property
    def path(self) -> Path | None:
        """File of the open scene."""
        return None if self.open is None else self.open.path

    @property
    def count(self) -> int:
        """Gaussians of the open scene, 0 without one."""
        return 0 if self.open is None else len(self.open.scene.gaussians)

    @property
    def origin(self) -> Array:
        """(3,) of the open scene."""
        return NO_ORIGIN if self.open is None else self.open.scene.origin

    @property
    def marks(self) -> Marks:
        """Return the session's marks as masks, the same objects for the same marks."""
        return self.masks_of(self.session.marks, self.count)

    @property
    def has_field(self) -> bool:
        """True where a scene with a language field is open."""
        return self.open is not None and self.open.scene.language is not None

    @property
    def why_no_field(self) -> str:
        """Why the open scene cannot be searched; "" where it can, and without one."""
        return "" if self.open is None or self.has_field else no_field(self.open.scene)

    @property
    def is_unsaved(self) -> bool:
        """True where something was deleted or transformed since the scene was opened or saved."""
        deleted, saved = self.session.marks.deleted, self.saved.session
        return self.session.moves != saved.moves or (deleted is not None and deleted != saved.marks.deleted)

    @property
    def is_changed(self) -> bool:
        """True where something of the scene would be lost if the window closed."""
        return self.is_unsaved or self.saved.lacks_notes(self.session)


@dataclass(eq=False)
class ViewerState(SceneState):
    """The viewer without its window."""

    scenes: tuple[Path, ...] = ()  # to switch between, absolute
    opening: Path | None = None  # the file being read, until it is open or has failed

    tools: Tools = field(default_factory=Tools)
    leaving: Leaving | None = None
    writing: Future[Any] | None = None  # what was last written, or is being written
    may_close: bool = False  # the window closes at the next frame
    pins_notes: bool = False  # a click on the scene pins one
    pointing: bool = False  # a tooltip names the point under the cursor

    asked: list[str] = field(default_factory=list)  # what was searched for, the oldest first
    recalled: int = 0  # index into `asked` of the phrase last recalled; its length: none
    focus_input: bool = False  # the query box takes the keyboard at the next frame
    focus_name: bool = False  # that for a name of what is selected does
    awaits_keyboard: bool = False  # keys wait until a box has it
    has_escape: bool = False  # a menu, a dialog or a text box does, which Esc leaves before the tool
    letters_muted: bool = False  # letters are no keys: they were meant for a box that is not there

    training_form: TrainingForm = field(default_factory=TrainingForm)
    edit_form: EditForm = field(default_factory=EditForm)
    export_form: ExportForm | None = None  # while the dialog is open
    drafts: dict[str, str] = field(default_factory=dict)  # half-typed texts of the panels, by their boxes
    messages: list[Message] = field(default_factory=list)
    echoes: bool = False  # what is said is said in the terminal, too: the process is to end
    stats: FrameStats = field(default_factory=FrameStats)
    backend: str = ""
    size: tuple[int, int] = (1, 1)  # pixels of the scene's area
    wanted_panel: str = ""  # the title of one that is opened and brought to the front at the next frame
    show_panel: bool = True  # the panels, as many as are open
    show_help: bool = False
    show_start: bool = False  # the start page, in place of panels and scene
    show_palette: bool = False
    resets_panels: bool = False  # at the next frame
    unfolds: bool = False  # the search, once the three levels are left
    choice: FileChoice | None = None  # what a dialog asks for, while one is open
    extension_panels: dict[str, Any] = field(default_factory=dict)  # title -> what an extension's panel keeps
    preferences: Preferences = field(default_factory=Preferences)

    def begin(self, fresh: SceneState) -> None:
        """Replace the scene's part of the state by `fresh`."""
        for part in fields(SceneState):
            setattr(self, part.name, getattr(fresh, part.name))

    def say(
        self, text: str, is_error: bool = False, file: Path | None = None, undoes: Session | None = None
    ) -> None:
        """Add one line to the messages area, replacing the last one if that says the same."""
        message = Message(" ".join(text.split()), is_error, file, undoes)
        kept = self.messages[:-1] if self.messages[-1:] == [message] else self.messages
        self.messages = [*kept[1 - MAX_MESSAGES :], message]
        if self.echoes:
            print(message.text, file=sys.stderr)

    def answer(self, query: Query) -> QueryAnswer:
        return self.answers.get(query.phrase, QueryAnswer(pending=True))

    def result(self, query: Query) -> QueryResult | None:
        """Return the result of a query with its threshold, None without one."""
        return self.answer(query).at(query.cut)

    def shown(self) -> list[Query | None]:
        """Return the answered queries by slot, as many as the highest slot in use."""
        queries = self.session.queries
        by_slot = {q.slot: q for q in queries if q.slot is not None and self.answer(q).result is not None}
        return [by_slot.get(slot) for slot in range(max(by_slot, default=-1) + 1)]

    def shown_results(self) -> tuple[QueryResult | None, ...]:
        return tuple(None if query is None else self.result(query) for query in self.shown())

    def panes(self) -> tuple[Pane, ...]:
        """Return the displays in the scene's area, from left to right."""
        session = self.session
        return panes(session.picture, session.latent_level, self.shown_results(), session.split)

    def request(self, size: tuple[int, int] | None = None, transparent: bool = False) -> RenderRequest:
        """Return the image that the scene's area shows, or the same of another (width, height) in pixels."""
        assert self.open is not None
        session, size = self.session, size or self.size
        scene = self.open.scene if self.moving is None else self.moving[1]
        self._edited = edited_scene(scene, self.marks, self._edited)
        return RenderRequest(
            self._edited,
            self.open.view.camera(*session.split.pane_size(size)),
            size[0],
            replace(session.picture, transparent=transparent),
            session.latent_level,
            self.shown_results(),
            session.split,
            session.splats,
            session.clip,
        )
