"""`langsplat transform`, `crop` and `scale`: scenes edited by numbers.

What belongs to them goes along.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from langsplat_core.cli.arguments import AnyScene, WrittenScene
from langsplat_core.config import Positive, Range
from langsplat_core.errors import InputError
from langsplat_core.io.ply import write_metres
from langsplat_core.io.scenes import (
    check_keeps,
    check_writable,
    load_scene,
    load_without_language,
    save_scene,
)
from langsplat_core.query.selection import in_box
from langsplat_core.scene import Scene
from langsplat_core.scene.transform import (
    AXES,
    IDENTITY,
    Similarity,
    moving,
    rotating,
    scaling,
    similarity,
    transform_scene,
    turning,
)

Coordinate = Annotated[float, Range(-1e12, 1e12)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Four = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
Box = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Turn = tuple[Literal["x", "y", "z"], float]


@dataclass(frozen=True)
class Transform:
    """Move, rotate and scale a whole scene, colours seen from the side, cameras and metres per unit included.

    Steps are taken in this order: --matrix, --up, --rotate, --scale, --move.
    """

    scene: AnyScene
    out: WrittenScene
    matrix: Annotated[tuple[Four, Four, Four, Four] | None, tyro.conf.arg(metavar="16 NUMBERS")] = None
    """A 4x4 matrix, row by row, as registration gives one: a rotation times a scale, and a move."""
    up: Axis | None = None
    """Turn the scene upright: what is up in it, by its cameras, becomes this axis."""
    rotate: Annotated[tyro.conf.UseAppendAction[tuple[Turn, ...]], tyro.conf.arg(metavar="AXIS DEGREES")] = ()
    """About the x, y or z axis through the origin, right-handed; may be given several times."""
    scale: Positive = 1.0
    """Factor about the origin. With the metres per unit that `langsplat inspect` prints, a unit becomes a
    metre; `langsplat scale` says how long a unit is and moves nothing."""
    move: Annotated[Point, tyro.conf.arg(metavar="X Y Z")] = (0.0, 0.0, 0.0)
    """World units."""

    def run(self) -> None:
        check_writable(self.out)
        check_keeps(self.out, self.scene)
        scene = load_scene(self.scene)
        to = self._similarity(scene)
        save_scene(self.out, replace(transform_scene(scene, to), path=self.out))
        rows = "; ".join(" ".join(f"{number:.9g}" for number in row) for row in to.matrix)
        print(f"{self.out}: {len(scene.gaussians)} Gaussians, {len(scene.cameras)} cameras; matrix {rows}")

    def _similarity(self, scene: Scene) -> Similarity:
        to = IDENTITY if self.matrix is None else similarity(np.array(self.matrix))
        if self.up is not None:
            to = to.then(turning(to.rotation @ scene.up(), AXES[self.up]))
        for axis, degrees in self.rotate:
            to = to.then(rotating(AXES[axis], degrees))
        return to.then(scaling(self.scale)).then(moving(np.array(self.move)))


@dataclass(frozen=True)
class Crop:
    """Keep the Gaussians whose centres lie in a box; what belongs to them goes along."""

    scene: AnyScene
    out: WrittenScene
    box: Annotated[Box, tyro.conf.arg(metavar="X Y Z X Y Z")]
    """Two opposite corners, world units."""

    def run(self) -> None:
        check_writable(self.out)
        check_keeps(self.out, self.scene)
        scene, corners = load_scene(self.scene), np.array(self.box).reshape(2, 3)
        keep = in_box(scene.gaussians.means, corners.min(0), corners.max(0))
        if not keep.any():
            raise InputError(f"the crop holds none of the {len(keep)} Gaussians; {_extent(scene)}")
        save_scene(self.out, replace(scene.take(keep), path=self.out))
        print(f"{self.out}: {keep.sum()} of {len(keep)} Gaussians")


def _extent(scene: Scene) -> str:
    """Return the extent of a scene's Gaussians, in words."""
    means = scene.gaussians.means[np.isfinite(scene.gaussians.means).all(1)]
    if not len(means):
        return "the scene holds none that lies anywhere"
    low, high = (" ".join(f"{number:.4g}" for number in corner) for corner in (means.min(0), means.max(0)))
    return f"they lie between {low} and {high}"


@dataclass(frozen=True)
class SetScale:
    """Say how long a scene's unit is, so that answers are in metres: by a known length in it, or by a factor.

    Without either, print what the scene says. Only the header of the .ply is changed.
    """

    scene: tyro.conf.Positional[Path]
    """The scene, *.ply."""
    metres: Positive | None = None
    """A known length, between the two points of --between."""
    between: Box | None = None
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
            units = math.dist(self.between[:3], self.between[3:])
            if not 0 < units < math.inf:
                raise InputError(
                    f"--between: points {units:g} units apart; their distance must be above 0 and finite"
                )
            factor = self.metres / units
        if factor is not None:
            write_metres(self.scene, factor)
        stored = load_without_language(self.scene).metres_per_unit
        print(f"{self.scene}: {'no scale' if stored is None else f'{stored:.6g} m per unit'}")
