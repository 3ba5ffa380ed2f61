"""Everything a frame depends on, as one dataclass: actions change it, panels and the canvas read it."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice, PictureConfig
from langsplat_core.display.colour_maps import MAX_QUERIES
from langsplat_core.display.compose import HeatRanges
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.suggestions import Suggestions
from langsplat_core.scene import Scene
from langsplat_core.semantics.relevancy import FLOOR
from langsplat_viewer.controls import Extent, OrbitCamera

SLOTS = MAX_QUERIES  # queries shown at a time: one colour each
NO_HEAT = (FLOOR, 1.0)  # heat range of a slot without an answer, whose relevancy is 0
MAX_MESSAGES = 50
GLIDE_SECONDS = 0.35


@dataclass(eq=False)
class Query:
    """One line of the query list."""

    phrase: str
    slot: int | None = None  # index of its colour while shown, None while hidden
    result: QueryResult | None = None
    reading: str = ""  # how the phrase was understood, where it has structure
    problem: str = ""  # why it has no result, one line
    meant: str = ""  # the phrase with its unknown words replaced by known ones, where there are such
    pending: bool = True


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
    """How the picture on screen was made."""

    milliseconds: float = 0.0
    width: int = 0  # pixels
    height: int = 0
    scale: float = 1.0  # of the window's resolution, below 1 while the camera moves on a slow machine


@dataclass(eq=False)
class ViewerState:
    """The viewer without its window."""

    scene: Scene | None = None
    path: Path | None = None
    opening: Path | None = None  # the file being read, until it is open or has failed
    extent: Extent | None = None  # there whenever a scene is
    latent: Array | None = None  # (3, N, 3) latent colours per level, None without a language field

    view: OrbitCamera | None = None
    glide: Glide | None = None
    camera_index: int | None = None  # training camera last jumped to
    fly_speed: float = 0.5  # scene radii per second

    picture: PictureConfig = field(default_factory=PictureConfig)
    latent_level: int = 2  # index into scene.LEVELS
    level: LevelChoice = "auto"
    queries: list[Query] = field(default_factory=list)
    typed: str = ""
    asked: list[str] = field(default_factory=list)  # what was searched for, the oldest first
    recalled: int = 0  # index into `asked` of the phrase last recalled; its length: none
    suggestions: Suggestions = field(default_factory=Suggestions)
    suggestions_of: Scene | None = None  # the scene for which they were looked for
    focus_input: bool = False  # the query box takes the keyboard at the next frame

    path_typed: str = ""
    messages: list[Message] = field(default_factory=list)
    stats: FrameStats = field(default_factory=FrameStats)
    backend: str = ""
    size: tuple[int, int] = (1, 1)  # pixels of the scene's area
    coarse_while_moving: bool = True
    show_panel: bool = True
    show_help: bool = False

    def say(self, text: str, is_error: bool = False) -> None:
        """Add one line to the messages area."""
        message = Message(" ".join(text.split()), is_error)
        if not self.messages or self.messages[-1] != message:
            self.messages = [*self.messages[1 - MAX_MESSAGES :], message]

    def shown(self) -> list[Query | None]:
        """Answered queries by slot, as many as the highest slot in use."""
        by_slot = {q.slot: q for q in self.queries if q.slot is not None and q.result is not None}
        return [by_slot.get(slot) for slot in range(max(by_slot, default=-1) + 1)]

    def heat_ranges(self) -> HeatRanges:
        """The relevancies at which the heat of each slot is 0 and 1."""
        results = (None if q is None else q.result for q in self.shown())
        return tuple(NO_HEAT if result is None else result.heat_range for result in results)

    def layers_key(self) -> tuple[object, ...]:
        """Changes exactly when `latent_rgb` or `relevancies` would. Holds the objects themselves: the id of
        a result that is gone may be given to the next one."""
        wants_latent = self._shows_latents() and self.latent is not None
        results = tuple(None if q is None else q.result for q in self.shown())
        return self.scene, self.latent_level if wants_latent else None, results

    def latent_rgb(self) -> Array | None:
        """(N, 3) colours of the latents, while they are shown."""
        if not self._shows_latents() or self.latent is None:
            return None
        colours: Array = self.latent[self.latent_level]
        return colours

    def _shows_latents(self) -> bool:
        return DISPLAYS[self.picture.display].extra == "latent"

    def relevancies(self) -> Array | None:
        """(N, Q) float32 relevancy of the shown queries at their levels; an unused slot is zero."""
        shown = self.shown()
        if self.scene is None or not shown:
            return None
        columns = np.zeros((len(self.scene.gaussians), len(shown)), np.float32)
        for column, query in enumerate(shown):
            if query is not None and query.result is not None:
                columns[:, column] = query.result.relevancy[query.result.level]
        return columns
