"""The viewer without its window: its state, what acts on it, and what it needs from elsewhere."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from langsplat_core.arrays import Array
from langsplat_core.progress import Progress
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import LoadEncoder, QueryEngine
from langsplat_core.scene import Scene
from langsplat_viewer.files.bookmarks import Shelf
from langsplat_viewer.files.watching import Watch
from langsplat_viewer.jobs import Worker
from langsplat_viewer.marks.packed_marks import Pair
from langsplat_viewer.state import ViewerState
from langsplat_viewer.training import Training
from langsplat_viewer.visits import Visit


class Surface(Protocol):
    """The picture on screen, as far as actions need it."""

    def point_at(self, u: float, v: float) -> Array | None:
        """(3,) world point of the surface at a place in the picture, fractions from the top left corner."""

    def depths(self) -> Array | None:
        """(H, W) camera z of the surface all over the picture, world units, 0 where nothing is drawn; its
        size may be another than the window's. None while there is no picture."""

    def capture(self, state: ViewerState) -> Array:
        """(H, W, 3) uint8, or (H, W, 4) of a transparent picture: the scene as shown, at full resolution
        and without panels."""


@dataclass(frozen=True)
class Services:
    """What the viewer needs from the layers below; tests put small fakes here."""

    load_scene: Callable[[Path], Scene]
    load_encoder: LoadEncoder
    encoder_id: str = ""  # in place of the text encoder that a scene names
    # the first use of a backend is slow
    warm_up: Callable[[Scene, str, Progress], None] = lambda scene, backend, progress: None

    def engine(self, scene: Scene) -> QueryEngine:
        """What answers queries on `scene`."""
        return QueryEngine(scene, self.load_encoder, encoder_id=self.encoder_id)


@dataclass(eq=False)
class History:
    """Moments (`actions.history`) to return to, the nearest one last."""

    past: list[Any] = field(default_factory=list)
    future: list[Any] = field(default_factory=list)
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
    surface: Surface | None = None
    training: Training | None = None  # under way
    history: History = field(default_factory=History)
    clock: float = 0.0  # seconds, as of the last `actions.tick`
