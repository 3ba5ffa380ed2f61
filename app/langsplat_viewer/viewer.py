"""The viewer without its window: state, history, services, and processes of commands."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from pathlib import Path
from typing import IO, Any, Concatenate, ParamSpec, Protocol, TypeVar

from langsplat_core.arrays import Array
from langsplat_core.errors import LangSplatError, printable_line
from langsplat_core.progress import AS_LINES, Progress, Report, TimeLeft
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import LoadEncoder, QueryEngine
from langsplat_core.scene import LanguageField, Scene
from langsplat_core.semantics.encoders import DEMO
from langsplat_core.semantics.weights import local_path
from langsplat_viewer.disk import Stamps, Watch
from langsplat_viewer.jobs import Job, Worker, one_line
from langsplat_viewer.rendering.request import RenderRequest
from langsplat_viewer.session import Point, Session, point_of
from langsplat_viewer.state import OpenScene, TrainingForm, ViewerState, Visit

PREVIEW_EVERY = 100  # steps between the checkpoints that can be looked at
KEPT = 20  # lines of what it says that are kept


@dataclass(eq=False)
class ProcessProgress:
    """Progress of a command. Written by the listening thread, read by the window's."""

    stages: dict[str, float] = field(default_factory=dict)  # name -> fraction in [0, 1], in their order
    stage: str = ""  # the latest
    left: TimeLeft = field(default_factory=TimeLeft)  # of the latest
    curves: dict[str, list[float]] = field(default_factory=dict)  # metrics of a training, as far as it is
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
        if report.stage != self.stage:
            if self.stage:
                self.stages[self.stage] = 1.0  # it may end before its last report
            self.stage, self.left = report.stage, TimeLeft()
        self.stages[report.stage] = report.fraction
        self.left.hear(report.fraction)
        for name, value in report.metrics.items():
            curve = self.curves.get(name, [])
            if curve[-1:] != [value]:
                self.curves = {**self.curves, name: [*curve, value]}


def program() -> list[str]:
    """Return what runs `langsplat`: this interpreter, or the program in a one-folder build."""
    if getattr(sys, "frozen", False):
        return [str(Path(sys.executable).with_stem("langsplat"))]
    return [sys.executable, "-m", "langsplat_core"]


def training_words(form: TrainingForm) -> list[str]:
    """Return the command line of a training."""
    return [
        *(*program(), "train", form.dataset, "--out", form.out),
        *("--preset", form.preset, "--clip.model", form.encoder),
        *("--radiance.checkpoint-every", str(PREVIEW_EVERY)),
        *(("--gaussians", form.gaussians) if form.gaussians else ()),
    ]


class CommandProcess:
    """A command of `langsplat` in a process of its own, and its progress."""

    def __init__(self, words: Sequence[str], wake: Callable[[], None]) -> None:
        """`wake` is called from another thread when there is news. OSError where it cannot be started."""
        self.progress = ProcessProgress()
        self.interrupted = False
        self._wake = wake
        # Ctrl-C in the terminal is the window's; the process gets its own signal from `interrupt`.
        self.process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="backslashreplace",
            env=os.environ | {"PYTHONUNBUFFERED": "1", AS_LINES: "lines"},
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
        self.process.send_signal(signal.SIGTERM)  # nothing where it has ended

    def end(self, patience: float = 5.0) -> None:
        """End the process, killed after `patience` seconds: the window closes."""
        self.interrupt()
        try:
            self.process.wait(patience)
        except subprocess.TimeoutExpired:
            self.process.kill()


class Training(CommandProcess):
    """Training in a process of its own."""

    def __init__(self, form: TrainingForm, wake: Callable[[], None]) -> None:
        super().__init__(training_words(form), wake)
        self.out = Path(form.out)
        self.previewed: Stamps = ()  # the checkpoint that is looked at


T = TypeVar("T")


class ShownImage(Protocol):
    """The image on screen, as far as actions need it."""

    def point_at(self, u: float, v: float) -> Array | None:
        """Return (3,) world point of the surface at a place in the image, fractions from the top left."""

    def depths(self) -> Array | None:
        """Return (H, W) camera z of the surface all over the image, world units, 0 where nothing is drawn.

        Its size may be another than the window's. None while there is no image.
        """

    def capture(self, request: RenderRequest) -> Array:
        """Return (H, W, 3) uint8, or (H, W, 4) of a transparent image: the request at full resolution."""


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


MOST_STEPS = 100  # steps that can be undone
GESTURE = 1.0  # seconds: changes of one setting that follow each other sooner are one step


@dataclass(eq=False)
class History:
    """Sessions to return to, the nearest one last."""

    past: list[Session] = field(default_factory=list)
    future: list[Session] = field(default_factory=list)
    setting: str = ""  # that was changed by the last step, where others of it may join the step
    set_at: float = 0.0  # when, seconds on the window's clock


