"""`langsplat transform`, `crop` and `clean`: scenes edited by numbers; what belongs to them goes along."""

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from langsplat_core.arrays import Array
from langsplat_core.cli.run import OutputConsole
from langsplat_core.compaction.clean import CleanReport, clean_scene
from langsplat_core.config import CleanConfig, Positive, Range
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import check_keeps, check_writable, load_scene, save_scene
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.selection import above_plane, in_box, in_sphere
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
    """Move, rotate and scale a whole scene, colours seen from the side, cameras and metres per unit
    included. Steps are taken in this order: --matrix, --up, --rotate, --scale, --move."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""
    out: tyro.conf.Positional[Path]
    """Scene to write: .ply, .spz or .splat."""
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
    """Keep the Gaussians whose centres lie in all of the given boxes, spheres and half-spaces, with all that
    belongs to them; or with --outside everything else. World units."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""
    out: tyro.conf.Positional[Path]
    """Scene to write: .ply, .spz or .splat."""
    box: Annotated[tyro.conf.UseAppendAction[tuple[Box, ...]], tyro.conf.arg(metavar="X Y Z X Y Z")] = ()
    """Two opposite corners; may be given several times, as the others."""
    sphere: Annotated[tyro.conf.UseAppendAction[tuple[Four, ...]], tyro.conf.arg(metavar="X Y Z R")] = ()
    """Centre and radius."""
    plane: Annotated[tyro.conf.UseAppendAction[tuple[Four, ...]], tyro.conf.arg(metavar="NX NY NZ D")] = ()
    """Normal and offset: keeps what has NX x + NY y + NZ z >= D."""
    outside: bool = False
    """Keep what lies outside of them together instead."""

    def run(self) -> None:
        check_writable(self.out)
        check_keeps(self.out, self.scene)
        if not (self.box or self.sphere or self.plane):
            raise InputError("nothing to crop to: give --box, --sphere or --plane")
        scene = load_scene(self.scene)
        keep = self.inside(scene.gaussians.means) != self.outside
        if not keep.any():
            raise InputError(f"the crop holds none of the {len(keep)} Gaussians; {_extent(scene)}")
        save_scene(self.out, replace(scene.take(keep), path=self.out))
        print(f"{self.out}: {keep.sum()} of {len(keep)} Gaussians")

    def inside(self, means: Array) -> Array:
        """(N, 3) positions -> (N,) bool, whether each is in all of the shapes."""
        inside = np.ones(len(means), bool)
        for numbers in self.box:
            corners = np.array(numbers).reshape(2, 3)
            inside &= in_box(means, corners.min(0), corners.max(0))
        for *centre, radius in self.sphere:
            if not radius > 0:
                raise InputError(f"--sphere: a radius of {radius:g} holds nothing; it must be above 0")
            inside &= in_sphere(means, np.array(centre), radius)
        for *normal, offset in self.plane:
            if not any(normal):
                raise InputError("--plane: the normal is 0 0 0; give a direction")
            inside &= above_plane(means, np.array(normal), offset)
        return inside


@dataclass(frozen=True)
class Clean:
    """Remove floaters: small regions that touch nothing and veils in free space, as many as the allowed loss
    of PSNR lets go, the least visible first. The loss is measured on photographs that the scene was not
    trained on where --photos has some, else derived from how far its images change."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""
    out: tyro.conf.Positional[Path]
    """Scene to write: .ply, .spz or .splat."""
    photos: Path | None = None
    """Dataset the scene was trained on: true floaters then cost nothing, and more of them go."""
    json: bool = False
    """Print JSON."""
    config: Annotated[CleanConfig, tyro.conf.arg(name="")] = field(default_factory=CleanConfig)

    def run(self) -> None:
        with TerminalProgress() as progress:
            report = clean_scene(self.scene, self.out, self.config, self.photos, progress)
        if self.json:
            print(json.dumps({"out": str(self.out), "removed": report.removed, **asdict(report)}, indent=1))
            return
        console = OutputConsole()
        for line in (*_lines(report), f"written: {self.out}"):
            console.print(line, soft_wrap=True, highlight=False, markup=False)


def _lines(report: CleanReport) -> list[str]:
    how = "on photographs" if report.assumed_psnr is None else f"if the scene has {report.assumed_psnr:g} dB"
    lines = [
        f"removed: {report.removed} of {report.gaussians} Gaussians: {report.regions} in small regions, "
        f"{report.free_space} in free space, {report.invalid} that cannot be drawn",
        f"loss: {report.loss:.3f} dB of {report.budget:g} allowed, worst view {report.worst_loss:.2f} dB "
        f"({how}; {report.measuring_views} views; {report.views_from})",
    ]
    if report.psnr_before is not None and report.psnr_after is not None:
        lines.append(f"PSNR: {report.psnr_before:.2f} dB before, {report.psnr_after:.2f} after")
    if report.kept:
        lines.append(f"kept: {report.kept} more are suspected; --max-psnr-loss allows more")
    return lines


def _extent(scene: Scene) -> str:
    """The extent of a scene's Gaussians, in words."""
    means = scene.gaussians.means[np.isfinite(scene.gaussians.means).all(1)]
    if not len(means):
        return "the scene holds none that lies anywhere"
    low, high = (" ".join(f"{number:.4g}" for number in corner) for corner in (means.min(0), means.max(0)))
    return f"they lie between {low} and {high}"
