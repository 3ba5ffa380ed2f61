"""`langsplat scale`: how long a scene's world unit is."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.config import Positive
from langsplat_core.errors import InputError
from langsplat_core.formats import load_without_language, write_metres
from langsplat_core.ranges import Range

Coordinate = Annotated[float, Range(-1e12, 1e12)]
Span = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class Scale:
    """Say how long a scene's unit is, so that answers are in metres: by a known length in it, or by a
    factor. Without either, print what the scene says. Only the header of the .ply is changed."""

    scene: tyro.conf.Positional[Path]
    """The scene, *.ply."""
    metres: Positive | None = None
    """A known length, between the two points of --between."""
    between: Span | None = None
    """Two points that are --metres apart, x y z x y z in world units."""
    metres_per_unit: Positive | None = None
    """How long a unit is."""

    def run(self) -> None:
        if (self.metres is None) != (self.between is None):
            raise InputError(
                "--metres and --between belong together: a length, and the points it lies between"
            )
        if self.metres is not None and self.metres_per_unit is not None:
            raise InputError("give either --metres with --between, or --metres-per-unit")
        factor = self.metres_per_unit
        if self.metres is not None and self.between is not None:
            factor = metres_per_unit(self.metres, self.between)
        if factor is not None:
            write_metres(self.scene, factor)
        stored = load_without_language(self.scene).metres_per_unit
        print(f"{self.scene}: {'no scale' if stored is None else f'{stored:.6g} m per unit'}")


def metres_per_unit(metres: float, between: Span) -> float:
    """From a length in metres and two points in world units. InputError unless both lengths are positive."""
    units = math.dist(between[:3], between[3:])
    if not (0 < metres < math.inf and 0 < units < math.inf):
        raise InputError(
            f"{metres:g} m between points {units:g} units apart: both must be above 0 and finite"
        )
    return metres / units
