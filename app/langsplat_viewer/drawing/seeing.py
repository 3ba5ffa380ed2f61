"""Settings of looking that are neither the camera's nor the picture's: plain data, a part of the state."""

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

from langsplat_core.arrays import Array
from langsplat_core.config import Display

SplitMode = Literal["off", "wipe", "levels"]
AT_RANGE = (0.02, 0.98)  # of the area's width, where the line can be: it stays within reach


@dataclass(frozen=True)
class Split:
    """Several pictures of one camera in the scene's area.

    "wipe": the display that is chosen left of a line, `second` right of it. "levels": three columns, from
    subpart to whole, with the relevancy of the shown queries at each level where a display of answers is
    chosen, else with the latents.
    """

    mode: SplitMode = "off"
    second: Display = "depth"
    second_level: int = 2  # index into scene.LEVELS, where latents are shown
    at: float = 0.5  # where the line is, of the area's width


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


SIZE_RANGE = (0.1, 1.0)
MOST_DEGREE = 3


@dataclass(frozen=True)
class Splats:
    """How the Gaussians are drawn, for looking alone: answers and files have them as they are."""

    size: float = 1.0  # factor of every axis, within SIZE_RANGE: small ones are points, and show gaps
    sh_degree: int = MOST_DEGREE  # at most; 0: colours that do not depend on the direction


@dataclass(frozen=True)
class Clip:
    """Between which depths Gaussians are drawn, told by their centres; world units from the eye. For looking
    into things: answers and files have all of them."""

    near: float = 0.0
    far: float = math.inf

    def beyond(self, plane: float) -> "Clip":
        """The same in depths of a camera before which the eye's plane lies `plane` away."""
        return Clip(self.near + plane, self.far + plane)

    def keeps(self, depths: Array) -> Array:
        """(N,) bool, of (N,) camera z."""
        kept: Array = (depths > self.near) & (depths <= self.far)
        return kept


UNCLIPPED = Clip()


@dataclass(frozen=True)
class Seeing:
    """How the scene is looked at."""

    split: Split = Split()
    ruler: Ruler = Ruler()
    splats: Splats = Splats()
    clip: Clip = UNCLIPPED
    transparent: bool = False  # pictures are saved without a background
    fade: float = 0.0  # how much of the photograph of a training camera lies over the picture, 0 to 1