@dataclass(eq=False)
class Viewer:
    """The viewer's state with its worker threads, services and history."""

    services: Services
    state: ViewerState = field(default_factory=ViewerState)
    worker: Worker = field(default_factory=Worker)
    recorder: Worker = field(default_factory=Worker)  # films: minutes, while one looks and searches on
    watch: Watch = field(default_factory=Watch)  # over the files of the scene shown
    visits: dict[Path, Visit] = field(default_factory=dict)  # of scenes that were left
    folder: Path | None = None  # of the preferences; None: nothing is remembered
    history: History = field(default_factory=History)
    engine: QueryEngine | None = None  # of the scene shown; asked on the worker only
    describer: Describer | None = None  # of the same scene, once it was needed
    beside: "Viewer | None" = None  # of a second scene, seen and asked as this one is
    surface: ShownImage | None = None
    training: Training | None = None  # under way
    clock: float = 0.0  # seconds, as of the last frame

    def change(self, setting: str = "", **values: Any) -> None:
        """Change fields of the session, as one step that can be undone, unless they are so already.

        `setting` names one that is moved, as sliders are: its changes in quick succession are one step.
        """
        session = replace(self.state.session, **values)
        if session != self.state.session:
            self.remember(setting)
            self.state.session = session

    def put(self, **values: Any) -> None:
        """Change fields of the session without a step of its own to undo."""
        self.state.session = replace(self.state.session, **values)

    def remember(self, setting: str = "") -> None:
        """Make what follows one step that can be undone; `setting` as in `change`."""
        history = self.history
        goes_on = setting != "" and setting == history.setting and self.clock - history.set_at < GESTURE
        history.setting, history.set_at = setting, self.clock
        if not goes_on:
            history.past = [*history.past[1 - MOST_STEPS :], self.state.session]
            history.future = []

    def run(
        self,
        label: str,
        work: Callable[[Progress], T],
        done: Callable[[T], None] = lambda result: None,
        failed: Callable[[str], None] | None = None,
    ) -> Job:
        """Have the worker do `work`, then `done` with its result or `failed`, by default `say_error`."""
        return self.worker.submit(label, work, done, failed or self.say_error)

    def ask_engine(
        self,
        label: str,
        work: Callable[[QueryEngine, Progress], T],
        done: Callable[[T], None],
        failed: Callable[[str], None] | None = None,
    ) -> None:
        """Have the worker do `work` with the engine; what comes of it is dropped with the scene."""
        engine = self.engine

        def here(then: Callable[[Any], None]) -> Callable[[Any], None]:
            return lambda found: then(found) if self.engine is engine else None

        if engine is not None:
            report = here(failed) if failed else self.say_error
            self.run(label, lambda progress: work(engine, progress), here(done), report)

    def unsaved(self) -> list[Visit]:
        """Return the scenes, the one shown first, with notes that no project holds."""
        seen = self.state.open
        shown = {} if seen is None else {seen.path.absolute(): self.state.visit(seen)}
        left = [visit for path, visit in self.visits.items() if path not in shown]
        return [visit for visit in (*shown.values(), *left) if visit.saved.lacks_notes(visit.session)]

    def searchable(self) -> QueryEngine | None:
        """Return the engine of a scene that can be searched; where there is none say why."""
        if self.state.open is None:
            self.say_no_scene("search it")
        elif self.state.why_no_field:
            self.say_error(self.state.why_no_field)
        return self.engine if self.state.has_field else None

    def say_no_scene(self, then: str) -> None:
        """Say that a scene must be open before what is to be done `then`."""
        opening = self.state.opening
        first = "open a scene first" if opening is None else f"{opening.name} is being opened: wait for it"
        self.say_error(f"{first}, then {then}")

    @property
    def language(self) -> LanguageField | None:
        """The language field of the scene shown, with what was taught since."""
        if self.engine is None or self.engine.scene.language is None:
            return None
        return replace(self.engine.scene.language, taught=tuple(self.engine.taught.values()))

    @property
    def has_percentages(self) -> bool:
        """True where probabilities were measured: others are not shown."""
        return self.engine is not None and self.engine.basis.calibration is not None

    def describing(self, engine: QueryEngine, progress: Progress) -> Describer:
        """Return the describer of an engine, made once; on the worker only."""
        kept = self.describer
        return kept if kept is not None and kept.engine is engine else Describer(engine, progress=progress)

    def point_at(self, u: float, v: float, to: str) -> Point | None:
        """Return the surface's point at fractions of the scene's area; say what cannot be done without."""
        point = None if self.surface is None else self.surface.point_at(u, v)
        if point is None:
            self.state.say(f"nothing under the cursor to {to}")
            return None
        return point_of(point)

    @property
    def encoder_id(self) -> str:
        """The text encoder of the scene shown, "" without one."""
        field = None if self.state.open is None else self.state.open.scene.language
        return "" if field is None else self.services.encoder_id or field.encoder_id

    @property
    def has_encoder_here(self) -> bool:
        """True where the text encoder lies on this machine: a hub id may mean a download."""
        encoder = self.encoder_id
        return encoder == DEMO or (encoder != "" and os.path.isdir(local_path(encoder)))

    def save(self, path: Path, write: Callable[[], object], more: str = "") -> Path | None:
        """Have `write` write the file `path`, and say so, or why it is not saved and return None."""
        try:
            write()
        except (OSError, ValueError, LangSplatError) as error:
            self.say_error(f"{path}: not saved ({one_line(error).removeprefix(f'{path}: ')})")
            return None
        self.state.say(f"saved {path}{more}", file=path)
        return path

    def take_results(self) -> None:
        """Deliver the results of other threads; only this does. Call once per frame."""
        self.worker.poll()
        self.recorder.poll()

    def say_error(self, reason: str) -> None:
        self.state.say(reason, is_error=True)


P = ParamSpec("P")
SceneAction = Callable[Concatenate[Viewer, OpenScene, P], T]


def needs_scene(then: str = "") -> Callable[[SceneAction[P, T]], Callable[Concatenate[Viewer, P], T | None]]:
    """Decorate an action that takes the open scene after the viewer: where none is open it is not done.

    then: what is not done, to be said in that case: "save a picture of it".
    """

    def decorated(act: SceneAction[P, T]) -> Callable[Concatenate[Viewer, P], T | None]:
        @wraps(act)
        def do(viewer: Viewer, *arguments: P.args, **options: P.kwargs) -> T | None:
            seen = viewer.state.open
            if seen is not None:
                return act(viewer, seen, *arguments, **options)
            if then:
                viewer.say_no_scene(then)
            return None

        return do

    return decorated
