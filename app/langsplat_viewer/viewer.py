"""The viewer without its window: its state, what it needs from elsewhere, a training in a process of its own,
and the history of what can be undone."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Protocol, TypeVar

from langsplat_core.arrays import Array
from langsplat_core.config import Display, LevelChoice, PictureConfig, TrainPreset
from langsplat_core.errors import LangSplatError, printable_line
from langsplat_core.progress import ALL_STAGES, Progress, Report
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import LoadEncoder, QueryEngine
from langsplat_core.scene import Camera, Scene
from langsplat_core.semantics.encoders import DEMO
from langsplat_viewer.camera.controls import OrbitCamera
from langsplat_viewer.camera.flight import Keyframe
from langsplat_viewer.files.disk import Stamps, Watch
from langsplat_viewer.files.projects import Note, Shelf, Things
from langsplat_viewer.jobs import Job, Worker, one_line
from langsplat_viewer.marks import Histogram, Marks, Move, PackedMarks, Pair, pack
from langsplat_viewer.rendering.request import Clip, RenderRequest
from langsplat_viewer.state import OutlineView, Query, Ruler, ViewerState, ViewSettings

PREVIEW_EVERY = 100  # steps between the checkpoints that can be looked at
KEPT = 20  # lines of what it says that are kept


@dataclass(frozen=True)
class TrainingRequest:
    """Options of a training run."""

    dataset: Path
    out: Path  # *.ply
    preset: TrainPreset = "good"
    encoder: str = "demo"


@dataclass(eq=False)
class TrainingProgress:
    """Progress of a training run. Written by the listening thread, read by the window's."""

    stages: dict[str, float] = field(default_factory=dict)  # name -> fraction in [0, 1], in their order
    overall: float = 0.0
    left: str = ""  # "about 3 min left"
    losses: list[float] = field(default_factory=list)  # of the Gaussians, as far as they are trained
    said: list[str] = field(default_factory=list)  # lines that are no progress, the latest last

    def hear(self, line: str) -> None:
        """Take one line of what the process writes."""
        try:
            report = Report.from_json(line)
        except ValueError:
            text = printable_line(line, 300)
            if text:
                self.said = [*self.said[1 - KEPT :], text]
            return
        if report.stage == ALL_STAGES:
            self.overall, self.left = report.fraction, report.details
            return
        self.stages[report.stage] = report.fraction
        loss = report.metrics.get("loss")
        if loss is not None and [loss] != self.losses[-1:]:
            self.losses = [*self.losses, loss]


def command(request: TrainingRequest) -> list[str]:
    """The command line of a request, for this interpreter or the program beside a one-folder build."""
    program = [sys.executable, "-m", "langsplat_core"]
    if getattr(sys, "frozen", False):
        program = [str(Path(sys.executable).with_stem("langsplat"))]
    return [
        *(*program, "train", str(request.dataset), "--out", str(request.out)),
        *("--preset", request.preset, "--clip.model", request.encoder, "--progress", "lines"),
        *("--radiance.checkpoint-every", str(PREVIEW_EVERY)),
    ]


class Training:
    """Training in a process of its own, and its progress."""

    def __init__(self, request: TrainingRequest, wake: Callable[[], None]) -> None:
        """`wake` is called from another thread when there is news. OSError where it cannot be started."""
        self.request = request
        self.progress = TrainingProgress()
        self.interrupted = False
        self.previewed: Stamps = ()  # the checkpoint that is looked at
        self._wake = wake
        # Ctrl-C in the terminal is the window's; the process gets its own signal from `interrupt`.
        self.process = subprocess.Popen(
            command(request),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="backslashreplace",
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
            start_new_session=True,
        )
        assert self.process.stdout is not None
        self._listener = threading.Thread(target=self._listen, args=(self.process.stdout,), daemon=True)
        self._listener.start()

    def _listen(self, lines: IO[str]) -> None:
        for line in lines:
            self.progress.hear(line)
            self._wake()
        self.process.wait()
        self._wake()

    @property
    def exit_code(self) -> int | None:
        """The exit code; None while the process runs, or while what it wrote is still being read."""
        return None if self._listener.is_alive() else self.process.poll()

    def interrupt(self) -> None:
        """Ask the process to stop soon; what is finished is kept."""
        self.interrupted = True
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)

    def end(self, patience: float = 5.0) -> None:
        """End the process, killed after `patience` seconds: the window closes."""
        self.interrupt()
        try:
            self.process.wait(patience)
        except subprocess.TimeoutExpired:
            self.process.kill()


