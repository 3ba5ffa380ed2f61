"""What the panel "Record" knows: a camera path, where it is played, and what film is wanted of it."""

from dataclasses import dataclass
from functools import lru_cache

from langsplat_viewer.camera.controls import OrbitCamera
from langsplat_viewer.camera.flight import Flight, Keyframe

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
    size: tuple[int, int] = (1280, 720)  # of films, and of pictures that are no screenshots, pixels
    fps: float = 30.0
    film_typed: str = ""  # where the film goes; empty: a new name
    path_typed: str = ""  # a file with a path
    clipboard: str = ""  # put there at the next frame


@lru_cache(maxsize=2)
def flight_of(keyframes: tuple[Keyframe, ...]) -> Flight:
    """The path through them; its curve is computed once for many frames of a window."""
    return Flight(keyframes)