# Where one stood in a scene and what was asked there, to be found again. It holds nothing of the scene.


@dataclass(frozen=True, eq=False)
class Visit:
    """State of a scene that was left, to be found again."""

    view: OrbitCamera | None
    opening_camera: Camera | None
    camera_index: int | None
    display: Display
    latent_level: int
    queries: tuple[Query, ...]  # without their answers
    selected: int | None  # index of the query whose details are shown
    canonical: tuple[str, ...]
    keyframes: tuple[Keyframe, ...]
    ruler: Ruler
    clip: Clip
    things: Things
    notes: tuple[Note, ...]
    kept: tuple[Things, tuple[Note, ...]]
    project: Path | None
    count: int  # Gaussians


def visit_of(state: ViewerState) -> Visit:
    chosen = [place for place, query in enumerate(state.queries) if query is state.selected]
    return Visit(
        view=state.view,
        opening_camera=state.opening_camera,
        camera_index=state.camera_index,
        display=state.picture.display,
        latent_level=state.latent_level,
        queries=tuple(unanswered(query) for query in state.queries),
        selected=chosen[0] if chosen else None,
        canonical=state.canonical,
        keyframes=state.record.keyframes,
        ruler=state.ruler,
        clip=state.settings.clip,
        things=state.things,
        notes=state.notes,
        kept=state.kept,
        project=state.project,
        count=0 if state.scene is None else len(state.scene.gaussians),
    )


def unanswered(query: Query) -> Query:
    """Return the same question without its answer, to be asked again."""
    return Query(query.phrase, query.slot, query.shown_since, cut=query.cut)


T = TypeVar("T")


class Surface(Protocol):
    """The image on screen, as far as actions need it."""

    def point_at(self, u: float, v: float) -> Array | None:
        """(3,) world point of the surface at a place in the image, fractions from the top left corner."""

    def depths(self) -> Array | None:
        """(H, W) camera z of the surface all over the image, world units, 0 where nothing is drawn; its
        size may be another than the window's. None while there is no image."""

    def capture(self, request: RenderRequest) -> Array:
        """(H, W, 3) uint8, or (H, W, 4) of a transparent image: the request at full resolution."""


@dataclass(frozen=True)
class Services:
    """Functions that the viewer needs from the layers below; tests put small fakes here."""

    load_scene: Callable[[Path], Scene]
    load_encoder: LoadEncoder
    encoder_id: str = ""  # in place of the text encoder that a scene names
    # the first use of a backend is slow
    warm_up: Callable[[Scene, str, Progress], None] = lambda scene, backend, progress: None

    def engine(self, scene: Scene) -> QueryEngine:
        return QueryEngine(scene, self.load_encoder, encoder_id=self.encoder_id)


@dataclass(frozen=True, eq=False)
class Moment:
    """The queries and how they were looked at; what is selected, hidden, deleted and moved."""

    queries: tuple[tuple[Query, int | None, int, float | None], ...]  # with slot, shown_since and cut
    selected: Query | None
    picture: PictureConfig
    latent_level: int
    level: LevelChoice
    settings: ViewSettings
    overlays: tuple[str, ...]
    marks: PackedMarks
    moves: tuple[Move, ...]
    keyframes: tuple[Keyframe, ...]
    things: Things
    notes: tuple[Note, ...]


@dataclass(eq=False)
class History:
    """Moments to return to, the nearest one last."""

    past: list[Moment] = field(default_factory=list)
    future: list[Moment] = field(default_factory=list)
    marks: Pair | None = None  # as they were packed last
    setting: str = ""  # that was changed by the last step, where others of it may join the step
    set_at: float = 0.0  # when, seconds on the window's clock


@dataclass(eq=False)
class Viewer:
    """The viewer's state together with what acts on it."""

    services: Services
    state: ViewerState = field(default_factory=ViewerState)
    worker: Worker = field(default_factory=Worker)
    recorder: Worker = field(default_factory=Worker)  # films: minutes, while one looks and searches on
    watch: Watch = field(default_factory=Watch)  # over the files of the scene shown
    visits: dict[Path, Visit] = field(default_factory=dict)  # of scenes that were left
    shelf: Shelf = field(default_factory=Shelf)
    engine: QueryEngine | None = None  # of the scene shown; asked on the worker only
    describer: Describer | None = None  # of the same scene, once it was needed
    histogram: tuple[tuple[object, ...], Histogram | None] | None = None  # the last one, and what it is of
    pivot: tuple[Scene, Array, Array] | None = None  # of what is selected in which scene, a point (3,)
    out_of_sight: tuple[OutlineView, Marks, Array] | None = None  # nodes with nothing shown, of which
    beside: "Viewer | None" = None  # of a second scene, seen and asked as this one is
    linked: tuple[OrbitCamera | None, tuple[str, ...]] = (None, ())  # view and canonical phrases given to it
    surface: Surface | None = None
    training: Training | None = None  # under way
    history: History = field(default_factory=History)
    clock: float = 0.0  # seconds, as of the last frame

    def run(
        self,
        label: str,
        work: Callable[[Progress], T],
        done: Callable[[T], None] = lambda result: None,
        failed: Callable[[str], None] | None = None,
    ) -> Job:
        """Have the worker do `work`; `take_results` then calls `done` with its result, or `failed` with the
        reason, which by default is said."""
        return self.worker.submit(label, work, done, failed or self.say_error)

    @property
    def encoder_id(self) -> str:
        """The text encoder of the scene shown, "" without one."""
        field = None if self.state.scene is None else self.state.scene.language
        return "" if field is None else self.services.encoder_id or field.encoder_id

    @property
    def has_encoder_here(self) -> bool:
        """True where the text encoder lies on this machine: a hub id may mean a download."""
        encoder = self.encoder_id
        return encoder == DEMO or (encoder != "" and Path(encoder).expanduser().is_dir())

    def save(self, path: Path, write: Callable[[], object], more: str = "") -> Path | None:
        """Have `write` write the file `path`, and say so, or why it is not saved and return None."""
        try:
            write()
        except (OSError, ValueError, LangSplatError) as error:
            self.say_error(f"{path}: not saved ({one_line(error)})")
            return None
        self.state.say(f"saved {path}{more}")
        return path

    def take_results(self) -> None:
        """Hand over what other threads have finished, which arrives nowhere else. Call once per frame."""
        self.worker.poll()
        self.recorder.poll()

    def say_error(self, reason: str) -> None:
        """Add one line to the messages area, as an error."""
        self.state.say(reason, is_error=True)


# History: queries, view settings, notes and marks as they were before each change, to be undone.

MOST_STEPS = 100  # steps that can be undone
GESTURE = 1.0  # seconds: changes of one setting that follow each other sooner are one step


def now(viewer: Viewer) -> Moment:
    state = viewer.state
    viewer.history.marks = pack(state.selection.marks, viewer.history.marks)
    return Moment(
        queries=tuple((query, query.slot, query.shown_since, query.cut) for query in state.queries),
        selected=state.selected,
        picture=state.picture,
        latent_level=state.latent_level,
        level=state.level,
        settings=state.settings,
        overlays=state.preferences.overlays,
        marks=viewer.history.marks.packed,
        moves=state.selection.moves,
        keyframes=state.record.keyframes,
        things=state.things,
        notes=state.notes,
    )


def remember(viewer: Viewer, setting: str = "") -> None:
    """Make what follows one step that can be undone; call it before a change. `setting` names one that is
    moved, as sliders are: its changes in quick succession are one step."""
    history = viewer.history
    goes_on = setting != "" and setting == history.setting and viewer.clock - history.set_at < GESTURE
    history.setting, history.set_at = setting, viewer.clock
    if not goes_on:
        history.past = [*history.past[1 - MOST_STEPS :], now(viewer)]
        history.future = []


def let_go(viewer: Viewer) -> None:
    """Drop the answers of queries that are in no list any more but in what can be undone: numbers for every
    Gaussian. They are asked anew when they come back."""
    listed = {id(query) for query in viewer.state.queries}
    for moment in (*viewer.history.past, *viewer.history.future):
        for query, *_ in moment.queries:
            if id(query) not in listed:
                query.result = query.automatic = None
                query.things, query.pending = (), False


def forget(viewer: Viewer) -> None:
    """Empty the history: nothing that was done in another scene can be undone."""
    history = viewer.history
    history.past, history.future, history.marks, history.setting = [], [], None, ""
